//! The house rules, read from `src/lib.rs` and held against the code: who may import whom, and how long things may get.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

const ROOT: &str = env!("CARGO_MANIFEST_DIR");
const FILE_LINES_MAX: usize = 500;
const FUNCTION_LINES_MAX: usize = 80;
/// What simulates; what maps must never see it.
const TRUTH: [&str; 4] = ["world", "robot", "scanner", "sonar"];
const BEHIND_THE_BARRIER: [&str; 6] = ["line", "points", "calibration", "maps", "navigation", "pipeline"];
/// Crates that only one place may name.
const ONE_PLACE: [(&str, &str); 4] = [
    ("rapier3d", "world/physics.rs"),
    ("spade", "maps/terrain.rs"),
    ("rerun", "sinks/rerun"),
    ("mcap", "record/bag.rs"),
];

fn sources(dir: &Path, out: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(dir).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            sources(&path, out);
        } else if path.extension().is_some_and(|e| e == "rs") {
            out.push(path);
        }
    }
    out.sort();
}

/// Every source file: its path below src, the room (top-level module) it is in, and its code before the tests.
fn files() -> Vec<(String, String, Vec<String>)> {
    let src = Path::new(ROOT).join("src");
    let mut paths = Vec::new();
    sources(&src, &mut paths);
    let mut files = Vec::new();
    for path in paths {
        let below = path.strip_prefix(&src).unwrap().to_string_lossy().replace('\\', "/");
        let room = below.split('/').next().unwrap().trim_end_matches(".rs").to_string();
        let text = fs::read_to_string(&path).unwrap();
        let code: Vec<String> = text.lines().take_while(|l| l.trim() != "#[cfg(test)]").map(String::from).collect();
        files.push((below, room, code));
    }
    files
}

/// The level table of `lib.rs`: lines such as `//! | 3 | robot points |`.
fn levels() -> BTreeMap<String, usize> {
    let text = fs::read_to_string(Path::new(ROOT).join("src/lib.rs")).unwrap();
    let mut levels = BTreeMap::new();
    for line in text.lines().filter_map(|l| l.strip_prefix("//! | ")) {
        let cells: Vec<&str> = line.split('|').map(str::trim).collect();
        if let Ok(level) = cells[0].parse::<usize>() {
            levels.extend(cells[1].split_whitespace().map(|room| (room.to_string(), level)));
        }
    }
    levels
}

/// Lines of code with their numbers from 0; a `use` over several lines is one.
fn statements(code: &[String]) -> Vec<(usize, String)> {
    let mut joined: Vec<(usize, String)> = Vec::new();
    let mut open = false;
    for (number, line) in code.iter().enumerate() {
        let line = line.split("//").next().unwrap_or_default();
        match joined.last_mut().filter(|_| open) {
            Some((_, statement)) => statement.push_str(line.trim()),
            None => joined.push((number, line.to_string())),
        }
        let begins = line.trim_start().starts_with("use ") || line.trim_start().starts_with("pub use ");
        open = (open || begins) && !line.contains(';');
    }
    joined
}

/// The rooms that a line of code names through `crate::` (in the binary, `metromap::`).
fn rooms_named(line: &str) -> Vec<String> {
    let code = line.split("//").next().unwrap_or_default();
    let mut rooms = Vec::new();
    for prefix in ["crate::", "metromap::"] {
        for (at, _) in code.match_indices(prefix) {
            let rest = &code[at + prefix.len()..];
            if let Some(group) = rest.strip_prefix('{') {
                let inner = group.split('}').next().unwrap_or_default();
                rooms.extend(
                    inner.split(',').map(|part| part.trim().split("::").next().unwrap_or_default().to_string()),
                );
            } else {
                rooms.push(rest.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect());
            }
        }
    }
    rooms.retain(|room| !room.is_empty());
    rooms
}

#[test]
fn every_room_has_a_level_and_imports_only_from_below() {
    let levels = levels();
    assert!(levels.len() > 10, "the level table of lib.rs was not found: {levels:?}");
    let mut wrong = Vec::new();
    for (file, room, code) in files() {
        if room == "lib" {
            continue;
        }
        let Some(own) = levels.get(&room) else {
            wrong.push(format!("{file}: `{room}` is not in the level table of lib.rs"));
            continue;
        };
        for (number, line) in statements(&code) {
            for named in rooms_named(&line) {
                let allowed = named == room || levels.get(&named).is_some_and(|level| level < own);
                if !allowed {
                    wrong.push(format!("{file}:{}: level {own} imports `{named}`", number + 1));
                }
                if BEHIND_THE_BARRIER.contains(&room.as_str()) && TRUTH.contains(&named.as_str()) {
                    wrong.push(format!("{file}:{}: behind the truth barrier, yet imports `{named}`", number + 1));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn big_libraries_are_named_in_one_place() {
    let mut wrong = Vec::new();
    for (file, _, code) in files() {
        for (library, place) in ONE_PLACE {
            let named = code.iter().any(|l| {
                let l = l.split("//").next().unwrap_or_default();
                // Not a path of our own such as `crate::sinks::rerun::`.
                l.match_indices(&format!("{library}::")).any(|(at, _)| {
                    !l[..at].ends_with("::") && !l[..at].ends_with(|c: char| c.is_alphanumeric() || c == '_')
                })
            });
            if named && !file.starts_with(place) {
                wrong.push(format!("{file} names {library}, which belongs in {place}"));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn nothing_is_too_long_to_read() {
    let mut wrong = Vec::new();
    for (file, _, code) in files() {
        if code.len() > FILE_LINES_MAX {
            wrong.push(format!("{file}: {} lines before its tests", code.len()));
        }
        let mut start: Option<(usize, usize)> = None; // line and indentation of the function we are in
        for (number, line) in code.iter().enumerate() {
            let indent = line.len() - line.trim_start().len();
            let words = line.trim_start();
            let opens = ["fn ", "pub fn ", "pub(crate) fn ", "pub(super) fn ", "const fn ", "pub const fn "];
            if opens.iter().any(|o| words.starts_with(o)) {
                start = Some((number, indent));
            }
            if let Some((first, depth)) = start
                && words.starts_with('}')
                && indent == depth
            {
                let length = number - first + 1;
                if length > FUNCTION_LINES_MAX {
                    wrong.push(format!("{file}:{}: a function of {length} lines", first + 1));
                }
                start = None;
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn only_the_command_line_prints() {
    let mut wrong = Vec::new();
    for (file, room, code) in files() {
        if room == "cli" || room == "main" {
            continue;
        }
        for (number, line) in code.iter().enumerate() {
            let line = line.split("//").next().unwrap_or_default();
            if ["println!", "eprintln!", "print!(", "dbg!("].iter().any(|p| line.contains(p)) {
                wrong.push(format!("{file}:{}: {}", number + 1, line.trim()));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}
