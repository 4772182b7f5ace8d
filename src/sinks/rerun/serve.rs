//! The embedded web viewer on 127.0.0.1: beside a run that goes on, or over a file.

use std::any::Any;
use std::fs::File;
use std::io::{self, BufReader, Read, Seek, SeekFrom, Write};
use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use rerun::ServerOptions;
use rerun::external::re_log_encoding::rrd::{Decodable, DecoderTransport, RRD_FOURCC, StreamFooter};
use rerun::grpc_server::GrpcServerSink;
use rerun::web_viewer::WebViewerConfig;

use super::blueprint;
use crate::fault::{Fault, Result};
use crate::record::METADATA_RECORDING;

/// The first and the last bytes of an MCAP file.
const MCAP_MAGIC: &[u8; 8] = b"\x89MCAP0\r\n";

/// The head of a request is short; more than this is none [bytes].
const HEAD_BYTES_MAX: usize = 16 << 10;

/// Where the layout of a recording is, beside the recording.
const LAYOUT_PATH: &str = "/layout.rbl";

/// How much of the end of an MCAP file is searched for what it is of [bytes].
const SUMMARY_BYTES_MAX: u64 = 1 << 20;

/// How long a browser may take to say what it wants, or to take a piece of the file.
const BROWSER_S_MAX: u64 = 30;

/// The page of the web viewer; served until it is dropped.
struct Page {
    url: String,
    /// The server: its type has no name outside of Rerun.
    _server: Box<dyn Any + Send>,
}

impl Page {
    /// Serves the page at a port (0: a free one), so that it shows these sources.
    fn start(port: u16, sources: Vec<String>, open_browser: bool) -> Result<Self> {
        drop(listen(port)?); // Rerun would name the port only within a sentence
        let escaped = |source: &String| source.replace(':', "%3A").replace('/', "%2F").replace('+', "%2B");
        let query: Vec<String> = sources.iter().map(|source| format!("url={}", escaped(source))).collect();
        let config = WebViewerConfig {
            bind_ip: Ipv4Addr::LOCALHOST.to_string(),
            web_port: port.into(),
            connect_to: sources,
            open_browser,
            ..WebViewerConfig::default()
        };
        let server = config.host_web_viewer().map_err(|e| Fault::new("web viewer", e, "a page that can be served"))?;
        Ok(Self { url: format!("{}/?{}", server.server_url(), query.join("&")), _server: Box::new(server) })
    }

    /// What the browser calls the page's origin, by number and by name.
    fn origins(&self) -> [String; 2] {
        let origin = self.url.split("/?").next().unwrap_or_default().to_string();
        [origin.replace("127.0.0.1", "localhost"), origin]
    }
}

/// A listener on 127.0.0.1; port 0 takes a free one.
fn listen(port: u16) -> Result<TcpListener> {
    TcpListener::bind((Ipv4Addr::LOCALHOST, port))
        .map_err(|e| Fault::new("port", format!("{port} on 127.0.0.1 ({e})"), "a port that is free, or 0 for any"))
}

/// The web viewer beside a run that goes on.
pub(super) struct Web {
    page: Page,
}

impl Web {
    /// Starts the page, and the server that keeps the run's data for it.
    pub(super) fn start(port: u16) -> Result<(Self, GrpcServerSink)> {
        let free = listen(0)?.local_addr().map_err(|e| Fault::new("port", e, "a port that is free"))?;
        let sink = GrpcServerSink::new(&free.ip().to_string(), free.port(), ServerOptions::default());
        let sink = sink.map_err(|e| Fault::new("port", e, "127.0.0.1"))?;
        wait_for(free)?;
        Ok((Self { page: Page::start(port, vec![sink.uri().to_string()], false)? }, sink))
    }

    /// Where to point a browser.
    pub(super) fn url(&self) -> &str {
        &self.page.url
    }
}

/// Rerun's server starts on a thread of its own and reports no failure.
fn wait_for(address: SocketAddr) -> Result<()> {
    for _ in 0..100 {
        if TcpStream::connect_timeout(&address, Duration::from_secs(1)).is_ok() {
            return Ok(());
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    Err(Fault::new("port", format!("{address}, where nothing answers"), "a server of Rerun"))
}

/// A recording in the embedded web viewer, served until it is dropped.
pub struct FileServer {
    page: Page,
    address: SocketAddr,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

/// What a connection needs to know.
struct Serving {
    file: PathBuf,
    path: String,
    layout: Vec<u8>,
    hosts: [String; 2],
    origins: [String; 2],
}

impl FileServer {
    /// Checks the file (see [`check_file`]) and serves it with the viewer's page at this port of 127.0.0.1 (0: a free one).
    ///
    /// Errors: those of the check, or a port that is taken.
    pub fn start(file: &Path, port: u16, open_browser: bool) -> Result<Self> {
        check_file(file)?;
        let listener = listen(0)?;
        let address = listener.local_addr().map_err(|e| Fault::new("port", e, "a port that is free"))?;
        let name = name_in_url(file);
        let path = format!("/{name}");
        let mut sources = vec![format!("http://{address}{path}")];
        let mut layout = vec![];
        if is_own_recording(file).map_err(|e| Fault::io(file, &e))? {
            // The viewer looks for the layout under the name of the file without its ending.
            layout = blueprint::of_recording(name.trim_end_matches(".mcap"))?;
            sources.push(format!("http://{address}{LAYOUT_PATH}"));
        }
        let page = Page::start(port, sources, open_browser)?;
        let hosts = [address.to_string(), format!("localhost:{}", address.port())];
        let serving = Arc::new(Serving { file: file.to_path_buf(), path, layout, hosts, origins: page.origins() });
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = stop.clone();
        let thread = std::thread::spawn(move || {
            for stream in listener.incoming() {
                if stopped.load(Ordering::Acquire) {
                    return;
                }
                let (Ok(stream), serving) = (stream, serving.clone()) else { continue };
                // A browser that goes away in the middle is no fault.
                std::thread::spawn(move || serving.answer(stream).ok());
            }
        });
        Ok(Self { page, address, stop, thread: Some(thread) })
    }

    /// Where to point a browser.
    pub fn url(&self) -> &str {
        &self.page.url
    }
}

impl Drop for FileServer {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        let woken = TcpStream::connect_timeout(&self.address, Duration::from_secs(1)).is_ok();
        if let Some(thread) = self.thread.take().filter(|_| woken) {
            thread.join().ok();
        }
    }
}

/// The file's name where it is plain enough for a URL: the viewer shows it.
fn name_in_url(file: &Path) -> String {
    let plain = |name: &&str| name.chars().all(|c| c.is_ascii_alphanumeric() || "._-".contains(c));
    let kind = file.extension().and_then(|kind| kind.to_str()).unwrap_or_default();
    let name = file.file_name().and_then(|name| name.to_str()).filter(plain);
    name.map_or_else(|| format!("recording.{kind}"), str::to_string)
}

impl Serving {
    /// Answers one request of HTTP/1.1 and closes. Only the page itself may have the file.
    fn answer(&self, mut stream: TcpStream) -> io::Result<()> {
        let patience = Some(Duration::from_secs(BROWSER_S_MAX));
        stream.set_read_timeout(patience)?;
        stream.set_write_timeout(patience)?;
        let Some(head) = read_head(&mut stream)? else { return reply(&mut stream, "400 Bad Request", "") };
        let header = |name: &str| {
            let lines = head.lines().skip(1).filter_map(|line| line.split_once(':'));
            lines.filter(|(key, _)| key.eq_ignore_ascii_case(name)).map(|(_, value)| value.trim()).next()
        };
        let known = |value: Option<&str>, those: &[String; 2]| value.is_some_and(|v| those.iter().any(|one| one == v));
        // Another site may have its name lead to 127.0.0.1, or ask from its own page: neither gets the file.
        if !known(header("host"), &self.hosts) || header("origin").is_some_and(|o| !known(Some(o), &self.origins)) {
            return reply(&mut stream, "403 Forbidden", "");
        }
        let mut allow = header("origin").map_or(String::new(), |o| format!("Access-Control-Allow-Origin: {o}\r\n"));
        let mut words = head.lines().next().unwrap_or_default().split(' ');
        match (words.next(), words.next()) {
            (Some("OPTIONS"), _) => {
                allow += "Access-Control-Allow-Methods: GET, HEAD\r\nAccess-Control-Allow-Headers: *\r\n";
                allow += "Access-Control-Allow-Private-Network: true\r\n";
                reply(&mut stream, "204 No Content", &allow)
            }
            (Some(method @ ("GET" | "HEAD")), Some(path)) if path == self.path => {
                let file = File::open(&self.file)?;
                let bytes = file.metadata()?.len();
                start_reply(&mut stream, "200 OK", &content(bytes, &allow))?;
                if method == "GET" {
                    io::copy(&mut file.take(bytes), &mut stream)?;
                }
                stream.flush()
            }
            (Some("GET"), Some(LAYOUT_PATH)) if !self.layout.is_empty() => {
                start_reply(&mut stream, "200 OK", &content(self.layout.len() as u64, &allow))?;
                stream.write_all(&self.layout)
            }
            _ => reply(&mut stream, "404 Not Found", &allow),
        }
    }
}

/// Reads up to the empty line; `None` if there is none within bounds.
fn read_head(stream: &mut TcpStream) -> io::Result<Option<String>> {
    let mut head = vec![];
    let mut piece = [0; 1024];
    while head.len() < HEAD_BYTES_MAX {
        let count = stream.read(&mut piece)?;
        head.extend_from_slice(&piece[..count]);
        if let Some(end) = head.windows(4).position(|bytes| bytes == b"\r\n\r\n") {
            head.truncate(end);
            return Ok(String::from_utf8(head).ok());
        }
        if count == 0 {
            break;
        }
    }
    Ok(None)
}

fn start_reply(stream: &mut TcpStream, status: &str, headers: &str) -> io::Result<()> {
    let cache = "Cache-Control: no-store\r\nConnection: close\r\n";
    stream.write_all(format!("HTTP/1.1 {status}\r\n{cache}{headers}\r\n").as_bytes())
}

fn content(bytes: u64, allow: &str) -> String {
    format!("Content-Type: application/octet-stream\r\nContent-Length: {bytes}\r\n{allow}")
}

fn reply(stream: &mut TcpStream, status: &str, headers: &str) -> io::Result<()> {
    start_reply(stream, status, &format!("Content-Length: 0\r\n{headers}"))
}

/// Refuses what the viewer cannot show: a file that is missing, empty, no `.rrd` or `.mcap`, damaged or cut off.
pub fn check_file(file: &Path) -> Result<()> {
    let fault = |found: String, expected: &str| Fault::new("recording", found, expected).in_file(file);
    let io = |e: io::Error| Fault::io(file, &e);
    if file.is_dir() {
        return Err(fault("a directory".into(), "an .rrd or .mcap file"));
    }
    let mut opened = File::open(file).map_err(io)?;
    let bytes = opened.metadata().map_err(io)?.len();
    if bytes == 0 {
        return Err(fault("an empty file".into(), "an .rrd or .mcap file"));
    }
    let kind = file.extension().and_then(|kind| kind.to_str()).unwrap_or_default();
    let (magic, tail) = ends(&mut opened, bytes).map_err(io)?;
    let (begins, complete) = match kind {
        "rrd" => (magic.starts_with(&RRD_FOURCC), StreamFooter::from_rrd_bytes(&tail).is_ok()),
        "mcap" => (magic == MCAP_MAGIC, tail.ends_with(MCAP_MAGIC) && bytes > 16),
        _ => return Err(fault(format!("a file named .{kind}"), "an .rrd or .mcap file")),
    };
    if !begins {
        return Err(fault("a file that does not begin as one".into(), &format!("an .{kind} file")));
    }
    if !complete {
        return Err(fault("a file without its end: cut off?".into(), &format!("a whole .{kind} file")));
    }
    if kind == "rrd" {
        opened.rewind().map_err(io)?;
        for message in DecoderTransport::decode_lazy(BufReader::new(opened)) {
            message.map_err(|e| fault(format!("damage ({e})"), "a whole .rrd file"))?;
        }
    }
    Ok(())
}

/// Whether this is an MCAP file of this crate, whose topics are known: its name for that stands in the summary, at the end.
fn is_own_recording(file: &Path) -> io::Result<bool> {
    if file.extension().is_none_or(|kind| kind != "mcap") {
        return Ok(false);
    }
    let mut opened = File::open(file)?;
    let bytes = opened.metadata()?.len();
    opened.seek(SeekFrom::Start(bytes.saturating_sub(SUMMARY_BYTES_MAX)))?;
    let mut summary = vec![];
    opened.take(SUMMARY_BYTES_MAX).read_to_end(&mut summary)?;
    let name = METADATA_RECORDING.as_bytes();
    Ok(summary.windows(name.len()).any(|bytes| bytes == name))
}

/// The first 8 bytes, and the last as many as the footer of an `.rrd` has; fewer where the file has no more.
fn ends(file: &mut File, bytes: u64) -> io::Result<(Vec<u8>, Vec<u8>)> {
    let (mut first, mut last) = (vec![], vec![]);
    Read::by_ref(file).take(8).read_to_end(&mut first)?;
    file.seek(SeekFrom::Start(bytes.saturating_sub(StreamFooter::ENCODED_SIZE_BYTES as u64)))?;
    file.take(StreamFooter::ENCODED_SIZE_BYTES as u64).read_to_end(&mut last)?;
    Ok((first, last))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A file of this content; keep the directory as long as the file.
    fn file(name: &str, content: &[u8]) -> (tempfile::TempDir, PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(name);
        std::fs::write(&path, content).unwrap();
        (folder, path)
    }

    fn mcap() -> Vec<u8> {
        [&MCAP_MAGIC[..], &[1; 100], MCAP_MAGIC].concat()
    }

    fn ask(address: SocketAddr, request: &str) -> String {
        let mut stream = TcpStream::connect(address).unwrap();
        stream.write_all(request.as_bytes()).unwrap();
        let mut answer = vec![];
        stream.read_to_end(&mut answer).unwrap();
        String::from_utf8_lossy(&answer).into_owned()
    }

    #[test]
    fn what_cannot_be_shown_is_refused_with_a_reason() {
        let cases: [(&str, &[u8], &str); 6] = [
            ("a.rrd", b"", "an empty file"),
            ("a.txt", b"text", "a file named .txt"),
            ("a.rrd", b"no recording at all, but long enough for one", "does not begin as one"),
            ("a.rrd", b"RRF2", "cut off"),
            ("a.mcap", b"\x89MCAP0\r\n", "cut off"),
            ("a.mcap", &mcap()[..90], "cut off"),
        ];
        for (name, content, reason) in cases {
            let (_folder, path) = file(name, content);
            let fault = check_file(&path).unwrap_err();
            assert!(fault.found.contains(reason), "{fault}");
            assert!(fault.file.as_ref().is_some_and(|file| file.ends_with(name)), "{fault}");
        }
        let (folder, path) = file("a.mcap", &mcap());
        assert_eq!(check_file(&path), Ok(()));
        assert!(check_file(folder.path()).unwrap_err().found.contains("directory"));
        assert_eq!(check_file(&folder.path().join("b.rrd")).unwrap_err().expected, "a file that exists");
    }

    #[test]
    fn the_page_gets_the_file_and_nobody_else_does() {
        let (_folder, path) = file("run 1.mcap", &mcap());
        let server = FileServer::start(&path, 0, false).unwrap();
        let (host, url) = (server.address.to_string(), server.url().to_string());
        let origin = url.split("/?").next().unwrap().to_string();
        assert!(url.ends_with("%2Frecording.mcap"), "{url}"); // a blank is not plain enough
        let get = |path: &str, host: &str, origin: &str| {
            ask(server.address, &format!("GET {path} HTTP/1.1\r\nHost: {host}\r\nOrigin: {origin}\r\n\r\n"))
        };
        let answer = get("/recording.mcap", &host, &origin);
        assert!(answer.starts_with("HTTP/1.1 200 OK\r\n"), "{answer}");
        assert!(answer.contains(&format!("Content-Length: {}\r\n", mcap().len())), "{answer}");
        assert!(answer.contains(&format!("Access-Control-Allow-Origin: {origin}\r\n")), "{answer}");
        assert!(answer.ends_with(&*String::from_utf8_lossy(&mcap())));
        assert!(get("/../../etc/hostname", &host, &origin).starts_with("HTTP/1.1 404"));
        assert!(get("/recording.mcap", &host, "http://elsewhere.example").starts_with("HTTP/1.1 403"));
        assert!(get("/recording.mcap", "elsewhere.example", &origin).starts_with("HTTP/1.1 403"));
        assert!(ask(server.address, "\u{1}\r\n\r\n").starts_with("HTTP/1.1 403"));
        assert!(ask(server.address, &"x".repeat(HEAD_BYTES_MAX + 4096)[..HEAD_BYTES_MAX]).starts_with("HTTP/1.1 400"));
        let page: SocketAddr = origin.trim_start_matches("http://").parse().unwrap();
        assert!(
            ask(page, &format!("GET / HTTP/1.1\r\nHost: {page}\r\nConnection: close\r\n\r\n")).contains("re_viewer")
        );
    }

    #[test]
    fn a_recording_of_this_crate_comes_with_its_layout() {
        let content = [&MCAP_MAGIC[..], &[1; 50], METADATA_RECORDING.as_bytes(), &[1; 50], MCAP_MAGIC].concat();
        let (_folder, path) = file("lab.mcap", &content);
        let server = FileServer::start(&path, 0, false).unwrap();
        assert!(server.url().ends_with("%2Flayout.rbl"), "{}", server.url());
        let answer = ask(server.address, &format!("GET /layout.rbl HTTP/1.1\r\nHost: {}\r\n\r\n", server.address));
        assert!(answer.starts_with("HTTP/1.1 200 OK\r\n") && answer.contains("\r\n\r\nRRF2"), "{answer}");
        let layout = blueprint::of_recording("lab").unwrap();
        let messages = DecoderTransport::decode_lazy(BufReader::new(&*layout));
        assert!(messages.filter(|message| message.is_ok()).count() > 10);
        let (_folder, path) = file("other.mcap", &mcap());
        assert!(!FileServer::start(&path, 0, false).unwrap().url().contains("layout"));
    }

    #[test]
    fn a_taken_port_is_named_and_a_dropped_server_frees_its_own() {
        let (_folder, path) = file("a.mcap", &mcap());
        let server = FileServer::start(&path, 0, false).unwrap();
        let port: u16 = server.page.origins()[1].rsplit(':').next().unwrap().parse().unwrap();
        let fault = FileServer::start(&path, port, false).err().unwrap();
        assert!(fault.to_string().contains(&port.to_string()), "{fault}");
        let fault = Web::start(port).err().unwrap();
        assert!(fault.to_string().contains(&port.to_string()), "{fault}");
        drop(server);
        // The page's listener goes a moment after its server.
        let freed = |_: &u32| {
            std::thread::sleep(Duration::from_millis(20));
            FileServer::start(&path, port, false).is_ok()
        };
        assert!((0..200).any(|n| freed(&n)));
    }
}
