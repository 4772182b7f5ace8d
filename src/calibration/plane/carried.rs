//! What a calibrated plane carries of its error bars, and of its camera's, into every point it will ever measure.

use nalgebra::{DMatrix, Matrix3, Matrix4x3};

use super::{PlaneFit, place};
use crate::geometry::{Camera as CameraFrame, Plane};
use crate::optics::{Distortion, RigCovariance};

/// The names of the camera's parameters in a rig, in the order of the bundle's.
const CAMERA: [&str; place::PLANE] = ["fx_px", "fy_px", "cu_px", "cv_px", "k1", "k2", "p1", "p2", "k3"];
/// Those of the plane, and of a laser on a mirror, which the finder no longer is.
const LASER: [&str; 9] = [
    "normal_x",
    "normal_y",
    "normal_z",
    "offset_m",
    "mirror_height_m",
    "mirror_x_m",
    "beam_zero_rad",
    "beam_rad_per_pulse",
    "slit_roll_rad",
];
/// Places of the plane in the joint covariance, and what comes after.
const PLANE: std::ops::Range<usize> = place::PLANE..OTHERS;
const OTHERS: usize = place::PLANE + 4;

impl PlaneFit {
    /// The same fit, for a rig that was known as well as `given` says before: the covariance in the file it started from.
    ///
    /// A camera that was refined has its covariance, with the plane's as one, from boards and stripes. One that was held is as uncertain
    /// as given, and the plane found with it is off by G times what it is off by, G = d plane/d camera at the least squares; the
    /// plane's error bars then hold that too. What else was known of the rig, the mount above all, stays as it was.
    pub fn carrying(mut self, given: &RigCovariance) -> Self {
        let mut names: Vec<&str> = CAMERA.to_vec();
        if matches!(self.camera.distortion, Distortion::Tsai { .. }) {
            names[4] = "k";
        }
        names.extend(&LASER[..4]);
        let known = given.parameters.iter().map(String::as_str);
        names.extend(known.filter(|name| *name != "k" && !CAMERA.contains(name) && !LASER.contains(name)));
        let size = names.len();
        let to_plane = to_plane(&self.plane);
        let before = DMatrix::from_fn(size, size, |i, j| {
            let own = |k: usize| PLANE.contains(&k) || (k < place::PLANE && self.camera_slopes.is_none());
            if own(i) || own(j) { 0.0 } else { entry(given, names[i], names[j]) }
        });
        let mut joint = match &self.camera_slopes {
            Some(slopes) => {
                let mut all = DMatrix::identity(size, size);
                all.view_mut((place::PLANE, 0), (4, place::PLANE)).copy_from(&(to_plane * slopes));
                &all * before * all.transpose()
            }
            None => before,
        };
        let mut solved = DMatrix::zeros(size, place::HAND);
        solved.view_mut((place::PLANE, place::PLANE), (4, 3)).copy_from(&to_plane);
        if self.camera_slopes.is_none() {
            solved.view_mut((0, 0), (place::PLANE, place::PLANE)).fill_with_identity();
        }
        joint += &solved * self.solution.covariance.view((0, 0), (place::HAND, place::HAND)) * solved.transpose();
        self.covariance = joint.fixed_view::<4, 4>(place::PLANE, place::PLANE).into_owned();
        self.carried = RigCovariance::of(&names, &joint);
        self
    }
}

/// d(n, d)/dm for n = m/|m| and d = 1/|m|.
fn to_plane(plane: &Plane<CameraFrame>) -> Matrix4x3<f64> {
    let (n, d) = (plane.normal, plane.offset);
    let mut slopes = Matrix4x3::zeros();
    slopes.fixed_view_mut::<3, 3>(0, 0).copy_from(&((Matrix3::identity() - n * n.transpose()) * d));
    slopes.fixed_view_mut::<1, 3>(3, 0).copy_from(&(-n.transpose() * d * d));
    slopes
}

/// The covariance of two parameters; 0 of what is not named.
fn entry(given: &RigCovariance, a: &str, b: &str) -> f64 {
    let place = |name: &str| given.parameters.iter().position(|p| p == name);
    let (Some(i), Some(j)) = (place(a), place(b)) else { return 0.0 };
    given.matrix.get(i).and_then(|row| row.get(j)).copied().unwrap_or(0.0)
}
