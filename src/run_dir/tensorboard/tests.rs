use super::*;

/// The events of a file, each with both checksums verified.
fn records(mut bytes: &[u8]) -> Vec<&[u8]> {
    let mut events = vec![];
    while !bytes.is_empty() {
        let (length, rest) = bytes.split_at(8);
        let (crc, rest) = rest.split_at(4);
        assert_eq!(crc, masked_crc(length).to_le_bytes());
        let n = u64::from_le_bytes(length.try_into().expect("8 bytes")) as usize;
        let (event, rest) = rest.split_at(n);
        let (crc, rest) = rest.split_at(4);
        assert_eq!(crc, masked_crc(event).to_le_bytes());
        events.push(event);
        bytes = rest;
    }
    events
}

fn take_varint(bytes: &mut &[u8]) -> u64 {
    let (mut value, mut shift) = (0, 0);
    loop {
        let byte = bytes[0];
        *bytes = &bytes[1..];
        value |= u64::from(byte & 0x7f) << shift;
        shift += 7;
        if byte < 0x80 {
            return value;
        }
    }
}

/// Fields of a message as (number, integer value, raw bytes).
fn fields(mut bytes: &[u8]) -> Vec<(u64, u64, &[u8])> {
    let mut out = vec![];
    while !bytes.is_empty() {
        let key = take_varint(&mut bytes);
        let n = match key & 7 {
            0 => {
                out.push((key >> 3, take_varint(&mut bytes), &[][..]));
                continue;
            }
            1 => 8,
            2 => take_varint(&mut bytes) as usize,
            5 => 4,
            other => panic!("wire type {other}"),
        };
        let (value, rest) = bytes.split_at(n);
        out.push((key >> 3, 0, value));
        bytes = rest;
    }
    out
}

fn only_file(dir: &Path) -> Vec<u8> {
    let mut files = fs::read_dir(dir.join(FOLDER)).expect("the folder");
    let path = files.next().expect("a file").expect("an entry").path();
    assert!(files.next().is_none(), "one file is expected");
    let name = path
        .file_name()
        .and_then(|n| n.to_str())
        .expect("a name")
        .to_owned();
    assert!(
        name.starts_with("events.out.tfevents.") && name.ends_with(".phantom"),
        "{name}"
    );
    fs::read(path).expect("the file")
}

#[test]
fn crc_has_the_published_check_value() {
    assert_eq!(crc32c(b"123456789"), 0xe306_9283);
    assert_eq!(crc32c(&[0; 32]), 0x8a91_36aa); // RFC 3720, appendix B.4
}

#[test]
fn scalars_come_back() {
    let dir = tempfile::tempdir().expect("a folder");
    let mut writer = EventWriter::create(dir.path(), None).expect("a writer");
    writer
        .scalars(300, &[("reward", 0.625), ("kl", f64::NAN), ("noise", -3.5)])
        .expect("a row");
    let bytes = only_file(dir.path());
    let events = records(&bytes);
    assert_eq!(events.len(), 2);
    assert_eq!(fields(events[0])[1], (3, 0, &b"brain.Event:2"[..]));

    let event = fields(events[1]);
    let wall_time = f64::from_le_bytes(event[0].2.try_into().expect("a double"));
    assert!(
        (now().as_secs_f64() - wall_time).abs() < 60.0,
        "{wall_time}"
    );
    assert_eq!((event[1].0, event[1].1), (2, 300));
    assert_eq!(event[2].0, 5);
    let scalars: Vec<(&[u8], f32)> = fields(event[2].2)
        .into_iter()
        .map(|(_, _, value)| {
            let entry = fields(value);
            (
                entry[0].2,
                f32::from_le_bytes(entry[1].2.try_into().expect("a float")),
            )
        })
        .collect();
    assert_eq!(scalars, [(&b"reward"[..], 0.625), (&b"noise"[..], -3.5)]);
}

#[test]
fn restart_is_marked_and_gets_its_own_file() {
    let dir = tempfile::tempdir().expect("a folder");
    EventWriter::create(dir.path(), Some(11)).expect("a writer");
    let bytes = only_file(dir.path());
    let restart = fields(records(&bytes)[1]);
    assert_eq!((restart[1].0, restart[1].1), (2, 11));
    assert_eq!((restart[2].0, restart[2].2), (7, &[8, 1][..]));
    EventWriter::create(dir.path(), Some(12)).expect("a second writer within the second");
    assert_eq!(
        fs::read_dir(dir.path().join(FOLDER))
            .expect("the folder")
            .count(),
        2
    );
}
