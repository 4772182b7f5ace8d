//! The slit image: the laser sheet cut with the world, projected, lit, and read out by a noisy sensor.
//!
//! `trace` finds where the stripe crosses the image's columns and which of it is lit and seen, `light` how bright and wide
//! it is there. Light is that of `instrument.md` 1. What is not plain geometry has a room of its own:
//!
//! - `speckle`: a fixed pattern of 0.04 px at f/2, and a contrast of the light, that belong to the place on the surface;
//! - `split`: an edge within the sheet's thickness parts the stripe in two, or leaves a mixed one;
//! - `bounce`: a flat glossy surface throws the sheet on something else: a false line;
//! - `sun`: parts of the world in direct sun;
//! - `smear`: a moving robot or mirror during the exposure.
//!
//! Absent: light that goes from diffuse surface to diffuse surface; stripes that the camera sees in a mirror; ambient
//! light by what reflects it; bodies that move during the exposure.

mod bounce;
mod light;
mod smear;
mod speckle;
mod split;
mod sun;
mod trace;

use nalgebra::{Isometry3, Matrix3, Vector3};

use super::camera::ImageParams;
use super::noise::{Bell, Detector, Light, Sensor};
use crate::fault::{Fault, Result, number_within};
use crate::geometry::{Point, Robot, Transform, World};
use crate::image::Image;
use crate::optics::{LaserPlane, Rig};
use crate::world::{Material, Scene, Surfaces};

use bounce::Mirror;
use light::Glimpse;
use speckle::Speckle;
use sun::Sun;
use trace::{PARTS, Trace};

type V3 = Vector3<f64>;

/// How far beyond the image's edge a stripe may lie and still spill into it [px].
const BORDER_PX: f64 = 4.0;

/// Where a column's line of sight truly met a surface that the laser lit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrueSight {
    /// Image column.
    pub column: u16,
    /// Row of the middle of the stripe in the column's centre [px] from the top, without speckle.
    pub v: f64,
    /// The point.
    pub point: Point<World>,
    /// Index of the body in the scene.
    pub body: u32,
    /// Mean number of electrons that the stripe leaves in the column.
    pub electrons: f32,
}

/// One image, and beside it what it shows.
#[derive(Clone, Debug)]
pub struct Exposure {
    /// What the camera gives.
    pub image: Image,
    /// What is in it in the middle of the exposure, by column, then row; a column may have none or several. Bounces are
    /// not in it: they are false.
    pub truth: Vec<TrueSight>,
}

/// Where the finder is at one instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Moment {
    /// The robot.
    pub world_from_robot: Transform<World, Robot>,
    /// θR [rad].
    pub cylinder_rad: f64,
    /// θB [rad].
    pub beam_rad: f64,
}

/// How the finder moves from the shutter's opening to its closing.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Movement {
    /// The robot, in its own frame.
    pub robot: Transform<Robot, Robot>,
    /// Turn of the cylinder [rad].
    pub cylinder_rad: f64,
    /// Turn of the beam [rad].
    pub beam_rad: f64,
}

impl Default for Movement {
    /// None.
    fn default() -> Self {
        Self { robot: Transform::identity(), cylinder_rad: 0.0, beam_rad: 0.0 }
    }
}

/// Takes slit images of a scene.
#[derive(Clone, Debug)]
pub struct Renderer {
    rig: Rig,
    params: ImageParams,
    materials: Vec<Material>,
    /// Whether any material mirrors.
    is_glossy: bool,
    sensor: Sensor,
    bell: Bell,
    speckle: Speckle,
    sun: Sun,
    /// The camera sees what has x, y between these times z (camera frame): x from, to, y from, to.
    field: [f64; 4],
}

/// A sheet of light: the laser's own, a part of its thickness, or its mirror image.
#[derive(Clone, Copy, Debug)]
struct Beam {
    sheet: LaserPlane<World>,
    /// Share of the laser's light.
    share: f64,
    /// Thickness over that of the laser's own.
    thinness: f64,
    /// The surface that throws it.
    mirror: Option<Mirror>,
}

/// What one camera sees of one sheet.
struct View<'a> {
    renderer: &'a Renderer,
    surfaces: &'a Surfaces,
    beam: Beam,
    eye: V3,
    /// Turns world directions into the camera's frame.
    turn: Matrix3<f64>,
    /// Which speckle the surfaces have.
    seed: u64,
}

impl Renderer {
    /// A camera in front of a scene: its materials and ambient light are taken over, its shapes are not.
    ///
    /// Errors: parameters, materials or ambient light out of their ranges; a lens model that cannot be undone anywhere
    /// along the image's edge.
    pub fn new(rig: &Rig, params: ImageParams, scene: &Scene) -> Result<Self> {
        let (rig, params) = (rig.clone().validated()?, params.validated()?);
        let ambient = number_within("ambient_w_per_m2", scene.ambient_w_per_m2, 0.0, 1e6)?;
        for body in &scene.bodies {
            number_within(&format!("body {}: albedo", body.name), body.material.albedo, 0.0, 1.0)?;
            number_within(&format!("body {}: gloss", body.name), body.material.gloss, 0.0, 1.0)?;
            number_within(&format!("body {}: gloss_spread_rad", body.name), body.material.gloss_spread_rad, 0.0, 1.0)?;
            let sum = body.material.albedo + body.material.gloss;
            if sum > 1.0 + 1e-9 {
                let expected = "at most 1: a surface cannot send back more light than it gets";
                return Err(Fault::new(format!("body {}: albedo + gloss", body.name), sum, expected));
            }
        }
        let materials: Vec<Material> = scene.bodies.iter().map(|body| body.material).collect();
        let is_glossy = materials.iter().any(|material| material.gloss > 0.0);
        let (sensor, field) = (sensor(&rig, &params, ambient), field_of_view(&rig)?);
        let speckle = Speckle::new(&rig, &params);
        let sun =
            Sun::new(&rig, scene, params.vignetting, params.electrons_of(&rig, params.filter_bandwidth_nm / 10.0, 1.0));
        Ok(Self { rig, params, materials, is_glossy, sensor, bell: Bell::new(), speckle, sun, field })
    }

    /// The parameters in use.
    pub fn params(&self) -> &ImageParams {
        &self.params
    }

    /// Takes an image with the robot at `world_from_robot` and the motors truly at θR and θB [rad], between whole pulses
    /// if need be, all standing still. The sensor's noise depends on `seed` and `frame` alone, speckle on `seed` and the
    /// surfaces.
    ///
    /// Errors: a pose or angle that is not finite.
    pub fn expose(
        &self,
        surfaces: &Surfaces,
        world_from_robot: &Transform<World, Robot>,
        cylinder_rad: f64,
        beam_rad: f64,
        seed: u64,
        frame: u64,
    ) -> Result<Exposure> {
        let middle = Moment { world_from_robot: *world_from_robot, cylinder_rad, beam_rad };
        self.expose_moving(surfaces, &middle, &Movement::default(), seed, frame)
    }

    /// The same on the move: `middle` is the middle of the exposure.
    ///
    /// Errors: a pose or angle that is not finite.
    pub fn expose_moving(
        &self,
        surfaces: &Surfaces,
        middle: &Moment,
        movement: &Movement,
        seed: u64,
        frame: u64,
    ) -> Result<Exposure> {
        for angle in [middle.cylinder_rad, movement.cylinder_rad] {
            number_within("cylinder angle", angle, -1e6, 1e6)?;
        }
        for angle in [middle.beam_rad, movement.beam_rad] {
            number_within("beam angle", angle, -1e3, 1e3)?;
        }
        if !middle.world_from_robot.is_finite() || !movement.robot.is_finite() {
            return Err(Fault::new("robot pose", "a pose that is not finite", "finite numbers"));
        }
        let mut light = Light::new(self.rig.camera.width, self.rig.camera.height);
        let view = self.view(surfaces, middle, seed)?;
        let trace = view.trace(None);
        let instants = if self.params.smear { view.instants(&trace, middle, movement)? } else { 1 };
        let share = 1.0 / f64::from(instants);
        let truth = view.shine(trace, share, &mut light);
        for instant in (0..instants).filter(|i| 2 * i + 1 != instants) {
            let moment = middle.moved(movement, (f64::from(instant) + 0.5) * share - 0.5);
            let view = self.view(surfaces, &moment, seed)?;
            view.shine(view.trace(None), share, &mut light);
        }
        self.shine_sun(surfaces, &view.eye, &view.turn.transpose(), &mut light);
        Ok(Exposure { image: self.sensor.read(light, seed, frame)?, truth })
    }

    /// What the camera sees of the laser's own sheet.
    fn view<'a>(&'a self, surfaces: &'a Surfaces, moment: &Moment, seed: u64) -> Result<View<'a>> {
        let world_from_sensor = moment.world_from_robot * self.rig.robot_from_sensor_at(moment.cylinder_rad);
        let world_from_camera: Isometry3<f64> = (world_from_sensor * self.rig.sensor_from_camera).iso;
        let sheet = world_from_sensor * self.rig.laser_plane_at(moment.beam_rad)?;
        Ok(View {
            renderer: self,
            surfaces,
            beam: Beam { sheet, share: 1.0, thinness: 1.0, mirror: None },
            eye: world_from_camera.translation.vector,
            turn: world_from_camera.rotation.inverse().to_rotation_matrix().into_inner(),
            seed,
        })
    }
}

impl View<'_> {
    /// The same camera with another sheet.
    fn with(&self, beam: Beam) -> Self {
        Self { beam, ..*self }
    }

    /// Adds all light of an instant that lasts this share of the exposure: the stripe, where an edge parts it its parts,
    /// and its bounces. Gives what is true.
    fn shine(&self, trace: Trace, share: f64, light: &mut Light) -> Vec<TrueSight> {
        let parted = self.parted(&trace);
        for (part, glimpse) in trace.glimpses().filter(|(part, _)| !parted.has(column_of(*part))) {
            self.add(part, glimpse, share, light);
        }
        let mut truth: Vec<TrueSight> =
            trace.seen().filter(|c| !parted.has(column_of(c.part))).map(|c| c.sight()).collect();
        if !parted.is_empty() {
            truth.extend(self.shine_parts(&trace, &parted, share, light));
            truth.sort_by(|a, b| a.column.cmp(&b.column).then(a.v.total_cmp(&b.v)));
        }
        for beam in self.bounces(&trace) {
            let view = self.with(beam);
            for (part, glimpse) in view.trace(None).glimpses() {
                view.add(part, glimpse, share, light);
            }
        }
        let in_image = |v: f64| v >= -0.5 && v <= self.renderer.rig.camera.height as f64 - 0.5;
        truth.retain(|sight| in_image(sight.v));
        truth
    }

    /// Adds a third of a column's light.
    fn add(&self, part: i32, glimpse: &Glimpse, share: f64, light: &mut Light) {
        let electrons = glimpse.electrons * glimpse.grain.gain * share / f64::from(PARTS);
        let v = glimpse.v + glimpse.grain.shift_px;
        light.add(&self.renderer.bell, column_of(part) as usize, v, glimpse.sigma_px, electrons);
    }
}

/// The column that a third of a column belongs to.
fn column_of(part: i32) -> i32 {
    (part + PARTS / 2).div_euclid(PARTS)
}

/// The sensor with the light that falls on it without the laser.
fn sensor(rig: &Rig, params: &ImageParams, ambient_w_per_m2: f64) -> Sensor {
    let background_electrons = params.background_electrons(rig, ambient_w_per_m2);
    let ambient = background_electrons - params.dark_electrons;
    let detector = Detector {
        well_electrons: params.well_electrons,
        read_noise_electrons: params.read_noise_electrons,
        background_electrons,
        blooming: params.blooming,
        white_level: params.white_level,
    };
    let fall_off = |u: f64, v: f64| rig.camera.ray(u, v).map_or(0.0, |ray| ray.norm().powf(-params.vignetting));
    Sensor::shaded(detector, rig.camera.width, rig.camera.height, |u, v| ambient * (1.0 - fall_off(u, v)))
}

/// The bounds of the lines of sight along the image's edge, as x/z and y/z in the camera's frame.
fn field_of_view(rig: &Rig) -> Result<[f64; 4]> {
    let camera = &rig.camera;
    let (right, bottom) = (camera.width as f64 - 1.0 + BORDER_PX, camera.height as f64 - 1.0 + BORDER_PX);
    let mut field = [f64::INFINITY, f64::NEG_INFINITY, f64::INFINITY, f64::NEG_INFINITY];
    for i in 0..=64 {
        let along = |end: f64| (end + BORDER_PX) * f64::from(i) / 64.0 - BORDER_PX;
        let (u, v) = (along(right), along(bottom));
        for [u, v] in [[u, -BORDER_PX], [u, bottom], [-BORDER_PX, v], [right, v]] {
            if let Some(ray) = camera.ray(u, v) {
                field = [field[0].min(ray.x), field[1].max(ray.x), field[2].min(ray.y), field[3].max(ray.y)];
            }
        }
    }
    if field.iter().all(|bound| bound.is_finite()) {
        return Ok(field);
    }
    Err(Fault::new(
        "camera.distortion",
        "a lens that no pixel of the image's edge sees through",
        "a lens model that can be undone",
    ))
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, PI};
    use std::sync::Arc;

    use super::*;
    use crate::optics::{Laser, PlaneLaser, Sheet, Uncertainty, triangulate};
    use crate::world::{Body, Mesh, Motion, Shape};

    const STILL: Motion = Motion::Static;
    /// θB of the beam at P, from Table 4.
    fn beam_at_p() -> f64 {
        (817.230f64 / 2704.210).atan()
    }

    fn body(shape: Shape, xyz: [f64; 3]) -> Body {
        let pose = Isometry3::translation(xyz[0], xyz[1], xyz[2]);
        Body { name: "thing".into(), shape, pose, material: Material::default(), motion: STILL, ground: false }
    }

    fn block(size: [f64; 3], xyz: [f64; 3]) -> Body {
        body(Shape::Box { size: V3::from(size) }, xyz)
    }

    fn floor() -> Body {
        body(Shape::Plane, [0.0; 3])
    }

    fn scene(bodies: Vec<Body>) -> Scene {
        Scene { bodies, ..Scene::default() }
    }

    fn shoot(rig: &Rig, params: ImageParams, scene: &Scene, beam_rad: f64, frame: u64) -> Exposure {
        let renderer = Renderer::new(rig, params, scene).unwrap();
        let surfaces = Surfaces::new(scene).unwrap();
        renderer.expose(&surfaces, &Transform::identity(), 0.0, beam_rad, 1, frame).unwrap()
    }

    #[test]
    fn light_passes_glass_and_stops_at_a_screen() {
        let wall = || Body { ground: false, ..block([0.1, 3.0, 2.0], [2.5, 0.0, 1.0]) };
        let pane = |transmission: f64| Body {
            material: Material { albedo: 0.0, transmission, ..Material::default() },
            ..block([0.01, 2.0, 2.0], [1.8, 0.0, 1.0])
        };
        let on_wall = |transmission| {
            let truth = seen(vec![floor(), pane(transmission), wall()], beam_at_p() - 0.05);
            truth.iter().filter(|sight| sight.body == 2).count()
        };
        let open = seen(vec![floor(), wall()], beam_at_p() - 0.05).iter().filter(|sight| sight.body == 1).count();
        assert!(open > 100, "{open}");
        assert_eq!((on_wall(0.9), on_wall(0.0)), (open, 0));
    }

    #[test]
    fn direct_sun_brightens_what_it_falls_on_and_nothing_else() {
        use crate::world::Sunlit;
        let lit = |from_m: [f64; 2]| {
            // A fourteenth of the sun's: more would saturate.
            let sun = Sunlit { from_m, to_m: [9.0, 9.0], w_per_m2: 1.0 };
            let scene = Scene { sunlit: vec![sun], ..scene(vec![floor()]) };
            let image = shoot(&Rig::metro_i(), calm(), &scene, beam_at_p(), 0).image;
            let mean = |u: std::ops::Range<usize>| {
                let rows = (0..image.height()).step_by(8);
                let levels: Vec<f64> = rows
                    .flat_map(|v| u.clone().map(move |u| (u, v)))
                    .map(|(u, v)| f64::from(image.row(v)[u]))
                    .collect();
                levels.iter().sum::<f64>() / levels.len() as f64
            };
            [mean(20..200), mean(312..492)]
        };
        let ([dark, _], [left, right]) = (lit([8.0, 8.0]), lit([0.0, 0.0]));
        // The left half of the image is the robot's left, y > 0.
        assert!(left > dark + 5.0 && (right - dark).abs() < 2.0, "{dark} {left} {right}");
        // ρE/(4N²)·pitch²·t·η·τ·λ/hc of the whole well, at ρ = 0.5 in the middle; the corners get half.
        let params = calm();
        let expected = params.electrons_of(&Rig::metro_i(), 1.0, 0.5) * 127.0 / params.well_electrons;
        assert!((0.4..1.0).contains(&((left - dark) / expected)), "{} {expected}", left - dark);
    }

    /// Without speckle.
    fn calm() -> ImageParams {
        ImageParams { speckle_contrast: 0.0, ..ImageParams::default() }
    }

    /// Without speckle, dark signal and much of the noise, in 255 levels that nothing saturates.
    fn fine() -> ImageParams {
        let (white_level, well_electrons) = (255, 150e3);
        ImageParams { white_level, well_electrons, read_noise_electrons: 5.0, dark_electrons: 0.0, ..calm() }
    }

    fn seen(bodies: Vec<Body>, beam_rad: f64) -> Vec<TrueSight> {
        shoot(&Rig::metro_i(), ImageParams::default(), &scene(bodies), beam_rad, 0).truth
    }

    fn in_column(truth: &[TrueSight], column: u16) -> Vec<TrueSight> {
        truth.iter().filter(|s| s.column == column).copied().collect()
    }

    /// The row on the optical axis' column of a floor point at X: the paper's V = lf·tan(θv − φ), (23), (26), in mm.
    fn floor_row(x_mm: f64) -> f64 {
        let (lf, k, h_b, x0, tilt) = (11.434f64, 0.00335, 2197.820 * 0.489f64.sin(), -164.630, 0.484f64);
        let depression = (h_b / (x_mm + x0)).atan();
        let ideal = lf * (tilt - depression).tan();
        let (mut low, mut high) = (-9.0f64, 9.0f64);
        for _ in 0..100 {
            let middle = (low + high) / 2.0;
            if middle * (1.0 + k * middle * middle) < ideal { low = middle } else { high = middle }
        }
        239.0 - low / (4.8 / 485.0)
    }

    #[test]
    fn a_flat_floor_is_seen_in_the_row_of_the_papers_formula() {
        // A sensor of fine steps: in the paper's 7 bits the faint line's flanks fall under half a level.
        let params = ImageParams { f_number: 4.0, well_electrons: 20e3, white_level: 255, ..calm() };
        for x_mm in [1500.0f64, 2104.0, 2704.210, 3500.0] {
            let shot = shoot(&Rig::metro_i(), params, &scene(vec![floor()]), (817.230 / x_mm).atan(), 0);
            let sights = in_column(&shot.truth, 256);
            assert_eq!((sights.len(), shot.truth.len()), (1, 512));
            assert!((sights[0].v - floor_row(x_mm)).abs() < 1e-6, "{} {}", sights[0].v, floor_row(x_mm));
            assert!((sights[0].point.xyz - V3::new(x_mm / 1e3, 0.0, 0.0)).norm() < 1e-9);
            // The image has it there too: centroid of 21 columns over the background.
            let near = sights[0].v.round() as usize;
            let (mut sum, mut moment) = (0.0, 0.0);
            for v in near - 3..=near + 3 {
                let lit: f64 = shot.image.row(v)[246..267].iter().map(|l| f64::from(*l)).sum();
                let lit = lit - 21.0 * 200.0 * 255.0 / 20e3; // over the dark signal
                sum += lit;
                moment += v as f64 * lit;
            }
            assert!((moment / sum - sights[0].v).abs() < 0.05, "{} {} at {x_mm}", moment / sum, sights[0].v);
        }
    }

    #[test]
    fn the_oracle_points_of_the_paper_are_seen_where_they_must() {
        // paper.md 6: (Uf, Vf upwards), X, Y, Z [mm]; a board is put up at each X.
        for ([u, v_up], [x, y, z]) in [
            ([356.0, 300.0], [1834.8129, -184.3697, 262.7375]),
            ([156.0, 340.0], [2427.9248, 245.9602, 83.4952]),
            ([400.0, 150.0], [971.2675, -138.2801, 523.7066]),
        ] {
            let board = block([0.1, 0.06, 0.06], [x / 1e3 + 0.05, y / 1e3, z / 1e3]);
            let sights = in_column(&seen(vec![board], beam_at_p()), u as u16);
            assert_eq!(sights.len(), 1);
            assert!((sights[0].v - (479.0 - v_up)).abs() < 1e-4, "{}", sights[0].v);
            assert!((sights[0].point.xyz * 1e3 - V3::new(x, y, z)).norm() < 1e-3, "{:?}", sights[0].point);
        }
    }

    /// A camera 2 m in front of a wall and square to it, its laser 0.1 m beside it.
    fn square_on(params: ImageParams) -> Exposure {
        let laser =
            Laser::Plane(PlaneLaser { normal: [0.0, -2.0, -0.1], offset_m: -0.2, origin_m: Some([0.0, 0.1, 0.0]) });
        let rig = Rig { laser, ..Rig::metro_i() };
        let mut wall = block([4.0, 4.0, 0.1], [0.0; 3]);
        wall.pose = rig.sensor_from_camera.iso * Isometry3::translation(0.0, 0.0, 2.05);
        shoot(&rig, params, &scene(vec![wall]), 0.0, 0)
    }

    #[test]
    fn a_wall_at_two_metres_gives_the_electrons_of_the_instrument() {
        // instrument.md 1: 1.8e5 electrons a column at f/1.4, 2.2e4 at f/4.
        let at = |f_number: f64| ImageParams { f_number, ..calm() };
        for (f_number, electrons) in [(1.4, 1.8e5), (4.0, 2.2e4)] {
            let got = f64::from(in_column(&square_on(at(f_number)).truth, 256)[0].electrons);
            assert!((got / electrons - 1.0).abs() < 0.02, "{got} at f/{f_number}");
        }
        // The well of 100 ke⁻ overflows at f/1.4: white, and no more than white.
        assert_eq!(square_on(at(1.4)).image.levels().iter().max(), Some(&127));
        assert!(square_on(at(4.0)).image.levels().iter().all(|l| *l < 40));
    }

    /// Mean level of the stripe's middle over the background, on the floor at X, with the stripe in the middle of a row.
    fn floor_peak(x_m: f64, params: ImageParams) -> f64 {
        let world = scene(vec![floor()]);
        let row = floor_row(x_m * 1e3).round().min(477.0); // X = 1.4 m lies just under the image
        let (mut near, mut far) = (x_m - 0.1, x_m + 0.1); // rows fall as X grows
        for _ in 0..60 {
            let middle = (near + far) / 2.0;
            if floor_row(middle * 1e3) > row { near = middle } else { far = middle }
        }
        let renderer = Renderer::new(&Rig::metro_i(), params, &world).unwrap();
        let surfaces = Surfaces::new(&world).unwrap();
        let frames = 150;
        let level = |frame| {
            let beam_rad = (0.817_230 / near).atan();
            let shot = renderer.expose(&surfaces, &Transform::identity(), 0.0, beam_rad, 1, frame).unwrap();
            shot.image.row(row as usize)[250..263].iter().map(|l| f64::from(*l)).sum::<f64>() / 13.0
        };
        (0..frames).map(level).sum::<f64>() / frames as f64 - params.dark_electrons * 127.0 / 100e3
    }

    #[test]
    fn the_floor_has_the_levels_of_the_instrument() {
        // instrument.md 1: at f/4 and albedo 0.5, peaks of 19, 9, 3, 1.6 levels at X = 1.4, 2, 3, 3.7 m, for a point
        // spread of some 0.2 px; our 0.3 px and the defocus cost 6 to 10 % of them.
        // Noise of a level, well over 0, so that steps of a level do not swallow what is smaller.
        let noisy = ImageParams { dark_electrons: 6000.0, read_noise_electrons: 800.0, ..calm() };
        let params = ImageParams { f_number: 4.0, ..noisy };
        for (x_m, peak) in [(1.4, 19.0), (2.0, 9.0), (3.0, 3.0), (3.7, 1.6)] {
            let sharp = floor_peak(x_m, ImageParams { point_spread_px: 0.2, ..params });
            assert!((sharp / peak - 1.0).abs() < 0.06, "{sharp} for {peak} at {x_m} m");
            let default = floor_peak(x_m, params);
            assert!((default / peak - 1.0).abs() < 0.13 && default < sharp, "{default} for {peak} at {x_m} m");
        }
    }

    #[test]
    fn a_dark_box_is_dimmer_by_its_albedo() {
        let lit = |albedo: f64| {
            let mut thing = block([0.3, 0.3, 0.3], [2.0, 0.0, 0.15]);
            thing.material.albedo = albedo;
            let params = ImageParams { signal_electrons_min: 0.0, ..ImageParams::default() };
            let shot = shoot(&Rig::metro_i(), params, &scene(vec![floor(), thing]), beam_at_p(), 0);
            in_column(&shot.truth, 256)[0].electrons
        };
        assert!((lit(0.5) / lit(0.05) - 10.0).abs() < 1e-4);
        assert_eq!(lit(0.0), 0.0);
    }

    #[test]
    fn a_box_keeps_the_light_from_the_floor_behind_it() {
        // Front face at 1.85 m; there the beam at P is 0.258 m high.
        let truth = seen(vec![floor(), block([0.3, 0.3, 0.3], [2.0, 0.0, 0.15])], beam_at_p());
        let half = |x: f64, y: f64| 915.0 * y / x; // roughly columns
        for column in 0..512u16 {
            let sights = in_column(&truth, column);
            let off = (f64::from(column) - 256.0).abs();
            if off < half(1.85, 0.14) * 0.98 {
                assert_eq!(sights.iter().map(|s| s.body).collect::<Vec<_>>(), [1], "{column}");
                assert!((sights[0].point.xyz.x - 1.85).abs() < 1e-9);
            } else if off > half(1.6, 0.17) {
                assert_eq!(sights.iter().map(|s| s.body).collect::<Vec<_>>(), [0], "{column}");
            }
        }
        // In the shadow, |y| < 0.15·X/1.85, no floor is lit at P.
        let shadow = 0.15 * 2.70421 / 1.85;
        assert!(truth.iter().all(|s| s.body == 1 || s.point.xyz.y.abs() > shadow - 1e-9));
    }

    #[test]
    fn a_bar_over_the_sheet_hides_the_line_from_the_camera_alone() {
        // The line of sight from the camera to P passes X = 1.5 m at 0.4896 m, the sheet at 0.3638 m.
        let bar = block([0.02, 0.2, 0.03], [1.5, 0.0, 0.4896]);
        let truth = seen(vec![floor(), bar], beam_at_p());
        assert!(in_column(&truth, 256).is_empty() && in_column(&truth, 220).is_empty());
        assert!(truth.iter().all(|s| s.body == 0));
        assert!((350..420).contains(&truth.len()), "{}", truth.len());
        // In the sheet, it stops the light instead: a line on the bar, none behind it.
        let truth = seen(vec![floor(), block([0.02, 0.2, 0.03], [1.5, 0.0, 0.3638])], beam_at_p());
        assert_eq!(in_column(&truth, 256).iter().map(|s| s.body).collect::<Vec<_>>(), [1]);
    }

    #[test]
    fn a_sheet_of_mesh_is_seen_from_the_laser_side_only() {
        // A leaf between laser and camera: lit from below, looked at from above.
        let leaf = |z: [f64; 2]| {
            let vertices =
                [[1.4, -2.0, z[0]], [1.8, -2.0, z[1]], [1.8, 2.0, z[1]], [1.4, 2.0, z[0]]].map(V3::from).to_vec();
            let mesh = Mesh { vertices, triangles: vec![[0, 1, 2], [0, 2, 3]] };
            seen(vec![body(Shape::Mesh(Arc::new(mesh)), [0.0; 3])], beam_at_p())
        };
        // The sheet falls by 0.302 a metre, from 0.394 to 0.273 m; the camera's rays fall by 0.45.
        assert!(leaf([0.42, 0.26]).is_empty(), "falls by 0.40 a metre: steeper than the light, flatter than the sight");
        assert_eq!(leaf([0.36, 0.30]).len(), 512, "falls by 0.15: both from above");
        assert_eq!(leaf([0.46, 0.20]).len(), 512, "falls by 0.65: both from below");
    }

    #[test]
    fn a_mesh_floor_is_the_floor_in_every_column() {
        let n = 60u32;
        let step = 8.0 / f64::from(n);
        let at = |i: u32| V3::new(f64::from(i / (n + 1)) * step - 1.0, f64::from(i % (n + 1)) * step - 4.0, 0.0);
        let vertices = (0..(n + 1) * (n + 1)).map(at).collect();
        let cell = |i: u32| i / n * (n + 1) + i % n;
        let triangles =
            (0..n * n).map(cell).flat_map(|a| [[a, a + n + 1, a + 1], [a + 1, a + n + 1, a + n + 2]]).collect();
        let mesh = body(Shape::Mesh(Arc::new(Mesh { vertices, triangles })), [0.0; 3]);
        for x_m in [1.6, 2.0, 2.70421] {
            let beam = (0.817_230f64 / x_m).atan();
            let (flat, tiled) = (seen(vec![floor()], beam), seen(vec![mesh.clone()], beam));
            assert_eq!((flat.len(), tiled.len()), (512, 512));
            for (a, b) in flat.iter().zip(&tiled) {
                assert!(a.column == b.column && (a.v - b.v).abs() < 1e-6 && (a.point.xyz - b.point.xyz).norm() < 1e-8);
                assert!((a.electrons / b.electrons - 1.0).abs() < 1e-4);
            }
        }
    }

    #[test]
    fn boxes_that_share_an_edge_on_a_column_are_seen_once_there() {
        let boxes = vec![block([0.2, 0.5, 1.0], [2.0, 0.25, 0.5]), block([0.2, 0.5, 1.0], [2.0, -0.25, 0.5])];
        let truth = seen(boxes, beam_at_p());
        assert!((200..300u16).all(|column| in_column(&truth, column).len() == 1));
    }

    #[test]
    fn a_column_with_an_edge_in_it_holds_both_stripes() {
        // A box ends at column 300.1 and a leaf farther off begins there: column 300 sees two thirds of one, a third of the
        // other.
        let rig = Rig::metro_i();
        let face = |x: f64, u: f64| {
            // The y at which the line along the sheet on the plane X = x falls on column u.
            let z = 0.817_230 * (1.0 - x / 2.70421);
            let (mut low, mut high) = (-1.0f64, 1.0f64);
            for _ in 0..80 {
                let y = (low + high) / 2.0;
                let p = rig.sensor_from_camera.inverse() * Point::new(x, y, z);
                if rig.camera.project(&p.xyz).unwrap()[0] > u { low = y } else { high = y }
            }
            low
        };
        // The near box is just high enough for the light (0.334 m); the camera looks over it at the far one.
        let near = block([0.2, 1.0, 0.34], [1.7, face(1.6, 300.1) + 0.5, 0.17]);
        let y = face(2.4, 300.1);
        let vertices = [[2.4, y, 0.0], [2.4, y, 1.0], [2.4, y - 2.0, 1.0], [2.4, y - 2.0, 0.0]].map(V3::from).to_vec();
        let leaf = Mesh { vertices, triangles: vec![[0, 1, 2], [0, 2, 3]] };
        let far = body(Shape::Mesh(Arc::new(leaf)), [0.0; 3]);
        let params = ImageParams { dark_electrons: 800.0, ..calm() };
        let world = scene(vec![near, far]);
        let truth = shoot(&rig, params, &world, beam_at_p(), 0).truth;
        let row = |column: u16| in_column(&truth, column)[0].v.round() as usize;
        assert_eq!((in_column(&truth, 300)[0].body, in_column(&truth, 301)[0].body), (0, 1));
        let mut light = [[0.0; 2]; 3];
        for frame in 0..40 {
            let image = shoot(&rig, params, &world, beam_at_p(), frame).image;
            for (i, column) in [298usize, 300, 302].into_iter().enumerate() {
                for (j, row) in [row(299), row(301)].into_iter().enumerate() {
                    let sum: f64 = (row - 3..=row + 3).map(|v| f64::from(image.row(v)[column])).sum();
                    light[i][j] += sum - 7.0 * 800.0 * 127.0 / 100e3;
                }
            }
        }
        let [[near_full, far_none], [near_part, far_part], [near_none, far_full]] = light;
        assert!((near_part / near_full - 2.0 / 3.0).abs() < 0.03, "{light:?}");
        assert!((far_part / far_full - 1.0 / 3.0).abs() < 0.03, "{light:?}");
        assert!(far_none < 0.03 * far_full && near_none < 0.03 * near_full, "{light:?}");
    }

    /// A room full of shapes, turned every way.
    fn clutter() -> Scene {
        let mut bodies = vec![
            floor(),
            block([0.2, 6.0, 2.0], [4.0, 0.0, 1.0]),
            body(Shape::Sphere { radius: 0.2 }, [2.0, 0.3, 0.2]),
            body(Shape::Cylinder { radius: 0.08, length: 1.0 }, [1.6, -0.25, 0.5]),
            body(Shape::Cylinder { radius: 0.1, length: 0.7 }, [1.9, -0.1, 0.1]),
            block([0.3, 0.2, 0.2], [2.6, -0.6, 0.2]),
        ];
        bodies[4].pose.rotation = nalgebra::UnitQuaternion::from_euler_angles(FRAC_PI_2, 0.0, 0.4);
        bodies[5].pose.rotation = nalgebra::UnitQuaternion::from_euler_angles(0.3, 0.4, 0.5);
        bodies[5].motion = Motion::Dynamic { mass_kg: 1.0 };
        scene(bodies)
    }

    #[test]
    fn what_is_true_lies_on_sheet_surface_and_line_of_sight() {
        let (rig, world) = (Rig::metro_i(), clutter());
        let surfaces = Surfaces::new(&world).unwrap();
        let params = ImageParams { split: false, ..ImageParams::default() }; // parts of the sheet are beside it
        let renderer = Renderer::new(&rig, params, &world).unwrap();
        let none = Uncertainty { u_px: 0.0, v_px: 0.0, beam_rad: 0.0, cylinder_rad: 0.0 };
        let mut bodies = [0; 6];
        for step in 0..40 {
            let beam = 0.15 + 0.012 * f64::from(step);
            let cylinder = 0.5 * (f64::from(step) * 0.7).sin();
            let pose = Transform::planar(0.1, -0.05, 0.1);
            let shot = renderer.expose(&surfaces, &pose, cylinder, beam, 0, 0).unwrap();
            let world_from_sensor = pose * rig.robot_from_sensor_at(cylinder);
            let sheet = rig.laser_plane_at(beam).unwrap();
            for s in &shot.truth {
                let seen =
                    world_from_sensor * triangulate(&rig, &sheet, f64::from(s.column), s.v, &none).unwrap().point;
                assert!((seen.xyz - s.point.xyz).norm() < 1e-7);
                let near = [-1e-7, 1e-7].map(|d| (s.point.xyz + V3::repeat(d)).into());
                assert!(surfaces.touches(near[0], near[1]));
                // Nothing nearer on the way: the first thing that the eye and the laser meet there is this point.
                let eye = world_from_sensor * Point::from(rig.sensor_from_camera.xyz());
                for from in [eye, world_from_sensor * sheet.origin] {
                    let way = s.point.xyz - from.xyz;
                    let hit = surfaces.cast(from, &way, 20.0).unwrap();
                    assert!((hit.range_m - way.norm()).abs() < 6e-4 / hit.normal.dot(&way.normalize()).abs().max(0.05));
                }
                bodies[s.body as usize] += 1;
            }
            assert!(shot.truth.is_sorted_by(|a, b| (a.column, a.v) <= (b.column, b.v)));
        }
        assert!(bodies.iter().all(|count| *count > 100), "{bodies:?}");
    }

    #[test]
    fn all_the_light_of_the_truth_is_in_the_image() {
        // Sum of the levels over the background against the sum of the electrons; ambient light lies under both.
        let world = Scene { ambient_w_per_m2: 0.06, ..clutter() };
        let fine = ImageParams { f_number: 2.8, well_electrons: 40e3, white_level: 255, vignetting: 0.0, ..calm() };
        let shot = shoot(&Rig::metro_i(), fine, &world, 0.35, 0);
        let dark = shoot(&Rig::metro_i(), fine, &world, -1.0, 0);
        let sum = |shot: &Exposure| shot.image.levels().iter().map(|l| f64::from(*l)).sum::<f64>();
        assert!(dark.truth.is_empty());
        let light = (sum(&shot) - sum(&dark)) * 40e3 / 255.0;
        let truth: f64 = shot.truth.iter().map(|s| f64::from(s.electrons)).sum();
        assert!((light / truth - 1.0).abs() < 0.02, "{light} {truth}");
        // instrument.md 1: 0.06 W/m² on albedo 0.5 is 5760 photons at f/2: 2000 electrons, half that at f/2.8.
        let mean = sum(&dark) / (512.0 * 480.0) * 40e3 / 255.0;
        assert!((mean - 200.0 - 1020.0).abs() < 40.0, "{mean}");
    }

    #[test]
    fn the_same_seed_gives_the_same_bits_and_truth_knows_no_noise() {
        let world = clutter();
        let surfaces = Surfaces::new(&world).unwrap();
        let renderer = Renderer::new(&Rig::metro_i(), ImageParams::default(), &world).unwrap();
        let shoot = |seed, frame| renderer.expose(&surfaces, &Transform::identity(), 0.1, 0.35, seed, frame).unwrap();
        let (a, b, c, d) = (shoot(1, 2), shoot(1, 2), shoot(1, 3), shoot(2, 2));
        assert!(a.image == b.image && a.image != c.image && a.image != d.image);
        assert!(a.truth == b.truth && a.truth == c.truth && a.truth == d.truth);
        let threads: Vec<_> = std::thread::scope(|scope| {
            let runs: Vec<_> = (0..4).map(|_| scope.spawn(|| shoot(1, 2).image)).collect();
            runs.into_iter().map(|run| run.join().unwrap()).collect()
        });
        assert!(threads.iter().all(|image| *image == a.image));
    }

    /// Electrons of a column, from the levels over the background of dark frames.
    fn charge(image: &Image, column: usize, rows: std::ops::Range<usize>, background: f64, well: f64) -> f64 {
        let level = |v: usize| f64::from(image.row(v)[column]) - background;
        rows.map(level).sum::<f64>() * well / f64::from(image.white())
    }

    #[test]
    fn speckle_moves_each_column_by_c_lambda_n_over_pi_and_no_average_takes_it_away() {
        // f/4: 0.0814 px (instrument.md 1). A well of 20 ke⁻ in 255 levels; noise, averaged over 12 frames, adds 0.02 px.
        let params = ImageParams { f_number: 4.0, well_electrons: 20e3, white_level: 255, ..ImageParams::default() };
        let (rig, world) = (Rig::metro_i(), scene(vec![floor()]));
        let (renderer, surfaces) = (Renderer::new(&rig, params, &world).unwrap(), Surfaces::new(&world).unwrap());
        let beam_rad = (0.817_230f64 / 1.7).atan();
        let background = params.dark_electrons * 255.0 / 20e3;
        let errors = |seed: u64, x: f64| {
            let mut sums = vec![[0.0; 2]; 512];
            let mut truth = Vec::new();
            for frame in 0..12 {
                let pose = Transform::planar(x, 0.0, 0.0);
                let shot = renderer.expose(&surfaces, &pose, 0.0, beam_rad, seed, frame).unwrap();
                for sight in &shot.truth {
                    let (column, near) = (usize::from(sight.column), sight.v.round() as usize);
                    for v in near - 3..=near + 3 {
                        let level = f64::from(shot.image.row(v)[column]) - background;
                        sums[column][0] += level;
                        sums[column][1] += level * (v as f64 - sight.v);
                    }
                }
                truth = shot.truth;
            }
            assert_eq!(truth.len(), 512);
            sums.iter().map(|[light, moment]| moment / light).collect::<Vec<f64>>()
        };
        let rms = |e: &[f64]| (e.iter().map(|e| e * e).sum::<f64>() / e.len() as f64).sqrt();
        let correlation = |a: &[f64], b: &[f64]| {
            let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
            dot(a, b) / (dot(a, a) * dot(b, b)).sqrt()
        };
        let here = errors(1, 0.0);
        assert!((rms(&here) / 0.0814 - 1.0).abs() < 0.1, "{}", rms(&here));
        assert!(correlation(&here[1..], &here[..511]).abs() < 0.12, "{}", correlation(&here[1..], &here[..511]));
        // 5 mm on, or another surface: another pattern.
        assert!(correlation(&here, &errors(1, 0.005)).abs() < 0.12);
        assert!(correlation(&here, &errors(2, 0.0)).abs() < 0.12);
        let calm = Renderer::new(&rig, ImageParams { speckle_contrast: 0.0, ..params }, &world).unwrap();
        assert_eq!(calm.expose(&surfaces, &Transform::identity(), 0.0, beam_rad, 1, 0).unwrap().truth.len(), 512);
    }

    /// Mean grey level of a small area without a line.
    fn background_level(params: ImageParams, ambient_w_per_m2: f64, (u, v): (usize, usize)) -> f64 {
        let world = Scene { ambient_w_per_m2, ..scene(vec![]) };
        let image = shoot(&Rig::metro_i(), params, &world, 0.3, 0).image;
        let area = (v..v + 16).flat_map(|v| image.row(v)[u..u + 16].iter().map(|l| f64::from(*l)));
        area.sum::<f64>() / 256.0
    }

    #[test]
    fn sunlight_has_the_level_of_its_irradiance_and_falls_off_to_the_corners() {
        // Sun, 14 W/m² in 10 nm, on albedo 0.5 at f/16, 1 ms: E·ρ/(4N²)·pitch·t·τη·λ/hc electrons.
        let params = ImageParams {
            f_number: 16.0,
            exposure_s: 1e-3,
            sun_w_per_m2_nm: 1.4,
            well_electrons: 1000.0,
            read_noise_electrons: 5.0,
            ..ImageParams::default()
        };
        let pitch_m2 = (6.4e-3 / 512.0 / 1.095) * (4.8e-3 / 485.0);
        let joules = 14.0 * 0.5 / (4.0 * 256.0) * pitch_m2 * 1e-3 * 0.51 * 0.35;
        let electrons = 200.0 + joules * 632.8e-9 / (6.62607015e-34 * 299_792_458.0);
        let middle = background_level(params, 0.0, (248, 232));
        assert!((middle - electrons * 0.127).abs() < 1.0, "{middle} for {}", electrons * 0.127);
        // A band of 5 nm, and the same as ambient light of a world.
        let half = background_level(ImageParams { filter_bandwidth_nm: 5.0, ..params }, 0.0, (248, 232));
        assert!((half - (200.0 + (electrons - 200.0) / 2.0) * 0.127).abs() < 1.0, "{half}");
        let ambient = ImageParams { sun_w_per_m2_nm: 0.0, ..params };
        assert!((background_level(ambient, 14.0, (248, 232)) - middle).abs() < 0.5);
        // cos⁴ of the corner's 18.6°, by the pinhole: tan² = (248/1001.7)² + (231/1155.3)², a little more for the lens.
        let ray = Rig::metro_i().camera.ray(8.0, 8.0).unwrap();
        let expected = 200.0 + (electrons - 200.0) / ray.norm_squared().powi(2);
        let corner = background_level(params, 0.0, (0, 0));
        assert!((corner - expected * 0.127).abs() < 1.0 && corner < 0.9 * middle, "{corner} {}", expected * 0.127);
        let flat = background_level(ImageParams { vignetting: 0.0, ..params }, 0.0, (0, 0));
        assert!((flat - middle).abs() < 0.5, "{flat} {middle}");
    }

    #[test]
    fn the_stripe_falls_off_like_the_background() {
        let light = |vignetting: f64| {
            shoot(&Rig::metro_i(), ImageParams { vignetting, ..calm() }, &scene(vec![floor()]), beam_at_p(), 0).truth
        };
        // cos⁴ holds three cosines that geometry gives; the lens' own is the fourth.
        for (full, geometric) in light(4.0).iter().zip(&light(3.0)) {
            let ray = Rig::metro_i().camera.ray(f64::from(full.column), full.v).unwrap();
            assert!((f64::from(full.electrons / geometric.electrons) * ray.norm() - 1.0).abs() < 1e-5);
        }
    }

    #[test]
    fn a_full_pixel_overflows_along_its_column() {
        // f/1.4 at 2 m: 1.8e5 electrons a column, of which the middle row holds more than its 1e5.
        let lit = |blooming: f64| {
            let params = ImageParams { f_number: 1.4, blooming, read_noise_electrons: 1.0, ..calm() };
            let shot = square_on(params);
            let sight = in_column(&shot.truth, 256)[0];
            let (row, background) = (sight.v.round() as usize, 200.0 * 127.0 / 100e3);
            let held = charge(&shot.image, 256, row - 9..row + 10, background, 100e3);
            (held, f64::from(sight.electrons), (0..480).filter(|v| shot.image.row(*v)[256] == 127).count())
        };
        let (drained, all, full) = lit(0.0);
        let (spilt, _, rows) = lit(1.0);
        assert_eq!((full, rows), (1, 1), "{drained} {spilt} {all}");
        assert!((spilt / all - 1.0).abs() < 0.02, "nothing is lost: {spilt} of {all}");
        assert!(drained < 0.95 * all, "{drained} of {all}");
    }

    /// A mirror of this material, upright and square to the robot, its front at `x` [m].
    fn mirror(x: f64, albedo: f64, gloss: f64, gloss_spread_rad: f64) -> Body {
        let mut board = block([0.1, 0.6, 1.0], [x + 0.05, 0.0, 0.5]);
        board.material = Material { albedo, gloss, gloss_spread_rad, ..Material::default() };
        board
    }

    #[test]
    fn the_mirrored_lobe_holds_the_gloss_and_is_brightest_in_the_mirror_direction() {
        let world = scene(vec![mirror(2.0, 0.3, 0.4, 0.2)]);
        let (rig, surfaces) = (Rig::metro_i(), Surfaces::new(&world).unwrap());
        let renderer = Renderer::new(&rig, calm(), &world).unwrap();
        let still = Moment { world_from_robot: Transform::identity(), cylinder_rad: 0.0, beam_rad: beam_at_p() };
        let view = renderer.view(&surfaces, &still, 1).unwrap();
        // Over the whole sphere, from light that comes in at 0.3 rad: albedo once (half of |cos| lies behind) and gloss.
        let (normal, to_laser) = (-V3::x(), V3::new(-0.3f64.cos(), 0.3f64.sin(), 0.0) * 1.7);
        let (n, mut sum, mut brightest) = (400, 0.0, (0.0, V3::zeros()));
        for i in 0..n {
            let z = -1.0 + (2.0 * f64::from(i) + 1.0) / f64::from(n);
            for j in 0..n {
                let (sin, cos) = (f64::from(j) / f64::from(n) * std::f64::consts::TAU).sin_cos();
                let way = V3::new(cos * (1.0 - z * z).sqrt(), sin * (1.0 - z * z).sqrt(), z);
                let share = view.scattered(0, &normal, &to_laser, &(way * 2.0));
                sum += share * 4.0 * PI / f64::from(n * n);
                if share > brightest.0 {
                    brightest = (share, way);
                }
            }
        }
        assert!((sum - (2.0 * 0.3 + 0.4)).abs() < 2e-3, "{sum}");
        assert!(brightest.1.angle(&V3::new(-0.3f64.cos(), -0.3f64.sin(), 0.0)) < 0.02, "{:?}", brightest.1);
    }

    #[test]
    fn a_glossy_board_in_the_mirror_direction_is_white() {
        // Tilted so that the camera, 0.215 m over the laser and 0.165 m ahead of it, is in the mirror direction.
        let lit = |gloss: f64, extra: f64| {
            let point = V3::new(2.0, 0.0, 0.817_230 * (1.0 - 2.0 / 2.70421));
            let (eye, laser) = (V3::new(0.164_630, 0.0, 1.032_411), V3::new(0.0, 0.0, 0.817_230));
            let half = (eye - point).normalize() + (laser - point).normalize();
            let mut board = mirror(0.0, 0.3, gloss, 0.03);
            let tilt = half.z.atan2(-half.x) + extra;
            let turn = nalgebra::UnitQuaternion::from_axis_angle(&V3::y_axis(), tilt);
            board.pose = Isometry3::from_parts((point - turn * V3::new(-0.05, 0.0, 0.0)).into(), turn);
            let shot = shoot(&Rig::metro_i(), calm(), &scene(vec![board]), beam_at_p(), 0);
            let sight = in_column(&shot.truth, 256)[0];
            (f64::from(sight.electrons), shot.image.row(sight.v.round() as usize)[256])
        };
        let (dull, dull_level) = lit(0.0, 0.0);
        let (bright, level) = lit(0.5, 0.0);
        let (beside, _) = lit(0.5, 0.03); // the normal turned by σ: the mirror direction by 2 σ
        // gloss/(2π·σ²) over ρ·cosθr/π, with the aperture's 0.7 mrad in σ.
        let (kappa, cosine) = (1.0 / (0.03f64 * 0.03 + 0.0007 * 0.0007), 0.9985);
        let expected = 1.0 + 0.5 * kappa / (2.0 * PI) / (0.3 * cosine / PI);
        assert!((bright / dull / expected - 1.0).abs() < 0.01, "{} for {expected}", bright / dull);
        assert!((beside / bright - (-2.0f64).exp()).abs() < 0.02, "{}", beside / bright);
        assert!(dull_level < 100 && level == 127, "{dull_level} {level}");
    }

    #[test]
    fn a_mirror_throws_a_false_line_where_geometry_says() {
        // The beam at P meets the mirror at X = 2.3 m, 0.1222 m up, and goes on to the floor 0.404 m in front of it.
        let (x, unfolded) = (2.3, 2.70421);
        let seen = 2.0 * x - unfolded;
        let params = ImageParams { white_level: 255, read_noise_electrons: 5.0, dark_electrons: 0.0, ..calm() };
        let charge_at = |bodies: Vec<Body>, bounce: bool, x_m: f64| {
            let shot = shoot(&Rig::metro_i(), ImageParams { bounce, ..params }, &scene(bodies), beam_at_p(), 0);
            let row = floor_row(x_m * 1e3);
            let near = row.round() as usize;
            let rows = near - 4..near + 5;
            let level = |v: usize| f64::from(shot.image.row(v)[256]);
            let moment: f64 = rows.clone().map(|v| level(v) * (v as f64 - row)).sum();
            let light = charge(&shot.image, 256, rows, 0.0, 100e3);
            let true_there = in_column(&shot.truth, 256).iter().any(|s| (s.v - row).abs() < 3.0);
            assert_eq!(true_there, x_m == unfolded, "a false line is no truth");
            (light, moment * 100e3 / 255.0 / light)
        };
        let throwing = || vec![floor(), mirror(x, 0.0, 0.8, 0.0)];
        let (direct, _) = charge_at(vec![floor()], true, unfolded);
        let (thrown, off) = charge_at(throwing(), true, seen);
        assert!(off.abs() < 0.05, "{off} px from {}", floor_row(seen * 1e3));
        // The way of the light is the same; the camera is nearer: e ∝ Δy·cosθr·Ω·cosα ∝ z²·h/R⁴, z along the view.
        let seen_from = |x_m: f64| {
            let (ahead, height) = (x_m - 0.164_630, 1.032_411f64);
            let z = ahead * 0.484f64.cos() + height * 0.484f64.sin();
            z * z * height / (ahead * ahead + height * height).powi(2)
        };
        let expected = 0.8 * seen_from(seen) / seen_from(unfolded);
        // Rounding to levels of 392 electrons costs some per cent of 4e4.
        assert!((thrown / direct / expected - 1.0).abs() < 0.05, "{} for {expected}", thrown / direct);
        let (dark, _) = charge_at(throwing(), false, seen);
        assert!(dark.abs() < 0.02 * thrown, "{dark}");
        // Something low between mirror and floor keeps the light away.
        let mut stopped = throwing();
        stopped.push(block([0.01, 0.3, 0.1], [2.1, 0.0, 0.05])); // the light passes there 62 mm up, 1 mm thick
        let (dark, _) = charge_at(stopped, true, seen);
        assert!(dark.abs() < 0.02 * thrown, "{dark}");
    }

    #[test]
    fn a_rough_mirror_spreads_the_false_line() {
        // 0.01 rad over the 0.42 m from mirror to floor: 4.2 mm RMS across the sheet.
        let params = ImageParams { white_level: 255, well_electrons: 20e3, read_noise_electrons: 5.0, ..calm() };
        let spread = |rad: f64| {
            let world = scene(vec![floor(), mirror(2.3, 0.0, 0.9, rad)]);
            let (renderer, surfaces) =
                (Renderer::new(&Rig::metro_i(), params, &world).unwrap(), Surfaces::new(&world).unwrap());
            let row = floor_row((4.6 - 2.70421) * 1e3);
            let near = row.round() as usize;
            let (mut light, mut moment) = (0.0, 0.0);
            for frame in 0..40 {
                let image =
                    renderer.expose(&surfaces, &Transform::identity(), 0.0, beam_at_p(), 1, frame).unwrap().image;
                for (v, u) in (near - 12..near + 13).flat_map(|v| (250..262).map(move |u| (v, u))) {
                    let level = f64::from(image.row(v)[u]) - 200.0 * 255.0 / 20e3;
                    light += level;
                    moment += level * (v as f64 - row).powi(2);
                }
            }
            moment / light
        };
        let half_m = 0.01 * (0.404_21f64 / (817.230f64 / 2704.210).atan().cos());
        let row_per_m = (floor_row(1891.0) - floor_row(1901.0)) / 0.010; // along the floor
        let across = half_m / (817.230f64 / 2704.210).atan().sin() * row_per_m;
        let found = spread(0.01) - spread(0.0);
        assert!((found / (across * across) - 1.0).abs() < 0.1, "{found} for {}", across * across);
    }

    /// Upright leaves across the view: x, and the height they reach [m].
    fn leaf(x: f64, top: f64) -> Body {
        let vertices = [[x, 1.0, 0.0], [x, 1.0, top], [x, -1.0, top], [x, -1.0, 0.0]].map(V3::from).to_vec();
        body(Shape::Mesh(Arc::new(Mesh { vertices, triangles: vec![[0, 1, 2], [0, 2, 3]] })), [0.0; 3])
    }

    #[test]
    fn an_edge_within_the_sheets_thickness_parts_the_stripe() {
        // A leaf that ends a share of the sheet's σ over its middle, and another one 0.5 m behind it.
        let rig = Rig::metro_i();
        let beam = beam_at_p();
        let middle = 0.817_230 - 2.0 * beam.tan();
        let sigma = rig.sheet.thickness_m(2.0 / beam.cos()) / 2.0 / beam.cos(); // upright
        let params = fine();
        let bell = Bell::new();
        let light = |top: f64, split: bool| {
            let bodies = vec![leaf(2.0, top), leaf(2.5, 0.6)];
            let shot = shoot(&rig, ImageParams { split, ..params }, &scene(bodies), beam, 0);
            let whole = |x: f64| {
                let alone = shoot(&rig, params, &scene(vec![leaf(x, 0.6)]), beam, 0);
                let sight = in_column(&alone.truth, 200)[0];
                (sight.v.round() as usize, f64::from(sight.electrons))
            };
            let share = [2.0, 2.5].map(|x| {
                let (row, all) = whole(x);
                charge(&shot.image, 200, row - 5..row + 6, 0.0, 150e3) / all
            });
            (share, in_column(&shot.truth, 200))
        };
        // 17 thin sheets: one of them is an eighth, and may fall on either side of the edge.
        for off in [-1.0, -0.4, 0.05, 0.7, 1.0] {
            let (share, truth) = light(middle + off * sigma, true);
            let near = bell.at(off);
            assert!(
                (share[0] - near).abs() < 0.07 && (share[1] - (1.0 - near)).abs() < 0.08,
                "{off}: {share:?} {near}"
            );
            assert_eq!(truth.iter().map(|s| s.body).collect::<Vec<_>>(), [1, 0], "{off}");
            let (share, truth) = light(middle + off * sigma, false);
            assert!(share[0] > 0.97 || share[1] > 0.97, "{share:?}");
            assert_eq!(truth.len(), 1);
        }
        // Well over or under the sheet, nothing is parted, to the bit.
        for off in [-4.0, 4.0] {
            let (share, truth) = light(middle + off * sigma, true);
            assert_eq!((share, truth), light(middle + off * sigma, false));
        }
    }

    #[test]
    fn near_parts_make_a_mixed_peak() {
        // The second leaf 20 mm behind the first: 1.3 px; half of the light on each: one peak between them.
        let beam = beam_at_p();
        let bodies = vec![leaf(2.0, 0.817_230 - 2.0 * beam.tan()), leaf(2.02, 0.6)];
        let shot = shoot(&Rig::metro_i(), fine(), &scene(bodies), beam, 0);
        let truth = in_column(&shot.truth, 200);
        let rows: Vec<f64> = truth.iter().map(|s| s.v).collect();
        let near = rows[0].round() as usize;
        let (mut light, mut moment) = (0.0, 0.0);
        for v in near - 5..near + 7 {
            let level = f64::from(shot.image.row(v)[200]);
            light += level;
            moment += level * v as f64;
        }
        assert_eq!(rows.len(), 2);
        let share = (moment / light - rows[0]) / (rows[1] - rows[0]);
        assert!((0.3..0.7).contains(&share), "{share} of the way between {rows:?}");
    }

    fn on_the_move(bodies: Vec<Body>, params: ImageParams, robot: Transform<Robot, Robot>) -> Exposure {
        let world = scene(bodies);
        let middle = Moment { world_from_robot: Transform::identity(), cylinder_rad: 0.0, beam_rad: beam_at_p() };
        let movement = Movement { robot, ..Movement::default() };
        let renderer = Renderer::new(&Rig::metro_i(), params, &world).unwrap();
        renderer.expose_moving(&Surfaces::new(&world).unwrap(), &middle, &movement, 1, 0).unwrap()
    }

    #[test]
    fn motion_smears_the_stripe_by_how_far_it_gets() {
        // 30 mm towards a board 2 m away: some 2 rows (15.5 mm a row at X' = 2 m), which adds Δ²/12 to the variance.
        let params = fine();
        let variance = |shot: &Exposure| {
            let mut sum = [0.0; 3];
            for sight in &shot.truth {
                let near = sight.v.round() as usize;
                for v in near - 6..=near + 6 {
                    let level = f64::from(shot.image.row(v)[usize::from(sight.column)]);
                    let off = v as f64 - sight.v;
                    sum.iter_mut().zip([1.0, off, off * off]).for_each(|(sum, x)| *sum += level * x);
                }
            }
            sum[2] / sum[0] - (sum[1] / sum[0]).powi(2)
        };
        let board = || vec![leaf(2.0, 0.9)];
        let row = |x: f64| {
            let moved = shoot(&Rig::metro_i(), params, &scene(vec![leaf(x, 0.9)]), beam_at_p(), 0);
            in_column(&moved.truth, 256)[0].v
        };
        let rows = row(2.0 - 0.015) - row(2.0 + 0.015);
        let still = on_the_move(board(), params, Transform::identity());
        let moving = on_the_move(board(), params, Transform::planar(0.03, 0.0, 0.0));
        let added = variance(&moving) - variance(&still);
        let instants = 1.0 - 1.0 / 49.0; // seven of them are a little less than a continuum
        assert!((added / (rows * rows / 12.0 * instants) - 1.0).abs() < 0.06, "{added} for {}", rows * rows / 12.0);
        assert_eq!(moving.truth, still.truth, "the truth is that of the middle");
        let sharp = on_the_move(board(), ImageParams { smear: false, ..params }, Transform::planar(0.03, 0.0, 0.0));
        assert_eq!(sharp.image, still.image);
    }

    #[test]
    fn motion_that_moves_nothing_in_the_image_costs_nothing() {
        // Over a flat floor nothing moves, and 1 mm towards a board is a sixteenth of a row: one instant, the same bits.
        for (bodies, robot) in [
            (vec![floor()], Transform::planar(0.01, 0.0, 0.02)),
            (vec![leaf(2.0, 0.9)], Transform::planar(0.001, 0.0, 0.0)),
        ] {
            let still = on_the_move(bodies.clone(), ImageParams::default(), Transform::identity());
            assert_eq!(on_the_move(bodies, ImageParams::default(), robot).image, still.image);
        }
        // A turn smears an upright edge over the columns it passes.
        let edge = || vec![floor(), block([0.1, 0.2, 0.5], [2.0, 0.1, 0.25])];
        let turned = on_the_move(edge(), calm(), Transform::planar(0.0, 0.0, 0.01));
        let still = on_the_move(edge(), calm(), Transform::identity());
        let sight = in_column(&still.truth, 240)[0];
        assert_eq!(sight.body, 1);
        let profile = |shot: &Exposure| -> Vec<f64> {
            (240..280)
                .map(|u| charge(&shot.image, u, sight.v as usize - 3..sight.v as usize + 5, 0.25, 100e3))
                .collect()
        };
        let half = |p: &[f64]| p.iter().filter(|c| **c > 0.15 * p[0] && **c < 0.85 * p[0]).count();
        assert!(half(&profile(&turned)) >= 5 && half(&profile(&still)) <= 1, "{:?}", profile(&turned));
    }

    #[test]
    fn wrong_parameters_are_refused() {
        let fault = toml::from_str::<ImageParams>("f_stop = 2.0").unwrap_err();
        assert!(fault.to_string().contains("unknown field `f_stop`"));
        assert_eq!(toml::from_str::<ImageParams>("f_number = 4.0").unwrap().f_number, 4.0);
        let refused = |params: ImageParams| Renderer::new(&Rig::metro_i(), params, &scene(vec![])).is_err();
        let good = ImageParams::default();
        assert!(!refused(good));
        assert!(refused(ImageParams { f_number: 0.0, ..good }));
        assert!(refused(ImageParams { exposure_s: f64::NAN, ..good }));
        assert!(refused(ImageParams { quantum_efficiency: 1.1, ..good }));
        assert!(refused(ImageParams { white_level: 0, ..good }));
        assert!(
            refused(ImageParams { speckle_contrast: 1.1, ..good }) && refused(ImageParams { blooming: -0.1, ..good })
        );
        assert!(
            refused(ImageParams { vignetting: f64::NAN, ..good })
                && refused(ImageParams { sun_w_per_m2_nm: -1.0, ..good })
        );
        let mut shiny = floor();
        shiny.material.albedo = 1.5;
        assert!(Renderer::new(&Rig::metro_i(), good, &scene(vec![shiny])).is_err());
        let sheet = Sheet { power_w: -1.0, ..Sheet::default() };
        assert!(Renderer::new(&Rig { sheet, ..Rig::metro_i() }, good, &scene(vec![])).is_err());
        let renderer = Renderer::new(&Rig::metro_i(), good, &scene(vec![])).unwrap();
        let surfaces = Surfaces::new(&scene(vec![])).unwrap();
        let lost = Transform::planar(f64::NAN, 0.0, 0.0);
        assert!(renderer.expose(&surfaces, &lost, 0.0, 0.3, 0, 0).is_err());
        assert!(renderer.expose(&surfaces, &Transform::identity(), 0.0, f64::INFINITY, 0, 0).is_err());
    }
}
