//! The pose of a flat board in the frame of a known camera, from its marks in one image.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector2, Vector3};

use super::points::Mark;
use super::report::robust_sigma;
use super::solve::{Options, Parameter, minimise};
use super::tsai::Shape;
use super::zhang::{homography, pose};
use crate::fault::{Fault, Result};
use crate::optics::Camera;

/// Marks that a pose needs.
const MARKS_MIN: usize = 6;

/// A board found in an image.
#[derive(Clone, Debug, PartialEq)]
pub struct BoardPose {
    /// The board in the camera's frame.
    pub camera_from_board: Isometry3<f64>,
    /// The marks that agree with it.
    pub marks: Vec<Mark>,
    /// The others, with their distance from where they should be [px].
    pub off: Vec<(Mark, f64)>,
    /// Of the marks used, RMS of the distances in the image [px].
    pub rms_px: f64,
}

/// Finds it; marks more than `outlier_sigmas` robust standard deviations off are left out.
///
/// Errors: fewer than six marks, marks on one line, marks that the camera cannot see so (another camera, a wrong order).
pub fn board_pose(camera: &Camera, marks: &[Mark], outlier_sigmas: f64) -> Result<BoardPose> {
    let mut kept = marks.to_vec();
    let mut off = Vec::new();
    loop {
        let (camera_from_board, sizes) = fitted(camera, &kept)?;
        // Rayleigh's median against the normal's.
        let sigma = robust_sigma(sizes.iter().copied()) * (0.6745 / 1.1774);
        let limit = outlier_sigmas * sigma.max(1e-6);
        if sizes.iter().all(|size| *size <= limit) {
            let rms_px = (sizes.iter().map(|s| s * s).sum::<f64>() / sizes.len() as f64).sqrt();
            return Ok(BoardPose { camera_from_board, marks: kept, off, rms_px });
        }
        let (near, far): (Vec<_>, Vec<_>) = kept.into_iter().zip(sizes).partition(|(_, size)| *size <= limit);
        kept = near.into_iter().map(|(mark, _)| mark).collect();
        off.extend(far);
        if off.len() * 3 > marks.len() {
            let found = format!("{} of {} that do not fit the others", off.len(), marks.len());
            return Err(Fault::new("marks", found, "marks as this camera sees a flat board"));
        }
    }
}

/// The pose, and how far each mark is from it [px].
fn fitted(camera: &Camera, marks: &[Mark]) -> Result<(Isometry3<f64>, Vec<f64>)> {
    if marks.len() < MARKS_MIN {
        return Err(Fault::new("marks", marks.len(), format!("at least {MARKS_MIN}")));
    }
    let places: Vec<Vector3<f64>> = marks.iter().map(|m| m.target.xyz).collect();
    let shape = Shape::of(&places);
    shape.at_least_flat()?;
    // The image as a camera without distortion would see it, its axis at 0.
    let mut straight = Vec::with_capacity(marks.len());
    for mark in marks {
        let ray = camera.ray(mark.u_px, mark.v_px).ok_or_else(|| {
            let found = format!("pixel ({:.1}, {:.1}), where the lens model ends", mark.u_px, mark.v_px);
            Fault::new("mark", found, "a pixel of this camera")
        })?;
        straight.push(Mark { u_px: ray.x * camera.fx, v_px: ray.y * camera.fy, ..*mark });
    }
    let h = homography(&straight, &shape, Vector2::zeros())?;
    let (rotation, origin) = pose(&h, [camera.fx, camera.fy], &shape)?;
    let mut found = Isometry3::from_parts(Translation3::from(origin), UnitQuaternion::from_rotation_matrix(&rotation));
    let distance = origin.norm().max(1e-3);
    let names = ["turn_x", "turn_y", "turn_z", "x_m", "y_m", "z_m"];
    let parameters: Vec<Parameter> = (names.into_iter().enumerate())
        .map(|(i, name)| Parameter::new(name, 0.0, if i < 3 { 1.0 } else { distance }))
        .collect();
    let residuals = |start: &Isometry3<f64>, p: &[f64]| -> Option<Vec<f64>> {
        let pose = moved(start, p);
        let mut all = Vec::with_capacity(2 * marks.len());
        for mark in marks {
            let [u, v] = camera.project(&(pose * nalgebra::Point3::from(mark.target.xyz)).coords)?;
            all.extend([mark.u_px - u, mark.v_px - v]);
        }
        Some(all)
    };
    let fit = minimise(&parameters, &|p| residuals(&found, p), &Options::default())?.full_rank()?;
    found = moved(&found, &fit.values);
    Ok((found, fit.residuals.chunks_exact(2).map(|r| r[0].hypot(r[1])).collect()))
}

/// The pose turned by a rotation vector about the axes of the frame it leads to, and shifted in it.
pub(super) fn moved(pose: &Isometry3<f64>, by: &[f64]) -> Isometry3<f64> {
    let turn = UnitQuaternion::new(Vector3::new(by[0], by[1], by[2]));
    let shift = Vector3::new(by[3], by[4], by[5]);
    Isometry3::from_parts(Translation3::from(pose.translation.vector + shift), turn * pose.rotation)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Point;
    use proptest::prelude::*;

    fn seen(camera: &Camera, pose: &Isometry3<f64>) -> Vec<Mark> {
        let mark = |i: usize| {
            let target = Point::new((i % 9) as f64 * 0.02, (i / 9) as f64 * 0.02, 0.0);
            let [u_px, v_px] = camera.project(&(pose * nalgebra::Point3::from(target.xyz)).coords).unwrap();
            Mark { target, u_px, v_px, image: 0, line: i + 1 }
        };
        (0..54).map(mark).collect()
    }

    proptest! {
        #[test]
        fn exact_marks_give_the_exact_pose(turn in prop::array::uniform3(-0.6..0.6f64), z in 0.3..1.0f64) {
            let camera = Camera::metro_i();
            let pose = Isometry3::new(Vector3::new(-0.08, -0.05, z), Vector3::from(turn));
            let found = board_pose(&camera, &seen(&camera, &pose), 6.0).unwrap();
            prop_assert!((found.camera_from_board.inverse() * pose).translation.vector.norm() < 1e-7);
            prop_assert!(found.camera_from_board.rotation.angle_to(&pose.rotation) < 1e-7);
        }
    }

    #[test]
    fn a_mark_that_is_off_is_left_out() {
        let camera = Camera::metro_i();
        let pose = Isometry3::new(Vector3::new(-0.08, -0.05, 0.5), Vector3::new(0.3, 0.2, 0.1));
        let mut marks = seen(&camera, &pose);
        for (i, mark) in marks.iter_mut().enumerate() {
            mark.u_px += 0.1 * (i as f64 * 1.7).sin();
        }
        marks[7].v_px += 5.0;
        let found = board_pose(&camera, &marks, 6.0).unwrap();
        assert_eq!((found.marks.len(), found.off.len(), found.off[0].0.line), (53, 1, 8));
        assert!(board_pose(&camera, &marks[..5], 6.0).unwrap_err().to_string().contains("at least 6"));
        assert!(board_pose(&camera, &marks[..9], 6.0).unwrap_err().to_string().contains("on one line"));
    }
}
