//! Lengths of texts inside MCAP records, checked before the parser reserves memory for them: it takes up to 4 GB on the
//! word of four damaged bytes.

use mcap::records::op;

use super::mcap_read::Stop;

/// Parses a record whose texts fit into it.
pub(super) fn parse(opcode: u8, body: &[u8]) -> Result<mcap::records::Record<'_>, Stop> {
    let whole = match opcode {
        // ids, topic, encoding, metadata
        op::CHANNEL => after(body, 4).and_then(text).and_then(text).and_then(map),
        op::METADATA => text(body).and_then(map),
        // times, size, checksum, compression
        op::CHUNK => after(body, 28).and_then(text),
        _ => Some(body),
    };
    if whole.is_none() {
        return Err(Stop::Damage("a text is longer than its record".into()));
    }
    Ok(mcap::parse_record(opcode, body)?)
}

fn after(bytes: &[u8], n: usize) -> Option<&[u8]> {
    bytes.get(n..)
}

/// What comes after a length and as many bytes.
fn text(bytes: &[u8]) -> Option<&[u8]> {
    let (length, rest) = bytes.split_first_chunk()?;
    after(rest, u32::from_le_bytes(*length) as usize)
}

/// What comes after a map of texts.
fn map(bytes: &[u8]) -> Option<&[u8]> {
    let (length, rest) = bytes.split_first_chunk()?;
    let (mut entries, rest) = rest.split_at_checked(u32::from_le_bytes(*length) as usize)?;
    while !entries.is_empty() {
        entries = text(entries)?;
    }
    Some(rest)
}
