//! What changes in a model file.

use std::fmt::Write as _;

/// Lines of a diff around a change.
const CONTEXT: usize = 2;

/// The unified difference of two texts of which the second mostly has the lines of the first.
pub fn diff(old: &str, new: &str, name: &str) -> String {
    let (a, b): (Vec<&str>, Vec<&str>) = (old.lines().collect(), new.lines().collect());
    // longest common subsequence: files have hundreds of lines
    let mut length = vec![vec![0_u32; b.len() + 1]; a.len() + 1];
    for i in (0..a.len()).rev() {
        for j in (0..b.len()).rev() {
            length[i][j] = if a[i] == b[j] {
                length[i + 1][j + 1] + 1
            } else {
                length[i + 1][j].max(length[i][j + 1])
            };
        }
    }
    let mut lines: Vec<(char, &str, usize, usize)> = Vec::new();
    let (mut i, mut j) = (0, 0);
    while i < a.len() || j < b.len() {
        if i < a.len() && j < b.len() && a[i] == b[j] {
            lines.push((' ', a[i], i, j));
            (i, j) = (i + 1, j + 1);
        } else if i < a.len() && (j == b.len() || length[i + 1][j] >= length[i][j + 1]) {
            lines.push(('-', a[i], i, j));
            i += 1;
        } else {
            lines.push(('+', b[j], i, j));
            j += 1;
        }
    }
    let near = |k: usize| {
        let from = k.saturating_sub(CONTEXT);
        lines[from..(k + CONTEXT + 1).min(lines.len())]
            .iter()
            .any(|l| l.0 != ' ')
    };
    let mut out = format!("--- {name}\n+++ model.xml\n");
    let mut k = 0;
    while k < lines.len() {
        if !near(k) {
            k += 1;
            continue;
        }
        let end = (k..lines.len()).find(|e| !near(*e)).unwrap_or(lines.len());
        let hunk = &lines[k..end];
        let count = |sign: char| hunk.iter().filter(|l| l.0 != sign).count();
        let _ = writeln!(
            out,
            "@@ -{},{} +{},{} @@",
            hunk[0].2 + 1,
            count('+'),
            hunk[0].3 + 1,
            count('-')
        );
        for (sign, line, ..) in hunk {
            let _ = writeln!(out, "{sign}{line}");
        }
        k = end;
    }
    out
}

#[cfg(test)]
mod tests {
    use super::diff;

    #[test]
    fn a_diff_shows_what_changed() {
        let old = "a\nb\nc\nd\ne\nf\ng\n";
        let new = "a\nb\nc\nX\ne\nf\ng\nh\n";
        let expected = "--- m\n+++ model.xml\n@@ -2,6 +2,7 @@\n b\n c\n-d\n+X\n e\n f\n g\n+h\n";
        assert_eq!(diff(old, new, "m"), expected);
        assert_eq!(diff(old, old, "m"), "--- m\n+++ model.xml\n");
    }
}
