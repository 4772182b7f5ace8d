//! A pinhole camera with Tsai's (eq. 19–26) or Brown–Conrady's distortion.
//!
//! Pixels: u to the right, v down, integers at pixel centres, (0, 0) the top left one. The paper's frame memory has Vf
//! growing upwards: v = height − 1 − Vf.

use nalgebra::{Matrix2, Vector2, Vector3};
use serde::{Deserialize, Serialize};

use crate::fault::{Fault, Result, number_within, positive};

/// How the lens bends the pinhole image, on coordinates divided by the focal length.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "model", rename_all = "snake_case", deny_unknown_fields)]
pub enum Distortion {
    /// None.
    Pinhole,
    /// Tsai: x_u = x_d·(1 + k·r_d²) (eq. 22–24), `k` in 1/focal length²: k [1/mm²]·lf² [mm²].
    Tsai {
        /// The distortion factor on normalised coordinates.
        k: f64,
    },
    /// Brown–Conrady, as OpenCV and ROS `plumb_bob`.
    BrownConrady {
        /// Radial, r².
        k1: f64,
        /// Radial, r⁴.
        k2: f64,
        /// Tangential.
        p1: f64,
        /// Tangential.
        p2: f64,
        /// Radial, r⁶.
        #[serde(default)]
        k3: f64,
    },
}

/// A camera: where a point in its frame falls in the image, and the line of sight of a pixel.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Camera {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Focal length in columns: Su·lf/d'u.
    pub fx: f64,
    /// Focal length in rows: lf/dv.
    pub fy: f64,
    /// Column of the optical axis.
    pub cx: f64,
    /// Row of the optical axis, from the top.
    pub cy: f64,
    /// Lens distortion.
    pub distortion: Distortion,
}

impl Camera {
    /// METRO-I's camera after calibration: Tables 3 and 4, `paper.md` 6. 512 × 480, C = (256, 240) with Vf upwards.
    pub fn metro_i() -> Self {
        let (lf_mm, su, k_per_mm2) = (11.434, 1.095, 0.00335);
        let (column_mm, row_mm) = (6.4 / 512.0 / su, 4.8 / 485.0);
        Self {
            width: 512,
            height: 480,
            fx: lf_mm / column_mm,
            fy: lf_mm / row_mm,
            cx: 256.0,
            cy: 480.0 - 1.0 - 240.0,
            distortion: Distortion::Tsai { k: k_per_mm2 * lf_mm * lf_mm },
        }
    }

    /// Refuses sizes and numbers that make no camera.
    pub fn validated(self) -> Result<Self> {
        for (name, size) in [("camera.width", self.width), ("camera.height", self.height)] {
            if !(1..=65_536).contains(&size) {
                return Err(Fault::new(name, size, "a number of pixels from 1 to 65536"));
            }
        }
        if self.width * self.height > 1 << 26 {
            return Err(Fault::new("camera size", format!("{} x {}", self.width, self.height), "at most 64 Mpixel"));
        }
        positive("camera.fx", self.fx)?;
        positive("camera.fy", self.fy)?;
        number_within("camera.cx", self.cx, -1e6, 1e6)?;
        number_within("camera.cy", self.cy, -1e6, 1e6)?;
        let coefficients = match self.distortion {
            Distortion::Pinhole => vec![],
            Distortion::Tsai { k } => vec![k],
            Distortion::BrownConrady { k1, k2, p1, p2, k3 } => vec![k1, k2, p1, p2, k3],
        };
        for value in coefficients {
            // On coordinates over the focal length: a tele lens has huge ones.
            number_within("camera.distortion", value, -1e12, 1e12)?;
        }
        let (right, bottom) = ((self.width - 1) as f64, (self.height - 1) as f64);
        for (u, v) in [(0.0, 0.0), (right, 0.0), (0.0, bottom), (right, bottom)] {
            if self.ray(u, v).is_none() {
                let found = format!("{:?}, which folds over at pixel ({u}, {v})", self.distortion);
                return Err(Fault::new("camera.distortion", found, "a lens that can be undone over the whole image"));
            }
        }
        Ok(self)
    }

    /// Where a point (camera frame: x right, y down, z along the view) falls: (u, v) [px], also outside the image.
    /// `None` behind the camera, or so far off axis that the distortion model folds over.
    pub fn project(&self, p: &Vector3<f64>) -> Option<[f64; 2]> {
        if p.z.is_nan() || p.z <= 1e-9 {
            return None;
        }
        let ideal = Vector2::new(p.x / p.z, p.y / p.z); // (20), (21) divided by lf
        let bent = self.distortion.distort(ideal)?;
        Some([self.fx * bent.x + self.cx, self.fy * bent.y + self.cy]) // (25), (26)
    }

    /// The line of sight of pixel (u, v), as (x, y, 1) in the camera frame; `None` where the model cannot be undone.
    pub fn ray(&self, u: f64, v: f64) -> Option<Vector3<f64>> {
        let bent = Vector2::new((u - self.cx) / self.fx, (v - self.cy) / self.fy);
        let ideal = self.distortion.undistort(bent)?;
        Some(Vector3::new(ideal.x, ideal.y, 1.0))
    }

    /// d(ray.x, ray.y)/d(u, v): how the line of sight turns with the pixel.
    pub fn ray_jacobian(&self, u: f64, v: f64) -> Option<Matrix2<f64>> {
        let step = 0.5;
        let du = (self.ray(u + step, v)? - self.ray(u - step, v)?) / (2.0 * step);
        let dv = (self.ray(u, v + step)? - self.ray(u, v - step)?) / (2.0 * step);
        Some(Matrix2::new(du.x, dv.x, du.y, dv.y))
    }
}

impl Distortion {
    /// Where the lens puts what a pinhole would put at `ideal`.
    fn distort(&self, ideal: Vector2<f64>) -> Option<Vector2<f64>> {
        match *self {
            Self::Pinhole => Some(ideal),
            Self::Tsai { k } => {
                // Solve r_d·(1 + k·r_d²) = r_u by Newton (22–24).
                let ru = ideal.norm();
                if ru == 0.0 || k == 0.0 {
                    return Some(ideal);
                }
                // For k < 0 the cubic has its maximum at r_d² = −1/(3k): nothing beyond can be imaged.
                if k < 0.0 && ru > 2.0 / 3.0 * (-1.0 / (3.0 * k)).sqrt() {
                    return None;
                }
                let mut rd = ru / (1.0 + k * ru * ru).max(0.5);
                for _ in 0..30 {
                    let step = (rd * (1.0 + k * rd * rd) - ru) / (1.0 + 3.0 * k * rd * rd);
                    rd -= step;
                    if step.abs() < 1e-15 * ru {
                        break;
                    }
                }
                rd.is_finite().then(|| ideal * (rd / ru))
            }
            Self::BrownConrady { .. } => {
                if self.brown_slope(ideal.norm_squared()) <= 0.0 {
                    return None;
                }
                Some(self.brown(ideal))
            }
        }
    }

    /// The pinhole coordinates of what the lens puts at `bent`.
    fn undistort(&self, bent: Vector2<f64>) -> Option<Vector2<f64>> {
        match *self {
            Self::Pinhole => Some(bent),
            Self::Tsai { k } => {
                let r2 = bent.norm_squared(); // (24)
                (1.0 + 3.0 * k * r2 > 0.0).then(|| bent * (1.0 + k * r2)) // (22), (23)
            }
            Self::BrownConrady { .. } => {
                let mut ideal = bent;
                for _ in 0..50 {
                    let error = self.brown(ideal) - bent;
                    if error.norm() < 1e-14 {
                        break;
                    }
                    ideal -= self.brown_jacobian(ideal).try_inverse()? * error;
                }
                let solved = (self.brown(ideal) - bent).norm() < 1e-10;
                (solved && self.brown_slope(ideal.norm_squared()) > 0.0).then_some(ideal)
            }
        }
    }

    fn brown(&self, p: Vector2<f64>) -> Vector2<f64> {
        let Self::BrownConrady { k1, k2, p1, p2, k3 } = *self else { return p };
        let (x, y, r2) = (p.x, p.y, p.norm_squared());
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        Vector2::new(
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        )
    }

    /// d(r·radial)/dr: negative where the radial polynomial folds the image over.
    fn brown_slope(&self, r2: f64) -> f64 {
        let Self::BrownConrady { k1, k2, k3, .. } = *self else { return 1.0 };
        1.0 + r2 * (3.0 * k1 + r2 * (5.0 * k2 + r2 * 7.0 * k3))
    }

    fn brown_jacobian(&self, p: Vector2<f64>) -> Matrix2<f64> {
        let Self::BrownConrady { k1, k2, p1, p2, k3 } = *self else { return Matrix2::identity() };
        let (x, y, r2) = (p.x, p.y, p.norm_squared());
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        let slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3)); // d(radial)/d(r²)·2
        let cross = x * y * slope + 2.0 * (p1 * x + p2 * y);
        Matrix2::new(
            radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x,
            cross,
            cross,
            radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x,
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn cameras() -> impl Strategy<Value = Camera> {
        let brown = Distortion::BrownConrady { k1: -0.350373, k2: 0.158447, p1: 0.000735, p2: -0.000231, k3: 0.0 };
        let models = prop_oneof![
            Just(Distortion::Pinhole),
            Just(Distortion::Tsai { k: 0.438 }),
            Just(Distortion::Tsai { k: -0.2 }),
            Just(brown)
        ];
        models.prop_map(|distortion| Camera { distortion, ..Camera::metro_i() })
    }

    proptest! {
        #[test]
        fn a_pixel_sees_what_falls_on_it(camera in cameras(), u in 0.0..511.0f64, v in 0.0..479.0f64, z in 0.1..9.0f64) {
            let ray = camera.ray(u, v).unwrap();
            let [back_u, back_v] = camera.project(&(ray * z)).unwrap();
            prop_assert!((back_u - u).abs() < 1e-7 && (back_v - v).abs() < 1e-7);
        }
    }

    #[test]
    fn brown_conrady_agrees_with_opencv() {
        // cv2.projectPoints of (0.3, -0.2, 1) with these coefficients, worked out by hand:
        // r² = 0.13, radial = 1 − 0.350373·0.13 + 0.158447·0.0169 = 0.957129264
        // x = 0.3·radial + 2·p1·x·y + p2·(r² + 2x²) = 0.287138779 − 0.0000882 − 0.00007161
        let d = Distortion::BrownConrady { k1: -0.350373, k2: 0.158447, p1: 0.000735, p2: -0.000231, k3: 0.0 };
        let p = d.distort(Vector2::new(0.3, -0.2)).unwrap();
        let radial = 1.0 - 0.350373 * 0.13 + 0.158447 * 0.0169;
        assert!((p.x - (0.3 * radial - 2.0 * 0.000735 * 0.06 - 0.000231 * 0.31)).abs() < 1e-12);
        assert!((p.y - (-0.2 * radial + 0.000735 * 0.21 + 2.0 * 0.000231 * 0.06)).abs() < 1e-12);
    }

    #[test]
    fn what_the_model_cannot_image_is_none() {
        let camera = Camera::metro_i();
        assert!(camera.project(&Vector3::new(0.0, 0.0, -1.0)).is_none());
        assert!(camera.project(&Vector3::new(0.0, 0.0, 0.0)).is_none());
        assert!(camera.project(&Vector3::new(f64::NAN, 0.0, f64::NAN)).is_none());
        let barrel = Camera { distortion: Distortion::Tsai { k: -0.2 }, ..camera };
        assert!(barrel.project(&Vector3::new(9.0, 0.0, 1.0)).is_none());
    }

    #[test]
    fn impossible_cameras_are_refused() {
        let good = Camera::metro_i();
        assert!(good.validated().is_ok());
        assert!(Camera { width: 0, ..good }.validated().is_err());
        assert!(Camera { fx: -3.0, ..good }.validated().is_err());
        assert!(Camera { cy: f64::NAN, ..good }.validated().is_err());
    }
}
