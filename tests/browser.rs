//! The viewer as a user sees it: a short run, opened in headless Chromium by `tests/browser/view.mjs`.
//!
//! Needs node, `npm ci` in tests/browser, and Chromium; without them it says that it was skipped, unless
//! METROMAP_BROWSER=required (as in the check).

use std::path::Path;
use std::process::Command;

const ROOT: &str = env!("CARGO_MANIFEST_DIR");

#[test]
fn a_run_is_seen_in_a_browser() {
    let folder = Path::new(ROOT).join("tests/browser");
    let ready = folder.join("node_modules/playwright-core").exists() && Path::new("/usr/bin/chromium").exists();
    if !ready {
        let required = std::env::var("METROMAP_BROWSER").is_ok_and(|v| v == "required");
        assert!(!required, "no Chromium, or no `npm ci` in tests/browser");
        eprintln!("skipped: Chromium or tests/browser/node_modules is absent");
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("lab");
    let metromap = env!("CARGO_BIN_EXE_metromap");
    let run = Command::new(metromap)
        .current_dir(ROOT)
        .args(["run", "worlds/lab.toml", "--duration-s", "60", "--json", "--out"])
        .arg(&out)
        .output()
        .unwrap();
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    let picture = dir.path().join("view.png");
    let seen = Command::new("node")
        .current_dir(&folder)
        .env("VIEW_S_MAX", "600") // drawn in software, on a busy machine
        .arg("view.mjs")
        .args([Path::new(metromap), &out.join("view.rrd"), &picture])
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&seen.stdout).into_owned() + &String::from_utf8_lossy(&seen.stderr);
    assert!(seen.status.success(), "{said}");
    eprintln!("{said}");
}
