//! What a step leaves behind besides arrays: contacts and warnings.

use super::arrays::view;
use super::{Data, ffi};

/// One detected contact.
#[repr(transparent)]
pub struct Contact(ffi::mjContact);

impl Contact {
    /// Distance between nearest points in metres, negative in penetration.
    pub fn dist(&self) -> f64 {
        self.0.dist
    }
    /// Position, midway between the surfaces, world frame, metres.
    pub fn pos(&self) -> [f64; 3] {
        self.0.pos
    }
    /// Contact frame, rows = normal from geom 1 to geom 2, tangent, tangent (3 × 3).
    pub fn frame(&self) -> [f64; 9] {
        self.0.frame
    }
    /// Friction: tangent 1, 2, spin, roll 1, 2.
    pub fn friction(&self) -> [f64; 5] {
        self.0.friction
    }
    /// The two geoms.
    pub fn geoms(&self) -> [usize; 2] {
        [self.0.geom1 as usize, self.0.geom2 as usize]
    }
    /// Dimension of the contact space: 1, 3, 4 or 6.
    pub fn dim(&self) -> usize {
        self.0.dim as usize
    }
    /// First of its rows in `efc_*`; `None` if it makes no force.
    pub fn efc_address(&self) -> Option<usize> {
        usize::try_from(self.0.efc_address).ok()
    }
}

impl Data {
    /// Contacts detected by the last position stage (ncon).
    pub fn contacts(&self) -> &[Contact] {
        let len = self.ncon().min(self.model().nconmax());
        // SAFETY: invariants 2 and 3, at most nconmax are allocated; `Contact` is transparent.
        unsafe { view(self.raw().contact.cast(), len) }
    }
}

/// How often each `MuJoCo` warning was raised since the last reset or clear.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct Warnings {
    /// Nearly singular inertia matrix.
    pub inertia: u64,
    /// Contact buffer full: contacts were dropped.
    pub contact_full: u64,
    /// Constraint buffer full: constraints were dropped.
    pub constraint_full: u64,
    /// Visual geom buffer full.
    pub vgeom_full: u64,
    /// NaN, infinite or huge position: the state was reset.
    pub bad_qpos: u64,
    /// The same for velocity.
    pub bad_qvel: u64,
    /// The same for acceleration.
    pub bad_qacc: u64,
    /// NaN, infinite or huge control: all controls were taken as 0.
    pub bad_ctrl: u64,
}

/// The counts that are not 0, as `bad_qpos 1, contact_full 3`.
impl std::fmt::Display for Warnings {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let named = [
            ("inertia", self.inertia),
            ("contact_full", self.contact_full),
            ("constraint_full", self.constraint_full),
            ("vgeom_full", self.vgeom_full),
            ("bad_qpos", self.bad_qpos),
            ("bad_qvel", self.bad_qvel),
            ("bad_qacc", self.bad_qacc),
            ("bad_ctrl", self.bad_ctrl),
        ];
        let raised: Vec<String> = named
            .iter()
            .filter(|(_, count)| *count > 0)
            .map(|(name, count)| format!("{name} {count}"))
            .collect();
        f.write_str(&raised.join(", "))
    }
}

impl Warnings {
    /// Whether a state or control was not a usable number, so the trajectory is worthless.
    pub fn diverged(&self) -> bool {
        self.bad_qpos + self.bad_qvel + self.bad_qacc + self.bad_ctrl > 0
    }

    /// Whether anything at all was raised.
    pub fn any(&self) -> bool {
        *self != Self::default()
    }
}

impl Data {
    /// Warning counts since the last [`Data::reset`], [`Data::clear_warnings`] or automatic reset.
    pub fn warnings(&self) -> Warnings {
        use ffi::mjtWarning_ as w;
        let count = |kind: u32| self.warning_total(kind as usize);
        Warnings {
            inertia: count(w::mjWARN_INERTIA),
            contact_full: count(w::mjWARN_CONTACTFULL),
            constraint_full: count(w::mjWARN_CNSTRFULL),
            vgeom_full: count(w::mjWARN_VGEOMFULL),
            bad_qpos: count(w::mjWARN_BADQPOS),
            bad_qvel: count(w::mjWARN_BADQVEL),
            bad_qacc: count(w::mjWARN_BADQACC),
            bad_ctrl: count(w::mjWARN_BADCTRL),
        }
    }
}
