//! Any bytes as a recording: no panic, no memory beyond what they hold, and what is read can be written and read again.
#![no_main]

use std::path::Path;

use libfuzzer_sys::fuzz_target;
use phantom::recording::{Binding, check, read, salvage, write};

fuzz_target!(|input: (u8, &[u8])| {
    let (ending, bytes) = input;
    let folder = std::env::temp_dir().join(format!("phantom-fuzz-{}", std::process::id()));
    std::fs::create_dir_all(&folder).expect("a folder");
    match ending % 4 {
        0 => file(&folder.join("log.csv"), bytes),
        1 => file(&folder.join("log.csv.gz"), bytes),
        2 => {
            let _ = Binding::from_toml(&String::from_utf8_lossy(bytes), Path::new("b.toml"));
        }
        _ => file(&folder.join("log.mcap"), bytes),
    }
});

fn file(path: &Path, bytes: &[u8]) {
    std::fs::write(path, bytes).expect("written");
    let Ok(loaded) = salvage(path, &Binding::default()) else {
        return;
    };
    for recording in &loaded.trials {
        check(recording, None);
        let copy = path.with_file_name("copy.mcap");
        if write(&copy, recording).is_ok() {
            let again = read(&copy).expect("what was written is whole");
            assert_eq!(again.streams.len(), recording.streams.len());
            for (a, b) in again.streams.iter().zip(&recording.streams) {
                assert_eq!(a.stamps_ns, b.stamps_ns);
                assert_eq!(a.values.len(), b.values.len());
            }
        }
    }
}
