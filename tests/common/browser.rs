//! A page in a browser.

use std::process::Command;

/// The document of a page after its scripts ran, in a browser that cannot resolve any host; none where there is no
/// browser, which is said.
#[allow(clippy::print_stdout)] // what was skipped
pub(crate) fn dom(html: &str) -> Option<String> {
    let paths = std::env::var_os("PATH").unwrap_or_default();
    let mut found = std::env::split_paths(&paths).map(|folder| folder.join("chromium"));
    let Some(browser) = found.find(|path| path.is_file()) else {
        println!("skipped: no chromium (Debian package `chromium`)");
        return None;
    };
    let folder = tempfile::tempdir().expect("a folder");
    let page = folder.path().join("page.html");
    std::fs::write(&page, html).expect("written");
    let profile = folder.path().join("profile");
    let output = Command::new(browser)
        .args([
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-dev-shm-usage",
        ])
        .args([
            "--host-resolver-rules=MAP * ~NOTFOUND",
            "--virtual-time-budget=10000",
        ])
        .arg(format!("--user-data-dir={}", profile.display()))
        .arg("--dump-dom")
        .arg(format!("file://{}", page.display()))
        .output()
        .expect("the browser runs");
    Some(String::from_utf8_lossy(&output.stdout).into_owned())
}
