//! `metromap calibrate plane`: images of a laser's stripe on chessboards in, rig.toml with the laser plane and a report out.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use nalgebra::Isometry3;
use serde_json::{Value, json};

use super::super::Exit;
use super::shared::{BoardArgs, Progress, Seen, exit, files, look, name_of, print, save, summary, with};
use crate::calibration::board::Chessboard;
use crate::calibration::plane::{
    self, Frame, FrameFit, HeldOut, Outline, PlaneFit, PlaneLimits, PlaneParams, held_out, residuals_of,
};
use crate::calibration::points::camera_info;
use crate::calibration::report::Rejected;
use crate::calibration::stripe::{self, StripeParams};
use crate::fault::{Fault, Result};
use crate::geometry::Transform;
use crate::optics::{Axis, Camera, Laser, Rig, Sheet};
use crate::report::html::figures;
use crate::sources::images::{Channel, read_channels};
use crate::sources::{arm_poses, rig_file};

const HELP: &str = "\
Stripe and corners in the same images:\n    \
metromap calibrate plane IMAGES/ --rig out/camera/rig.toml --board 11x7 --square 21.167x21.125\n\
Corners in images of the same names without the stripe: --boards DIR\n\
Camera and laser on an arm, images black but for the stripe too: --poses FILE, with base_from_hand for each image, \
`name tx ty tz qx qy qz qw` a line, or position, quaternion and name on three lines (metres)\n\n\
Only stripe points on the board count: its corners and --margin-mm around them.\n\n\
JSON keys: parameters {name: {value, sigma, unit}} (normal and offset_m: n.x = d in the camera's optical frame; the camera where it \
was refined; with an arm hand_*, arm_*), residual {rms, mean, max, unit} (points off the plane, mm), used (points), rejected \
[{what, why}], boards_seen, stripes_used, stripe_px {rms, mean, max, unit}, weak [{changes {name: by}, correlation}], verdict \
{accepted, reasons}, frames [{image, corners, corners_px, points, outside, stripe_px, plane_rms_mm, arm_off_mm, arm_off_deg, look}], \
holdout {calibrated_on, boards_seen, through_arm, all: {rms, mean, max, unit}, images} (with --hold-out: triangulated stripes \
off their boards), files.";

/// Which images have no part in the calibration of the hold-out test.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum HoldOut {
    /// The second, fourth … image, in natural order.
    Odd,
    /// The first, third … image.
    Even,
}

/// Calibrate a laser plane.
#[derive(Args, Clone, Debug)]
#[command(after_long_help = HELP)]
pub struct Options {
    /// Images of the stripe on the board, or folders of them
    #[arg(value_name = "IMAGE", required = true)]
    pub images: Vec<PathBuf>,
    /// The camera: a rig.toml (`calibrate camera` writes one), or a ROS camera_info YAML
    #[arg(long, value_name = "FILE")]
    pub rig: PathBuf,
    /// The chessboard.
    #[command(flatten)]
    pub board: BoardArgs,
    /// Images of the same names and places in which the board is looked for instead
    #[arg(long, value_name = "DIR")]
    pub boards: Option<PathBuf>,
    /// Poses of the arm that carries the camera, one an image
    #[arg(long, value_name = "FILE")]
    pub poses: Option<PathBuf>,
    /// How far the flat sheet reaches beyond the outermost corners [mm; default: one square]
    #[arg(long, value_name = "MM")]
    pub margin_mm: Option<f64>,
    /// What of a colour image is looked at [default: red, and red minus the others, whichever shows the line best]
    #[arg(long, value_enum, value_name = "CHANNEL")]
    pub channel: Option<Channel>,
    /// Calibrate again without these images, and see how far their stripes lie off their boards
    #[arg(long, value_enum, value_name = "WHICH")]
    pub hold_out: Option<HoldOut>,
    /// Keep the camera as it is; otherwise boards and stripes refine it
    #[arg(long)]
    pub hold_camera: bool,
    /// How far the arm's positions are off, standard deviation along each axis [mm; default: as the boards tell]
    #[arg(long, value_name = "MM", requires = "poses")]
    pub arm_sigma_mm: Option<f64>,
    /// How far the arm's turns are off, standard deviation about each axis [degrees; default: as the boards tell]
    #[arg(long, value_name = "DEG", requires = "poses")]
    pub arm_sigma_deg: Option<f64>,
    /// Accepted if the stripes are off the plane by at most this part of the boards' distance, RMS [%]
    #[arg(long, value_name = "PERCENT", default_value_t = PlaneLimits::default().rms_part_max * 100.0)]
    pub limit_percent: f64,
    /// Directory for rig.toml, camera_info.yaml, report.html and calibration.json
    #[arg(long, value_name = "DIR", default_value = "out/plane")]
    pub out: PathBuf,
    /// Print one JSON object on stdout instead of a summary on stderr
    #[arg(long)]
    pub json: bool,
}

/// What was seen.
struct Seens {
    frames: Vec<Frame>,
    rejected: Vec<Rejected>,
    unreadable: usize,
}

/// Runs the command.
pub fn run(options: Options) -> Result<Exit> {
    let limits = PlaneLimits { rms_part_max: options.limit_percent / 100.0, ..PlaneLimits::default() }.validated()?;
    let params = PlaneParams {
        board_sigma_m: options.board.board_sigma_mm * 1e-3,
        hold_camera: options.hold_camera,
        arm_sigma_m: options.arm_sigma_mm.map(|mm| mm * 1e-3),
        arm_sigma_rad: options.arm_sigma_deg.map(f64::to_radians),
        ..PlaneParams::default()
    }
    .validated()?;
    let board =
        options.board.chessboard()?.ok_or_else(|| Fault::new("--board", "nothing", "COLSxROWS, and --square MM"))?;
    let camera = rig_file::load_camera(&options.rig)?;
    let Seens { frames, rejected, unreadable } = seen(&options, &board, &camera, &params)?;
    let mut fit = plane::calibrate(&camera, &frames, &params)?;
    fit.rejected.splice(0..0, rejected);
    let (held, halves) = match options.hold_out {
        Some(which) => held(&camera, &frames, &params, which)?,
        None => (Vec::new(), 0),
    };
    let rig = rig(&options.rig, &fit)?;
    let info = camera_info(&fit.camera, "camera")?;
    let names = ["rig.toml", "camera_info.yaml", "report.html", "calibration.json"];
    let (verdict, weak, report) = (fit.verdict(&limits), fit.weak(), fit.report());
    let [stripes, boards] = fit.counts();
    let mut more = json!({
        "boards_seen": boards, "stripes_used": stripes, "stripe_px": fit.stripe_residual(), "weak": weak, "verdict": verdict,
        "frames": fit.frames.iter().map(frame_json).collect::<Vec<_>>(),
        "files": names.map(|name| options.out.join(name).display().to_string()).to_vec(),
    });
    if options.hold_out.is_some() {
        more["holdout"] = holdout_json(&held, halves);
    }
    let value = with(&report, more)?;
    let texts = [rig_file::to_toml(&rig), info.yaml, fit.page(&limits, &held), format!("{value}\n")];
    save(&options.out, &names.into_iter().zip(texts).collect::<Vec<_>>())?;
    if options.json {
        print(&value);
        return Ok(exit(unreadable));
    }
    let residual = fit.residual();
    eprintln!(
        "{} points of {stripes} stripes, off the plane by {} mm RMS, in the image by {} px; {boards} boards seen",
        report.used,
        figures(residual.rms, 3),
        figures(fit.stripe_residual().rms, 3)
    );
    if !held.is_empty() {
        let [all, seen, arm] = residuals_of(&held);
        eprintln!(
            "held out: the stripes of {} images lie {} mm RMS off their boards ({} mm where they are seen, {} mm through the arm)",
            held.len(),
            figures(all.rms, 3),
            figures(seen.rms, 3),
            figures(arm.rms, 3)
        );
    }
    eprint!("{}", summary(&report, &weak, &verdict));
    eprintln!("report: {}", options.out.join("report.html").display());
    let rig = options.out.join("rig.toml");
    eprintln!("try it: metromap extract IMAGE --rig {}", rig.display());
    eprintln!("to map with it: say in it where the camera sits ([mount]) and where images were taken ([images])");
    Ok(exit(unreadable))
}

/// Boards and stripes of all images.
fn seen(options: &Options, board: &Chessboard, camera: &Camera, params: &PlaneParams) -> Result<Seens> {
    let paths = files(&options.images)?;
    let arm = match &options.poses {
        Some(path) => arm_poses::load(path)?,
        None => BTreeMap::new(),
    };
    let mut progress = Progress::new(2 * paths.len());
    let mut found = Seens { frames: Vec::new(), rejected: Vec::new(), unreadable: 0 };
    let mut used = Vec::new();
    let mut why_no_board: BTreeMap<String, String> = BTreeMap::new();
    for (i, path) in paths.iter().enumerate() {
        progress.step("looking for boards");
        let name = name_of(path);
        let shown = options.boards.as_ref().map_or_else(|| path.clone(), |dir| dir.join(&name));
        let marks = match look(&shown, board, i as u32) {
            Ok(Seen::Board(marks, size)) => fits(camera, size, &shown).map(|()| marks)?,
            Ok(Seen::Nothing(fault, size)) => {
                fits(camera, size, &shown)?;
                why_no_board.insert(name.clone(), fault.to_string());
                Vec::new()
            }
            Err(fault) => {
                found.unreadable += 1;
                found.rejected.push(Rejected { what: name, why: fault.to_string() });
                continue;
            }
        };
        let base_from_hand: Option<Isometry3<f64>> = arm.get(&name).copied();
        if base_from_hand.is_none() && options.poses.is_some() {
            let why = "no pose of the arm for it".to_string();
            found.rejected.push(Rejected { what: format!("{name}: arm"), why });
        }
        if let (true, None, Some(why)) = (marks.is_empty(), base_from_hand, why_no_board.get(&name)) {
            found.rejected.push(Rejected { what: name, why: why.clone() });
            continue;
        }
        found.frames.push(Frame { name, marks, base_from_hand, stripe: None });
        used.push(path.clone());
    }
    let poses = plane::poses(camera, &found.frames, params)?;
    let margin_m = options.margin_mm.map_or(board.column_pitch_m.max(board.row_pitch_m), |mm| mm * 1e-3);
    let outline = Outline::of(board, margin_m)?;
    let mut first_fault = None;
    for ((frame, path), posed) in found.frames.iter_mut().zip(&used).zip(&poses.boards) {
        progress.step("looking for stripes");
        let Some(posed) = posed else { continue };
        let on_board = |ray: &nalgebra::Vector3<f64>| outline.is_met(&posed.camera_from_board, ray);
        match stripe_of(path, options.channel, camera, &on_board) {
            Ok(stripe) => frame.stripe = Some(stripe),
            Err(fault) => {
                found.rejected.push(Rejected { what: format!("{}: stripe", frame.name), why: fault.to_string() });
                first_fault.get_or_insert(fault);
            }
        }
    }
    progress.end();
    match first_fault {
        Some(fault) if found.frames.iter().all(|frame| frame.stripe.is_none()) => Err(fault),
        _ => Ok(found),
    }
}

fn fits(camera: &Camera, [width, height]: [usize; 2], path: &Path) -> Result<()> {
    if (width, height) == (camera.width, camera.height) {
        return Ok(());
    }
    let expected = format!("{} x {}, the camera's", camera.width, camera.height);
    Err(Fault::new("image size", format!("{width} x {height}"), expected).in_file(path))
}

fn stripe_of(
    path: &Path,
    channel: Option<Channel>,
    camera: &Camera,
    on_board: &dyn Fn(&nalgebra::Vector3<f64>) -> bool,
) -> Result<stripe::Stripe> {
    let channels = channel.map_or_else(|| vec![Channel::Red, Channel::RedMinusOthers], |channel| vec![channel]);
    let images = read_channels(path, &channels, u8::MAX)?;
    let name = |channel: &Channel| match channel {
        Channel::Red => "red",
        Channel::Green => "green",
        Channel::Blue => "blue",
        Channel::Gray => "gray",
        Channel::RedMinusOthers => "red minus others",
    };
    let named: Vec<(&str, &crate::image::Image)> = images.iter().map(|(c, image)| (name(c), image)).collect();
    stripe::find(&named, camera, on_board, &StripeParams::default()).map_err(|fault| fault.in_file(path))
}

/// Calibrates without every second image, and measures those; how many images went into the calibration.
fn held(camera: &Camera, frames: &[Frame], params: &PlaneParams, which: HoldOut) -> Result<(Vec<HeldOut>, usize)> {
    let is_held = |i: &usize| (i % 2 == 1) == (which == HoldOut::Odd);
    let of = |held: bool| -> Vec<Frame> {
        frames.iter().enumerate().filter(|(i, _)| is_held(i) == held).map(|(_, frame)| frame.clone()).collect()
    };
    let rest = of(false);
    let fit = plane::calibrate(camera, &rest, params)?;
    Ok((held_out(&fit, &of(true), params), rest.len()))
}

fn frame_json(frame: &FrameFit) -> Value {
    let count = frame.stripe_px.len().max(1) as f64;
    let stripe_px = (frame.stripe_px.iter().map(|d| d * d).sum::<f64>() / count).sqrt();
    json!({
        "image": frame.name, "corners": frame.corners, "corners_px": frame.corners_px, "points": frame.points.len(),
        "outside": frame.outside, "stripe_px": stripe_px, "plane_rms_mm": frame.plane_rms_m() * 1e3,
        "arm_off_mm": frame.arm_off[0] * 1e3, "arm_off_deg": frame.arm_off[1].to_degrees(), "look": frame.look,
    })
}

fn holdout_json(held: &[HeldOut], calibrated_on: usize) -> Value {
    let [all, seen, arm] = residuals_of(held);
    let image = |h: &HeldOut| {
        let [own, ..] = residuals_of(std::slice::from_ref(h));
        json!({ "image": h.name, "board_seen": h.seen, "points": h.from_board_m.len(), "rms_mm": own.rms })
    };
    json!({
        "calibrated_on": calibrated_on, "all": all, "boards_seen": seen, "through_arm": arm,
        "images": held.iter().map(image).collect::<Vec<_>>(),
    })
}

/// The rig given, if it was a whole one, with the camera and the laser found; otherwise one that looks along x.
fn rig(path: &Path, fit: &PlaneFit) -> Result<Rig> {
    let (camera, laser, covariance) = (fit.camera, Laser::Plane(fit.laser()), fit.rig_covariance());
    if let Some(file) = rig_file::load_if_whole(path)? {
        return Rig { camera, laser, covariance, ..file.rig }.validated();
    }
    // Beyond twice the farthest board nothing was tried.
    let farthest = fit.frames.iter().map(|f| f.camera_from_board.translation.vector.norm()).fold(0.05, f64::max);
    let rig = Rig {
        name: "camera and laser".into(),
        camera,
        // An optical frame, z along the robot's x.
        sensor_from_camera: Transform::from_stored([0.0; 3], [-0.5, 0.5, -0.5, 0.5]),
        laser,
        sheet: Sheet::default(),
        cylinder: Axis::FIXED,
        robot_from_finder: Transform::identity(),
        beam_sigma_rad: 0.0,
        cylinder_sigma_rad: 0.0,
        range_m_max: 2.0 * farthest,
        covariance,
    };
    rig.validated()
}
