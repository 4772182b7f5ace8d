//! The slit image: the laser sheet cut with the world, projected, lit, and read out by a noisy sensor.
//!
//! Each curve in which the sheet cuts a surface is projected through the calibrated lens and solved for the point that
//! falls on each image column, and on a third of a column to either side: so a stripe that ends within a column leaves its
//! share of light there, beside that of the surface behind. A point counts if the light reaches it and the camera sees it,
//! from the same side of the surface. Thirds are interpolated between the columns beside them where these agree on the
//! same stripe, and solved where they do not; so the shadow of a thing narrower than a column may be missed.
//!
//! Light is that of `instrument.md` 1. Absent, each to be added here: speckle (a fixed pattern of 0.08 px at f/4, per pose),
//! blooming of a full pixel along its column, the specular bounce of glossy surfaces (a false line) and of light between
//! surfaces, vignetting, motion during the exposure.

use std::f64::consts::PI;

use nalgebra::{Isometry3, Matrix2, Matrix3, Vector2, Vector3};

use super::camera::ImageParams;
use super::noise::{Bell, Detector, Light, Sensor};
use crate::fault::{Fault, Result, number_within};
use crate::geometry::{Point, Robot, Transform, World};
use crate::image::Image;
use crate::optics::{LaserPlane, Rig};
use crate::world::{Curve, Cut, Scene, Surfaces};

type V3 = Vector3<f64>;

/// Parts of a column that light is gathered from: odd, so that one of them is the column's centre.
const PARTS: i32 = 3;
/// Nearest thing that the camera can see [m].
const NEAR_M: f64 = 0.05;
/// How far beyond the image's edge a stripe may lie and still spill into it [px].
const BORDER_PX: f64 = 4.0;
/// A stripe that runs along a column is taken to cross at least this part of a column a row.
const STEEP: f64 = 0.05;

/// Where a column's line of sight truly met a surface that the laser lit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrueSight {
    /// Image column.
    pub column: u16,
    /// Row of the middle of the stripe in the column's centre [px] from the top.
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
    /// What is in it, by column, then row; a column may have none or several.
    pub truth: Vec<TrueSight>,
}

/// Takes slit images of a scene.
#[derive(Clone, Debug)]
pub struct Renderer {
    rig: Rig,
    params: ImageParams,
    albedo: Vec<f64>,
    sensor: Sensor,
    bell: Bell,
    /// The camera sees what has x, y between these times z (camera frame): x from, to, y from, to.
    field: [f64; 4],
}

/// One exposure under way.
struct View<'a> {
    renderer: &'a Renderer,
    surfaces: &'a Surfaces,
    sheet: LaserPlane<World>,
    eye: V3,
    /// Turns world directions into the camera's frame.
    turn: Matrix3<f64>,
}

/// A place on a cut that lies on an image column.
struct Candidate {
    /// Column times `PARTS`.
    part: i32,
    /// Which stretch of which cut, from one turn to the next: it crosses a column at most once.
    stretch: usize,
    body: usize,
    point: V3,
    glimpse: Glimpse,
    seen: bool,
}

/// A crossing of a third of a column that is not solved yet: it lies between these parameters and columns.
struct Crossing {
    part: i32,
    cut: usize,
    stretch: usize,
    from: (f64, f64),
    to: (f64, f64),
}

/// A parameter of a cut and the column it falls on; `None` where the lens sees nothing.
type Knot = Option<(f64, f64)>;

/// How the stripe crosses a column.
#[derive(Clone, Copy)]
struct Glimpse {
    v: f64,
    sigma_px: f64,
    electrons: f64,
}

impl Renderer {
    /// A camera in front of a scene: its materials and ambient light are taken over, its shapes are not.
    ///
    /// Errors: parameters, albedos or ambient light out of their ranges; a lens model that cannot be undone anywhere
    /// along the image's edge.
    pub fn new(rig: &Rig, params: ImageParams, scene: &Scene) -> Result<Self> {
        let (rig, params) = (rig.clone().validated()?, params.validated()?);
        let ambient = number_within("ambient_w_per_m2", scene.ambient_w_per_m2, 0.0, 1e6)?;
        for body in &scene.bodies {
            number_within(&format!("body {}: albedo", body.name), body.material.albedo, 0.0, 1.0)?;
        }
        // A pixel sees radiance ρE/π through the solid angle π/(4N²).
        let pitch = params.focal_length_m * params.focal_length_m / (rig.camera.fx * rig.camera.fy);
        let power_w = ambient * params.ambient_albedo / (4.0 * params.f_number * params.f_number) * pitch;
        let ambient_electrons = power_w * params.exposure_s * params.electrons_per_joule(rig.sheet.wavelength_m);
        let sensor = Sensor::new(Detector {
            well_electrons: params.well_electrons,
            read_noise_electrons: params.read_noise_electrons,
            background_electrons: params.dark_electrons + ambient_electrons,
            white_level: params.white_level,
        });
        let albedo = scene.bodies.iter().map(|body| body.material.albedo).collect();
        let field = field_of_view(&rig)?;
        Ok(Self { rig, params, albedo, sensor, bell: Bell::new(), field })
    }

    /// The parameters in use.
    pub fn params(&self) -> &ImageParams {
        &self.params
    }

    /// Takes an image with the robot at `world_from_robot` in the middle of the exposure and the motors truly at θR and
    /// θB [rad], between whole pulses if need be. The noise depends on `seed` and `frame` alone.
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
        number_within("cylinder angle", cylinder_rad, -1e6, 1e6)?;
        number_within("beam angle", beam_rad, -1e3, 1e3)?;
        if !world_from_robot.is_finite() {
            return Err(Fault::new("robot pose", "a pose that is not finite", "finite numbers"));
        }
        let world_from_sensor = *world_from_robot * self.rig.robot_from_sensor_at(cylinder_rad);
        let world_from_camera: Isometry3<f64> = (world_from_sensor * self.rig.sensor_from_camera).iso;
        let view = View {
            renderer: self,
            surfaces,
            sheet: world_from_sensor * self.rig.laser_plane_at(beam_rad)?,
            eye: world_from_camera.translation.vector,
            turn: world_from_camera.rotation.inverse().to_rotation_matrix().into_inner(),
        };
        let (centres, between) = view.stripes();
        let (width, height) = (self.rig.camera.width, self.rig.camera.height);
        let mut light = Light::new(width, height);
        let mut add = |part: i32, glimpse: &Glimpse| {
            let column = (part + PARTS / 2).div_euclid(PARTS) as usize;
            light.add(&self.bell, column, glimpse.v, glimpse.sigma_px, glimpse.electrons / f64::from(PARTS));
        };
        centres.iter().for_each(|c| add(c.part, &c.glimpse));
        between.iter().for_each(|(part, glimpse)| add(*part, glimpse));
        let in_image = |c: &&Candidate| c.glimpse.v >= -0.5 && c.glimpse.v <= height as f64 - 0.5;
        let sight = |c: &Candidate| TrueSight {
            column: (c.part / PARTS) as u16,
            v: c.glimpse.v,
            point: c.point.into(),
            body: c.body as u32,
            electrons: c.glimpse.electrons as f32,
        };
        let truth = centres.iter().filter(in_image).map(sight).collect();
        Ok(Exposure { image: self.sensor.read(&light, seed, frame)?, truth })
    }
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

impl View<'_> {
    /// Where lit and seen stripes cross the columns' centres, by column, then row, and their thirds to either side.
    fn stripes(&self) -> (Vec<Candidate>, Vec<(i32, Glimpse)>) {
        let mut cuts = Vec::new();
        self.surfaces.cut(&self.sheet, self.renderer.params.reach_m, &mut cuts);
        let mut clipped = Vec::new();
        cuts.into_iter().for_each(|cut| self.clip(cut, 0, &mut clipped));
        let (mut crossings, mut knots, mut stretch) = (Vec::new(), Vec::new(), 0);
        for (index, cut) in clipped.iter().enumerate() {
            self.follow(cut, &mut knots);
            let mut rising = None;
            for pair in knots.windows(2) {
                let now = pair[0].zip(pair[1]).map(|(a, b)| a.1 < b.1);
                stretch += usize::from(now != rising);
                rising = now;
                self.cross_columns((index, stretch), pair[0], pair[1], &mut crossings);
            }
            stretch += 1;
        }
        let solve = |c: &Crossing| {
            let cut = &clipped[c.cut];
            let t = self.solve(cut, c.from, c.to, f64::from(c.part) / f64::from(PARTS))?;
            let (point, glimpse) = self.glimpse(cut, t)?;
            Some(Candidate { part: c.part, stretch: c.stretch, body: cut.body, point, glimpse, seen: false })
        };
        let mut centres: Vec<_> = crossings.iter().filter(|c| c.part % PARTS == 0).filter_map(solve).collect();
        centres.sort_by(|a, b| {
            a.part.cmp(&b.part).then(a.glimpse.v.total_cmp(&b.glimpse.v)).then(a.stretch.cmp(&b.stretch))
        });
        centres.iter_mut().for_each(|c| c.seen = self.clear(&c.point));
        let mut between = Vec::new();
        for crossing in crossings.iter().filter(|c| c.part % PARTS != 0) {
            let glimpse = match between_columns(&centres, crossing) {
                Some(same) => same,
                None => solve(crossing).filter(|c| self.reached(&centres, c)).map(|c| c.glimpse),
            };
            between.extend(glimpse.map(|glimpse| (crossing.part, glimpse)));
        }
        centres.retain(|c| c.seen);
        (centres, between)
    }

    /// Whether the laser reaches a point and the camera sees it.
    fn clear(&self, point: &V3) -> bool {
        let point = Point::from(*point);
        !self.surfaces.blocked(self.sheet.origin, point) && !self.surfaces.blocked(point, self.eye.into())
    }

    /// The same for a third of a column, asked for only where the columns beside it do not agree.
    fn reached(&self, centres: &[Candidate], this: &Candidate) -> bool {
        let left = this.part.div_euclid(PARTS) * PARTS;
        let beside = |part: i32| {
            let apart = |c: &Candidate| (c.glimpse.v - this.glimpse.v).abs();
            let same = in_part(centres, part).iter().filter(|c| c.body == this.body && apart(c) < 1.5);
            same.min_by(|a, b| apart(a).total_cmp(&apart(b))).map(|c| c.seen)
        };
        match (beside(left), beside(left + PARTS)) {
            (Some(a), Some(b)) if a == b => a,
            _ => self.clear(&this.point),
        }
    }

    /// Clips a cut to what the camera may see, one bound of the field after the other.
    fn clip(&self, cut: Cut, bound: usize, out: &mut Vec<Cut>) {
        let [left, right, top, bottom] = self.renderer.field;
        let inward = [
            V3::new(0.0, 0.0, 1.0),
            V3::new(1.0, 0.0, -left),
            V3::new(-1.0, 0.0, right),
            V3::new(0.0, 1.0, -top),
            V3::new(0.0, -1.0, bottom),
        ];
        let Some(inward) = inward.get(bound) else { return out.push(cut) };
        let normal = self.turn.tr_mul(inward);
        let offset = normal.dot(&self.eye) + if bound == 0 { NEAR_M } else { 0.0 };
        cut.clipped(&normal, offset, |part| self.clip(part, bound + 1, out));
    }

    /// Where a point of the world falls in the image.
    fn project(&self, point: &V3) -> Option<[f64; 2]> {
        self.renderer.rig.camera.project(&(self.turn * (point - self.eye)))
    }

    fn column(&self, cut: &Cut, t: f64) -> Option<f64> {
        self.project(&cut.curve.at(t)).map(|[u, _]| u)
    }

    /// Parameters along a cut between which its column grows or falls steadily; a gap where the lens sees nothing.
    fn follow(&self, cut: &Cut, knots: &mut Vec<Knot>) {
        let (t0, t1) = cut.curve.span();
        let steps = match cut.curve {
            Curve::Segment { a, b } => match (self.project(&a), self.project(&b)) {
                (Some(a), Some(b)) => ((a[0] - b[0]).hypot(a[1] - b[1]) / 24.0).ceil().clamp(1.0, 32.0),
                _ => 32.0,
            },
            Curve::Arc { .. } => ((t1 - t0) * 8.0).ceil().clamp(4.0, 52.0),
        } as i32;
        let at = |i: i32| if i == steps { t1 } else { t0 + (t1 - t0) * f64::from(i) / f64::from(steps) };
        knots.clear();
        knots.extend((0..=steps).map(|i| self.column(cut, at(i)).map(|u| (at(i), u))));
        for i in 1..knots.len() - 1 {
            let (Some(a), Some(b), Some(c)) = (knots[i - 1], knots[i], knots[i + 1]) else { continue };
            if (b.1 - a.1) * (c.1 - b.1) < 0.0 {
                knots[i] = Some(self.turning_point(cut, a.0, b, c.0));
            }
        }
    }

    /// The column farthest to one side between `low` and `high`, by golden sections around `middle`.
    fn turning_point(&self, cut: &Cut, mut low: f64, middle: (f64, f64), mut high: f64) -> (f64, f64) {
        const GOLDEN: f64 = 0.618_033_988_749_895;
        let rising = self.column(cut, low).is_some_and(|u| u < middle.1);
        let height = |t: f64| self.column(cut, t).map_or(f64::NEG_INFINITY, |u| if rising { u } else { -u });
        let (mut a, mut b) = (high - GOLDEN * (high - low), low + GOLDEN * (high - low));
        let (mut fa, mut fb) = (height(a), height(b));
        for _ in 0..40 {
            if fa > fb {
                (high, b, fb) = (b, a, fa);
                a = high - GOLDEN * (high - low);
                fa = height(a);
            } else {
                (low, a, fa) = (a, b, fb);
                b = low + GOLDEN * (high - low);
                fb = height(b);
            }
        }
        let t = (low + high) / 2.0;
        self.column(cut, t).map_or(middle, |u| (t, u))
    }

    /// Adds a crossing for each third of a column between two knots. The lower end belongs to the stretch, the upper to
    /// the next one: where two cuts share a corner that falls on a column, one of them has it.
    fn cross_columns(&self, (cut, stretch): (usize, usize), from: Knot, to: Knot, out: &mut Vec<Crossing>) {
        let (Some(from), Some(to)) = (from, to) else { return };
        let (low, high) = (from.1.min(to.1), from.1.max(to.1));
        let parts = f64::from(PARTS);
        let last = (self.renderer.rig.camera.width as i32 - 1) * PARTS + PARTS / 2;
        let mut part = (low * parts).ceil().max(f64::from(-(PARTS / 2))) as i32;
        while part <= last && f64::from(part) / parts < high {
            out.push(Crossing { part, cut, stretch, from, to });
            part += 1;
        }
    }

    /// The parameter at which the cut crosses column `u`, to 1e-9 px: regula falsi, the Illinois way.
    fn solve(&self, cut: &Cut, a: (f64, f64), b: (f64, f64), u: f64) -> Option<f64> {
        let ((mut ta, mut fa), (mut tb, mut fb)) = ((a.0, a.1 - u), (b.0, b.1 - u));
        if fa == 0.0 {
            return Some(ta);
        }
        for _ in 0..100 {
            let t = (ta * fb - tb * fa) / (fb - fa);
            let f = self.column(cut, t)? - u;
            if f.abs() < 1e-9 {
                return Some(t);
            }
            if (f > 0.0) != (fb > 0.0) {
                (ta, fa) = (tb, fb);
            } else {
                fa /= 2.0;
            }
            (tb, fb) = (t, f);
        }
        None
    }

    /// What the camera would get of the place at t if nothing stood in the way; `None` if laser or camera are behind the
    /// surface, or the stripe is too faint or too far outside the image.
    fn glimpse(&self, cut: &Cut, t: f64) -> Option<(V3, Glimpse)> {
        let (rig, params) = (&self.renderer.rig, &self.renderer.params);
        let (point, normal, tangent) = (cut.curve.at(t), cut.normal(t), cut.curve.tangent(t));
        let (to_laser, to_eye) = (self.sheet.origin.xyz - point, self.eye - point);
        let (lit, seen) = (normal.dot(&to_laser), normal.dot(&to_eye));
        let facing = if cut.two_sided { lit * seen > 0.0 } else { lit > 0.0 && seen > 0.0 };
        if !facing {
            return None;
        }
        let camera = self.turn * -to_eye;
        let [u, v] = rig.camera.project(&camera)?;
        if v < -BORDER_PX || v > rig.camera.height as f64 - 1.0 + BORDER_PX {
            return None;
        }
        let pixels_per_ray: Matrix2<f64> = rig.camera.ray_jacobian(u, v)?.try_inverse()?;
        let flow = |way: &V3| {
            let way = self.turn * way;
            let ray = Vector2::new(way.x * camera.z - camera.x * way.z, way.y * camera.z - camera.y * way.z);
            pixels_per_ray * ray / (camera.z * camera.z)
        };
        // Along the stripe, and across it in the surface; then the mix that stays in the column.
        let along = tangent.try_normalize(0.0)?;
        let across = normal.cross(&along);
        let (mut along_px, across_px) = (flow(&along), flow(&across));
        along_px.x = along_px.x.abs().max(STEEP * along_px.y.abs()).copysign(along_px.x);
        let slope = along_px.y / along_px.x;
        let row_per_m = (across_px.y - across_px.x * slope) / self.sheet.plane.normal.dot(&across);

        // The fan: power between two of its rays, p(y)·D·d(y/D), is the same at any range and slant.
        let (x, y) = (-self.sheet.forward.dot(&to_laser), -self.sheet.lateral.dot(&to_laser));
        let width = rig.sheet.width_m(x);
        let fan = self.sheet.lateral.dot(&along) - y / width * rig.sheet.width_per_m * self.sheet.forward.dot(&along);
        let power_w = rig.sheet.line_power_w_per_m(x, y) * (fan / along_px.x).abs(); // p·Δy

        let range = to_eye.norm();
        let aperture = PI * (params.focal_length_m / (2.0 * params.f_number)).powi(2) / (range * range); // Ω
        let albedo = self.renderer.albedo.get(cut.body).copied().unwrap_or_default();
        let diffuse = albedo * (seen.abs() / range) * aperture / PI; // ρ·cosθr·Ω/π
        let joules = power_w * diffuse * params.exposure_s;
        let electrons = joules * params.electrons_per_joule(rig.sheet.wavelength_m);
        if electrons.is_nan() || electrons < params.signal_electrons_min {
            return None;
        }
        let sigma_px = self.stripe_sigma_px(to_laser.norm(), range, row_per_m, slope);
        Some((point, Glimpse { v, sigma_px, electrons }))
    }

    /// RMS width of the stripe along a column before the pixels' own: the sheet's thickness (1/e² half width w = 2σ), the
    /// lens' point spread, the disc of defocus (RMS a quarter of its diameter) and the rows a third of a column runs over.
    fn stripe_sigma_px(&self, laser_range_m: f64, range_m: f64, row_per_m: f64, slope: f64) -> f64 {
        let (rig, params) = (&self.renderer.rig, &self.renderer.params);
        let thick = rig.sheet.thickness_m(laser_range_m) / 2.0 * row_per_m;
        let lf = params.focal_length_m;
        let disc_m = lf / params.f_number * lf * (1.0 / range_m - 1.0 / params.focus_m).abs();
        let defocus = disc_m / 4.0 * rig.camera.fy / lf;
        let run = slope / f64::from(PARTS) / 12f64.sqrt();
        let sum = thick * thick + defocus * defocus + run * run + params.point_spread_px.powi(2);
        sum.sqrt().min(rig.camera.height as f64)
    }
}

/// The candidates of one column's centre.
fn in_part(centres: &[Candidate], part: i32) -> &[Candidate] {
    let first = centres.partition_point(|c| c.part < part);
    let count = centres[first..].partition_point(|c| c.part == part);
    &centres[first..first + count]
}

/// What a third of a column gets of a stripe that both columns beside it see, or neither: `None` if that is not so.
fn between_columns(centres: &[Candidate], crossing: &Crossing) -> Option<Option<Glimpse>> {
    let left = crossing.part.div_euclid(PARTS) * PARTS;
    let same = |part: i32| in_part(centres, part).iter().find(|c| c.stretch == crossing.stretch);
    let (a, b) = (same(left)?, same(left + PARTS)?);
    if a.seen != b.seen {
        return None;
    }
    let share = f64::from(crossing.part - left) / f64::from(PARTS);
    let mix = |a: f64, b: f64| a + (b - a) * share;
    Some(a.seen.then(|| Glimpse {
        v: mix(a.glimpse.v, b.glimpse.v),
        sigma_px: mix(a.glimpse.sigma_px, b.glimpse.sigma_px),
        electrons: mix(a.glimpse.electrons, b.glimpse.electrons),
    }))
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_2;
    use std::sync::Arc;

    use super::*;
    use crate::optics::{Laser, PlaneLaser, Sheet, Uncertainty, triangulate};
    use crate::world::{Body, Material, Mesh, Motion, Shape};

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
        let params = ImageParams { f_number: 4.0, well_electrons: 20e3, white_level: 255, ..ImageParams::default() };
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
    fn square_on(f_number: f64) -> Exposure {
        let laser =
            Laser::Plane(PlaneLaser { normal: [0.0, -2.0, -0.1], offset_m: -0.2, origin_m: Some([0.0, 0.1, 0.0]) });
        let rig = Rig { laser, ..Rig::metro_i() };
        let mut wall = block([4.0, 4.0, 0.1], [0.0; 3]);
        wall.pose = rig.sensor_from_camera.iso * Isometry3::translation(0.0, 0.0, 2.05);
        shoot(&rig, ImageParams { f_number, ..ImageParams::default() }, &scene(vec![wall]), 0.0, 0)
    }

    #[test]
    fn a_wall_at_two_metres_gives_the_electrons_of_the_instrument() {
        // instrument.md 1: 1.8e5 electrons a column at f/1.4, 2.2e4 at f/4.
        for (f_number, electrons) in [(1.4, 1.8e5), (4.0, 2.2e4)] {
            let got = f64::from(in_column(&square_on(f_number).truth, 256)[0].electrons);
            assert!((got / electrons - 1.0).abs() < 0.02, "{got} at f/{f_number}");
        }
        // The well of 100 ke⁻ overflows at f/1.4: white, and no more than white.
        assert_eq!(square_on(1.4).image.levels().iter().max(), Some(&127));
        assert!(square_on(4.0).image.levels().iter().all(|l| *l < 40));
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
        let noisy = ImageParams { dark_electrons: 6000.0, read_noise_electrons: 800.0, ..ImageParams::default() };
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
        let params = ImageParams { dark_electrons: 800.0, ..ImageParams::default() };
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
        let renderer = Renderer::new(&rig, ImageParams::default(), &world).unwrap();
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
        let fine = ImageParams { f_number: 2.8, well_electrons: 40e3, white_level: 255, ..ImageParams::default() };
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
