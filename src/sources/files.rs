//! Whole files of bounded size.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use crate::fault::{Fault, Result};

/// All bytes of a file; an error for what is no regular file (a device never ends) or has more than `bytes_max`.
pub fn read_bytes(path: &Path, bytes_max: u64) -> Result<Vec<u8>> {
    let file = File::open(path).map_err(|e| Fault::io(path, &e))?;
    let about = file.metadata().map_err(|e| Fault::io(path, &e))?;
    if !about.is_file() {
        let found = if about.is_dir() { "a directory" } else { "something else" };
        return Err(Fault::new("file", found, "a regular file").in_file(path));
    }
    let mut bytes = Vec::new();
    file.take(bytes_max + 1).read_to_end(&mut bytes).map_err(|e| Fault::io(path, &e))?;
    if bytes.len() as u64 > bytes_max {
        let found = format!("more than {bytes_max} bytes");
        return Err(Fault::new("file size", found, format!("at most {bytes_max}")).in_file(path));
    }
    Ok(bytes)
}

/// The same as text; an error names the first line that is not UTF-8.
pub fn read_text(path: &Path, bytes_max: u64) -> Result<String> {
    String::from_utf8(read_bytes(path, bytes_max)?).map_err(|e| {
        let line = 1 + e.as_bytes()[..e.utf8_error().valid_up_to()].iter().filter(|b| **b == b'\n').count();
        Fault::new("text", "bytes that are not UTF-8", "UTF-8").in_file(path).at_line(line)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_too_long_or_no_file_or_no_text_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.txt");
        std::fs::write(&path, b"one\ntwo \xff\n").unwrap();
        assert_eq!(read_bytes(&path, 100).unwrap().len(), 10);
        assert!(read_bytes(&path, 9).unwrap_err().to_string().contains("more than 9 bytes"));
        assert_eq!(read_text(&path, 100).unwrap_err().line, Some(2));
        assert!(read_bytes(dir.path(), 9).unwrap_err().to_string().contains("a directory"));
        assert!(read_bytes(Path::new("/dev/zero"), 9).is_err());
    }
}
