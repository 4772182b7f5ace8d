//! `metromap reproduce`: the paper's tables and figures beside ours.

use std::path::PathBuf;

use clap::Args;
use nalgebra::{Isometry3, Vector3};

use super::Exit;
use super::session::progress_bar;
use super::tell::{answer, make_out, tell};
use crate::fault::{Fault, Result};
use crate::geometry::{Robot, Transform, World};
use crate::image::Image;
use crate::optics::Rig;
use crate::reproduce::{Effort, Scene as View, SlitImages, page, reproduce};
use crate::scanner::{ImageParams, Renderer};
use crate::world::{Body, Material, Motion, Scene, Shape, Surfaces};

const JSON_HELP: &str = "With --json, one object:\n\
    {\"tables\": {\"1\": [row, ...], ..., \"5\": [...], \"text\": [...]}, \"figures\": {\"8\": [...], ..., \"13\": [...]},\n \
     \"points\": [...], \"misprints\": [{place, quantity, printed, correct, why}], \"agrees\": bool, \"files\": [...]}\n\
    A row: {\"quantity\": name with unit, \"at\": {where}, \"paper\": printed number or null,\n \
     \"printed_form\": by the printed formula or constants, or null, \"ours\": number,\n \
     \"expected\": by an independent computation, or null, \"agrees\": bool or null,\n \
     \"simulated\": {\"repeats\", \"rms_error\", \"sigma\", \"inside_95\",\n \
     \"inside_95_accepted\": [from, to]}, \"note\"}";

/// Recompute the paper's tables and figures.
#[derive(Args, Clone, Debug)]
#[command(after_help = JSON_HELP)]
pub struct Options {
    /// Directory for reproduce.html and reproduce.json
    #[arg(long, value_name = "DIR", default_value = "out/reproduce")]
    pub out: PathBuf,
    /// Print one JSON object on stdout instead of a summary on stderr
    #[arg(long)]
    pub json: bool,
    /// How often the calibrations of Tables 3 and 4 are repeated
    #[arg(long, value_name = "N", default_value_t = Effort::default().repeats)]
    pub repeats: u32,
    /// Images for each row of Table 5
    #[arg(long, value_name = "N", default_value_t = Effort::default().frames)]
    pub frames: u32,
    /// Seed of all noise
    #[arg(long, value_name = "SEED", default_value_t = Effort::default().seed)]
    pub seed: u64,
}

/// Runs the command.
pub fn run(options: Options) -> Result<Exit> {
    make_out(&options.out)?;
    let effort = Effort { repeats: options.repeats, frames: options.frames, seed: options.seed };
    let mut studio = Studio { rig: Rig::metro_i(), seed: options.seed, set: None };
    let bar = progress_bar(Some(effort.pieces()));
    let all = reproduce(effort, Some(&mut studio), &|pieces| bar.inc(pieces));
    bar.finish_and_clear();
    let all = all?;
    let (html, json) = (options.out.join("reproduce.html"), options.out.join("reproduce.json"));
    let mut value =
        serde_json::to_value(&all).map_err(|e| Fault::new("reproduction", e, "numbers that JSON can hold"))?;
    value["files"] = [&html, &json].map(|path| path.display().to_string()).to_vec().into();
    for (path, text) in [(&html, page(&all)), (&json, format!("{value:#}\n"))] {
        std::fs::write(path, text).map_err(|e| Fault::io(path, &e))?;
    }
    if options.json {
        answer(&value)?;
        return Ok(Exit::Done);
    }
    let compared = all.rows().filter(|(_, row)| row.agrees.is_some()).count();
    let off: Vec<_> = all.rows().filter(|(_, row)| row.agrees == Some(false)).collect();
    tell!(
        "{} of {compared} numbers agree; {} places where the print is wrong",
        compared - off.len(),
        all.misprints.len()
    );
    for (place, row) in off {
        let at = serde_json::to_string(&row.at).unwrap_or_default();
        tell!(
            "  {place}: {} {at}: paper {:?}, expected {:?}, ours {}",
            row.quantity,
            row.paper,
            row.expected,
            row.ours
        );
    }
    tell!("open {}", html.display());
    Ok(Exit::Done)
}

/// Renders slit images of what a figure needs; keeps the last set up.
struct Studio {
    rig: Rig,
    seed: u64,
    set: Option<(View, Renderer, Surfaces)>,
}

impl SlitImages for Studio {
    fn take(&mut self, view: View, beam_rad: f64, frame: u64) -> Result<Image> {
        let (renderer, surfaces) = match self.set.take() {
            Some((last, renderer, surfaces)) if last == view => (renderer, surfaces),
            _ => {
                let scene = scene(view);
                (Renderer::new(&self.rig, ImageParams::default(), &scene)?, Surfaces::new(&scene)?)
            }
        };
        let here = Transform::<World, Robot>::identity();
        let image = renderer.expose(&surfaces, &here, 0.0, beam_rad, self.seed, frame)?.image;
        self.set = Some((view, renderer, surfaces));
        Ok(image)
    }
}

fn scene(view: View) -> Scene {
    let body = |name: &str, shape: Shape, at: [f64; 3]| Body {
        name: name.into(),
        shape,
        pose: Isometry3::translation(at[0], at[1], at[2]),
        material: Material::default(),
        motion: Motion::Static,
        ground: false,
    };
    let cuboid = |x: f64, y: f64, z: f64| Shape::Box { size: Vector3::new(x, y, z) };
    let mut bodies = vec![Body { ground: true, ..body("floor", Shape::Plane, [0.0; 3]) }];
    match view {
        View::Floor => {}
        View::Upright(ahead_m) => bodies.push(body("target", cuboid(0.1, 3.0, 2.0), [ahead_m + 0.05, 0.0, 1.0])),
        // A step, a box on it, a can beside it and a black mat, where the slits of the paper fall.
        View::Object => bodies.extend([
            Body {
                material: Material { albedo: 0.0, ..Material::default() },
                ..body("mat", cuboid(1.0, 0.2, 0.002), [2.2, 0.42, 0.001])
            },
            body("step", cuboid(0.5, 0.45, 0.12), [2.05, 0.0, 0.06]),
            body("box", cuboid(0.2, 0.2, 0.15), [2.1, 0.05, 0.195]),
            body("can", Shape::Cylinder { radius: 0.08, length: 0.3 }, [1.85, -0.36, 0.15]),
        ]),
    }
    // A lit room (instrument.md 1).
    Scene { name: "reproduce".into(), bodies, ambient_w_per_m2: 0.06, ..Scene::default() }
}
