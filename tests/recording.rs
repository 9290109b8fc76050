//! Recordings through files: nothing is lost or invented, and what is wrong is said.

use std::path::Path;

use phantom::recording::{self, Binding, Channel, Kind, Meta, Recording, RecordingError, Stream};
use proptest::prelude::*;

fn channel(name: &str, kind: Kind, unit: &str, noise_sigma: Option<f64>) -> Channel {
    Channel {
        name: name.into(),
        kind,
        unit: unit.into(),
        noise_sigma,
    }
}

/// Three clocks, gaps, a sample without any number, a stream without samples, times before the start.
fn sample() -> Recording {
    let mut fast = Stream::new(
        "joints",
        Some(2000.0),
        vec![
            channel("j1_pos", Kind::Sensor, "rad", Some(1.5e-4)),
            channel("m1", Kind::Control, "N m", None),
        ],
    );
    for k in 0..200 {
        let x = (f64::from(k) * 0.1).sin() / 3.0;
        fast.push(
            i64::from(k) * 500_000 - 1_000_000,
            &[x, if k % 7 == 0 { f64::NAN } else { -x }],
        );
    }
    let mut slow = Stream::new(
        "camera",
        Some(50.0),
        vec![channel("object[0]", Kind::Sensor, "m", None)],
    );
    slow.push(0, &[5e-324]);
    slow.push(20_000_001, &[f64::NAN]);
    slow.push(40_000_000, &[-0.0]);
    let empty = Stream::new(
        "goal",
        None,
        vec![channel("goal[0]", Kind::Goal, "m", None)],
    );
    Recording {
        meta: Meta {
            model_hash: "abc".into(),
            start_ns: 1_700_000_000_000_000_001,
            source: "bench \"A\"".into(),
            trial: "7".into(),
            notes: "µ, and\ntwo lines".into(),
        },
        streams: vec![fast, slow, empty],
    }
}

/// Equal to the last bit; any NaN equals any other.
fn assert_same(a: &Recording, b: &Recording) {
    let bits = |v: &[f64]| -> Vec<u64> {
        v.iter()
            .map(|x| if x.is_nan() { 1 } else { x.to_bits() })
            .collect()
    };
    assert_eq!(a.meta, b.meta);
    assert_eq!(a.streams.len(), b.streams.len());
    for (a, b) in a.streams.iter().zip(&b.streams) {
        assert_eq!(
            (&a.name, &a.channels, a.rate_hz),
            (&b.name, &b.channels, b.rate_hz)
        );
        assert_eq!(a.stamps_ns, b.stamps_ns, "{}", a.name);
        assert_eq!(bits(&a.values), bits(&b.values), "{}", a.name);
    }
}

fn through(folder: &Path, names: &[&str], recording: &Recording) -> Recording {
    names.iter().fold(recording.clone(), |recording, name| {
        let path = folder.join(name);
        recording::write(&path, &recording).expect("written");
        recording::read(&path).expect("read")
    })
}

/// Some file systems wait for the disk when a file is cut to nothing and written again, but not for a new file.
fn replace(path: &Path, bytes: &[u8]) {
    std::fs::remove_file(path).ok();
    std::fs::write(path, bytes).expect("written");
}

#[test]
fn mcap_and_tables_lose_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    let recording = sample();
    let back = through(
        folder.path(),
        &["a.mcap", "b.csv", "c.mcap", "d.csv.gz", "e.mcap"],
        &recording,
    );
    assert_same(&recording, &back);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn any_doubles_and_any_order_of_stamps_survive(
        rows in prop::collection::vec((any::<i32>(), any::<u64>(), any::<u64>()), 0..40),
        other in prop::collection::vec((-3i64..3, any::<u64>()), 0..20),
    ) {
        let finite = |b: u64| { let v = f64::from_bits(b); if v.is_infinite() { f64::NAN } else { v } };
        let channels = ["a", "b,\"c\""].map(|n| channel(n, Kind::Other, "", None));
        let mut one = Stream::new("one", None, channels.to_vec());
        for (stamp, a, b) in rows { one.push(i64::from(stamp), &[finite(a), finite(b)]); }
        let mut two = Stream::new("two", Some(1.0 / 3.0), vec![channel("d", Kind::Sensor, "m", None)]);
        for (stamp, a) in other { two.push(stamp, &[finite(a)]); }
        let recording = Recording { meta: Meta::default(), streams: vec![one, two] };
        let folder = tempfile::tempdir().expect("a folder");
        assert_same(&recording, &through(folder.path(), &["a.csv", "b.mcap", "c.csv.gz"], &recording));
    }
}

#[test]
fn a_plain_table_is_one_stream() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("log.csv");
    std::fs::write(&path, "time,q,u\n-0.000000001,1,\n0.25,,2e3\n1e-3,3,4\n").expect("written");
    let recording = recording::read(&path).expect("read");
    let [stream] = recording.streams.as_slice() else {
        panic!("one stream")
    };
    assert_eq!(stream.stamps_ns, [-1, 250_000_000, 1_000_000]);
    assert_eq!(
        (stream.row(0)[0], stream.row(1)[1], stream.row(2)[1]),
        (1.0, 2000.0, 4.0)
    );
    assert!(stream.row(0)[1].is_nan() && stream.row(1)[0].is_nan());
}

/// A file cut anywhere is refused; what stands before the cut is there on request.
#[test]
fn a_cut_file_is_refused_and_can_be_salvaged() {
    let folder = tempfile::tempdir().expect("a folder");
    let (whole, cut) = (folder.path().join("a.mcap"), folder.path().join("b.mcap"));
    let mut recording = sample();
    recording.streams.truncate(1);
    // more than one chunk
    for k in 200..60_000 {
        recording.streams[0].push(k * 500_000, &[(k as f64).sqrt(), (k as f64).ln()]);
    }
    recording::write(&whole, &recording).expect("written");
    let bytes = std::fs::read(&whole).expect("the file");
    let mut most = 0;
    for part in [0, 1, 5, 20, 50, 80, 95, 99] {
        replace(&cut, &bytes[..bytes.len() * part / 100]);
        assert!(
            matches!(recording::read(&cut), Err(RecordingError::Damaged { .. })),
            "{part} %"
        );
        if let Ok(saved) = recording::salvage(&cut, &Binding::default()) {
            let stream = &saved.trials[0].streams[0];
            assert!(saved.damage.is_some());
            assert_eq!(
                stream.stamps_ns,
                recording.streams[0].stamps_ns[..stream.len()]
            );
            most = most.max(stream.len());
        }
    }
    assert!(most > 30_000, "salvaged {most}");
}

/// Every single changed byte of a small file is noticed, or changes nothing.
#[test]
fn no_changed_byte_passes_for_data() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("a.mcap");
    let recording = sample();
    recording::write(&path, &recording).expect("written");
    let bytes = std::fs::read(&path).expect("the file");
    let mut refused = 0;
    for at in (0..bytes.len()).step_by(3) {
        let mut changed = bytes.clone();
        changed[at] ^= 0x10;
        replace(&path, &changed);
        match recording::read(&path) {
            Ok(read) => assert_same(&recording, &read),
            Err(_) => refused += 1,
        }
    }
    assert!(refused > 100, "{refused}");
}

#[test]
fn mistakes_in_tables_are_named() {
    let folder = tempfile::tempdir().expect("a folder");
    for (text, expected) in [
        (
            "t,q\n0,1\n",
            "line 1: there is no column `time`; found t, q",
        ),
        ("time,q,q\n", "line 1: two columns are called `q`"),
        (
            "time,q\n0,1\n1,x\n",
            "line 3: column `q` is `x`, expected a number",
        ),
        (
            "time,q\n0,1\nlate,1\n",
            "line 3: column `time` is `late`, expected a time",
        ),
        ("time,q\n0,1\n1\n", "line 3: 1 columns, expected 2"),
        (
            "time,q\n1e30,1\n",
            "line 2: column `time` is `1e30`, expected a time",
        ),
    ] {
        let path = folder.path().join("log.csv");
        std::fs::write(&path, text).expect("written");
        let message = recording::read(&path).expect_err(text).to_string();
        assert_eq!(message, format!("{}: {expected}", path.display()));
    }
    let path = folder.path().join("log.txt");
    let message = recording::read(&path)
        .expect_err("unknown ending")
        .to_string();
    assert!(
        message.ends_with("a recording ends in .mcap, .csv or .csv.gz"),
        "{message}"
    );
}

#[test]
fn what_a_format_cannot_hold_is_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let refused = |name: &str, change: fn(&mut Recording), expected: &str| {
        let mut recording = sample();
        change(&mut recording);
        let path = folder.path().join(name);
        let message = recording::write(&path, &recording)
            .expect_err(expected)
            .to_string();
        assert!(message.contains(expected), "{message}");
        assert!(!path.exists());
    };
    refused(
        "a.mcap",
        |r| r.streams[0].values[6] = f64::INFINITY,
        "`j1_pos` is infinite at 0.0005 s",
    );
    refused(
        "a.mcap",
        |r| r.streams[1].name = "joints".into(),
        "two streams are called `joints`",
    );
    refused(
        "a.csv",
        |r| r.streams[1].channels[0].name = "m1".into(),
        "two columns would be called `m1`",
    );
    refused(
        "a.csv",
        |r| r.streams[1].channels[0].name = " x".into(),
        "cannot hold",
    );
    refused("a.csv", |r| r.streams[2].channels.clear(), "no channels");
}

#[test]
fn another_programs_file_is_not_overwritten() {
    let folder = tempfile::tempdir().expect("a folder");
    let side = folder.path().join("log.json");
    std::fs::write(&side, "{\"mine\": 1}").expect("written");
    let error = recording::write(&folder.path().join("log.csv"), &sample()).expect_err("refused");
    assert!(error.to_string().contains("log.json"), "{error}");
    assert_eq!(
        std::fs::read_to_string(&side).expect("the file"),
        "{\"mine\": 1}"
    );
}

/// Thousands of changed files: no panic, no more memory than the bytes account for, and what is read at all is checked
/// and written again without trouble. A quick substitute for the fuzzer in `fuzz/`.
#[test]
fn damaged_files_never_panic() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut random = phantom::rng::stream(1, phantom::rng::Purpose::Start, 0, 0);
    let mut draw =
        |n: usize| (phantom::rng::uniform(&mut random, 0.0, n as f64) as usize).min(n - 1);
    let (mut readable, mut refused) = (0, 0);
    for name in ["a.mcap", "plain.mcap", "a.csv", "a.csv.gz"] {
        let path = folder.path().join(name);
        let bytes = if name == "plain.mcap" {
            without_checksums()
        } else {
            let mut recording = sample();
            recording.streams[0].stamps_ns.truncate(30);
            recording.streams[0].values.truncate(60);
            recording::write(&path, &recording).expect("written");
            std::fs::read(&path).expect("the file")
        };
        for _ in 0..1500 {
            let mut changed = bytes.clone();
            for _ in 0..=draw(3) {
                let at = draw(changed.len());
                match draw(5) {
                    0 => changed.truncate(at + 1),
                    1 => changed[at] = [0, 0xff, b',', b'\n', b'"', b'9'][draw(6)],
                    2 => changed[at] ^= 1 << draw(8),
                    3 => {
                        let from = draw(changed.len());
                        let piece = changed[from..(from + draw(40)).min(changed.len())].to_vec();
                        changed.splice(at..at, piece);
                    }
                    _ => {
                        let end = (at + 8).min(changed.len());
                        changed[at..end].fill([0, 0xff][draw(2)]);
                    }
                }
            }
            replace(&path, &changed);
            match recording::salvage(&path, &Binding::default()) {
                Ok(loaded) => {
                    readable += 1;
                    for recording in &loaded.trials {
                        recording::check(recording, None);
                        let numbers: usize = recording.streams.iter().map(|s| s.values.len()).sum();
                        assert!(
                            numbers < 100_000,
                            "{numbers} numbers from {} bytes",
                            changed.len()
                        );
                    }
                }
                Err(_) => refused += 1,
            }
        }
    }
    // both ways are really taken
    assert!(
        readable > 500 && refused > 500,
        "{readable} readable, {refused} refused"
    );
}

/// A small MCAP as other programs may write it: neither packed nor with checksums, so that changes reach the parser.
fn without_checksums() -> Vec<u8> {
    let mut writer = mcap::WriteOptions::new()
        .compression(None)
        .calculate_chunk_crcs(false)
        .calculate_data_section_crc(false)
        .create(std::io::Cursor::new(Vec::new()))
        .expect("a writer");
    let topic = |name: &str| {
        (
            name.to_owned(),
            r#"[{"name":"q","kind":"sensor"}]"#.to_owned(),
        )
    };
    let channel = writer
        .add_channel(0, "q", "json", &[topic("channels")].into())
        .expect("a channel");
    for k in 0..20 {
        let header = mcap::records::MessageHeader {
            channel_id: channel,
            sequence: k,
            log_time: u64::from(k),
            publish_time: 0,
        };
        let text = format!("{{\"values\":[{k}]}}");
        writer
            .write_to_known_channel(&header, text.as_bytes())
            .expect("a message");
    }
    writer.finish().expect("the end");
    writer.into_inner().into_inner()
}

#[test]
fn a_text_longer_than_its_record_reserves_nothing() {
    let bytes = std::fs::read(
        Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus/recording/long_text.mcap"),
    );
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("log.mcap");
    std::fs::write(&file, &bytes.expect("read")[1..]).expect("written");
    let error = recording::read(&file).expect_err("damaged").to_string();
    assert!(
        error.contains("a text is longer than its record"),
        "{error}"
    );
}

/// The corpus of the fuzzer: a byte for the ending, then the file.
#[test]
fn the_corpus_is_read_or_refused() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus/recording");
    let temporary = tempfile::tempdir().expect("a folder");
    let mut outcomes = std::collections::BTreeMap::new();
    for entry in std::fs::read_dir(folder).expect("a corpus") {
        let path = entry.expect("an entry").path();
        let bytes = std::fs::read(&path).expect("read");
        let endings = ["log.csv", "log.csv.gz", "", "log.mcap"];
        let file = temporary.path().join(endings[usize::from(bytes[0] % 4)]);
        let name = path
            .file_name()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned();
        if bytes[0] % 4 == 2 {
            let text = String::from_utf8_lossy(&bytes[1..]);
            outcomes.insert(name, Binding::from_toml(&text, &path).is_ok());
        } else {
            std::fs::write(&file, &bytes[1..]).expect("written");
            outcomes.insert(name, recording::read(&file).is_ok());
        }
    }
    for (name, sound) in [
        ("table.csv", true),
        ("table.csv.gz", true),
        ("log.mcap", true),
        ("binding.toml", true),
    ]
    .into_iter()
    .chain([
        ("truncated.csv.gz", false),
        ("truncated.mcap", false),
        ("flipped.mcap", false),
    ]) {
        assert_eq!(outcomes.get(name), Some(&sound), "{name}");
    }
}
