//! What moves: the robot, the sheet of light, the points, the image and its line, the numbers.

use std::collections::BTreeMap;

use nalgebra::{Isometry3, Vector3};
use rerun::components::PointShading;
use rerun::{Clear, EncodedImage, LineStrips2D, LineStrips3D, Mesh3D, Points3D, Radius, Rgba32, Scalars, TextLog};

use super::blueprint::{self, Layout};
use super::scene::{self, placed, pose};
use super::{Out, entity, f32s, maps};
use crate::fault::{Fault, Result};
use crate::geometry::Robot;
use crate::image::{Image, Line};
use crate::optics::Rig;
use crate::pipeline::Step;
use crate::points::Profile;
use crate::sinks::{Frame, Start, Truth};
use crate::time::Stamp;

/// Encoded images up to this much are all drawn [bytes]; after that, no more than two a second.
const IMAGE_BYTES_MAX: usize = 32 << 20;

/// The least time between images once there are many [ns].
const IMAGE_GAP_NS: i64 = 500_000_000;

/// Quality of the images in the viewer; the recording keeps them lossless.
const JPEG_QUALITY: u8 = 85;

/// The path grows by a piece when the robot has moved this far [m].
const PATH_STEP_M: f64 = 0.01;

/// Paths are drawn this much over the floor, or it would hide them [m].
const PATH_LIFT_M: f64 = 0.03;

/// Of the points of the past, one in so many is drawn: neighbours are closer to each other than a pixel is wide.
const HISTORY_EVERY: usize = 3;

/// Columns of the sheet of light from one drawn ray to the next.
const SHEET_COLUMNS: usize = 4;

/// A gap in the line of more columns than this is a gap in the sheet of light.
const GAP_COLUMNS: u16 = 12;

/// Colours of heights: dark blue, teal, green, yellow. No red in it: red is the laser.
#[derive(Clone, Debug)]
pub(super) struct HeightColours {
    /// The heights of the first and the last colour [m].
    pub span_m: [f64; 2],
}

const RAMP: [[f32; 3]; 5] =
    [[90.0, 80.0, 230.0], [50.0, 140.0, 240.0], [40.0, 190.0, 170.0], [120.0, 210.0, 80.0], [250.0, 230.0, 60.0]];

impl HeightColours {
    /// For what a finder with this range can see: METRO-I's 4.5 m give −0.22 m to 0.9 m.
    pub(super) fn new(range_m_max: f64) -> Self {
        Self { span_m: [-0.05 * range_m_max, 0.2 * range_m_max] }
    }

    /// The colour of a height [m].
    pub(super) fn at(&self, z: f32) -> Rgba32 {
        let [low, high] = self.span_m.map(|z| z as f32);
        let along = ((z - low) / (high - low)).clamp(0.0, 1.0) * (RAMP.len() - 1) as f32;
        let first = (along as usize).min(RAMP.len() - 2); // NaN casts to 0
        let part = along - first as f32;
        let mix = |n: usize| (RAMP[first][n] + (RAMP[first + 1][n] - RAMP[first][n]) * part) as u8;
        Rgba32::from_rgb(mix(0), mix(1), mix(2))
    }
}

/// What has been drawn so far.
pub(super) struct Drawing {
    scene: Vec<String>,
    rig: Rig,
    layout: Layout,
    revision: i64,
    colours: HeightColours,
    seen_m: Option<[Vector3<f64>; 2]>,
    paths: BTreeMap<&'static str, Vector3<f64>>,
    moved: BTreeMap<usize, Isometry3<f64>>,
    image_bytes: usize,
    image_at: Option<Stamp>,
    image_shown: bool,
}

impl Drawing {
    pub(super) fn new(start: &Start, colours: HeightColours) -> Self {
        let reach = start.rig.range_m_max;
        let around = [Vector3::new(-reach, -reach, 0.0), Vector3::new(reach, reach, 1.0)];
        Self {
            scene: start.scene.iter().map(|(name, _, _)| name.clone()).collect(),
            rig: start.rig.clone(),
            layout: Layout {
                image_px: [start.rig.camera.width as f32, start.rig.camera.height as f32],
                bounds_m: scene::bounds(start).unwrap_or(around),
                has_truth: !start.scene.is_empty(),
                has_sonar: !start.transducers.is_empty(),
            },
            revision: 0,
            colours,
            seen_m: None,
            paths: BTreeMap::new(),
            moved: BTreeMap::new(),
            image_bytes: 0,
            image_at: None,
            image_shown: false,
        }
    }

    /// Sends the layout, framing what was seen up to now.
    pub(super) fn send_blueprint(&mut self, out: &Out) -> Result<()> {
        let bounds_m = self.seen_m.unwrap_or(self.layout.bounds_m);
        blueprint::send(out, &Layout { bounds_m, ..self.layout.clone() }, self.revision)?;
        self.revision += 1;
        Ok(())
    }

    /// Takes note of what gives readings; tells whether the layout must show more than before.
    pub(super) fn note_sensors(&mut self, frame: &Frame) -> bool {
        let new = !frame.ranges.is_empty() && !self.layout.has_sonar;
        self.layout.has_sonar |= new;
        new
    }

    /// Draws a step.
    pub(super) fn step(&mut self, out: &Out, frame: &Frame) -> Result<()> {
        match (&frame.step, frame.ranges.last()) {
            (Some(step), _) => self.capture(out, frame, step)?,
            (None, Some(ranged)) => {
                let here = &ranged.step.world_from_robot;
                out.log("/world/robot", &pose(here))?;
                self.grow_path(out, "estimated", here.xyz(), [255, 150, 30])?;
            }
            (None, None) => {}
        }
        if let Some(changes) = &frame.maps {
            maps::draw(out, changes, &self.colours)?;
        }
        out.log("/metrics/lost", &Scalars::single(frame.dropped.lost() as f64))?;
        for (level, text) in &frame.log {
            out.log("/log", &TextLog::new(text.as_str()).with_level(*level))?;
        }
        Ok(())
    }

    /// Draws what a capture became.
    fn capture(&mut self, out: &Out, frame: &Frame, step: &Step) -> Result<()> {
        out.log("/world/robot", &pose(&step.world_from_robot))?;
        self.robot_parts(out, step)?;
        self.points(out, step)?;
        self.grow_path(out, "estimated", step.world_from_robot.xyz(), [255, 150, 30])?;
        if let Some(truth) = &frame.truth {
            self.truth(out, step, truth)?;
        }
        self.camera(out, frame, step)?;
        out.log("/metrics/points", &Scalars::single(step.placed.points.len() as f64))?;
        out.log("/metrics/dropped", &Scalars::single(step.dropped.0.values().sum::<u64>() as f64))
    }

    fn robot_parts(&self, out: &Out, step: &Step) -> Result<()> {
        let robot_from_sensor = self.rig.robot_from_sensor(step.cylinder_pulse)?;
        out.log("/world/robot/finder", &pose(&robot_from_sensor))?;
        match sheet(&step.seen) {
            Some(sheet) => out.log("/world/robot/laser", &sheet),
            None => out.log("/world/robot/laser", &Clear::flat()),
        }
    }

    fn points(&mut self, out: &Out, step: &Step) -> Result<()> {
        let points = step.placed.points.iter().map(|p| p.point.xyz).filter(|p| p.iter().all(|c| c.is_finite()));
        let points: Vec<Vector3<f64>> = points.collect();
        for point in &points {
            self.see(point);
        }
        let places: Vec<[f32; 3]> = points.iter().map(f32s).collect();
        let bright = Points3D::new(&places).with_colors([[255, 60, 40]]).with_radii([Radius::new_ui_points(3.0)]);
        out.log("/world/profile", &bright)?;
        if places.is_empty() {
            return Ok(());
        }
        let kept: Vec<[f32; 3]> = places.iter().step_by(HISTORY_EVERY).copied().collect();
        let colours = kept.iter().map(|p| self.colours.at(p[2]));
        let history = Points3D::new(&kept).with_colors(colours).with_radii([Radius::new_ui_points(1.5)]);
        out.log("/world/points", &history.with_point_shading(PointShading::Flat))
    }

    fn truth(&mut self, out: &Out, step: &Step, truth: &Truth) -> Result<()> {
        let (here, true_pose) = (&step.world_from_robot, &truth.world_from_robot);
        self.grow_path(out, "true", true_pose.xyz(), [255, 90, 220])?;
        for (index, by) in &truth.moved {
            if self.moved.get(index) == Some(by) {
                continue;
            }
            let Some(name) = self.scene.get(*index) else { continue };
            out.log(entity(&["world", "scene", name]), &placed(by))?;
            self.moved.insert(*index, *by);
        }
        let error_mm = (here.xyz() - true_pose.xyz()).norm() * 1e3;
        out.log("/metrics/pose_error_mm", &Scalars::single(error_mm))?;
        truth.point_rms_m.map_or(Ok(()), |rms| out.log("/metrics/point_rms_mm", &Scalars::single(rms * 1e3)))
    }

    /// Adds a piece to a path; the layout shows all pieces up to the time looked at.
    fn grow_path(&mut self, out: &Out, which: &'static str, to: Vector3<f64>, colour: [u8; 3]) -> Result<()> {
        if !to.iter().all(|c| c.is_finite()) {
            return Ok(());
        }
        self.see(&to);
        let Some(from) = self.paths.get(which) else {
            self.paths.insert(which, to);
            return Ok(());
        };
        if (to - from).norm() < PATH_STEP_M {
            return Ok(());
        }
        let lifted = [from, &to].map(|p| f32s(&(p + Vector3::z() * PATH_LIFT_M)));
        let piece = LineStrips3D::new([lifted]).with_colors([colour]).with_radii([Radius::new_ui_points(1.0)]);
        self.paths.insert(which, to);
        out.log(format!("/path/{which}"), &piece)
    }

    /// The image, and over it the line of the same capture: never one with the other of another.
    fn camera(&mut self, out: &Out, frame: &Frame, step: &Step) -> Result<()> {
        let Some(image) = &frame.image else {
            if std::mem::take(&mut self.image_shown) {
                out.log("/camera/image", &Clear::flat())?;
            }
            return out.log("/camera/image/line", &line_strips(&step.line));
        };
        let rare = self.image_at.is_none_or(|at| (step.stamp - at).0 >= IMAGE_GAP_NS);
        if !rare && self.image_bytes > IMAGE_BYTES_MAX {
            return Ok(());
        }
        let jpeg = encode(image)?;
        self.image_bytes += jpeg.len();
        self.image_at = Some(step.stamp);
        self.image_shown = true;
        out.log("/camera/image", &EncodedImage::new(jpeg).with_media_type("image/jpeg"))?;
        out.log("/camera/image/line", &line_strips(&step.line))
    }

    fn see(&mut self, point: &Vector3<f64>) {
        self.seen_m = Some(self.seen_m.map_or([*point; 2], |[low, high]| [low.inf(point), high.sup(point)]));
    }
}

/// Vertices [m] and triangles.
type Fan = (Vec<[f32; 3]>, Vec<[u32; 3]>);

/// The sheet of light in the viewer.
fn sheet(seen: &Profile<Robot>) -> Option<Mesh3D> {
    let (vertices, triangles) = sheet_of(seen)?;
    let red = Rgba32::from_unmultiplied_rgba(255, 40, 30, 70);
    Some(Mesh3D::new(vertices).with_triangle_indices(triangles).with_albedo_factor(red))
}

/// The light from where it leaves the finder to where it was seen; nothing where its origin is not known.
fn sheet_of(seen: &Profile<Robot>) -> Option<Fan> {
    if !seen.knows_laser_origin {
        return None;
    }
    let mut vertices = vec![f32s(&seen.sheet.origin.xyz)];
    let mut triangles = vec![];
    let mut before: Option<u16> = None;
    for point in seen.points.iter().filter(|p| p.point.xyz.iter().all(|c| c.is_finite())).step_by(SHEET_COLUMNS) {
        let index = vertices.len() as u32;
        vertices.push(f32s(&point.point.xyz));
        if before.is_some_and(|column| point.column.saturating_sub(column) <= GAP_COLUMNS) {
            triangles.push([0, index - 1, index]);
        }
        before = Some(point.column);
    }
    (!triangles.is_empty()).then_some((vertices, triangles))
}

/// The line in the viewer.
fn line_strips(line: &Line) -> LineStrips2D {
    LineStrips2D::new(strips_of(line)).with_colors([[60, 255, 90]]).with_radii([Radius::new_ui_points(0.8)])
}

/// The line as strips that break where columns are missing; Rerun counts from the corner of the first pixel.
fn strips_of(line: &Line) -> Vec<Vec<[f32; 2]>> {
    let mut strips: Vec<Vec<[f32; 2]>> = vec![];
    let mut joined = false;
    for (column, peak) in line.columns.iter().enumerate() {
        let Some(peak) = peak.filter(|peak| peak.v.is_finite()) else {
            joined = false;
            continue;
        };
        let place = [column as f32 + 0.5, peak.v + 0.5];
        match strips.last_mut() {
            Some(strip) if joined => strip.push(place),
            _ => strips.push(vec![place]),
        }
        joined = true;
    }
    for strip in &mut strips {
        if let [[u, v]] = strip[..] {
            *strip = vec![[u - 0.5, v], [u + 0.5, v]]; // a strip of one point would not be drawn
        }
    }
    strips
}

/// A JPEG whose brightness is the square root of the light, so that weak lines show.
fn encode(image: &Image) -> Result<Vec<u8>> {
    let white = f32::from(image.white());
    let shade: Vec<u8> = (0..=255u8).map(|level| ((f32::from(level) / white).min(1.0).sqrt() * 255.0) as u8).collect();
    let shades: Vec<u8> = image.levels().iter().map(|level| shade[usize::from(*level)]).collect();
    let mut jpeg = vec![];
    let mut encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut jpeg, JPEG_QUALITY);
    let (width, height) = (image.width() as u32, image.height() as u32);
    let done = encoder.encode(&shades, width, height, image::ExtendedColorType::L8);
    done.map_err(|e| Fault::new("camera image", e, "an image of at most 65535 x 65535 pixels"))?;
    Ok(jpeg)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Point, Sensor};
    use crate::image::{Dropped, Peak};
    use crate::points::profile;

    fn line(rows: &[Option<f32>]) -> Line {
        let peak = |v: &f32| Peak { v: *v, sigma: 0.1, level: 50.0 };
        let columns = rows.iter().map(|v| v.as_ref().map(peak)).collect();
        Line { height: 480, columns, dropped: Dropped::default() }
    }

    #[test]
    fn heights_run_from_blue_over_green_to_yellow_and_stay_there() {
        let colours = HeightColours { span_m: [0.0, 1.0] };
        assert_eq!(colours.at(-5.0), colours.at(0.0));
        assert_eq!(colours.at(5.0), colours.at(1.0));
        let (low, middle, high) = (colours.at(0.0).to_array(), colours.at(0.6).to_array(), colours.at(1.0).to_array());
        assert!(low[2] > low[0] && low[2] > low[1], "{low:?}");
        assert!(middle[1] > middle[0] && middle[1] > middle[2], "{middle:?}");
        assert!(high[0] > 200 && high[1] > 200 && high[2] < 100, "{high:?}");
        let _ = colours.at(f32::NAN);
    }

    #[test]
    fn strips_break_where_columns_are_missing() {
        let seen = line(&[Some(1.0), Some(2.0), None, Some(f32::NAN), Some(7.0), None]);
        let strips = strips_of(&seen);
        // Half a pixel on, since the first pixel's centre is at 0.5 in the viewer; one column becomes a dash.
        assert_eq!(strips, vec![vec![[0.5, 1.5], [1.5, 2.5]], vec![[4.0, 7.5], [5.0, 7.5]]]);
    }

    #[test]
    fn the_sheet_has_a_gap_where_the_line_has_one() {
        let mut rows = vec![Some(250.0); 512];
        rows[200..300].fill(None);
        let rig = Rig::metro_i();
        let (mut seen, _) = profile(&rig, &line(&rows), Stamp(0), 0, 0).unwrap();
        let (vertices, triangles) = sheet_of(&seen).unwrap();
        assert_eq!(vertices.len(), 1 + 412usize.div_ceil(SHEET_COLUMNS));
        assert_eq!(triangles.len(), vertices.len() - 1 - 2); // one less in each of two parts
        assert!(triangles.iter().flatten().all(|index| (*index as usize) < vertices.len()));
        let mirror = Point::<Sensor>::new(0.0, 0.0, 0.817230);
        let origin = rig.robot_from_sensor(0).unwrap() * mirror;
        assert!((Vector3::from(vertices[0]) - origin.xyz.cast::<f32>()).norm() < 1e-4);
        seen.knows_laser_origin = false;
        assert!(sheet_of(&seen).is_none());
    }

    #[test]
    fn weak_light_is_lifted_and_full_light_is_white() {
        let mut levels = vec![0; 64 * 64];
        levels[..32 * 64].fill(127);
        let jpeg = encode(&Image::new(64, 64, 127, levels).unwrap()).unwrap();
        let seen = image::load_from_memory(&jpeg).unwrap().to_luma8();
        assert_eq!((seen.width(), seen.height()), (64, 64));
        assert!(seen.get_pixel(10, 5).0[0] > 250 && seen.get_pixel(10, 60).0[0] < 5);
        let dim = encode(&Image::new(64, 64, 127, vec![8; 64 * 64]).unwrap()).unwrap();
        let seen = image::load_from_memory(&dim).unwrap().to_luma8();
        assert!((60..68).contains(&seen.get_pixel(30, 30).0[0])); // 255·√(8/127) = 64
    }
}
