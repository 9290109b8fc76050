use std::{
    fs::{File, Permissions},
    io::{self, Write as _},
    os::unix::fs::PermissionsExt as _,
    path::Path,
};

use super::RunDirError;

/// Replaces a file as a whole: a reader, or a crash at any moment, sees the old or the new bytes.
///
/// The bytes go to a temporary file in the same folder, reach the disk, and take the name over.
///
/// # Errors
/// Names the file and the system's reason; the old file is then untouched and nothing is left behind.
pub fn write_atomic(path: &Path, bytes: &[u8]) -> Result<(), RunDirError> {
    write_atomic_with(path, |file| file.write_all(bytes))
}

/// As [`write_atomic`], of bytes that `fill` writes one after the other.
///
/// # Errors
/// As [`write_atomic`], and what `fill` returns.
pub fn write_atomic_with(
    path: &Path,
    fill: impl FnOnce(&mut File) -> io::Result<()>,
) -> Result<(), RunDirError> {
    let folder = match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    let replace = || -> io::Result<()> {
        let mut temporary = temporary_in(folder)?;
        fill(temporary.as_file_mut())?;
        temporary.as_file().sync_all()?;
        temporary.persist(path).map_err(|e| e.error)?;
        // the new name is an entry of the folder, which has to reach the disk too
        File::open(folder)?.sync_all()
    };
    replace().map_err(|reason| RunDirError::Write {
        path: path.to_owned(),
        reason,
    })
}

/// A temporary file that vanishes unless it is persisted, with the permissions of an ordinary file.
pub(super) fn temporary_in(folder: &Path) -> io::Result<tempfile::NamedTempFile> {
    tempfile::Builder::new()
        .prefix(".tmp-")
        .permissions(Permissions::from_mode(0o666)) // less the umask
        .tempfile_in(folder)
        .map_err(without_temporary_name)
}

/// The reason alone: the random name that follows it says nothing to a reader.
fn without_temporary_name(error: io::Error) -> io::Error {
    match error.to_string().split_once(" at path ") {
        Some((reason, _)) => io::Error::new(error.kind(), reason),
        None => error,
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn replaces_and_leaves_no_temporary_file() {
        let dir = tempfile::tempdir().expect("a folder");
        let path = dir.path().join("policy.json");
        write_atomic(&path, b"old").expect("first write");
        write_atomic(&path, b"new").expect("second write");
        assert_eq!(fs::read(&path).expect("the file"), b"new");
        assert_eq!(fs::read_dir(dir.path()).expect("the folder").count(), 1);
    }

    #[test]
    fn failure_names_the_file_and_keeps_what_was_there() {
        let dir = tempfile::tempdir().expect("a folder");
        let path = dir.path().join("taken");
        fs::create_dir_all(path.join("child")).expect("a folder in the way");
        let message = write_atomic(&path, b"x")
            .expect_err("a folder cannot be replaced")
            .to_string();
        assert!(
            message.starts_with(&format!("cannot write {}: ", path.display())),
            "{message}"
        );
        assert_eq!(fs::read_dir(dir.path()).expect("the folder").count(), 1);
    }

    #[test]
    fn message_has_no_temporary_name() {
        let message = write_atomic(Path::new("/nowhere/at/all"), b"x")
            .expect_err("no folder")
            .to_string();
        assert_eq!(
            message,
            "cannot write /nowhere/at/all: No such file or directory (os error 2)"
        );
    }
}
