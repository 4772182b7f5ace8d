//! The whole story on one screen: capture → line → profile → maps → step; and an ultrasonic range → maps.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::calibration::finder::drift::{Drift, DriftParams, DriftWatch};
use crate::fault::{Fault, Result};
use crate::geometry::{Odom, Robot, Transducer, Transform, World};
use crate::image::{Capture, Drop, Dropped, Line, Reading};
use crate::line::{Extractor, LineParams};
use crate::maps::{MapParams, Maps};
use crate::optics::Rig;
use crate::points::{Profile, profile};
use crate::ranges::RangeReading;
use crate::time::Stamp;

/// More ultrasonic transducers than any robot has.
const TRANSDUCERS_MAX: usize = 1024;

/// What one capture became.
#[derive(Clone, Debug)]
pub struct Step {
    /// Number of the capture.
    pub id: u64,
    /// Middle of the exposure.
    pub stamp: Stamp,
    /// Cylinder encoder [pulses].
    pub cylinder_pulse: i32,
    /// Mirror encoder [pulses].
    pub mirror_pulse: i32,
    /// The robot as its odometry has it.
    pub odom_from_robot: Transform<Odom, Robot>,
    /// The robot as the map has it.
    pub world_from_robot: Transform<World, Robot>,
    /// The line in the image.
    pub line: Line,
    /// Its points in the robot's frame.
    pub seen: Profile<Robot>,
    /// Its points in the world.
    pub placed: Profile<World>,
    /// What of this capture was not used.
    pub dropped: Dropped,
}

/// What one ultrasonic range became.
#[derive(Clone, Debug)]
pub struct RangeStep {
    /// The reading.
    pub reading: RangeReading,
    /// The robot as the map has it.
    pub world_from_robot: Transform<World, Robot>,
    /// The transducer in the map.
    pub world_from_transducer: Transform<World, Transducer>,
    /// What of it was not used.
    pub dropped: Dropped,
}

/// The parameters of every stage.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PipelineParams {
    /// How the line is found.
    pub line: LineParams,
    /// How maps are made.
    pub maps: MapParams,
    /// Whether the calibration is watched, where the floor is known to be flat.
    pub drift: DriftParams,
}

impl PipelineParams {
    /// As TOML, which [`Self::from_toml`] reads back bit for bit.
    pub fn to_toml(&self) -> Result<String> {
        toml::to_string(self).map_err(|e| Fault::new("pipeline parameters", e, "what TOML can hold"))
    }

    /// From TOML.
    pub fn from_toml(text: &str) -> Result<Self> {
        toml::from_str(text).map_err(|e| Fault::new("pipeline.toml", e.message(), "the parameters of this version"))
    }
}

/// Turns captures into maps. Same captures, same maps, to the bit, wherever the captures come from.
pub struct Pipeline {
    rig: Rig,
    extractor: Extractor,
    maps: Maps,
    watch: Option<DriftWatch>,
    last_stamp: Option<Stamp>,
    /// When each transducer was last fired.
    last_heard: BTreeMap<String, Stamp>,
}

impl Pipeline {
    /// A pipeline with empty maps; an error for a finder or parameters that cannot be.
    pub fn new(rig: Rig, params: PipelineParams) -> Result<Self> {
        let extractor = Extractor::new(params.line)?;
        let rig = rig.validated()?;
        let watch = DriftWatch::new(&rig, params.drift)?;
        Ok(Self { rig, extractor, maps: Maps::new(params.maps)?, watch, last_stamp: None, last_heard: BTreeMap::new() })
    }

    /// One capture through every stage. A capture that cannot be used changes nothing: the error says why.
    pub fn step(&mut self, capture: &Capture) -> Result<Step, (Drop, Fault)> {
        self.admit(capture)?;
        let line = self.line(&capture.reading);
        let (seen, no_point) = profile(&self.rig, &line, capture.stamp, capture.cylinder_pulse, capture.mirror_pulse)
            .map_err(|fault| (Drop::EncoderOutOfRange, fault))?;
        let world_from_robot = self.world_from_odom() * capture.odom_from_robot;
        let placed = seen.moved(&world_from_robot);
        let unmapped = self.maps.insert(&placed, &world_from_robot);
        self.last_stamp = Some(capture.stamp);
        if let Some(watch) = &mut self.watch {
            watch.see(&line, capture.mirror_pulse, capture.cylinder_pulse); // looks on, changes nothing
        }

        let mut dropped = line.dropped.clone();
        dropped.merge(&no_point);
        dropped.merge(&unmapped);
        Ok(Step {
            id: capture.id,
            stamp: capture.stamp,
            cylinder_pulse: capture.cylinder_pulse,
            mirror_pulse: capture.mirror_pulse,
            odom_from_robot: capture.odom_from_robot,
            world_from_robot,
            line,
            seen,
            placed,
            dropped,
        })
    }

    /// One ultrasonic range into its layer. Ranges and captures go through in the order of each alone; a range that cannot be
    /// used changes nothing: the error says why.
    pub fn hear(&mut self, reading: &RangeReading) -> Result<RangeStep, (Drop, Fault)> {
        self.admit_range(reading)?;
        let world_from_robot = self.world_from_odom() * reading.odom_from_robot;
        let world_from_transducer = world_from_robot * reading.robot_from_transducer;
        let dropped = self.maps.hear(reading, &world_from_transducer)?;
        self.last_heard.insert(reading.frame.clone(), reading.stamp);
        Ok(RangeStep { reading: reading.clone(), world_from_robot, world_from_transducer, dropped })
    }

    /// What the floor last said of the calibration; `None` where it is not watched.
    pub fn drift(&self) -> Option<&Drift> {
        self.watch.as_ref().map(DriftWatch::latest)
    }

    /// The finder.
    pub fn rig(&self) -> &Rig {
        &self.rig
    }

    /// The maps as they are now.
    pub fn maps(&self) -> &Maps {
        &self.maps
    }

    /// The maps, to ask what changed.
    pub fn maps_mut(&mut self) -> &mut Maps {
        &mut self.maps
    }

    /// Where odometry started in the map. Nothing corrects drift yet, so the frames coincide.
    pub fn world_from_odom(&self) -> Transform<World, Odom> {
        Transform::identity()
    }

    fn line(&mut self, reading: &Reading) -> Line {
        match reading {
            Reading::Image(image) => self.extractor.extract(image), // section 2.3, steps 2 to 4
            Reading::Line(line) => line.clone(),
        }
    }

    /// Refuses a range that says nothing that can be, or that its transducer cannot have measured then.
    fn admit_range(&self, reading: &RangeReading) -> Result<(), (Drop, Fault)> {
        reading.check().map_err(|fault| (Drop::OutOfRange, fault))?;
        if let Some(last) = self.last_heard.get(&reading.frame)
            && reading.stamp <= *last
        {
            let why = if reading.stamp == *last { Drop::SameTime } else { Drop::TimeWentBack };
            let expected = format!("later than {} ns, the time of its range before", last.0);
            let what = format!("{}: time", reading.frame);
            return Err((why, Fault::new(what, format!("{} ns", reading.stamp.0), expected)));
        }
        if self.last_heard.len() >= TRANSDUCERS_MAX && !self.last_heard.contains_key(&reading.frame) {
            let expected = format!("at most {TRANSDUCERS_MAX}");
            return Err((Drop::MapFull, Fault::new("transducers", TRANSDUCERS_MAX + 1, expected)));
        }
        Ok(())
    }

    /// Refuses a capture that would put points in the wrong place.
    fn admit(&self, capture: &Capture) -> Result<(), (Drop, Fault)> {
        let at = |what: &str| format!("capture {}: {what}", capture.id);
        if let Some(last) = self.last_stamp
            && capture.stamp <= last
        {
            let why = if capture.stamp == last { Drop::SameTime } else { Drop::TimeWentBack };
            let expected = format!("later than {} ns, the time of the capture before", last.0);
            return Err((why, Fault::new(at("time"), format!("{} ns", capture.stamp.0), expected)));
        }
        if !capture.odom_from_robot.is_finite() {
            let found = format!("{:?}", capture.odom_from_robot);
            return Err((Drop::BadPose, Fault::new(at("odometry"), found, "finite numbers")));
        }
        let (width, height) = match &capture.reading {
            Reading::Image(image) => (image.width(), image.height()),
            Reading::Line(line) => (line.width(), line.height),
        };
        let camera = &self.rig.camera;
        if (width, height) != (camera.width, camera.height) {
            let expected = format!("{} x {}, the size of the finder's camera", camera.width, camera.height);
            return Err((Drop::WrongSize, Fault::new(at("image size"), format!("{width} x {height}"), expected)));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::Peak;

    fn capture(id: u64, ns: i64) -> Capture {
        let peak = Peak { v: 250.0, sigma: 0.1, level: 50.0 };
        let line = Line { height: 480, columns: vec![Some(peak); 512], dropped: Dropped::default() };
        Capture {
            id,
            stamp: Stamp(ns),
            cylinder_pulse: 0,
            mirror_pulse: 0,
            odom_from_robot: Transform::identity(),
            reading: Reading::Line(line),
        }
    }

    fn pipeline() -> Pipeline {
        Pipeline::new(Rig::metro_i(), PipelineParams::default()).unwrap()
    }

    #[test]
    fn a_capture_becomes_points_and_maps() {
        let mut pipeline = pipeline();
        let step = pipeline.step(&capture(0, 1)).unwrap();
        assert_eq!(step.placed.points.len(), 512);
        assert!(pipeline.maps().summary().occupancy.occupied > 0);
    }

    fn range(ns: i64, number: usize) -> RangeReading {
        RangeReading {
            stamp: Stamp(ns),
            frame: crate::ranges::transducer_frame(number),
            robot_from_transducer: Transform::planar(0.3, 0.0, 0.0),
            field_of_view_rad: 0.5,
            range_m_min: 0.4,
            range_m_max: 10.0,
            range_m: Some(2.0),
            odom_from_robot: Transform::planar(1.0, 0.0, 0.0),
        }
    }

    #[test]
    fn a_range_fills_its_layer_and_no_other_map() {
        let (mut pipeline, untouched) = (pipeline(), pipeline());
        assert_eq!(pipeline.maps().layers(), None);
        let heard = pipeline.hear(&range(5, 3)).unwrap();
        assert!((heard.world_from_transducer.xyz().x - 1.3).abs() < 1e-12);
        let maps = pipeline.maps();
        assert_eq!((maps.summary(), maps.plan_view()), (untouched.maps().summary(), untouched.maps().plan_view()));
        assert_ne!(maps.digest(), untouched.maps().digest());
        let layers = maps.layers().unwrap();
        assert_eq!(layers.ultrasonic, layers.fused);
        assert!(layers.laser.cells.iter().all(|cell| *cell == -1) && layers.laser.width == layers.fused.width);
        assert_eq!(maps.check(), Ok(()));
        // Together with a capture: the laser's cells are those of the plan view.
        pipeline.step(&capture(0, 1)).unwrap();
        let (layers, plan) = (pipeline.maps().layers().unwrap(), pipeline.maps().plan_view());
        let count = |view: &crate::maps::PlanView, what: i8| view.cells.iter().filter(|cell| **cell == what).count();
        assert!(count(&plan, 0) > 0 && count(&plan, 100) + count(&plan, 0) < layers.fused.cells.len());
        assert_eq!([0, 100].map(|what| count(&layers.laser, what)), [0, 100].map(|what| count(&plan, what)));
        assert!(count(&layers.fused, -1) < count(&layers.ultrasonic, -1).min(count(&layers.laser, -1)));
    }

    #[test]
    fn a_range_that_cannot_be_used_changes_nothing() {
        let mut pipeline = pipeline();
        pipeline.hear(&range(100, 3)).unwrap();
        let digest = pipeline.maps().digest();
        let lost = Transform::planar(f64::NAN, 0.0, 0.0);
        for (bad, why) in [
            (range(100, 3), Drop::SameTime),
            (range(50, 3), Drop::TimeWentBack),
            (RangeReading { range_m: Some(f32::NAN), ..range(200, 3) }, Drop::OutOfRange),
            (RangeReading { range_m: Some(0.1), ..range(200, 3) }, Drop::OutOfRange),
            (RangeReading { odom_from_robot: lost, ..range(200, 3) }, Drop::BadPose),
        ] {
            assert_eq!(pipeline.hear(&bad).unwrap_err().0, why);
            assert_eq!(pipeline.maps().digest(), digest);
        }
        // Another one may have been fired at the same time, or be told of late.
        assert!(pipeline.hear(&range(100, 4)).is_ok() && pipeline.hear(&range(50, 5)).is_ok());
        assert!(pipeline.hear(&range(200, 3)).is_ok() && pipeline.step(&capture(0, 1)).is_ok());
    }

    #[test]
    fn a_capture_that_cannot_be_used_changes_nothing() {
        let mut pipeline = pipeline();
        pipeline.step(&capture(0, 100)).unwrap();
        let digest = pipeline.maps().digest();
        let bad_pose = Capture { odom_from_robot: Transform::planar(f64::NAN, 0.0, 0.0), ..capture(1, 200) };
        let short = Line { height: 480, columns: vec![None; 3], dropped: Dropped::default() };
        for (bad, why) in [
            (capture(1, 50), Drop::TimeWentBack),
            (capture(1, 100), Drop::SameTime),
            (bad_pose, Drop::BadPose),
            (Capture { mirror_pulse: 5000, ..capture(1, 200) }, Drop::EncoderOutOfRange),
            (Capture { reading: Reading::Line(short), ..capture(1, 200) }, Drop::WrongSize),
        ] {
            assert_eq!(pipeline.step(&bad).unwrap_err().0, why);
            assert_eq!(pipeline.maps().digest(), digest);
        }
        assert!(pipeline.step(&capture(1, 200)).is_ok());
    }
}
