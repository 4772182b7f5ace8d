//! Recorded ranges of a ring as a text table: a scan a row, a transducer a column.

use std::path::Path;

use super::files::read_text;
use crate::fault::{Fault, Result};

/// Largest file that is read [bytes].
const FILE_BYTES_MAX: u64 = 64 << 20;
/// Letters of a wrong cell that are shown.
const SHOWN_MAX: usize = 24;

/// Ranges of a ring, scan by scan.
#[derive(Clone, Debug, PartialEq)]
pub struct RangeTable {
    count: usize,
    ranges_m: Vec<f64>,
}

impl RangeTable {
    /// Reads a table of this many transducers: ranges [m] separated by commas or blanks. Further columns are ignored; so are
    /// empty lines, what follows `#`, and a first line without a number where ranges belong.
    ///
    /// # Errors
    /// With file and line: a cell that is no range, a row that is too short; a file without rows, or larger than 64 MiB.
    pub fn load(path: &Path, count: usize) -> Result<Self> {
        Self::parse(&read_text(path, FILE_BYTES_MAX)?, count).map_err(|fault| fault.in_file(path))
    }

    fn parse(text: &str, count: usize) -> Result<Self> {
        let count = count.max(1);
        let mut table = Self { count, ranges_m: Vec::new() };
        let mut first = true;
        for (i, line) in text.trim_start_matches('\u{feff}').lines().enumerate() {
            let content = line.split('#').next().unwrap_or_default().trim();
            if content.is_empty() {
                continue;
            }
            let begun = std::mem::take(&mut first);
            if !(begun && cells(content).take(count).all(|cell| cell.parse::<f64>().is_err())) {
                table.add(content).map_err(|fault| fault.at_line(i + 1))?;
            }
        }
        if table.ranges_m.is_empty() {
            return Err(Fault::new("table of ranges", "no rows", format!("rows of {count} ranges [m]")));
        }
        Ok(table)
    }

    fn add(&mut self, row: &str) -> Result<()> {
        let before = self.ranges_m.len();
        for (column, cell) in cells(row).take(self.count).enumerate() {
            let range = cell.parse::<f64>().ok().filter(|range| *range >= 0.0);
            self.ranges_m.push(range.ok_or_else(|| {
                let expected = "a range [m] of at least 0, or inf where there was no echo";
                Fault::new(format!("column {}", column + 1), format!("`{}`", shortened(cell)), expected)
            })?);
        }
        let found = self.ranges_m.len() - before;
        if found < self.count {
            let expected = format!("at least {}, a range of every transducer", self.count);
            return Err(Fault::new("row", format!("{found} columns"), expected));
        }
        Ok(())
    }

    /// The scans in the order of the file.
    pub fn rows(&self) -> Vec<&[f64]> {
        self.ranges_m.chunks_exact(self.count).collect()
    }
}

/// The cells of a row: between commas if it has any, else between blanks.
fn cells(row: &str) -> Box<dyn Iterator<Item = &str> + '_> {
    if row.contains(',') { Box::new(row.split(',').map(str::trim)) } else { Box::new(row.split_whitespace()) }
}

fn shortened(cell: &str) -> String {
    let mut letters = cell.chars();
    let shown: String = letters.by_ref().take(SHOWN_MAX).collect();
    if letters.next().is_some() { shown + "…" } else { shown }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rows(text: &str, count: usize) -> Vec<Vec<f64>> {
        RangeTable::parse(text, count).unwrap().rows().into_iter().map(<[f64]>::to_vec).collect()
    }

    fn fault(text: &str) -> String {
        RangeTable::parse(text, 2).unwrap_err().to_string()
    }

    #[test]
    fn commas_or_blanks_with_or_without_a_header_and_a_label() {
        let expected = vec![vec![0.5, 5.0], vec![1.0, 0.0]];
        for text in [
            "0.5,5.0,Left\n1,0,Right\n",
            "S1,S2,class\r\n0.5, 5.0 ,Left\r\n1,0,\r\n",
            "\u{feff}first second\n\n0.5\t5\n  1 0 7 8\n",
            "# seen on a Monday\n0.5 5 # far\n1 0",
        ] {
            assert_eq!(rows(text, 2), expected, "{text:?}");
        }
        assert_eq!(rows("7,8,9\n", 1), [[7.0]]);
    }

    #[test]
    fn what_is_no_range_is_refused_with_its_line_and_column() {
        let range = "expected a range [m] of at least 0, or inf where there was no echo";
        assert_eq!(fault("a b\n1 2\n1 x\n"), format!("line 3: column 2: found `x`, {range}"));
        assert_eq!(fault("1,nan\n"), format!("line 1: column 2: found `nan`, {range}"));
        assert_eq!(fault("1,2\n\n-0.1,2\n"), format!("line 3: column 1: found `-0.1`, {range}"));
        assert_eq!(rows("1,2\ninf,2\n", 2)[1], [f64::INFINITY, 2.0]);
        assert_eq!(fault("1,2\n-inf,2\n"), format!("line 2: column 1: found `-inf`, {range}"));
        assert_eq!(fault("1,,2\n"), format!("line 1: column 2: found ``, {range}"));
        assert_eq!(fault("1,2 3\n"), format!("line 1: column 2: found `2 3`, {range}"));
        // A header has no number, and there is only one.
        assert_eq!(fault("a,2\n1,2\n"), format!("line 1: column 1: found `a`, {range}"));
        assert_eq!(fault("a,b\nc,d\n"), format!("line 2: column 1: found `c`, {range}"));
        assert!(fault(&format!("1 2\n{} 2\n", "y".repeat(99))).contains(&format!("`{}…`", "y".repeat(24))));
    }

    #[test]
    fn short_rows_and_empty_files_are_refused() {
        let short = "found 1 columns, expected at least 2, a range of every transducer";
        assert_eq!(fault("1 2\n3\n"), format!("line 2: row: {short}"));
        for text in ["", "\n\n", "a,b\n", "# nothing\n"] {
            assert_eq!(fault(text), "table of ranges: found no rows, expected rows of 2 ranges [m]");
        }
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("ranges.csv");
        std::fs::write(&path, "1 2\n3 -4\n").unwrap();
        let fault = RangeTable::load(&path, 2).unwrap_err().to_string();
        assert!(fault.contains("ranges.csv:2: column 2: found `-4`"), "{fault}");
        std::fs::File::create(&path).unwrap().set_len(FILE_BYTES_MAX + 1).unwrap();
        assert!(RangeTable::load(&path, 2).unwrap_err().to_string().contains("file size: found more than"));
    }
}
