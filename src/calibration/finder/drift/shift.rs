//! What a bump may move, and the finder after it.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};

use crate::calibration::finder::known::Assumptions;
use crate::calibration::finder::measured::Observations;
use crate::calibration::finder::model::{Model, PARAMETERS};
use crate::fault::Result;
use crate::optics::{Laser, Rig};

/// A parameter that may have moved.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Suspect {
    pub name: &'static str,
    pub unit: &'static str,
    /// The change over which rows bend.
    pub scale: f64,
    /// Shifts to try, to both sides, where the floor is not where it should be: the step from one to the next, small enough
    /// that the floor is recognized half a step beside; 0 for what no knock moves so far.
    pub step: f64,
}

/// Of a finder with a mirror: all but the chip's scale and distortion, which no bump changes, and the optical centre, which
/// a floor does not tell from tilt and pan. Names and steps.
const OF_A_MIRROR: [(&str, f64); 14] = [
    ("camera_height_m", 0.05),
    ("x0_m", 0.05),
    ("tilt_rad", 0.04),
    ("roll_rad", 0.04),
    ("pan_rad", 0.04),
    ("mirror_height_m", 0.05),
    ("beam_zero_rad", 0.02),
    ("beam_rad_per_pulse", 0.0),
    ("slit_roll_rad", 0.02),
    ("mirror_x_m", 0.0),
    ("camera_y_m", 0.0),
    ("axis_pitch_rad", 0.02),
    ("axis_roll_rad", 0.02),
    ("f_mm", 0.0),
];
/// Of a sheet that is fixed to the camera: both move together, or the sheet alone.
const OF_A_PLANE: [Suspect; 4] = [
    Suspect { name: "camera_height_m", unit: "m", scale: 1.0, step: 0.05 },
    Suspect { name: "tilt_rad", unit: "rad", scale: 1.0, step: 0.02 },
    Suspect { name: "roll_rad", unit: "rad", scale: 1.0, step: 0.02 },
    Suspect { name: "laser_offset_m", unit: "m", scale: 1.0, step: 0.02 },
];

/// A finder and what may have moved of it.
#[derive(Clone, Debug)]
pub(super) struct Shifts {
    nominal: Rig,
    /// The finder as numbers in the order of a calibration's parameters; none for a fixed sheet.
    numbers: Vec<f64>,
}

impl Shifts {
    /// Errors: a finder that is no list of numbers.
    pub fn of(rig: &Rig) -> Result<Self> {
        let numbers = match rig.laser {
            Laser::Mirror(_) => modelled(rig, |model| model.numbers_of(rig))?,
            Laser::Plane(_) => Vec::new(),
        };
        Ok(Self { nominal: rig.clone(), numbers })
    }

    /// The finder that nothing has moved.
    pub fn nominal(&self) -> &Rig {
        &self.nominal
    }

    /// All that may have moved.
    pub fn suspects(&self) -> Vec<Suspect> {
        match self.nominal.laser {
            Laser::Mirror(_) => (OF_A_MIRROR.iter())
                .filter_map(|(name, step)| {
                    let (_, unit, _, scale) = PARAMETERS.iter().find(|(known, ..)| known == name)?;
                    Some(Suspect { name, unit, scale: *scale, step: *step })
                })
                .collect(),
            Laser::Plane(_) => OF_A_PLANE.to_vec(),
        }
    }

    /// The finder with one parameter moved.
    pub fn moved(&self, name: &str, by: f64) -> Rig {
        let Laser::Plane(mut plane) = self.nominal.laser else {
            let mut numbers = self.numbers.clone();
            let place = PARAMETERS.iter().position(|(known, ..)| *known == name);
            if let Some(number) = place.and_then(|place| numbers.get_mut(place)) {
                *number += by;
            }
            return modelled(&self.nominal, |model| model.rig(&numbers));
        };
        let turn = |axis| Isometry3::from_parts(Translation3::identity(), UnitQuaternion::from_axis_angle(&axis, by));
        let mut rig = self.nominal.clone();
        let pose = rig.sensor_from_camera.iso;
        let pose = match name {
            "camera_height_m" => Translation3::new(0.0, 0.0, by) * pose,
            // Down is to turn the view, z, towards y.
            "tilt_rad" => pose * turn(-Vector3::x_axis()),
            "roll_rad" => pose * turn(Vector3::z_axis()),
            _ => {
                plane.offset_m += by * Vector3::from(plane.normal).norm();
                pose
            }
        };
        rig.sensor_from_camera = pose.into();
        rig.laser = Laser::Plane(plane);
        rig
    }
}

/// What a model of a finder without measurements says.
fn modelled<T>(rig: &Rig, ask: impl FnOnce(&Model) -> T) -> T {
    let seen = Observations { slits: Vec::new(), walls: Vec::new(), pulse_sigma: 1.0, mark_sigma_m: 1.0 };
    ask(&Model { nominal: rig, assumptions: &Assumptions::free(), seen: &seen })
}
