//! A compiled model: loading, names, options, copies.

use super::guard::{guarded_once, initialise, null_error};
use super::kinds::{Cone, Integrator, Jacobian, ObjectKind, Solver, SolverOptions};
use super::{Extension, ModelEdit, MujocoError, Result, ffi};
use std::ffi::{CStr, CString, c_char};
use std::fs;
use std::os::unix::ffi::OsStrExt;
use std::path::Path;
use std::ptr::{self, NonNull};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// Bytes kept of `MuJoCo`'s load message.
const MESSAGE_LEN: usize = 1000;
/// Name under which a model given as text is known.
const STRING_NAME: &CStr = c"model.xml";

/// Gives every loaded model its `origin`.
static NEXT_ORIGIN: AtomicU64 = AtomicU64::new(0);

/// A compiled `MuJoCo` model. Shared between threads read-only, through `Arc`.
pub struct Model {
    raw: NonNull<ffi::mjModel>,
    /// Equal for copies of one loaded model: same structure without comparing.
    origin: u64,
    /// What the compiler said about a model it accepted.
    warning: Option<Arc<str>>,
    /// Arrays that an edit handed out and nobody has checked for NaN since.
    pub(super) unchecked: Vec<&'static str>,
    /// Physics beyond the engine's.
    extension: Option<Arc<dyn Extension>>,
}

// SAFETY: mjModel holds no thread-bound resource, and this type owns it.
unsafe impl Send for Model {}
// SAFETY: through `&Model` it is only read, by Rust and by C alike.
unsafe impl Sync for Model {}

impl Model {
    /// Loads an MJCF (or URDF) file.
    ///
    /// # Errors
    /// [`MujocoError::File`] if it cannot be read, [`MujocoError::Load`] with `MuJoCo`'s message if it
    /// is not a valid model.
    pub fn from_xml_path(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let refuse = |reason: String| MujocoError::File {
            file: path.into(),
            reason,
        };
        let meta = fs::metadata(path).map_err(|e| refuse(e.to_string()))?;
        if !meta.is_file() {
            return Err(refuse("it is not a file".into()));
        }
        if meta.len() == 0 {
            return Err(refuse("it is empty".into()));
        }
        fs::File::open(path).map_err(|e| refuse(e.to_string()))?;
        let bytes = path.as_os_str().as_bytes();
        let name = CString::new(bytes).map_err(|_| refuse("its path holds a NUL".into()))?;
        Self::load(path, &name, ptr::null())
    }

    /// Compiles a model given as MJCF text; files it names are looked up in the current directory.
    ///
    /// # Errors
    /// [`MujocoError::Load`] with `MuJoCo`'s message.
    pub fn from_xml_str(xml: &str) -> Result<Self> {
        Self::from_text(xml, STRING_NAME, Path::new("<string>"))
    }

    /// Compiles MJCF text as if it were the content of the file `path`, beside which other files are looked up.
    ///
    /// # Errors
    /// As [`Model::from_xml_str`], and [`MujocoError::File`] for a path that holds a NUL.
    pub fn from_xml_text(xml: &str, path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        // the engine allows 99 characters for the name of a given text, and finds files beside it by its folder
        let name = path.with_file_name("text.phantom.xml");
        let name = CString::new(name.as_os_str().as_bytes()).map_err(|_| MujocoError::File {
            file: path.into(),
            reason: "its path holds a NUL".into(),
        })?;
        Self::from_text(xml, &name, path)
    }

    fn from_text(xml: &str, name: &CStr, file: &Path) -> Result<Self> {
        let refuse = |message: &str| MujocoError::Load {
            file: file.into(),
            message: message.into(),
        };
        if xml.trim().is_empty() {
            return Err(refuse("it is empty"));
        }
        if xml.contains('\0') {
            return Err(refuse("it holds a NUL"));
        }
        let size = i32::try_from(xml.len()).map_err(|_| refuse("it is larger than 2 GB"))?;
        initialise()?;
        // 2 MB: on the heap
        let mut vfs = Box::<ffi::mjVFS>::new_uninit();
        let vfs = vfs.as_mut_ptr();
        // SAFETY: valid for writes of an mjVFS, which this call initialises.
        unsafe { ffi::mj_defaultVFS(vfs) };
        // SAFETY: `vfs` is initialised, the name ends in NUL.
        let status = unsafe { ffi::mj_makeEmptyFileVFS(vfs, name.as_ptr(), size) };
        let model = if status == 0 {
            // SAFETY: `vfs` is initialised; entry 0 is the file just made.
            let content = unsafe { (*vfs).filedata[0] };
            // SAFETY: that buffer has `size` bytes and does not overlap the text.
            unsafe { ptr::copy_nonoverlapping(xml.as_ptr(), content.cast(), xml.len()) };
            Self::load(file, name, vfs)
        } else {
            Err(refuse("out of memory"))
        };
        // SAFETY: frees the file made above; `vfs` is initialised.
        unsafe { ffi::mj_deleteVFS(vfs) };
        model
    }

    fn load(file: &Path, name: &CStr, vfs: *const ffi::mjVFS) -> Result<Self> {
        initialise()?;
        let mut text: [c_char; MESSAGE_LEN] = [0; MESSAGE_LEN];
        let raw = guarded_once(|| {
            // SAFETY: the name ends in NUL, `vfs` is null or initialised, the buffer has the size
            // given. MuJoCo takes its own lock.
            unsafe { ffi::mj_loadXML(name.as_ptr(), vfs, text.as_mut_ptr(), MESSAGE_LEN as i32) }
        })?;
        text[MESSAGE_LEN - 1] = 0;
        // SAFETY: the buffer ends in NUL.
        let message = unsafe { CStr::from_ptr(text.as_ptr()) };
        let message = message.to_string_lossy().trim().replace('\n', "; ");
        let message = message.strip_prefix("Error: ").unwrap_or(&message);
        let raw = NonNull::new(raw).ok_or_else(|| MujocoError::Load {
            file: file.into(),
            message: message.into(),
        })?;
        let origin = NEXT_ORIGIN.fetch_add(1, Ordering::Relaxed);
        Ok(Self {
            raw,
            origin,
            warning: (!message.is_empty()).then(|| message.into()),
            unchecked: Vec::new(),
            extension: None,
        })
    }

    /// A copy, as `Clone`.
    ///
    /// # Errors
    /// [`MujocoError::Fatal`] when out of memory.
    pub fn try_clone(&self) -> Result<Self> {
        // SAFETY: a null destination makes MuJoCo allocate; the source is valid.
        let raw = guarded_once(|| unsafe { ffi::mj_copyModel(ptr::null_mut(), self.as_ptr()) })?;
        let raw = NonNull::new(raw).ok_or_else(|| null_error("could not copy the model"))?;
        Ok(Self {
            raw,
            origin: self.origin,
            warning: self.warning.clone(),
            unchecked: self.unchecked.clone(),
            extension: self.extension.clone(),
        })
    }

    /// A copy whose constraint Jacobians are dense: [`Data::efc_J`](super::Data::efc_J) is then nefc × nv.
    ///
    /// # Errors
    /// As [`Model::try_clone`].
    pub fn with_dense_jacobian(&self) -> Result<Self> {
        let mut own = self.try_clone()?;
        let mut option = own.option();
        option.jacobian = Jacobian::Dense;
        own.edit().set_option(&option)?;
        Ok(own)
    }

    /// This model with physics beyond the engine's in every simulation made of it or of its copies.
    #[must_use]
    pub fn with_extension(mut self, extension: Arc<dyn Extension>) -> Self {
        self.extension = Some(extension);
        self
    }

    /// The physics beyond the engine's, if it has some.
    pub fn extension(&self) -> Option<&Arc<dyn Extension>> {
        self.extension.as_ref()
    }

    /// Whether springs or play between motors and joints are loaded by what went before, see [`Extension::load`].
    pub fn has_loaded_drives(&self) -> bool {
        self.extension().is_some_and(|e| e.is_loaded())
    }

    /// Hinges and slides whose motors are put where readings show them, see [`super::Data::show`].
    pub fn followed_joints(&self) -> impl Iterator<Item = usize> + '_ {
        let follows = |j: &usize| self.extension().is_some_and(|e| e.follows(*j));
        self.scalar_joints().filter(follows)
    }

    /// The C structure, for reading.
    pub(super) fn raw(&self) -> &ffi::mjModel {
        // SAFETY: invariant 1: valid, and written only through `&mut self`.
        unsafe { self.raw.as_ref() }
    }

    /// The C structure, for writing numbers.
    pub(super) fn raw_mut(&mut self) -> &mut ffi::mjModel {
        // SAFETY: invariant 1, and `&mut self` is exclusive.
        unsafe { self.raw.as_mut() }
    }

    pub(super) fn as_ptr(&self) -> *const ffi::mjModel {
        self.raw.as_ptr()
    }

    pub(super) fn as_mut_ptr(&mut self) -> *mut ffi::mjModel {
        self.raw.as_ptr()
    }

    /// Index of the `kind` named `name`.
    ///
    /// # Errors
    /// [`MujocoError::UnknownName`], which lists the names there are.
    pub fn id(&self, kind: ObjectKind, name: &str) -> Result<usize> {
        let id = CString::new(name).ok().map_or(-1, |text| {
            // SAFETY: valid model, name ends in NUL.
            unsafe { ffi::mj_name2id(self.as_ptr(), kind.object(), text.as_ptr()) }
        });
        usize::try_from(id)
            .ok()
            .filter(|_| !name.is_empty())
            .ok_or_else(|| MujocoError::UnknownName {
                kind: kind.text(),
                name: name.into(),
                known: (0..self.count(kind))
                    .filter_map(|i| self.name(kind, i))
                    .map(String::from)
                    .collect(),
            })
    }

    /// Name of object `id`; `None` if it has none, does not exist, or is not UTF-8.
    pub fn name(&self, kind: ObjectKind, id: usize) -> Option<&str> {
        let id = i32::try_from(id)
            .ok()
            .filter(|&i| (i as usize) < self.count(kind))?;
        // SAFETY: valid model, index in range.
        let text = unsafe { ffi::mj_id2name(self.as_ptr(), kind.object(), id) };
        if text.is_null() {
            return None;
        }
        // SAFETY: points into the NUL-terminated names of this model, which no edit touches.
        let text = unsafe { CStr::from_ptr(text) };
        text.to_str().ok().filter(|t| !t.is_empty())
    }

    /// How many objects of `kind` there are.
    pub fn count(&self, kind: ObjectKind) -> usize {
        kind.count(self.raw())
    }

    /// Checks an index.
    pub(super) fn check_id(&self, kind: ObjectKind, id: usize) -> Result<i32> {
        let count = self.count(kind);
        if id < count {
            return Ok(id as i32);
        }
        Err(MujocoError::Index {
            kind: kind.text(),
            count,
            got: id,
        })
    }

    /// What `MuJoCo`'s compiler said about the model although it accepted it.
    pub fn load_warning(&self) -> Option<&str> {
        self.warning.as_deref()
    }

    /// Time step in seconds.
    pub fn timestep(&self) -> f64 {
        self.raw().opt.timestep
    }

    /// Solver settings.
    pub fn option(&self) -> SolverOptions {
        let opt = &self.raw().opt;
        SolverOptions {
            timestep: opt.timestep,
            integrator: Integrator::from_raw(opt.integrator),
            solver: Solver::from_raw(opt.solver),
            cone: Cone::from_raw(opt.cone),
            jacobian: Jacobian::from_raw(opt.jacobian),
            iterations: opt.iterations.max(0) as usize,
            tolerance: opt.tolerance,
            noslip_iterations: opt.noslip_iterations.max(0) as usize,
            noslip_tolerance: opt.noslip_tolerance,
            impratio: opt.impratio,
            gravity: opt.gravity,
            disable_flags: opt.disableflags,
            enable_flags: opt.enableflags,
        }
    }

    /// Total mass in kg.
    pub fn total_mass(&self) -> f64 {
        self.body_mass().iter().sum()
    }

    /// Opens the model for changes of numbers and settings.
    pub fn edit(&mut self) -> ModelEdit<'_> {
        ModelEdit::new(self)
    }

    /// Whether data of one model can be used with the other.
    ///
    /// # Errors
    /// [`MujocoError::ModelMismatch`] with the first size or array that differs.
    pub(super) fn check_same_structure(&self, other: &Self, what: &'static str) -> Result<()> {
        if self.origin == other.origin {
            return Ok(());
        }
        match self.structure_difference(other) {
            None => Ok(()),
            Some(detail) => Err(MujocoError::ModelMismatch { what, detail }),
        }
    }
}

impl Clone for Model {
    /// # Panics
    /// When out of memory.
    fn clone(&self) -> Self {
        self.try_clone().unwrap_or_else(|e| panic!("{e}"))
    }
}

impl Drop for Model {
    fn drop(&mut self) {
        // SAFETY: owned, and not used after this.
        unsafe { ffi::mj_deleteModel(self.raw.as_ptr()) };
    }
}

impl std::fmt::Debug for Model {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (nq, nv, nu, nbody) = (self.nq(), self.nv(), self.nu(), self.nbody());
        f.debug_struct("Model")
            .field("nq", &nq)
            .field("nv", &nv)
            .field("nu", &nu)
            .field("nbody", &nbody)
            .finish_non_exhaustive()
    }
}
