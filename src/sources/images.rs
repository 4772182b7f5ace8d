//! Image files → `Image`, and a folder of images with its poses → `Capture`s.

use std::path::{Path, PathBuf};

use image::{DynamicImage, ImageDecoder, ImageFormat, ImageReader, Limits};
use serde::{Deserialize, Serialize};

use super::files::read_bytes;
use super::image_poses::Poses;
use super::rig_file::RigFile;
use crate::fault::{Fault, Result, number_within};
use crate::image::{Capture, Drop, Dropped, Image, Reading};

/// Largest image file that is read [bytes].
const FILE_BYTES_MAX: u64 = 1 << 29;
/// Most files of one folder.
const FILES_MAX: usize = 10_000_000;
/// Reasons kept for images that could not be used.
const FAULTS_MAX: usize = 100;
/// Level given to no difference by `Channel::RedMinusOthers`, so that noise below it is not cut off.
const NO_DIFFERENCE: i16 = 32;
/// Endings of the files that are taken for images.
pub const ENDINGS: [&str; 7] = ["png", "jpg", "jpeg", "bmp", "pgm", "ppm", "pnm"];

/// What of a colour image is looked at. Grey images are taken as they are.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "snake_case")]
#[value(rename_all = "snake_case")]
pub enum Channel {
    /// Red. The best of these for a red laser: JPEG stores brightness finely and colour differences coarsely, and the
    /// background is taken away along each column anyway.
    #[default]
    Red,
    /// Green.
    Green,
    /// Blue.
    Blue,
    /// Brightness (BT.709).
    Gray,
    /// 32 + red − the larger of green and blue.
    RedMinusOthers,
}

/// Reads an image file (PNG, JPEG, BMP, PNM; at most 64 Mpixel); `white` is the level of a full pixel.
///
/// Errors name the file: it is not there, empty, cut off, of another kind, or too large.
pub fn read_image(path: &Path, channel: Channel, white: u8) -> Result<Image> {
    let bytes = read_bytes(path, FILE_BYTES_MAX)?;
    decode(&bytes, channel, white).map_err(|fault| fault.in_file(path))
}

/// The same for several channels at once; of a grey image only the first, since all would be alike.
pub fn read_channels(path: &Path, channels: &[Channel], white: u8) -> Result<Vec<(Channel, Image)>> {
    let bytes = read_bytes(path, FILE_BYTES_MAX)?;
    let all = decoded(&bytes).and_then(|decoded| {
        let count = if decoded.color().has_color() { channels.len() } else { 1 };
        let (width, height) = (decoded.width() as usize, decoded.height() as usize);
        let image =
            |channel: &Channel| Ok((*channel, Image::new(width, height, white, levels(decoded.clone(), *channel))?));
        channels.iter().take(count).map(image).collect()
    });
    all.map_err(|fault: Fault| fault.in_file(path))
}

/// The images of a folder in natural order (img2 before img10).
///
/// Errors: no folder, or no images in it.
pub fn image_files(folder: &Path) -> Result<Vec<PathBuf>> {
    list(folder, &ImagesSpec::default())
}

/// One channel of an image file's bytes.
pub fn decode(bytes: &[u8], channel: Channel, white: u8) -> Result<Image> {
    let decoded = decoded(bytes)?;
    Image::new(decoded.width() as usize, decoded.height() as usize, white, levels(decoded, channel))
}

fn decoded(bytes: &[u8]) -> Result<DynamicImage> {
    const KINDS: &str = "a PNG, JPEG, BMP or PNM image";
    if bytes.is_empty() {
        return Err(Fault::new("image", "0 bytes", KINDS));
    }
    let reader = ImageReader::new(std::io::Cursor::new(bytes));
    let mut reader = reader.with_guessed_format().map_err(|e| Fault::new("image", e, KINDS))?;
    match reader.format() {
        None => return Err(Fault::new("image", "bytes of another kind", KINDS)),
        Some(ImageFormat::Jpeg) if !jpeg_is_whole(bytes) => {
            return Err(Fault::new("image", "a JPEG that ends too early", "a whole one"));
        }
        Some(_) => {}
    }
    let mut limits = Limits::default();
    limits.max_alloc = Some(8 * Image::PIXELS_MAX as u64);
    reader.limits(limits);
    let decoder = reader.into_decoder().map_err(|e| Fault::new("image", e, KINDS))?;
    let (width, height) = decoder.dimensions();
    if u64::from(width) * u64::from(height) > Image::PIXELS_MAX as u64 {
        return Err(Fault::new("image size", format!("{width} x {height}"), "at most 64 Mpixel"));
    }
    DynamicImage::from_decoder(decoder).map_err(|e| Fault::new("image", e, "a whole image"))
}

/// Whether the scan of a JPEG is followed by its end mark. The decoder fills a cut-off one with grey without a word.
fn jpeg_is_whole(bytes: &[u8]) -> bool {
    let last = |mark: u8| bytes.windows(2).rposition(|pair| pair == [0xFF, mark]);
    match (last(0xDA), last(0xD9)) {
        (Some(scan), Some(end)) => end > scan,
        _ => false,
    }
}

fn levels(image: DynamicImage, channel: Channel) -> Vec<u8> {
    if !image.color().has_color() || channel == Channel::Gray {
        return image.into_luma8().into_raw();
    }
    let pixels = image.into_rgb8();
    let level = |p: &image::Rgb<u8>| {
        let [red, green, blue] = p.0;
        match channel {
            Channel::Red | Channel::Gray => red,
            Channel::Green => green,
            Channel::Blue => blue,
            Channel::RedMinusOthers => {
                (NO_DIFFERENCE + i16::from(red) - i16::from(green.max(blue))).clamp(0, 255) as u8
            }
        }
    };
    pixels.pixels().map(level).collect()
}

/// The table `[images]` of a rig file: which files of a folder are images, and where the robot was at each.
///
/// The number of an image is the last run of digits in its name. Exactly one of `step_m`, `table` and `trajectory` says
/// where the robot was.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ImagesSpec {
    /// File names, with at most one `*`; without it, all files with the ending of an image.
    pub pattern: Option<String>,
    /// What of a colour image is looked at.
    pub channel: Channel,
    /// Level of a full pixel, 1 to 255 [255].
    pub white: Option<u8>,
    /// Time of image number 0 [s].
    pub start_s: f64,
    /// Time from one number to the next [s].
    pub period_s: Option<f64>,
    /// Way along x from one number to the next [m].
    pub step_m: Option<f64>,
    /// A file with a line an image: `name tx ty tz qx qy qz qw [stamp_s [cylinder_pulse mirror_pulse]]`.
    pub table: Option<PathBuf>,
    /// A TUM trajectory, `timestamp tx ty tz qx qy qz qw` a line: with `period_s` the pose is interpolated at the image's
    /// time, without it there is one line an image and its time is the image's.
    pub trajectory: Option<PathBuf>,
}

impl ImagesSpec {
    /// Refuses what says no pose, or several.
    pub fn validated(self) -> Result<Self> {
        let given = [self.step_m.is_some(), self.table.is_some(), self.trajectory.is_some()];
        if given.iter().filter(|given| **given).count() != 1 {
            let found = format!("{} of them", given.iter().filter(|given| **given).count());
            return Err(Fault::new("images", found, "exactly one of step_m, table and trajectory"));
        }
        number_within("images.start_s", self.start_s, -9e9, 9e9)?;
        if let Some(step) = self.step_m {
            number_within("images.step_m", step, -1e3, 1e3)?;
        }
        match self.period_s {
            Some(period) => number_within("images.period_s", period, 1e-6, 1e6).map(drop)?,
            None if self.step_m.is_some() => {
                return Err(Fault::new(
                    "images.period_s",
                    "nothing",
                    "the time from one image to the next, with step_m",
                ));
            }
            None => {}
        }
        if self.white == Some(0) {
            return Err(Fault::new("images.white", 0, "1 to 255"));
        }
        if let Some(pattern) = self.pattern.as_ref().filter(|p| p.matches('*').count() > 1) {
            return Err(Fault::new("images.pattern", pattern, "at most one *"));
        }
        Ok(self)
    }

    fn takes(&self, name: &str) -> bool {
        match self.pattern.as_deref().map(|pattern| (pattern, pattern.split_once('*'))) {
            Some((_, Some((start, end)))) => {
                name.len() >= start.len() + end.len() && name.starts_with(start) && name.ends_with(end)
            }
            Some((exact, None)) => name == exact,
            None => {
                let ending = Path::new(name).extension().map(|e| e.to_string_lossy().to_lowercase());
                ending.is_some_and(|ending| ENDINGS.contains(&ending.as_str()))
            }
        }
    }
}

/// The images of a folder as captures, one after the other; only one is in memory at a time.
#[derive(Debug)]
pub struct ImageFolder {
    files: Vec<PathBuf>,
    next: usize,
    spec: ImagesSpec,
    poses: Poses,
    size: (usize, usize),
    has_first: bool,
    dropped: Dropped,
    faults: Vec<Fault>,
}

impl ImageFolder {
    /// Lists the images of `folder` in natural order (img2 before img10) and reads their poses.
    ///
    /// Errors: no folder, no images in it, a rig without `[images]`, or poses that cannot be read or do not fit.
    pub fn open(folder: &Path, rig: &RigFile) -> Result<Self> {
        let Some(spec) = rig.images.clone() else {
            return Err(Fault::new("images", "nothing", "a table [images] in the rig file").in_file(&rig.path));
        };
        let spec = spec.validated().map_err(|fault| fault.in_file(&rig.path))?;
        let files = list(folder, &spec)?;
        let poses = Poses::read(&spec, &rig.path, &files)?;
        let size = (rig.rig.camera.width, rig.rig.camera.height);
        let (dropped, faults) = (Dropped::default(), Vec::new());
        Ok(Self { files, next: 0, spec, poses, size, has_first: false, dropped, faults })
    }

    /// How many image files there are.
    pub fn len(&self) -> usize {
        self.files.len()
    }

    /// Whether there are none; `open` refuses such a folder.
    pub fn is_empty(&self) -> bool {
        self.files.is_empty()
    }

    /// What was not used up to now, by reason.
    pub fn dropped(&self) -> &Dropped {
        &self.dropped
    }

    /// Why the first hundred of them were not.
    pub fn faults(&self) -> &[Fault] {
        &self.faults
    }

    /// The next image that can be read and has a pose; the others are counted. An error if the very first one that can
    /// be read is not of the camera's size: then the rig is another camera's.
    pub fn next_capture(&mut self) -> Result<Option<Capture>> {
        while let Some(path) = self.files.get(self.next).cloned() {
            let id = self.next as u64;
            self.next += 1;
            let Some(place) = self.poses.of(id as usize) else {
                let expected = "one in the file of poses, for the time of this image";
                self.refuse(Drop::BadPose, Fault::new("pose", "none", expected).in_file(&path));
                continue;
            };
            let white = self.spec.white.unwrap_or(u8::MAX);
            let image = match read_image(&path, self.spec.channel, white) {
                Ok(image) => image,
                Err(fault) => {
                    self.refuse(Drop::Unreadable, fault);
                    continue;
                }
            };
            if (image.width(), image.height()) != self.size {
                let found = format!("{} x {}", image.width(), image.height());
                let expected = format!("{} x {}, the camera's", self.size.0, self.size.1);
                let fault = Fault::new("image size", found, expected).in_file(&path);
                if !self.has_first {
                    return Err(fault);
                }
                self.refuse(Drop::WrongSize, fault);
                continue;
            }
            self.has_first = true;
            return Ok(Some(Capture {
                id,
                stamp: place.stamp,
                cylinder_pulse: place.cylinder_pulse,
                mirror_pulse: place.mirror_pulse,
                odom_from_robot: place.odom_from_robot,
                reading: Reading::Image(image),
            }));
        }
        Ok(None)
    }

    fn refuse(&mut self, why: Drop, fault: Fault) {
        self.dropped.add(why);
        if self.faults.len() < FAULTS_MAX {
            self.faults.push(fault);
        }
    }
}

impl Iterator for ImageFolder {
    type Item = Result<Capture>;
    fn next(&mut self) -> Option<Result<Capture>> {
        self.next_capture().transpose()
    }
}

fn list(folder: &Path, spec: &ImagesSpec) -> Result<Vec<PathBuf>> {
    let mut named = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(|e| Fault::io(folder, &e))? {
        let entry = entry.map_err(|e| Fault::io(folder, &e))?;
        let name = entry.file_name().to_string_lossy().into_owned();
        if spec.takes(&name) && entry.path().is_file() {
            named.push((natural(&name), entry.path()));
        }
        if named.len() > FILES_MAX {
            return Err(Fault::new("images", format!("more than {FILES_MAX}"), "fewer").in_file(folder));
        }
    }
    if named.is_empty() {
        let expected = match &spec.pattern {
            Some(pattern) => format!("files named {pattern}"),
            None => format!("files ending in {}", ENDINGS.join(", ")),
        };
        return Err(Fault::new("images", "none", expected).in_file(folder));
    }
    named.sort();
    Ok(named.into_iter().map(|(_, path)| path).collect())
}

/// A part of a file name: numbers order by value, before text.
#[derive(Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Part {
    Number(u64),
    Text(String),
}

/// The parts of a name, so that img2 comes before img10.
fn natural(name: &str) -> Vec<Part> {
    let mut parts = Vec::new();
    let mut rest = name;
    while let Some(first) = rest.chars().next() {
        let is_digit = first.is_ascii_digit();
        let end = rest.find(|c: char| c.is_ascii_digit() != is_digit).unwrap_or(rest.len());
        let (part, after) = rest.split_at(end);
        parts.push(match part.parse() {
            Ok(number) if is_digit => Part::Number(number),
            _ => Part::Text(part.to_string()),
        });
        rest = after;
    }
    parts
}

/// The last run of digits in a file's name without its ending: 29 for `img0029.jpg`.
pub(super) fn number_of(path: &Path) -> Option<u64> {
    let stem = path.file_stem()?.to_string_lossy();
    natural(&stem).into_iter().rev().find_map(|part| match part {
        Part::Number(number) => Some(number),
        Part::Text(_) => None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sources::rig_file;
    use ::image::{GrayImage, Rgb, RgbImage};

    fn rig(images: &str) -> String {
        format!(
            "version = 1\nname = \"r\"\nrange_m_max = 4.0\n[camera]\nwidth = 8\nheight = 6\nfx = 9.0\nfy = 9.0\ncx = 4.0\ncy = 3.0\n\
             [mount]\nposition_m = [0.0, 0.0, 0.5]\n[laser]\nkind = \"plane\"\nnormal = [0.0, 1.0, 0.3]\noffset_m = 0.2\n\
             [images]\n{images}\n"
        )
    }

    fn folder_with(images: &str, files: &[&str]) -> (tempfile::TempDir, RigFile) {
        let folder = tempfile::tempdir().unwrap();
        for file in files {
            GrayImage::new(8, 6).save(folder.path().join(file)).unwrap();
        }
        let rig = rig_file::parse(&rig(images), &folder.path().join("rig.toml")).unwrap();
        (folder, rig)
    }

    fn png(image: &DynamicImage) -> Vec<u8> {
        encoded(image, ImageFormat::Png)
    }

    fn encoded(image: &DynamicImage, format: ImageFormat) -> Vec<u8> {
        let mut bytes = std::io::Cursor::new(Vec::new());
        image.write_to(&mut bytes, format).unwrap();
        bytes.into_inner()
    }

    #[test]
    fn every_kind_and_channel_is_read() {
        let colour = DynamicImage::ImageRgb8(RgbImage::from_pixel(4, 3, Rgb([200, 90, 50])));
        for format in [ImageFormat::Png, ImageFormat::Jpeg, ImageFormat::Bmp, ImageFormat::Pnm] {
            let image = decode(&encoded(&colour, format), Channel::Red, 127).unwrap();
            assert_eq!((image.width(), image.height(), image.white()), (4, 3, 127));
            assert!((i16::from(image.levels()[5]) - 200).abs() < 3, "{format:?}");
        }
        let level = |channel| decode(&png(&colour), channel, 255).unwrap().levels()[0];
        assert_eq!(
            [Channel::Red, Channel::Green, Channel::Blue, Channel::RedMinusOthers].map(level),
            [200, 90, 50, 142]
        );
        assert!((100..125).contains(&level(Channel::Gray)));
        let dark = DynamicImage::ImageRgb8(RgbImage::from_pixel(1, 1, Rgb([80, 90, 50])));
        assert_eq!(decode(&png(&dark), Channel::RedMinusOthers, 255).unwrap().levels(), [22]);
        let gray = DynamicImage::ImageLuma8(GrayImage::from_pixel(4, 3, ::image::Luma([77])));
        for channel in [Channel::Red, Channel::Blue, Channel::RedMinusOthers] {
            assert_eq!(decode(&png(&gray), channel, 255).unwrap().levels()[0], 77);
        }
    }

    #[test]
    fn what_is_no_whole_image_is_refused_with_its_name() {
        let noisy = RgbImage::from_fn(64, 48, |x, y| Rgb([(x * 37 + y * 91) as u8, (x * y) as u8, (x ^ y) as u8]));
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.jpg");
        for format in [ImageFormat::Png, ImageFormat::Jpeg, ImageFormat::Bmp, ImageFormat::Pnm] {
            let whole = encoded(&DynamicImage::ImageRgb8(noisy.clone()), format);
            // The last 16 bytes of a PNG hold no pixels.
            for length in [0, 1, 5, 20, whole.len() / 2, whole.len() - 17] {
                std::fs::write(&path, &whole[..length]).unwrap();
                let fault = read_image(&path, Channel::Red, 255).unwrap_err();
                assert!(fault.to_string().contains("a.jpg"), "{format:?} {length}: {fault}");
            }
        }
        std::fs::write(&path, "not an image at all, but long enough to be one").unwrap();
        assert!(read_image(&path, Channel::Red, 255).is_err());
        assert!(read_image(&folder.path().join("none.png"), Channel::Red, 255).is_err());
        assert!(read_image(folder.path(), Channel::Red, 255).is_err());
        // A header that promises more than there may be.
        let huge = b"P5 60000 60000 255\n";
        assert!(decode(huge, Channel::Red, 255).unwrap_err().to_string().contains("64 Mpixel"));
    }

    #[test]
    fn files_come_in_natural_order_with_steps_along_x() {
        let files = ["img10.png", "img2.png", "img0.png", "other7.png"];
        let (folder, rig) = folder_with("pattern = \"img*.png\"\nstep_m = 0.02\nperiod_s = 0.5\nstart_s = 3.0", &files);
        std::fs::write(folder.path().join("img3.txt"), "no image").unwrap();
        let captures: Vec<Capture> = ImageFolder::open(folder.path(), &rig).unwrap().map(|c| c.unwrap()).collect();
        let places: Vec<(u64, f64, f64)> =
            captures.iter().map(|c| (c.id, c.stamp.as_secs(), c.odom_from_robot.xyz().x)).collect();
        assert_eq!(places, [(0, 3.0, 0.0), (1, 4.0, 0.04), (2, 8.0, 0.2)]);
    }

    #[test]
    fn what_cannot_be_used_is_counted_but_another_camera_is_refused() {
        let (folder, rig) = folder_with("step_m = 0.02\nperiod_s = 0.5", &["a1.png", "a2.png", "a3.png", "a4.png"]);
        std::fs::write(folder.path().join("a1.png"), "").unwrap();
        GrayImage::new(9, 6).save(folder.path().join("a3.png")).unwrap();
        let mut images = ImageFolder::open(folder.path(), &rig).unwrap();
        assert_eq!((images.len(), images.is_empty()), (4, false));
        let ids: Vec<u64> = images.by_ref().map(|c| c.unwrap().id).collect();
        assert_eq!(ids, [1, 3]);
        assert_eq!((images.dropped().0[&Drop::Unreadable], images.dropped().0[&Drop::WrongSize]), (1, 1));
        assert!(images.faults()[0].to_string().contains("a1.png") && images.faults()[1].to_string().contains("9 x 6"));
        GrayImage::new(9, 6).save(folder.path().join("a1.png")).unwrap();
        let fault = ImageFolder::open(folder.path(), &rig).unwrap().next_capture().unwrap_err();
        assert!(fault.to_string().contains("a1.png") && fault.to_string().contains("8 x 6"), "{fault}");
    }

    #[test]
    fn folders_without_images_and_rigs_without_poses_are_refused() {
        let (folder, rig) = folder_with("step_m = 0.02\nperiod_s = 0.5", &[]);
        assert!(ImageFolder::open(folder.path(), &rig).unwrap_err().to_string().contains("png"));
        assert!(ImageFolder::open(&folder.path().join("none"), &rig).is_err());
        let without = RigFile { images: None, ..rig };
        assert!(ImageFolder::open(folder.path(), &without).unwrap_err().to_string().contains("[images]"));
        for (spec, word) in [
            (ImagesSpec::default(), "exactly one"),
            (ImagesSpec { step_m: Some(0.1), table: Some("t".into()), ..Default::default() }, "exactly one"),
            (ImagesSpec { step_m: Some(0.1), ..Default::default() }, "period_s"),
            (ImagesSpec { step_m: Some(f64::NAN), period_s: Some(1.0), ..Default::default() }, "step_m"),
            (ImagesSpec { step_m: Some(0.1), period_s: Some(0.0), ..Default::default() }, "period_s"),
            (ImagesSpec { step_m: Some(0.1), period_s: Some(1.0), white: Some(0), ..Default::default() }, "white"),
            (ImagesSpec { table: Some("t".into()), pattern: Some("*a*".into()), ..Default::default() }, "pattern"),
        ] {
            assert!(spec.validated().unwrap_err().to_string().contains(word), "{word}");
        }
    }

    #[test]
    fn numbers_in_names_order_by_value() {
        let mut names = ["img10", "img2", "b", "img2b", "1", "img", "img02"];
        names.sort_by_key(|name| natural(name));
        assert_eq!(names, ["1", "b", "img", "img2", "img02", "img2b", "img10"]);
        assert_eq!(number_of(Path::new("x/img0029.jpg")), Some(29));
        assert_eq!(number_of(Path::new("2025_07 (3) left.png")), Some(3));
        assert_eq!(number_of(Path::new("img99999999999999999999999.png")), None);
    }
}
