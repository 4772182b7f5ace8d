//! `metromap calibrate camera`: images of a target or a file of points in, rig.toml, camera_info and a report out.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use serde_json::{Value, json};

use super::super::Exit;
use super::shared::{
    BoardArgs, Progress, Seen, counts, exit, files, lengths, look, name_of, numbers, print, save, summary, with,
};
use crate::calibration::CameraLimits;
use crate::calibration::board::Chessboard;
use crate::calibration::camera::{self, BlockFit, BlockParams, Sensor, Unknown};
use crate::calibration::dots::{self, DotGrid};
use crate::calibration::points::{LengthUnit, Mark, Rows, camera_info};
use crate::calibration::report::{Rejected, Report, Verdict, Weak};
use crate::calibration::views::{self, BoardFit, BoardParams, View};
use crate::fault::{Fault, Result};
use crate::optics::Camera;
use crate::report::html::figures;
use crate::sources::images::{Channel, read_image};
use crate::sources::{marks, rig_file};

const HELP: &str = "\
Chessboards (many views, Brown-Conrady):\n    \
metromap calibrate camera IMAGES/ --board 11x7 --square 21.167x21.125\n\
A block of dots (one view, Tsai; an image for each plane, camera and block unmoved):\n    \
metromap calibrate camera low.png high.png --dots 6x5 --pitch 28x20 --diameter 10 --heights 0,45 --pitch-mm 0.0125x0.0099\n\
A file of points, x y z u v a line, a sixth number for the view (# starts a comment):\n    \
metromap calibrate camera points.txt --size 576x576 --pitch-mm 0.023 --centre 258,204 --su 1\n\n\
JSON keys: parameters {name: {value, sigma, unit}}, residual {rms, mean, max, unit}, used, rejected [{what, why}], model, \
weak [{changes {name: by}, correlation}], verdict {accepted, reasons}, covariance {names, rows}, camera_info \
{difference_rms_px, difference_max_px} (what the rewriting for ROS costs), files; one view: tz_over_f, tilt_deg; many views: \
drawn {rms, mean, max, unit} (against the board as drawn), board_rms_m, views [{image, marks, rms_px, drawn_rms_px, tilt_deg, \
distance_m}].";

/// A model of the lens.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Model {
    /// One radial factor k and a column scale, as the paper: one view.
    Tsai,
    /// k1 k2 k3 p1 p2, as OpenCV and ROS: several views of a flat board.
    Brown,
}

/// The unit of a point file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Unit {
    /// Millimetres.
    Mm,
    /// Metres.
    M,
}

/// Calibrate a camera.
#[derive(Args, Clone, Debug)]
#[command(after_long_help = HELP)]
pub struct Options {
    /// Images, folders of images, or one file of points
    #[arg(value_name = "INPUT", required = true)]
    pub inputs: Vec<PathBuf>,
    /// The chessboard.
    #[command(flatten)]
    pub board: BoardArgs,
    /// Dots of a block, columns x rows
    #[arg(long, value_name = "COLSxROWS", value_parser = counts, requires_all = ["pitch", "diameter"], conflicts_with = "board")]
    pub dots: Option<[usize; 2]>,
    /// Distance of the dots' centres [mm]
    #[arg(long, value_name = "MM[xMM]", value_parser = lengths, requires = "dots")]
    pub pitch: Option<[f64; 2]>,
    /// Diameter of a dot [mm]
    #[arg(long, value_name = "MM", requires = "dots")]
    pub diameter: Option<f64>,
    /// Height of the dots in each image over the first plane [mm]
    #[arg(long, value_name = "MM,...", value_delimiter = ',', requires = "dots", default_value = "0")]
    pub heights: Vec<f64>,
    /// Unit of x y z in a point file
    #[arg(long, value_enum, value_name = "UNIT", default_value = "mm")]
    pub unit: Unit,
    /// Rows of a point file count from the bottom, as in the paper
    #[arg(long)]
    pub rows_from_bottom: bool,
    /// Size of the image, for point files [px]
    #[arg(long, value_name = "WxH", value_parser = counts)]
    pub size: Option<[usize; 2]>,
    /// Pitch of the pixels in memory, columns x rows [mm] (Tsai)
    #[arg(long, value_name = "MM[xMM]", value_parser = lengths)]
    pub pitch_mm: Option<[f64; 2]>,
    /// Where the optical axis is thought to be: the search starts there [px; default: the middle]
    #[arg(long, value_name = "U,V", value_parser = numbers)]
    pub centre: Option<[f64; 2]>,
    /// Hold the axis there
    #[arg(long, requires = "centre")]
    pub centre_known: bool,
    /// The column scale su is known and held (Tsai; a flat target does not give it)
    #[arg(long, value_name = "SU")]
    pub su: Option<f64>,
    /// Model of the lens [default: tsai for one view and points, brown for several]
    #[arg(long, value_enum, value_name = "MODEL")]
    pub model: Option<Model>,
    /// Radial coefficients that are fitted, 0 to 3 (Brown-Conrady)
    #[arg(long, value_name = "N", default_value_t = BoardParams::default().radial)]
    pub radial: usize,
    /// Hold p1 and p2 at 0 (Brown-Conrady)
    #[arg(long)]
    pub no_tangential: bool,
    /// Standard deviation of a mark in the image [px; default: from what is left]
    #[arg(long, value_name = "PX")]
    pub pixel_sigma: Option<f64>,
    /// Accepted up to this reprojection, RMS [px]
    #[arg(long, value_name = "PX", default_value_t = CameraLimits::default().rms_px_max)]
    pub limit_px: f64,
    /// Directory for rig.toml, camera_info.yaml, report.html and calibration.json
    #[arg(long, value_name = "DIR", default_value = "out/camera")]
    pub out: PathBuf,
    /// Print one JSON object on stdout instead of a summary on stderr
    #[arg(long)]
    pub json: bool,
}

/// What was measured: one view for Tsai, or several.
struct Measured {
    views: Vec<View>,
    size: [usize; 2],
    rejected: Vec<Rejected>,
    unreadable: usize,
}

/// What either way of calibrating gives.
struct Outcome {
    camera: Camera,
    report: Report,
    weak: Vec<Weak>,
    verdict: Verdict,
    page: String,
    /// Keys beside the agreed ones.
    more: Value,
    lines: String,
}

/// Runs the command.
pub fn run(options: Options) -> Result<Exit> {
    let limits = CameraLimits { rms_px_max: options.limit_px, ..CameraLimits::default() }.validated()?;
    let measured = measured(&options)?;
    let model = match (options.model, measured.views.len()) {
        (Some(Model::Tsai), 2..) => {
            let found = format!("{} views with --model tsai", measured.views.len());
            return Err(Fault::new("views", found, "one view, or --model brown"));
        }
        (Some(model), _) => model,
        (None, 1) if options.board.board.is_none() => Model::Tsai,
        (None, _) => Model::Brown,
    };
    let mut outcome = match model {
        Model::Tsai => by_block(&options, &measured, &limits)?,
        Model::Brown => by_boards(&options, &measured, &limits)?,
    };
    outcome.report.rejected.splice(0..0, measured.rejected);
    let info = camera_info(&outcome.camera, "camera")?;
    outcome.more["camera_info"] =
        json!({ "difference_rms_px": info.difference_rms_px, "difference_max_px": info.difference_max_px });
    let names = ["rig.toml", "camera_info.yaml", "report.html", "calibration.json"];
    outcome.more["files"] = names.map(|name| options.out.join(name).display().to_string()).to_vec().into();
    outcome.more["weak"] = json!(outcome.weak);
    outcome.more["verdict"] = json!(outcome.verdict);
    let value = with(&outcome.report, outcome.more)?;
    let texts = [rig_file::camera_to_toml("camera", &outcome.camera), info.yaml, outcome.page, format!("{value}\n")];
    save(&options.out, &names.into_iter().zip(texts).collect::<Vec<_>>())?;
    if options.json {
        print(&value);
    } else {
        eprint!("{}", outcome.lines);
        eprint!("{}", summary(&outcome.report, &outcome.weak, &outcome.verdict));
        if info.difference_rms_px > 0.0 {
            let off = figures(info.difference_rms_px, 2);
            eprintln!("camera_info.yaml has the nearest plumb_bob: {off} px RMS from this model over the image");
        }
        eprintln!("report: {}", options.out.join("report.html").display());
        let rig = options.out.join("rig.toml");
        eprintln!("next: metromap calibrate plane IMAGES --board COLSxROWS --square MM --rig {}", rig.display());
    }
    Ok(exit(measured.unreadable))
}

fn measured(options: &Options) -> Result<Measured> {
    if let Some(grid) = grid(options)? {
        return dotted(options, &grid);
    }
    match options.board.chessboard()? {
        Some(board) => boards(options, &board),
        None => points(options),
    }
}

fn grid(options: &Options) -> Result<Option<DotGrid>> {
    let (Some([columns, rows]), Some([x, y]), Some(diameter)) = (options.dots, options.pitch, options.diameter) else {
        return Ok(None);
    };
    let (column_pitch_m, row_pitch_m, diameter_m) = (x * 1e-3, y * 1e-3, diameter * 1e-3);
    DotGrid { columns, rows, column_pitch_m, row_pitch_m, diameter_m }.validated().map(Some)
}

/// One view, from an image for each plane of dots.
fn dotted(options: &Options, grid: &DotGrid) -> Result<Measured> {
    let paths = files(&options.inputs)?;
    if paths.len() != options.heights.len() {
        let expected = format!("{}, one for each of --heights", options.heights.len());
        return Err(Fault::new("images", paths.len(), expected));
    }
    let (mut all, mut size) = (Vec::new(), None);
    for (path, height) in paths.iter().zip(&options.heights) {
        let image = read_image(path, Channel::Gray, u8::MAX)?;
        let own = [image.width(), image.height()];
        same_size(&mut size, own).map_err(|fault| fault.in_file(path))?;
        all.extend(dots::find(&image, grid, height * 1e-3, 0).map_err(|fault| fault.in_file(path))?);
    }
    // Numbered through, so that each has a name of its own.
    all.iter_mut().enumerate().for_each(|(i, mark)| mark.line = i + 1);
    let name = paths.first().map(|path| name_of(path)).unwrap_or_default();
    let size = size.unwrap_or_default();
    Ok(Measured { views: vec![View { name, marks: all }], size, rejected: Vec::new(), unreadable: 0 })
}

fn same_size(size: &mut Option<[usize; 2]>, own: [usize; 2]) -> Result<()> {
    let [width, height] = *size.get_or_insert(own);
    if own != [width, height] {
        let found = format!("{} x {}", own[0], own[1]);
        return Err(Fault::new("image size", found, format!("{width} x {height} as the images before")));
    }
    Ok(())
}

/// A view an image in which the board is found.
fn boards(options: &Options, board: &Chessboard) -> Result<Measured> {
    let paths = files(&options.inputs)?;
    let mut progress = Progress::new(paths.len());
    let (mut views, mut size, mut rejected, mut unreadable) = (Vec::new(), None, Vec::new(), 0);
    let mut first_fault = None;
    for (i, path) in paths.iter().enumerate() {
        let name = name_of(path);
        match look(path, board, i as u32) {
            Ok(Seen::Board(marks, own)) => {
                same_size(&mut size, own).map_err(|fault| fault.in_file(path))?;
                views.push(View { name, marks });
            }
            Ok(Seen::Nothing(fault, _)) => {
                rejected.push(Rejected { what: name, why: fault.to_string() });
                first_fault.get_or_insert(fault.in_file(path));
            }
            Err(fault) => {
                unreadable += 1;
                rejected.push(Rejected { what: name, why: fault.to_string() });
                first_fault.get_or_insert(fault);
            }
        }
        progress.step("looking for boards");
    }
    progress.end();
    match (size, first_fault) {
        (Some(size), _) => Ok(Measured { views, size, rejected, unreadable }),
        (None, Some(fault)) if paths.len() == 1 => Err(fault),
        (None, Some(fault)) => {
            let found = format!("none in {} images; the first: {fault}", paths.len());
            Err(Fault::new("boards", found, "boards in several images"))
        }
        (None, None) => Err(Fault::new("images", "none", "images of the board")),
    }
}

/// The views of a point file.
fn points(options: &Options) -> Result<Measured> {
    let [path] = options.inputs.as_slice() else {
        return Err(Fault::new(
            "INPUT",
            format!("{} files", options.inputs.len()),
            "one file of points, or --board or --dots",
        ));
    };
    if path.is_dir() || path.extension().is_some_and(|e| ["png", "jpg", "jpeg", "bmp", "pgm"].iter().any(|i| e == *i)) {
        let expected = "--board COLSxROWS --square MM, or --dots, with images";
        return Err(Fault::new("target", "nothing", expected).in_file(path));
    }
    let size =
        options.size.ok_or_else(|| Fault::new("--size", "nothing", "WxH of the image, with a file of points"))?;
    let unit = match options.unit {
        Unit::Mm => LengthUnit::Mm,
        Unit::M => LengthUnit::M,
    };
    let rows = if options.rows_from_bottom { Rows::FromBottom(size[1]) } else { Rows::FromTop };
    let mut by_view: BTreeMap<u32, Vec<Mark>> = BTreeMap::new();
    for mark in marks::load(path, unit, rows)? {
        by_view.entry(mark.image).or_default().push(mark);
    }
    let name = |image: u32| if image == 0 { name_of(path) } else { format!("view {image}") };
    let views = by_view.into_iter().map(|(image, marks)| View { name: name(image), marks }).collect();
    Ok(Measured { views, size, rejected: Vec::new(), unreadable: 0 })
}

/// One view: Tsai.
fn by_block(options: &Options, measured: &Measured, limits: &CameraLimits) -> Result<Outcome> {
    let [column_pitch_mm, row_pitch_mm] = options.pitch_mm.ok_or_else(|| {
        Fault::new("--pitch-mm", "nothing", "the pitch of the pixels: Tsai's model is in millimetres on the chip")
    })?;
    let [width, height] = measured.size;
    let sensor = Sensor { width, height, column_pitch_mm, row_pitch_mm };
    let centre = |c| if options.centre_known { Unknown::Known(c) } else { Unknown::From(c) };
    let params = BlockParams {
        scale_u: options.su.map_or(Unknown::From(1.0), Unknown::Known),
        centre_px: options.centre.map(centre),
        pixel_sigma_px: options.pixel_sigma,
        ..BlockParams::default()
    };
    let Some(view) = measured.views.first() else {
        return Err(Fault::new("views", 0, "one view of the target"));
    };
    let fit = match options.diameter {
        Some(diameter) => dots::calibrate(&view.marks, diameter * 1e-3, &sensor, &params),
        None => camera::calibrate(&view.marks, &sensor, &params),
    };
    let fit: BlockFit = fit.map_err(|fault| named(fault, options))?;
    let marks: Vec<[f64; 2]> = fit.used.iter().map(|&i| [view.marks[i].u_px, view.marks[i].v_px]).collect();
    let tz_over_f = fit.camera_from_target.xyz().z * 1e3 / fit.f_mm;
    let residual = fit.residual();
    let lines = format!(
        "{} marks of one view, off by {} px RMS, {} px on average\n",
        fit.used.len(),
        figures(residual.rms, 4),
        figures(residual.mean, 4)
    );
    let more = json!({
        "model": "tsai", "tz_over_f": tz_over_f, "tilt_deg": fit.tilt_rad.to_degrees(),
        "covariance": covariance(&fit.solution, 3..11),
    });
    Ok(Outcome {
        camera: fit.camera,
        report: fit.report(),
        weak: fit.weak(),
        verdict: fit.verdict(limits),
        page: fit.page(limits, &marks),
        more,
        lines,
    })
}

/// The file, where there is only one that a fault can be about.
fn named(fault: Fault, options: &Options) -> Fault {
    match options.inputs.as_slice() {
        [path] if path.is_file() => fault.in_file(path as &Path),
        _ => fault,
    }
}

fn covariance(fit: &crate::calibration::solve::Solution, places: std::ops::Range<usize>) -> Value {
    let names: Vec<&str> = places.clone().map(|i| fit.parameters[i].name.as_str()).collect();
    let row = |i: usize| places.clone().map(|j| fit.covariance[(i, j)]).collect::<Vec<_>>();
    let rows: Vec<Vec<f64>> = places.clone().map(row).collect();
    json!({ "names": names, "rows": rows })
}

/// Several views of a flat board: Brown–Conrady.
fn by_boards(options: &Options, measured: &Measured, limits: &CameraLimits) -> Result<Outcome> {
    let params = BoardParams {
        radial: options.radial,
        tangential: !options.no_tangential,
        pixel_sigma_px: options.pixel_sigma,
        board_sigma_m: options.board.board_sigma_mm * 1e-3,
        ..BoardParams::default()
    };
    let [width, height] = measured.size;
    let fit: BoardFit =
        views::calibrate(&measured.views, width, height, &params).map_err(|fault| named(fault, options))?;
    let (left, drawn) = (fit.residual(), fit.drawn_residual());
    let lines = format!(
        "{} boards, marks off by {} px RMS ({} px against the board as drawn, which is off by {} mm RMS)\n",
        fit.views.len(),
        figures(left.rms, 3),
        figures(drawn.rms, 3),
        figures(fit.board_rms_m() * 1e3, 2)
    );
    let views: Vec<Value> = (fit.views.iter())
        .map(|v| {
            json!({
                "image": v.name, "marks": v.marks.len(), "rms_px": v.residual().rms, "drawn_rms_px": v.drawn_rms_px(),
                "tilt_deg": v.tilt_rad().to_degrees(), "distance_m": v.camera_from_target.xyz().norm(),
            })
        })
        .collect();
    let more = json!({
        "model": "brown_conrady", "drawn": drawn, "board_rms_m": fit.board_rms_m(), "views": views,
        "covariance": covariance(&fit.solution, 0..9),
    });
    Ok(Outcome {
        camera: fit.camera,
        report: fit.report(),
        weak: fit.weak(),
        verdict: fit.verdict(limits),
        page: fit.page(limits),
        more,
        lines,
    })
}
