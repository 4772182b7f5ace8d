//! The whole story on one screen: capture → line → profile → maps → step.

use serde::{Deserialize, Serialize};

use crate::calibration::finder::drift::{Drift, DriftParams, DriftWatch};
use crate::fault::{Fault, Result};
use crate::geometry::{Odom, Robot, Transform, World};
use crate::image::{Capture, Drop, Dropped, Line, Reading};
use crate::line::{Extractor, LineParams};
use crate::maps::{MapParams, Maps};
use crate::optics::Rig;
use crate::points::{Profile, profile};
use crate::time::Stamp;

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
}

impl Pipeline {
    /// A pipeline with empty maps; an error for a finder or parameters that cannot be.
    pub fn new(rig: Rig, params: PipelineParams) -> Result<Self> {
        let extractor = Extractor::new(params.line)?;
        let rig = rig.validated()?;
        let watch = DriftWatch::new(&rig, params.drift)?;
        Ok(Self { rig, extractor, maps: Maps::new(params.maps)?, watch, last_stamp: None })
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
