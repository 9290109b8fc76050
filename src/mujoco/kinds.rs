//! Named objects of a model, and the solver settings.

use super::ffi;
use ffi::{mjtCone_, mjtIntegrator_, mjtJacobian_, mjtObj_, mjtSolver_};

macro_rules! kinds {
    ($($variant:ident $text:literal $object:ident $count:ident;)+) => {
        /// Kinds of named model objects.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
        #[non_exhaustive]
        pub enum ObjectKind {
            $(#[doc = concat!("A ", $text, ", one of `", stringify!($count), "`.")] $variant,)+
        }

        impl ObjectKind {
            /// The kind in words.
            pub fn text(self) -> &'static str {
                match self { $(Self::$variant => $text,)+ }
            }

            /// `mjOBJ_*`.
            pub(super) fn object(self) -> i32 {
                match self { $(Self::$variant => mjtObj_::$object as i32,)+ }
            }

            /// How many `model` has.
            pub(super) fn count(self, model: &ffi::mjModel) -> usize {
                match self { $(Self::$variant => model.$count as usize,)+ }
            }
        }
    };
}

kinds! {
    Body "body" mjOBJ_BODY nbody;
    Joint "joint" mjOBJ_JOINT njnt;
    Geom "geom" mjOBJ_GEOM ngeom;
    Site "site" mjOBJ_SITE nsite;
    Camera "camera" mjOBJ_CAMERA ncam;
    Light "light" mjOBJ_LIGHT nlight;
    Mesh "mesh" mjOBJ_MESH nmesh;
    HeightField "height field" mjOBJ_HFIELD nhfield;
    Texture "texture" mjOBJ_TEXTURE ntex;
    Material "material" mjOBJ_MATERIAL nmat;
    Pair "contact pair" mjOBJ_PAIR npair;
    Exclude "contact exclusion" mjOBJ_EXCLUDE nexclude;
    Equality "equality constraint" mjOBJ_EQUALITY neq;
    Tendon "tendon" mjOBJ_TENDON ntendon;
    Actuator "actuator" mjOBJ_ACTUATOR nu;
    Sensor "sensor" mjOBJ_SENSOR nsensor;
    Numeric "numeric" mjOBJ_NUMERIC nnumeric;
    Text "text" mjOBJ_TEXT ntext;
    Tuple "tuple" mjOBJ_TUPLE ntuple;
    Keyframe "keyframe" mjOBJ_KEY nkey;
}

macro_rules! setting {
    ($(#[$doc:meta])+ $name:ident { $($(#[$vdoc:meta])+ $variant:ident = $value:path,)+ }) => {
        $(#[$doc])+
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        pub enum $name { $($(#[$vdoc])+ $variant,)+ }

        impl $name {
            pub(super) fn to_raw(self) -> i32 {
                match self { $(Self::$variant => $value as i32,)+ }
            }

            /// `MuJoCo`'s compiler only writes values of this list; the first stands for any other.
            pub(super) fn from_raw(raw: i32) -> Self {
                $(if raw == $value as i32 { return Self::$variant; })+
                [$(Self::$variant),+][0]
            }
        }
    };
}

setting! {
    /// Time integration scheme.
    Integrator {
        /// Semi-implicit Euler, joint damping implicit.
        Euler = mjtIntegrator_::mjINT_EULER,
        /// Fourth-order Runge-Kutta.
        Rk4 = mjtIntegrator_::mjINT_RK4,
        /// Implicit in velocity.
        Implicit = mjtIntegrator_::mjINT_IMPLICIT,
    }
}

setting! {
    /// Constraint solver.
    Solver {
        /// Projected Gauss-Seidel (dual).
        Pgs = mjtSolver_::mjSOL_PGS,
        /// Conjugate gradient (primal).
        Cg = mjtSolver_::mjSOL_CG,
        /// Newton (primal).
        Newton = mjtSolver_::mjSOL_NEWTON,
    }
}

setting! {
    /// Friction cone.
    Cone {
        /// Pyramid approximation.
        Pyramidal = mjtCone_::mjCONE_PYRAMIDAL,
        /// True elliptic cone.
        Elliptic = mjtCone_::mjCONE_ELLIPTIC,
    }
}

setting! {
    /// Storage of the constraint Jacobian.
    Jacobian {
        /// Always dense.
        Dense = mjtJacobian_::mjJAC_DENSE,
        /// Always sparse.
        Sparse = mjtJacobian_::mjJAC_SPARSE,
        /// Chosen by size.
        Auto = mjtJacobian_::mjJAC_AUTO,
    }
}

/// The part of `mjOption` that decides accuracy and cost.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SolverOptions {
    /// Time step in seconds.
    pub timestep: f64,
    /// Integration scheme.
    pub integrator: Integrator,
    /// Constraint solver.
    pub solver: Solver,
    /// Friction cone.
    pub cone: Cone,
    /// Jacobian storage.
    pub jacobian: Jacobian,
    /// Largest number of solver iterations.
    pub iterations: usize,
    /// Solver stops below this scaled improvement.
    pub tolerance: f64,
    /// Iterations of the no-slip pass, 0 = off.
    pub noslip_iterations: usize,
    /// Stop of the no-slip pass.
    pub noslip_tolerance: f64,
    /// Frictional over normal constraint impedance.
    pub impratio: f64,
    /// Gravity in m/s², world frame.
    pub gravity: [f64; 3],
    /// Bits `mjDSBL_*`.
    pub disable_flags: i32,
    /// Bits `mjENBL_*`.
    pub enable_flags: i32,
}
