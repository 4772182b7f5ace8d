//! `metromap gallery`: what each effect of image formation does, drawn with and without it, for a person to look at.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use clap::Args;
use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use serde::Serialize;

use super::Exit;
use crate::fault::{Fault, Result};
use crate::geometry::{Robot, Transform};
use crate::image::Image;
use crate::optics::Rig;
use crate::record::png;
use crate::report::html;
use crate::scanner::{Exposure, ImageParams, Moment, Movement, Renderer};
use crate::world::{Body, Material, Mesh, Motion, Scene, Shape, Surfaces};

const HELP: &str = "\
Writes gallery.html, which holds all pictures, and one PNG an effect: on the left without it, on the right with it.

With --json, one object:
{\"effects\": [{\"name\", \"title\", \"caption\", \"picture\": path,
   \"checks\": [{\"what\", \"formula\", \"measured\", \"unit\"}]}], \"files\": [path]}";

/// The gap between the two halves of a picture [px].
const GAP_PX: usize = 8;

/// Draw what each effect in the simulated image does, with and without it.
#[derive(Args, Clone, Debug)]
#[command(after_long_help = HELP, after_help = "--help tells what is written.")]
pub struct Options {
    /// Directory for the page and its pictures
    #[arg(long, value_name = "DIR", default_value = "out/gallery")]
    pub out: PathBuf,
    /// Print one JSON object on stdout
    #[arg(long)]
    pub json: bool,
}

/// An effect as it is shown.
#[derive(Serialize)]
struct Shown {
    name: &'static str,
    title: &'static str,
    caption: String,
    picture: String,
    checks: Vec<Check>,
}

/// A number of the picture beside what its formula says.
#[derive(Serialize)]
struct Check {
    what: &'static str,
    formula: f64,
    measured: f64,
    unit: &'static str,
}

/// One image to take.
#[derive(Clone)]
struct Shot {
    bodies: Vec<Body>,
    params: ImageParams,
    ambient_w_per_m2: f64,
    movement: Transform<Robot, Robot>,
}

/// What of both images is shown: columns from, rows from, columns, rows; how much larger, how much brighter.
#[derive(Clone, Copy)]
struct Frame {
    crop: [usize; 4],
    zoom: usize,
    gain: f64,
}

struct Effect {
    name: &'static str,
    title: &'static str,
    caption: String,
    without: Shot,
    with: Shot,
    frame: Frame,
    check: fn(&Exposure, &Exposure, &ImageParams) -> Vec<Check>,
}

/// Runs the command.
pub fn run(options: Options) -> Result<Exit> {
    std::fs::create_dir_all(&options.out).map_err(|e| Fault::io(&options.out, &e))?;
    let write = |path: &Path, bytes: &[u8]| std::fs::write(path, bytes).map_err(|e| Fault::io(path, &e));
    let (mut shown, mut files, mut figures) = (Vec::new(), Vec::new(), String::new());
    for effect in effects() {
        let (without, with) = (effect.without.take()?, effect.with.take()?);
        let picture = effect.frame.beside(&without.image, &with.image)?;
        let bytes = png::encode(&picture)?;
        let path = options.out.join(format!("{}.png", effect.name));
        write(&path, &bytes)?;
        let checks = (effect.check)(&without, &with, &effect.with.params);
        figures += &section(&effect, &picture, &bytes, &checks);
        files.push(path.display().to_string());
        let (name, title, caption) = (effect.name, effect.title, effect.caption);
        shown.push(Shown { name, title, caption, picture: path.display().to_string(), checks });
    }
    let page = options.out.join("gallery.html");
    let intro = "<h1>What is in a slit image</h1><p>Simulated images of METRO-I's camera. Each pair shows the same scene \
        without an effect on the left and with it on the right; all else is at its default unless the caption says so.</p>";
    write(&page, html::page("What is in a slit image", &format!("{intro}{figures}")).as_bytes())?;
    files.insert(0, page.display().to_string());
    if options.json {
        // Whoever read has seen enough if this fails.
        let _ = writeln!(std::io::stdout(), "{}", serde_json::json!({ "effects": shown, "files": files }));
    } else {
        eprintln!("{} effects drawn\nopen {}", shown.len(), page.display());
    }
    Ok(Exit::Done)
}

fn section(effect: &Effect, picture: &Image, bytes: &[u8], checks: &[Check]) -> String {
    let figure = html::picture(&effect.caption, bytes, [picture.width(), picture.height()]);
    let rows = checks.iter().map(|check| {
        let number = |value: f64| html::figures(value, 3);
        [check.what.to_string(), number(check.formula), number(check.measured), check.unit.to_string()]
    });
    let table = match checks {
        [] => String::new(),
        _ => html::table(["", "formula", "in the image", "unit"], rows),
    };
    format!("<h2>{}</h2>{figure}{table}", effect.title)
}

impl Shot {
    fn take(&self) -> Result<Exposure> {
        let scene = Scene { bodies: self.bodies.clone(), ambient_w_per_m2: self.ambient_w_per_m2, ..Scene::default() };
        let renderer = Renderer::new(&Rig::metro_i(), self.params, &scene)?;
        let middle = Moment { world_from_robot: Transform::identity(), cylinder_rad: 0.0, beam_rad: beam_at_p() };
        let movement = Movement { robot: self.movement, ..Movement::default() };
        renderer.expose_moving(&Surfaces::new(&scene)?, &middle, &movement, 1, 0)
    }
}

impl Frame {
    /// Both images, cut out, enlarged and brightened.
    fn beside(&self, left: &Image, right: &Image) -> Result<Image> {
        let [u0, v0, width, height] = self.crop;
        let half = width * self.zoom;
        let row = |v: usize| {
            let grey = |image: &Image, x: usize| {
                let level = f64::from(image.row(v0 + v / self.zoom)[u0 + x / self.zoom]);
                (level * self.gain * 255.0 / f64::from(image.white())).min(255.0) as u8
            };
            let left: Vec<u8> = (0..half).map(|x| grey(left, x)).collect();
            let right: Vec<u8> = (0..half).map(|x| grey(right, x)).collect();
            [left, vec![255; GAP_PX], right].concat()
        };
        let levels = (0..height * self.zoom).flat_map(row).collect();
        Image::new(2 * half + GAP_PX, height * self.zoom, 255, levels)
    }
}

/// θB of the beam at P, Table 4 [rad].
fn beam_at_p() -> f64 {
    (817.230f64 / 2704.210).atan()
}

/// Height of that beam at X [m].
fn beam_height(x_m: f64) -> f64 {
    0.817_230 - x_m * beam_at_p().tan()
}

fn body(name: &str, shape: Shape, xyz: [f64; 3], material: Material) -> Body {
    let pose = Isometry3::translation(xyz[0], xyz[1], xyz[2]);
    Body { name: name.into(), shape, pose, material, motion: Motion::Static, ground: false }
}

fn floor() -> Body {
    body("floor", Shape::Plane, [0.0; 3], Material::default())
}

/// An upright box by its front's middle.
fn block(x: f64, y: f64, size: [f64; 3], material: Material) -> Body {
    body("box", Shape::Box { size: size.into() }, [x + size[0] / 2.0, y, size[2] / 2.0], material)
}

/// An upright leaf across the view, with a slanting upper edge: its heights on the left and on the right [m].
fn leaf(x: f64, [left, right]: [f64; 2]) -> Body {
    let corners = [[x, 0.6, 0.0], [x, 0.6, left], [x, -0.6, right], [x, -0.6, 0.0]];
    let mesh = Mesh { vertices: corners.map(Vector3::from).to_vec(), triangles: vec![[0, 1, 2], [0, 2, 3]] };
    body("leaf", Shape::Mesh(Arc::new(mesh)), [0.0; 3], Material::default())
}

fn shot(bodies: Vec<Body>, params: ImageParams) -> Shot {
    Shot { bodies, params, ambient_w_per_m2: 0.06, movement: Transform::identity() }
}

fn nothing(_: &Exposure, _: &Exposure, _: &ImageParams) -> Vec<Check> {
    Vec::new()
}

/// All effects, from the whole image to its details.
fn effects() -> Vec<Effect> {
    [light_effects(), background_effects(), surface_effects(), edge_effects()].into_iter().flatten().collect()
}

fn light_effects() -> Vec<Effect> {
    let default = ImageParams::default();
    let close = Frame { crop: [226, 0, 60, 24], zoom: 7, gain: 1.0 };
    let at = |x_m: f64, frame: Frame| Frame {
        crop: [frame.crop[0], row_at(x_m) - frame.crop[3] / 2, frame.crop[2], frame.crop[3]],
        ..frame
    };
    let board = |albedo: f64| vec![block(2.0, 0.0, [0.1, 1.0, 0.6], Material { albedo, ..Material::default() })];
    let f4 = ImageParams { f_number: 4.0, ..default };
    let bright = ImageParams { f_number: 1.4, exposure_s: 1.0 / 15.0, ..default };
    let blurred = ImageParams { f_number: 1.4, focus_m: 0.7, speckle_contrast: 0.0, ..default };
    vec![
        Effect {
            name: "speckle",
            title: "Speckle",
            caption: "A board at 2 m, f/4: every column's light is off by a little in place and strength. The same board from the \
                same place shows the same pattern again."
                .into(),
            without: shot(board(0.5), ImageParams { speckle_contrast: 0.0, ..f4 }),
            with: shot(board(0.5), f4),
            frame: Frame { gain: 3.0, ..at(2.0, close) },
            check: |without, with, params| {
                let found = rms_difference(&without.image, with);
                vec![Check {
                    what: "error of a column's centroid, C·λN/π, and noise of two images",
                    formula: params.speckle_sigma_px(&Rig::metro_i()),
                    measured: found,
                    unit: "px rms",
                }]
            },
        },
        Effect {
            name: "blooming",
            title: "Saturation and blooming",
            caption: "A white board at 2 m, f/1.4, 1/15 s: the wells are full. On the left their overflow is drained, on the right \
                it all runs up and down the columns, along the axis that range is read from."
                .into(),
            without: shot(board(0.9), bright),
            with: shot(board(0.9), ImageParams { blooming: 1.0, ..bright }),
            frame: at(2.0, close),
            check: |_, with, params| {
                let column = with.truth.iter().find(|s| s.column == 256);
                let full = (0..with.image.height()).filter(|v| with.image.row(*v)[256] == with.image.white()).count();
                let formula = column.map_or(0.0, |s| f64::from(s.electrons) / params.well_electrons);
                vec![Check { what: "full rows, electrons over a well", formula, measured: full as f64, unit: "rows" }]
            },
        },
        Effect {
            name: "defocus",
            title: "Defocus",
            caption: "A board at 2 m, f/1.4: focused at 2 m, and at 0.7 m.".into(),
            without: shot(board(0.5), ImageParams { focus_m: 2.0, ..blurred }),
            with: shot(board(0.5), blurred),
            frame: at(2.0, close),
            check: nothing,
        },
    ]
}

fn background_effects() -> Vec<Effect> {
    let default = ImageParams::default();
    let outdoors = ImageParams { f_number: 2.0, exposure_s: 1e-3, ..default };
    let sunny = ImageParams { sun_w_per_m2_nm: 1.4, ..outdoors };
    let lit = ImageParams { vignetting: 0.0, ..default };
    let board = vec![block(2.0, 0.0, [0.1, 1.0, 0.6], Material { albedo: 0.9, ..Material::default() })];
    let close = Frame { crop: [226, row_at(2.0) - 12, 60, 24], zoom: 7, gain: 2.0 };
    vec![
        Effect {
            name: "sun",
            title: "Sunlight",
            caption: "1 ms at f/2: indoors, and in direct sun behind a filter of 10 nm. Contrast twice.".into(),
            without: shot(board.clone(), outdoors),
            with: shot(board, sunny),
            frame: close,
            check: |_, with, params| {
                let sheet = Rig::metro_i().sheet;
                let peak = sheet.line_power_w_per_m(2.0, 0.0) * (2.0 / std::f64::consts::PI).sqrt() / sheet.thickness_m(2.0);
                let background = params.background_w_per_m2(0.06);
                let level = |u: usize| (40..80).map(|v| f64::from(with.image.row(v)[u])).sum::<f64>() / 40.0;
                let rig = Rig::metro_i();
                let pixel_m2 = params.focal_length_m.powi(2) / (rig.camera.fx * rig.camera.fy);
                let watts = background * params.ambient_albedo / (4.0 * params.f_number.powi(2)) * pixel_m2;
                let photon_j = 6.626_07e-34 * 299_792_458.0 / sheet.wavelength_m;
                let light = params.lens_transmission * params.filter_transmission * params.quantum_efficiency;
                let electrons = watts * params.exposure_s * light / photon_j + params.dark_electrons;
                let fall_off = rig.camera.ray(256.0, 59.5).map_or(1.0, |ray| ray.norm().powi(-4));
                vec![
                    Check { what: "sun within the filter over the laser's peak at 2 m (14 / 3.4 W/m²)", formula: 14.0 / 3.4, measured: background / peak, unit: "" },
                    Check {
                        what: "its level above the line",
                        formula: electrons * fall_off * 127.0 / params.well_electrons,
                        measured: (240..272).map(level).sum::<f64>() / 32.0,
                        unit: "levels",
                    },
                ]
            },
        },
        Effect {
            name: "vignetting",
            title: "Vignetting",
            caption: "The whole image in bright indoor light (2 W/m²), without and with cos⁴ towards the corners. Contrast twice.".into(),
            without: Shot { ambient_w_per_m2: 2.0, ..shot(vec![floor()], lit) },
            with: Shot { ambient_w_per_m2: 2.0, ..shot(vec![floor()], default) },
            frame: Frame { crop: [0, 0, 512, 480], zoom: 1, gain: 1.0 },
            check: |without, with, _| {
                let mean = |shot: &Exposure, u: usize, v: usize| {
                    (v..v + 8).flat_map(|v| shot.image.row(v)[u..u + 8].iter().map(|l| f64::from(*l))).sum::<f64>() / 64.0
                };
                let ray = Rig::metro_i().camera.ray(4.0, 4.0).map_or(1.0, |ray| ray.norm());
                let measured = mean(with, 0, 0) / mean(without, 0, 0);
                vec![Check { what: "corner over middle, cos⁴", formula: ray.powi(-4), measured, unit: "" }]
            },
        },
    ]
}

fn surface_effects() -> Vec<Effect> {
    let default = ImageParams::default();
    let calm = ImageParams { speckle_contrast: 0.0, ..default };
    let whole = Frame { crop: [56, 100, 400, 260], zoom: 1, gain: 2.0 };
    let patches = |albedos: [f64; 4]| {
        let patch = |i: usize| {
            let material = Material { albedo: albedos[i], ..Material::default() };
            block(2.0, 0.3 - 0.2 * i as f64, [0.1, 0.2, 0.6], material)
        };
        (0..4).map(patch).collect::<Vec<_>>()
    };
    // Turned so that the camera looks along the mirrored beam in the middle of the board.
    let glossy = |gloss: f64| {
        let point = Vector3::new(2.0, 0.0, beam_height(2.0));
        let (eye, laser) = (Vector3::new(0.164_630, 0.0, 1.032_411), Vector3::new(0.0, 0.0, 0.817_230));
        let half = (eye - point).normalize() + (laser - point).normalize();
        let turn = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), half.z.atan2(-half.x));
        let material = Material { albedo: 0.3, gloss, gloss_spread_rad: 0.02, ..Material::default() };
        let mut board = block(0.0, 0.0, [0.1, 0.8, 0.8], material);
        board.pose = Isometry3::from_parts((point - turn * Vector3::new(-0.05, 0.0, 0.0)).into(), turn);
        vec![board]
    };
    let mirror = |gloss: f64| {
        let material = Material { albedo: 0.2, gloss, gloss_spread_rad: 0.002, ..Material::default() };
        vec![floor(), block(2.3, 0.0, [0.1, 0.5, 0.5], material)]
    };
    vec![
        Effect {
            name: "materials",
            title: "Dark materials",
            caption: "Four boards of albedo 0.5, and of 0.9, 0.4, 0.1 and 0.03. Twice as bright as it is.".into(),
            without: shot(patches([0.5; 4]), default),
            with: shot(patches([0.9, 0.4, 0.1, 0.03]), default),
            frame: Frame { crop: [56, row_at(2.0) - 40, 400, 80], zoom: 1, gain: 2.0 },
            check: nothing,
        },
        Effect {
            name: "specular",
            title: "Specular lobe",
            caption: "A board turned so that the camera looks along the mirrored beam: matt, and with half of the light mirrored \
                within 0.02 rad. Columns near the mirror direction are white."
                .into(),
            without: shot(glossy(0.0), calm),
            with: shot(glossy(0.5), calm),
            frame: Frame { crop: [156, row_at(2.0) - 20, 200, 40], zoom: 2, gain: 1.0 },
            check: nothing,
        },
        Effect {
            name: "bounce",
            title: "One specular bounce",
            caption: "A box at 2.3 m, matt, and with a mirror's front: it throws the sheet on the floor before it, 0.4 m nearer. \
                The camera sees a second line where no surface is in the sheet. Eight times as bright."
                .into(),
            without: shot(mirror(0.0), default),
            with: shot(mirror(0.8), default),
            frame: Frame { gain: 8.0, ..whole },
            check: |_, with, _| {
                let row = Rig::metro_i().sensor_from_camera.inverse()
                    * crate::geometry::Point::new(4.6 - 2.704_21, 0.0, 0.0);
                let formula = Rig::metro_i().camera.project(&row.xyz).map_or(f64::NAN, |[_, v]| v);
                let near = formula as usize;
                let level = |v: usize| f64::from(with.image.row(v)[256]).max(0.0);
                let light: f64 = (near - 4..near + 6).map(level).sum();
                let measured = (near - 4..near + 6).map(|v| level(v) * v as f64).sum::<f64>() / light;
                vec![Check { what: "row of the false line", formula, measured, unit: "px" }]
            },
        },
    ]
}

fn edge_effects() -> Vec<Effect> {
    let default = ImageParams::default();
    let calm = ImageParams { speckle_contrast: 0.0, ..default };
    let apart = 0.004; // the edge crosses the sheet over some 300 columns
    let top = beam_height(2.0);
    let slant = vec![leaf(2.0, [top + apart, top - apart]), leaf(2.35, [0.6, 0.6])];
    let boxes = vec![
        floor(),
        block(1.7, 0.18, [0.2, 0.2, 0.5], Material::default()),
        block(2.2, -0.15, [0.2, 0.3, 0.5], Material::default()),
    ];
    let pole = vec![floor(), block(1.9, 0.1, [0.1, 0.25, 0.5], Material::default())];
    vec![
        Effect {
            name: "occlusion",
            title: "Shadows and hidden places",
            caption: "The line on the floor, and with two boxes on it: they carry it nearer, keep the light from the floor behind, and \
                hide some of what is lit from the camera. Twice as bright."
                .into(),
            without: shot(vec![floor()], default),
            with: shot(boxes, default),
            frame: Frame { crop: [56, 60, 400, 260], zoom: 1, gain: 2.0 },
            check: nothing,
        },
        Effect {
            name: "split",
            title: "An edge within the sheet",
            caption: "A leaf whose edge crosses the sheet at a flat angle, another one 0.35 m behind it. On the left the sheet is \
                infinitely thin; on the right both hold a part of the light over many columns."
                .into(),
            without: shot(slant.clone(), ImageParams { split: false, ..calm }),
            with: shot(slant, calm),
            frame: Frame { crop: [106, row_at(2.0) - 34, 300, 50], zoom: 1, gain: 2.0 },
            check: nothing,
        },
        Effect {
            name: "motion",
            title: "Motion during the exposure",
            caption: "A box on the floor: at rest, and while the robot turns by 10 mrad (0.6 rad/s). Its edges are smeared over ten \
                columns; the line on the floor is not."
                .into(),
            without: shot(pole.clone(), calm),
            with: Shot { movement: Transform::planar(0.0, 0.0, 0.01), ..shot(pole, calm) },
            frame: Frame { crop: [90, 105, 220, 120], zoom: 2, gain: 2.0 },
            check: nothing,
        },
    ]
}

/// The row in which an upright thing at X shows the beam at P, on the image's middle.
fn row_at(x_m: f64) -> usize {
    let rig = Rig::metro_i();
    let seen = rig.sensor_from_camera.inverse() * crate::geometry::Point::new(x_m, 0.0, beam_height(x_m));
    rig.camera.project(&seen.xyz).map_or(40, |[_, v]| (v.round() as usize).max(40))
}

/// RMS over the columns of how far the centroid of an image is off the true rows, with `calm` taken away: its stripe has
/// the same pixels but no speckle [px].
fn rms_difference(calm: &Image, speckled: &Exposure) -> f64 {
    let centroid = |image: &Image, column: usize, row: usize| {
        let rows = row - 2..=row + 2;
        let light = |v: usize| f64::from(image.row(v)[column]);
        let (all, moment) = rows.fold((0.0, 0.0), |(all, moment), v| (all + light(v), moment + light(v) * v as f64));
        moment / all
    };
    let sights = speckled.truth.iter().filter(|s| s.v > 3.0 && s.v + 3.0 < calm.height() as f64);
    let (mut sum, mut count) = (0.0, 0.0);
    for sight in sights {
        let (column, row) = (usize::from(sight.column), sight.v.round() as usize);
        let off = centroid(&speckled.image, column, row) - centroid(calm, column, row);
        if off.is_finite() {
            sum += off * off;
            count += 1.0;
        }
    }
    f64::sqrt(sum / f64::max(count, 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_effect_shows_in_its_picture() {
        let mut names = Vec::new();
        for effect in effects() {
            let (without, with) = (effect.without.take().unwrap(), effect.with.take().unwrap());
            let [u, v, width, height] = effect.frame.crop;
            assert!(u + width <= with.image.width() && v + height <= with.image.height(), "{}", effect.name);
            let differs = |v: usize| {
                let pixels = |image: &Image| image.row(v)[u..u + width].to_vec();
                let pairs = pixels(&without.image).into_iter().zip(pixels(&with.image));
                pairs.filter(|(a, b)| a.abs_diff(*b) >= 2).count()
            };
            let count: usize = (v..v + height).map(differs).sum();
            assert!(count > 30, "{}: {count} pixels differ", effect.name);
            let picture = effect.frame.beside(&without.image, &with.image).unwrap();
            assert_eq!(picture.width(), 2 * width * effect.frame.zoom + GAP_PX);
            names.push(effect.name);
        }
        names.dedup();
        assert_eq!(names.len(), effects().len());
    }
}
