//! From what is written to bodies: every number checked, every error with its line.

use std::collections::BTreeMap;
use std::ops::Range;

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use toml::Spanned;

use super::super::body::{Body, Material, Mesh, Motion, Scene, Shape, Sunlit};
use super::super::mesh;
use super::super::movers::{Mover, Track};
use super::super::sdf::asked_for_at;
use super::super::shapes::{REACH_M, height_samples, length_within_reach, smooth_noise};
use super::Source;
use super::spec::{
    BoxSpec, Common, GroundSpec, HeightfieldSpec, ImageSpec, MaterialSpec, MeshSpec, MoverSpec, NoiseSpec, Number,
    Numbers, ScaleSpec, SunlitSpec, TableSpec, WaveSpec,
};
use crate::fault::{Fault, Result, number_within, positive};

/// Direct sun within 10 nm about the laser's wavelength [W/m²] (instrument.md 1).
const SUN_W_PER_M2: f64 = 14.0;

/// Collects bodies, with what they refer to.
pub(super) struct Builder<'a> {
    source: &'a Source,
    materials: BTreeMap<String, Material>,
    /// Bodies with the place of their name in the file.
    bodies: Vec<(Range<usize>, Body)>,
    /// What moves by script, with its place in the file, and the names of its bodies.
    movers: Vec<(Range<usize>, Mover, Vec<String>)>,
}

impl<'a> Builder<'a> {
    /// Starts with the materials, which bodies refer to by name.
    pub(super) fn new(source: &'a Source, materials: &BTreeMap<String, Spanned<MaterialSpec>>) -> Result<Self> {
        let mut builder = Self { source, materials: BTreeMap::new(), bodies: Vec::new(), movers: Vec::new() };
        for (name, spec) in materials {
            let material = builder.material(name, spec.get_ref(), &spec.span())?;
            builder.materials.insert(name.clone(), material);
        }
        Ok(builder)
    }

    fn at<T>(&self, span: &Range<usize>, result: Result<T>) -> Result<T> {
        result.map_err(|fault| self.source.locate(fault, span))
    }

    pub(super) fn within(&self, what: &str, number: &Number, low: f64, high: f64) -> Result<f64> {
        self.at(&number.span(), number_within(what, *number.get_ref(), low, high))
    }

    /// A length of a body: above 0, within reach.
    pub(super) fn length(&self, body: &Common, key: &str, number: &Number) -> Result<f64> {
        let what = body.what(key);
        self.at(&number.span(), length_within_reach(&what, *number.get_ref()))
    }

    /// Several lengths of a body.
    fn lengths<const N: usize>(&self, body: &Common, key: &str, numbers: &Numbers) -> Result<[f64; N]> {
        let lengths = self.exactly::<N>(&body.what(key), numbers)?;
        for length in lengths {
            self.length(body, key, &Spanned::new(numbers.span(), length))?;
        }
        Ok(lengths)
    }

    fn exactly<const N: usize>(&self, what: &str, numbers: &Numbers) -> Result<[f64; N]> {
        let found = numbers.get_ref();
        let array = found.as_slice().try_into();
        let wrong = |_| Fault::new(what, format!("{} numbers", found.len()), format!("{N} numbers"));
        self.at(&numbers.span(), array.map_err(wrong))
    }

    fn material(&self, name: &str, spec: &MaterialSpec, span: &Range<usize>) -> Result<Material> {
        let mut material = Material::default();
        let set = |slot: &mut f64, key: &str, number: &Option<Number>, high: f64| -> Result<()> {
            if let Some(number) = number {
                *slot = self.within(&format!("material `{name}`: {key}"), number, 0.0, high)?;
            }
            Ok(())
        };
        set(&mut material.albedo, "albedo", &spec.albedo, 1.0)?;
        set(&mut material.gloss, "gloss", &spec.gloss, 1.0)?;
        set(&mut material.transmission, "transmission", &spec.transmission, 1.0)?;
        set(&mut material.gloss_spread_rad, "gloss_spread_rad", &spec.gloss_spread_rad, 1.0)?;
        set(&mut material.acoustic_roughness_m, "acoustic_roughness_m", &spec.acoustic_roughness_m, 1.0)?;
        set(&mut material.friction, "friction", &spec.friction, 1000.0)?;
        material.colour = spec.colour.unwrap_or(material.colour);
        let sum = material.albedo + material.gloss + material.transmission;
        if sum > 1.0 + 1e-9 {
            let fault = Fault::new(
                format!("material `{name}`: albedo + gloss + transmission"),
                sum,
                "at most 1: no surface sends back more light than it gets",
            );
            let last = spec.transmission.as_ref().or(spec.gloss.as_ref());
            let place = last.or(spec.albedo.as_ref()).map_or(span.clone(), Spanned::span);
            return Err(self.source.locate(fault, &place));
        }
        Ok(material)
    }

    fn named_material(&self, what: &str, name: Option<&Spanned<String>>) -> Result<Material> {
        let Some(name) = name else { return Ok(Material::default()) };
        let known = || match self.materials.keys().map(|k| format!("`{k}`")).collect::<Vec<_>>().join(", ") {
            none if none.is_empty() => "a table [world.material.NAME] of that name".to_string(),
            some => format!("one of {some}"),
        };
        let found = self.materials.get(name.get_ref()).copied();
        let unknown = || Fault::new(what, format!("`{}`", name.get_ref()), known());
        self.at(&name.span(), found.ok_or_else(unknown))
    }

    pub(super) fn ground(&mut self, ground: Option<&Spanned<GroundSpec>>) -> Result<()> {
        let Some(ground) = ground else { return Ok(()) };
        let (z, material) = match ground.get_ref() {
            GroundSpec::Default(false) => return Ok(()),
            GroundSpec::Default(true) => (0.0, Material::default()),
            GroundSpec::Table(table) => {
                let z = table.z.as_ref().map_or(Ok(0.0), |z| self.within("world.ground: z", z, -REACH_M, REACH_M))?;
                (z, self.named_material("world.ground: material", table.material.as_ref())?)
            }
        };
        let body = Body {
            name: "ground".to_string(),
            shape: Shape::Plane,
            pose: Isometry3::translation(0.0, 0.0, z),
            material,
            motion: Motion::Static,
            ground: true,
        };
        self.bodies.push((ground.span(), body));
        Ok(())
    }

    /// Where a body's own frame is, its position taken as it stands.
    fn pose(&self, body: &Common) -> Result<Isometry3<f64>> {
        let position = body.position.get_ref();
        let what = body.what("position");
        let [x, y, z] = match *position.as_slice() {
            [x, y] => [x, y, 0.0],
            [x, y, z] => [x, y, z],
            _ => {
                let fault = Fault::new(what, format!("{} numbers", position.len()), "[x, y] or [x, y, z]");
                return Err(self.source.locate(fault, &body.position.span()));
            }
        };
        for coordinate in [x, y, z] {
            self.at(&body.position.span(), number_within(&what, coordinate, -REACH_M, REACH_M))?;
        }
        let [roll, pitch, yaw] = match (body.yaw_deg, body.rpy_deg) {
            (Some(yaw), Some(_)) => {
                let fault = Fault::new(body.what("yaw_deg"), "rpy_deg beside it", "only one of the two");
                return Err(self.source.locate(fault, &yaw.span()));
            }
            (Some(yaw), None) => [0.0, 0.0, self.within(&body.what("yaw_deg"), yaw, -360.0, 360.0)?],
            (None, Some(rpy)) => {
                let angles = self.exactly(&body.what("rpy_deg"), rpy)?;
                for angle in angles {
                    self.at(&rpy.span(), number_within(&body.what("rpy_deg"), angle, -360.0, 360.0))?;
                }
                angles
            }
            (None, None) => [0.0; 3],
        };
        let turn = UnitQuaternion::from_euler_angles(roll.to_radians(), pitch.to_radians(), yaw.to_radians());
        Ok(Isometry3::from_parts(Translation3::new(x, y, z), turn))
    }

    fn motion(&self, body: &Common) -> Result<Motion> {
        if body.mover.is_some() {
            self.refuse_mass(body)?;
            return Ok(Motion::Scripted);
        }
        let Some(mass) = body.mass_kg else { return Ok(Motion::Static) };
        let mass_kg = self.at(&mass.span(), positive(&body.what("mass_kg"), *mass.get_ref()))?;
        Ok(Motion::Dynamic { mass_kg })
    }

    fn refuse_mass(&self, body: &Common) -> Result<()> {
        let Some(mass) = body.mass_kg else { return Ok(()) };
        let fault = Fault::new(body.what("mass_kg"), "a mass", "none: nothing can push it");
        Err(self.source.locate(fault, &mass.span()))
    }

    fn push(&mut self, body: &Common, shape: Shape, pose: Isometry3<f64>, is_ground: bool) -> Result<()> {
        let name = body.name.get_ref().trim();
        if name.is_empty() {
            let fault = Fault::new(format!("world.{}: name", body.kind), "an empty name", "a name of its own");
            return Err(self.source.locate(fault, &body.name.span()));
        }
        let pose = match body.mover {
            Some(mover) => self.ride(body, mover)? * pose,
            None => pose,
        };
        let body_built = Body {
            name: name.to_string(),
            shape: self.at(&body.name.span(), shape.validated())?,
            pose,
            material: self.named_material(&body.what("material"), body.material)?,
            motion: self.motion(body)?,
            ground: body.ground.unwrap_or(is_ground),
        };
        self.bodies.push((body.name.span(), body_built));
        Ok(())
    }

    /// Puts a body on its mover; gives where that is at time 0.
    fn ride(&mut self, body: &Common, mover: &Spanned<String>) -> Result<Isometry3<f64>> {
        let known: Vec<String> = self.movers.iter().map(|(_, mover, _)| format!("`{}`", mover.name)).collect();
        let Some((_, mover, riders)) = self.movers.iter_mut().find(|(_, known, _)| known.name == *mover.get_ref())
        else {
            let expected = match known.is_empty() {
                true => "a table [[world.mover]] of that name".to_string(),
                false => format!("one of {}", known.join(", ")),
            };
            let fault = Fault::new(body.what("mover"), format!("`{}`", mover.get_ref()), expected);
            return Err(self.source.locate(fault, &mover.span()));
        };
        riders.push(body.name.get_ref().trim().to_string());
        Ok(mover.track.at(0.0))
    }

    pub(super) fn mover(&mut self, spec: &MoverSpec) -> Result<()> {
        let name = spec.name.get_ref().clone();
        let what = |key: &str| format!("world.mover `{name}`: {key}");
        if self.movers.iter().any(|(_, mover, _)| mover.name == name) || name.is_empty() {
            let fault = Fault::new("world.mover: name", format!("`{name}`"), "a name of its own");
            return Err(self.source.locate(fault, &spec.name.span()));
        }
        let point = |at: &Vec<f64>| match *at.as_slice() {
            [x, y] => Ok([x, y, 0.0]),
            [x, y, z] => Ok([x, y, z]),
            _ => Err(Fault::new(what("path"), format!("{} numbers", at.len()), "[x, y] or [x, y, z]")),
        };
        let way = spec.path.get_ref().iter().map(point).collect::<Result<Vec<_>>>();
        let way = self.at(&spec.path.span(), way)?;
        let repeats = spec.r#loop.unwrap_or(false);
        let track = match (&spec.speed_m_s, &spec.times_s) {
            (Some(speed), None) => {
                let start_s = spec.start_s.as_ref().map_or(Ok(0.0), |s| self.within(&what("start_s"), s, 0.0, 1e6))?;
                Track::steady(&way, *speed.get_ref(), start_s, repeats)
            }
            (None, Some(times)) => Track::new(&way, times.get_ref(), repeats),
            _ => Err(Fault::new("speed", "both or none of speed_m_s and times_s", "one of the two")),
        };
        let named = |fault: Fault| Fault { what: what(&fault.what), ..fault };
        let track = self.at(&spec.path.span(), track.map_err(named))?;
        self.movers.push((spec.name.span(), Mover { name, bodies: Vec::new(), track }, Vec::new()));
        Ok(())
    }

    pub(super) fn sunlit(&self, spec: &SunlitSpec) -> Result<Sunlit> {
        let corner = |key: &str, numbers: &Numbers| {
            let corner = self.exactly::<2>(&format!("world.sunlit: {key}"), numbers)?;
            for value in corner {
                self.at(&numbers.span(), number_within(&format!("world.sunlit: {key}"), value, -REACH_M, REACH_M))?;
            }
            Ok::<_, Fault>(corner)
        };
        let (from_m, to_m) = (corner("from", &spec.from)?, corner("to", &spec.to)?);
        if from_m[0] >= to_m[0] || from_m[1] >= to_m[1] {
            let fault = Fault::new("world.sunlit: to", format!("{to_m:?}"), format!("above {from_m:?}"));
            return Err(self.source.locate(fault, &spec.to.span()));
        }
        let w_per_m2 = match &spec.w_per_m2 {
            Some(number) => self.within("world.sunlit: w_per_m2", number, 0.0, 2000.0)?,
            None => SUN_W_PER_M2,
        };
        Ok(Sunlit { from_m, to_m, w_per_m2 })
    }

    pub(super) fn cuboid(&self, body: &Common, size: &Numbers) -> Result<Shape> {
        Ok(Shape::Box { size: self.lengths::<3>(body, "size", size)?.into() })
    }

    /// A shape that stands on its position with its lowest point.
    pub(super) fn upright(
        &mut self,
        body: &Common,
        is_ground: bool,
        shape: impl FnOnce(&Self, &Common) -> Result<Shape>,
    ) -> Result<()> {
        let shape = shape(self, body)?;
        let mut pose = self.pose(body)?;
        pose.translation.z += reach_down(&shape, &pose.rotation);
        self.push(body, shape, pose, is_ground)
    }

    pub(super) fn ramp(&mut self, spec: &BoxSpec) -> Result<()> {
        let body = spec.common("ramp");
        let [length, width, height] = self.lengths::<3>(&body, "size", &spec.size)?;
        let mesh = self.at(&spec.size.span(), Mesh::ramp(length, width, height))?;
        let pose = self.pose(&body)?;
        self.push(&body, mesh.into(), pose, true)
    }

    /// A top on four upright legs, each a body of its own: `NAME/top`, `NAME/leg1` … `NAME/leg4`.
    pub(super) fn table(&mut self, spec: &TableSpec) -> Result<()> {
        let body = spec.common("table");
        self.refuse_mass(&body)?;
        let [length, width, height] = self.lengths::<3>(&body, "size", &spec.size)?;
        let or = |key: &str, number: &Option<Number>, default| {
            number.as_ref().map_or(Ok(default), |number| self.length(&body, key, number))
        };
        let thickness = or("top_thickness", &spec.top_thickness, 0.04)?;
        let radius = or("leg_radius", &spec.leg_radius, 0.025)?;
        let inset = or("leg_inset", &spec.leg_inset, 0.08)?;
        if thickness >= height || inset + radius > length.min(width) / 2.0 {
            let found = format!("{length} x {width} x {height}");
            let expected =
                format!("a top thicker than {thickness} above the legs and wider than {inset} on each side of them");
            return Err(self.source.locate(Fault::new(body.what("size"), found, expected), &spec.size.span()));
        }
        let world_from_table = self.pose(&body)?;
        let leg_length = height - thickness;
        let mut part = |part: &str, shape: Shape, middle: [f64; 3]| {
            let name = Spanned::new(body.name.span(), format!("{}/{part}", body.name.get_ref()));
            let part = Common { name: &name, ..spec.common("table") };
            let pose = world_from_table * Translation3::from(Vector3::from(middle));
            self.push(&part, shape, pose, false)
        };
        let top = Shape::Box { size: Vector3::new(length, width, thickness) };
        part("top", top, [0.0, 0.0, height - thickness / 2.0])?;
        let (x, y) = (length / 2.0 - inset, width / 2.0 - inset);
        for (number, (x, y)) in [(x, y), (-x, y), (-x, -y), (x, -y)].into_iter().enumerate() {
            let leg = Shape::Cylinder { radius, length: leg_length };
            part(&format!("leg{}", number + 1), leg, [x, y, leg_length / 2.0])?;
        }
        Ok(())
    }

    pub(super) fn mesh(&mut self, spec: &MeshSpec) -> Result<()> {
        let body = spec.common("mesh");
        let file = self.source.beside(spec.file.get_ref());
        if !file.exists() {
            let fault = Fault::new(body.what("file"), format!("no file `{}`", file.display()), "a file that exists");
            return Err(self.source.locate(fault, &spec.file.span()));
        }
        let line = self.source.line_of(spec.file.span().start);
        let asked = |fault| asked_for_at(line, &file, fault).in_file(&self.source.file);
        let mut mesh = mesh::load(&file).map_err(asked)?;
        if let Some(scale) = &spec.scale {
            let factors = match *scale.get_ref() {
                ScaleSpec::All(factor) => [factor; 3],
                ScaleSpec::Each(factors) => factors,
            };
            mesh = self.at(&scale.span(), mesh.scaled(factors))?;
        }
        let pose = self.pose(&body)?;
        self.push(&body, mesh.into(), pose, false)
    }

    pub(super) fn heightfield(&mut self, spec: &HeightfieldSpec) -> Result<()> {
        let body = spec.common("heightfield");
        self.refuse_mass(&body)?;
        let mesh = match &spec.image {
            Some(image) => self.heights_of_image(&body, spec, image)?,
            None => self.heights_of_function(&body, spec)?,
        };
        let pose = self.pose(&body)?;
        self.push(&body, mesh.into(), pose, true)
    }

    fn heights_of_image(&self, body: &Common, spec: &HeightfieldSpec, image: &Spanned<ImageSpec>) -> Result<Mesh> {
        if spec.size.is_some() || spec.spacing.is_some() || spec.waves.is_some() || spec.noise.is_some() {
            let fault = Fault::new(body.what("image"), "size, spacing, waves or noise beside it", "the image alone");
            return Err(self.source.locate(fault, &image.span()));
        }
        let image = image.get_ref();
        let pixel = self.length(body, "m_per_pixel", &image.m_per_pixel)?;
        let level = self.within(&body.what("m_per_level"), &image.m_per_level, -100.0, 100.0)?;
        let file = self.source.beside(image.file.get_ref());
        let line = self.source.line_of(image.file.span().start);
        let asked = |fault| asked_for_at(line, &file, fault).in_file(&self.source.file);
        let levels = mesh::load_levels(&file).map_err(asked)?;
        let heights: Vec<f64> = levels.levels.iter().map(|grey| grey * level).collect();
        self.at(&image.file.span(), Mesh::height_field(&heights, levels.columns, levels.rows, [pixel, pixel]))
    }

    /// Waves and noise, added up, sampled in the field's own frame.
    fn heights_of_function(&self, body: &Common, spec: &HeightfieldSpec) -> Result<Mesh> {
        let Some(size) = &spec.size else {
            let fault = Fault::new(body.what("size"), "no such key", "[length, width], or an image");
            return Err(self.source.locate(fault, &body.name.span()));
        };
        let waves = spec.waves.as_ref().map(|waves| waves.get_ref().as_slice()).unwrap_or_default();
        if waves.is_empty() && spec.noise.is_none() {
            let fault = Fault::new(body.what("heights"), "none", "waves, noise or an image");
            return Err(self.source.locate(fault, &body.name.span()));
        }
        let waves = waves.iter().map(|wave| self.wave(body, wave)).collect::<Result<Vec<_>>>()?;
        let noise = spec.noise.as_ref().map(|noise| self.noise(body, noise.get_ref())).transpose()?;
        let [length, width] = self.lengths::<2>(body, "size", size)?;
        let spacing = spec.spacing.as_ref().map_or(Ok(0.1), |spacing| self.length(body, "spacing", spacing))?;
        // As cast from a float: whatever does not fit becomes the largest number, which the limit refuses.
        let [columns, rows] = [length, width].map(|side| ((side / spacing).round() as usize).saturating_add(1));
        let place = spec.spacing.as_ref().map_or(size.span(), Spanned::span);
        let count = self.at(&place, height_samples(columns, rows))?;
        let step = [length / (columns - 1) as f64, width / (rows - 1) as f64];
        let height = |i: usize| {
            let x = (i % columns) as f64 * step[0] - length / 2.0;
            let y = (i / columns) as f64 * step[1] - width / 2.0;
            let noise = noise.as_ref().map_or(0.0, |noise| noise(x, y));
            waves.iter().fold(noise, |sum, wave| sum + wave(x, y))
        };
        let heights: Vec<f64> = (0..count).map(height).collect();
        self.at(&place, Mesh::height_field(&heights, columns, rows, step))
    }

    fn wave(&self, body: &Common, spec: &WaveSpec) -> Result<impl Fn(f64, f64) -> f64 + use<>> {
        let amplitude = self.length(body, "amplitude", &spec.amplitude)?;
        let wavelength = self.length(body, "wavelength", &spec.wavelength)?;
        let angle = |key: &str, number: &Option<Number>| {
            let degrees = number.as_ref().map_or(Ok(0.0), |n| self.within(&body.what(key), n, -360.0, 360.0));
            degrees.map(f64::to_radians)
        };
        let (sin, cos) = angle("direction_deg", &spec.direction_deg)?.sin_cos();
        let phase = angle("phase_deg", &spec.phase_deg)?;
        let turns_per_m = std::f64::consts::TAU / wavelength;
        Ok(move |x: f64, y: f64| amplitude * ((x * cos + y * sin) * turns_per_m + phase).sin())
    }

    fn noise(&self, body: &Common, spec: &NoiseSpec) -> Result<impl Fn(f64, f64) -> f64 + use<>> {
        let amplitude = self.length(body, "amplitude", &spec.amplitude)?;
        let wavelength = self.length(body, "wavelength", &spec.wavelength)?;
        let seed = spec.seed;
        Ok(move |x: f64, y: f64| amplitude * smooth_noise(seed, wavelength, x, y))
    }

    /// Puts the bodies behind those of the scene, in the order of the file, and checks their names.
    pub(super) fn finish(mut self, mut scene: Scene) -> Result<Scene> {
        self.bodies.sort_by_key(|(span, _)| span.start);
        let mut lines: BTreeMap<String, usize> = scene.bodies.iter().map(|body| (body.name.clone(), 0)).collect();
        for (span, body) in self.bodies {
            let line = self.source.line_of(span.start);
            if let Some(first) = lines.insert(body.name.clone(), line) {
                let place = if first == 0 { "in the SDF world".to_string() } else { format!("in line {first}") };
                let fault = Fault::new("name", format!("`{}`, already used {place}", body.name), "a name of its own");
                return Err(self.source.locate(fault, &span));
            }
            scene.bodies.push(body);
        }
        for (span, mut mover, riders) in self.movers {
            let index = |name: &String| scene.bodies.iter().position(|body| body.name == *name);
            mover.bodies = riders.iter().filter_map(index).collect();
            if mover.bodies.is_empty() {
                let what = format!("world.mover `{}`", mover.name);
                return Err(self.source.locate(Fault::new(what, "no body", "bodies with its name as `mover`"), &span));
            }
            scene.movers.push(mover);
        }
        Ok(scene)
    }
}

impl Common<'_> {
    fn what(&self, key: &str) -> String {
        format!("world.{} `{}`: {key}", self.kind, self.name.get_ref())
    }
}

/// How far a shape reaches below its own origin when turned so (m).
fn reach_down(shape: &Shape, turn: &UnitQuaternion<f64>) -> f64 {
    let up = turn.inverse() * Vector3::z();
    match shape {
        Shape::Box { size } => up.abs().dot(size) / 2.0,
        Shape::Cylinder { radius, length } => radius * up.xy().norm() + length / 2.0 * up.z.abs(),
        Shape::Sphere { radius } => *radius,
        Shape::Plane | Shape::Mesh(_) => 0.0,
    }
}
