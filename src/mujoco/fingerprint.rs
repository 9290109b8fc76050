//! What identifies a compiled model: a hash of all its numbers and names.

use sha2::{Digest, Sha256};

use super::guard::guarded_once;
use super::{Model, Result, ffi};
use std::ptr;

impl Model {
    /// SHA-256 of the compiled model as `MuJoCo` would save it, in hexadecimal: the same for files that differ in comments,
    /// order of attributes or includes alone.
    ///
    /// # Errors
    /// [`MujocoError::Fatal`](super::MujocoError::Fatal) when the engine refuses to save it.
    pub fn fingerprint(&self) -> Result<String> {
        // SAFETY: valid model.
        let size = guarded_once(|| unsafe { ffi::mj_sizeModel(self.as_ptr()) })?;
        let mut bytes = vec![0_u8; usize::try_from(size).unwrap_or(0)];
        guarded_once(|| {
            // SAFETY: valid model; the buffer has the `size` bytes that MuJoCo asked for.
            unsafe {
                ffi::mj_saveModel(self.as_ptr(), ptr::null(), bytes.as_mut_ptr().cast(), size);
            };
        })?;
        let hash = Sha256::digest(&bytes);
        Ok(format!("{hash:x}"))
    }
}
