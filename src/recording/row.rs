//! A row of numbers as JSON, `{"values":[0.5,null,-2.0]}`, exact in both directions.
//!
//! Numbers are written with the shortest digits that read back to the same bits. Reading takes the spelling of this
//! program directly, and leaves any other spelling to `serde_json`.

use serde::Deserialize;

/// What stands before the first number.
const OPENING: &[u8] = b"{\"values\":[";

#[derive(Deserialize)]
struct Message {
    values: Vec<Option<f64>>,
}

/// Replace `text` by the row. NaN is `null`; infinities are for the caller to refuse.
pub(super) fn encode(row: &[f64], text: &mut Vec<u8>) {
    let mut digits = zmij::Buffer::new();
    text.clear();
    text.extend_from_slice(OPENING);
    for (i, value) in row.iter().enumerate() {
        if i > 0 {
            text.push(b',');
        }
        if value.is_finite() {
            text.extend_from_slice(digits.format_finite(*value).as_bytes());
        } else {
            text.extend_from_slice(b"null");
        }
    }
    text.extend_from_slice(b"]}");
}

/// Append the numbers of a row to `values` and return how many there were; on an error nothing is appended.
pub(super) fn decode(text: &[u8], values: &mut Vec<f64>) -> Result<usize, serde_json::Error> {
    let begin = values.len();
    if decode_plain(text, values).is_none() {
        values.truncate(begin);
        let message: Message = serde_json::from_slice(text)?;
        values.extend(message.values.iter().map(|v| v.unwrap_or(f64::NAN)));
    }
    Ok(values.len() - begin)
}

/// The spelling of [`encode`]; `None` for any other.
fn decode_plain(text: &[u8], values: &mut Vec<f64>) -> Option<()> {
    let mut rest = text.strip_prefix(OPENING)?;
    if rest == b"]}" {
        return Some(());
    }
    loop {
        if let Some(after) = rest.strip_prefix(b"null") {
            values.push(f64::NAN);
            rest = after;
        } else {
            if !matches!(rest.first()?, b'-' | b'0'..=b'9') {
                return None;
            }
            let (value, length) = fast_float2::parse_partial::<f64, _>(rest).ok()?;
            if !value.is_finite() {
                return None;
            }
            values.push(value);
            rest = &rest[length..];
        }
        match rest {
            b"]}" => return Some(()),
            [b',', after @ ..] => rest = after,
            _ => return None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn bits(row: &[f64]) -> Vec<u64> {
        row.iter()
            .map(|v| if v.is_nan() { 0 } else { v.to_bits() })
            .collect()
    }

    proptest! {
        #[test]
        fn every_double_survives(raw in prop::collection::vec(any::<u64>(), 0..20)) {
            let row: Vec<f64> = raw.iter().map(|b| f64::from_bits(*b)).filter(|v| !v.is_infinite()).collect();
            let (mut text, mut plain, mut general) = (Vec::new(), Vec::new(), Vec::new());
            encode(&row, &mut text);
            prop_assert!(decode_plain(&text, &mut plain).is_some());
            prop_assert_eq!(bits(&plain), bits(&row));
            // the same text in another spelling takes the other way
            let spaced = String::from_utf8(text).expect("JSON").replace(',', " , ");
            prop_assert_eq!(decode(format!(" {spaced}").as_bytes(), &mut general).expect("JSON"), row.len());
            prop_assert_eq!(bits(&general), bits(&row));
        }
    }

    #[test]
    fn what_is_no_row_appends_nothing() {
        for text in [
            "",
            "{}",
            "{\"values\":[1,]}",
            "{\"values\":[1e999]}",
            "{\"values\":[1,nan]}",
            "{\"values\":[1",
        ] {
            let mut values = vec![7.0];
            assert!(decode(text.as_bytes(), &mut values).is_err(), "{text}");
            assert_eq!(values, [7.0], "{text}");
        }
    }
}
