//! Names by pattern.

/// Whether `name` matches a glob of literal characters, `*` (any run) and `?` (any one character).
pub fn matches(glob: &str, name: &str) -> bool {
    match glob.chars().next() {
        None => name.is_empty(),
        Some('*') => {
            let rest = &glob[1..];
            name.char_indices()
                .map(|(i, _)| i)
                .chain([name.len()])
                .any(|i| matches(rest, &name[i..]))
        }
        Some(first) => {
            let mut characters = name.chars();
            characters
                .next()
                .is_some_and(|c| first == '?' || first == c)
                && matches(&glob[first.len_utf8()..], characters.as_str())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::matches;

    #[test]
    fn globs() {
        for (glob, name, expected) in [
            ("p*_base", "p0_base", true),
            ("p?_base", "p0_base", true),
            ("p?_base", "p10_base", false),
            ("*", "", true),
            ("object", "object", true),
            ("object", "objects", false),
            ("**_t*", "p0_tip", true),
            ("é*", "éa", true),
        ] {
            assert_eq!(matches(glob, name), expected, "{glob} {name}");
        }
    }
}
