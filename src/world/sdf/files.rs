//! The files of an SDF world: reading them in bounded memory, and finding what a URI names.

use std::io::Read;
use std::path::{Component, Path, PathBuf};

use super::super::mesh::{read_bounded, utf8};
use super::super::xml::{self, children, trimmed};
use crate::fault::{Fault, Result};

/// The largest description that is read, also after unpacking (bytes).
const SDF_BYTES_MAX: u64 = 64 << 20;

/// A file to read from, and the folder its relative paths start in.
pub(super) struct SourceFile {
    /// As the user named it.
    pub(super) path: PathBuf,
    /// The one name of the file, whatever way led there.
    pub(super) identity: PathBuf,
    folder: PathBuf,
}

impl SourceFile {
    pub(super) fn open(path: &Path) -> Result<Self> {
        let identity = path.canonicalize().map_err(|e| Fault::io(path, &e))?;
        let folder = identity.parent().map(Path::to_path_buf).unwrap_or_default();
        Ok(Self { path: path.to_path_buf(), identity, folder })
    }

    pub(super) fn text(&self) -> Result<String> {
        let bytes = read_bounded(&self.identity, SDF_BYTES_MAX).map_err(|mut fault| {
            fault.file = None;
            fault.in_file(&self.path)
        })?;
        let bytes = unpacked(bytes).map_err(|fault| fault.in_file(&self.path))?;
        utf8(&bytes).map(str::to_string).map_err(|fault| fault.in_file(&self.path))
    }
}

/// The bytes as they are, or unpacked if they are gzip'ed.
fn unpacked(bytes: Vec<u8>) -> Result<Vec<u8>> {
    if !bytes.starts_with(&[0x1f, 0x8b]) {
        return Ok(bytes);
    }
    let mut unpacked = Vec::new();
    let mut reader = flate2::read::MultiGzDecoder::new(bytes.as_slice()).take(SDF_BYTES_MAX + 1);
    reader.read_to_end(&mut unpacked).map_err(|e| Fault::new("gzip", e, "a whole gzip file"))?;
    if unpacked.len() as u64 > SDF_BYTES_MAX {
        return Err(Fault::new("unpacked size", "more", format!("at most {SDF_BYTES_MAX} bytes")));
    }
    Ok(unpacked)
}

/// Where `model://` is looked up for a file in this folder.
fn lookup_folders(folder: &Path) -> Vec<PathBuf> {
    let near = folder.ancestors().take(2).map(Path::to_path_buf);
    near.chain(folder.ancestors().map(|above| above.join("models"))).collect()
}

/// What a URI leads to.
pub(super) enum Found {
    Path(PathBuf),
    Network,
    Nowhere,
}

/// The folders in which `model://` is looked up.
#[derive(Default)]
pub(super) struct Lookup {
    /// Those of the file the user named.
    roots: Vec<PathBuf>,
    /// Those the user gave.
    model_path: Vec<PathBuf>,
}

impl Lookup {
    pub(super) fn new(file: &SourceFile, model_path: &[PathBuf]) -> Self {
        Self { roots: lookup_folders(&file.folder), model_path: model_path.to_vec() }
    }

    /// What a URI leads to.
    ///
    /// # Errors
    /// A scheme nobody knows; a `model://` that leaves its folder.
    pub(super) fn resolve(&self, uri: &str, file: &SourceFile) -> Result<Found> {
        let (scheme, rest) = uri.split_once("://").unwrap_or(("", uri));
        let candidates: Vec<PathBuf> = match scheme.to_lowercase().as_str() {
            "http" | "https" => return Ok(Found::Network),
            "" | "file" => vec![file.folder.join(rest)],
            "model" | "package" => {
                let escapes = |part| !matches!(part, Component::Normal(_) | Component::CurDir);
                if rest.is_empty() || Path::new(rest).components().any(escapes) {
                    return Err(Fault::new("uri", format!("`{uri}`"), "`model://NAME/…` without `..`"));
                }
                let folders = lookup_folders(&file.folder);
                folders.iter().chain(&self.roots).chain(&self.model_path).map(|folder| folder.join(rest)).collect()
            }
            _ => return Err(Fault::new("uri", format!("`{uri}`"), "model://, file://, http(s):// or a path")),
        };
        Ok(candidates.into_iter().find(|path| path.exists()).map_or(Found::Nowhere, Found::Path))
    }
}

/// Whether a URI names the ground plane that Gazebo's own library holds.
pub(super) fn is_ground_plane(uri: &str) -> bool {
    let parts = uri.trim_end_matches('/').rsplit('/');
    let mut names = parts.filter(|part| !part.bytes().all(|b| b.is_ascii_digit()) && *part != "tip");
    let name = names.next().unwrap_or_default().to_lowercase().replace("%20", " ").replace('_', " ");
    name == "ground plane"
}

/// The description in a model's folder: what `model.config` names for the newest version, or `model.sdf`.
pub(super) fn description_in(folder: &Path) -> Result<PathBuf> {
    let config = folder.join("model.config");
    if !config.exists() {
        return Ok(folder.join("model.sdf"));
    }
    let text = SourceFile::open(&config)?.text()?;
    let document = xml::parse(&text).map_err(|fault| fault.in_file(&config))?;
    let version = |node: &roxmltree::Node| -> Vec<u32> {
        node.attribute("version").unwrap_or_default().split('.').map(|part| part.parse().unwrap_or(0)).collect()
    };
    let newest = children(document.root_element(), "sdf").max_by_key(version);
    Ok(folder.join(newest.map(trimmed).filter(|name| !name.is_empty()).unwrap_or_else(|| "model.sdf".to_string())))
}
