//! Camera on a robot's arm: A·X = X·B. Where the camera sits on the hand, and where the board stands, as a first guess.
//!
//! With base_from_hand known for each image (A) and camera_from_board seen in it (B), hand_from_camera X and base_from_board W
//! fulfil A·X·B = W. Two images leave (A_j⁻¹·A_i)·X = X·(B_j·B_i⁻¹): rotations first (Park and Martin 1994), then the shift by
//! linear least squares.

use nalgebra::{DMatrix, DVector, Isometry3, Matrix3, SVD, SymmetricEigen, Translation3, UnitQuaternion, Vector3};

use super::tsai::nearest_rotation;
use crate::fault::{Fault, Result};

/// Where the camera sits and where the board stands.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HandEye {
    /// The camera in the hand's (flange's) frame.
    pub hand_from_camera: Isometry3<f64>,
    /// The board in the arm's base.
    pub base_from_board: Isometry3<f64>,
}

impl HandEye {
    /// Where the camera should see the board when the arm stands so.
    pub fn camera_from_board(&self, base_from_hand: &Isometry3<f64>) -> Isometry3<f64> {
        (base_from_hand * self.hand_from_camera).inverse() * self.base_from_board
    }
}

/// Images that a hand-eye calibration needs.
const IMAGES_MIN: usize = 3;
/// Turns that show less than this between images are none [rad].
const TURN_MIN_RAD: f64 = 0.05;

/// The first guess from pairs (base_from_hand, camera_from_board), one an image.
///
/// Errors: fewer than three images, an arm that turned about one axis only (the shift along it does not show), poses of the arm
/// that do not go with the boards (another unit, the inverse, another order of the quaternion).
pub fn guess(pairs: &[(Isometry3<f64>, Isometry3<f64>)]) -> Result<HandEye> {
    if pairs.len() < IMAGES_MIN {
        let expected = format!("at least {IMAGES_MIN} with the board and a pose of the arm");
        return Err(Fault::new("images for hand-eye", pairs.len(), expected));
    }
    let found = solved(pairs)?;
    let (off_m, reach_m) = (spread_m(pairs, &found), reach_m(pairs));
    if off_m > 0.1 * reach_m {
        let inverse: Vec<_> = pairs.iter().map(|(a, b)| (a.inverse(), *b)).collect();
        let fits = solved(&inverse).is_ok_and(|other| spread_m(&inverse, &other) < 0.2 * off_m);
        let expected = if fits {
            "base_from_hand: these look like the inverse, the base seen from the hand"
        } else {
            "the hand in the base's frame, metres, qx qy qz qw, each with the image taken there"
        };
        let found = format!("poses that put the board {:.1} mm apart from image to image", off_m * 1e3);
        return Err(Fault::new("arm", found, expected));
    }
    Ok(found)
}

fn solved(pairs: &[(Isometry3<f64>, Isometry3<f64>)]) -> Result<HandEye> {
    let mut motions = Vec::new();
    for (i, (a, b)) in pairs.iter().enumerate() {
        motions.extend(pairs[..i].iter().map(|(a0, b0)| (a0.inverse() * a, b0 * b.inverse())));
    }
    let (mut cross, mut turns) = (Matrix3::zeros(), Matrix3::zeros());
    for (a, b) in &motions {
        let (alpha, beta) = (a.rotation.scaled_axis(), b.rotation.scaled_axis());
        cross += alpha * beta.transpose();
        turns += alpha * alpha.transpose() / motions.len() as f64;
    }
    let mut strengths: Vec<f64> = SymmetricEigen::new(turns).eigenvalues.iter().map(|e| e.max(0.0).sqrt()).collect();
    strengths.sort_by(f64::total_cmp);
    if strengths[1] < TURN_MIN_RAD {
        let found = if strengths[2] < TURN_MIN_RAD { "never turned" } else { "turned about one axis only" };
        let found = format!("{found} ({:.1}° and {:.1}° RMS)", strengths[2].to_degrees(), strengths[1].to_degrees());
        return Err(Fault::new("arm", found, "turns of 10° or more about two axes, or the camera's place stays open"));
    }
    let rotation = nearest_rotation(&cross)?;
    let mut rows = DMatrix::zeros(3 * motions.len(), 3);
    let mut right = DVector::zeros(3 * motions.len());
    for (k, (a, b)) in motions.iter().enumerate() {
        let turn = a.rotation.to_rotation_matrix().into_inner() - Matrix3::identity();
        rows.view_mut((3 * k, 0), (3, 3)).copy_from(&turn);
        right.rows_mut(3 * k, 3).copy_from(&(rotation * b.translation.vector - a.translation.vector));
    }
    let refused = || Fault::new("arm", "motions that leave the camera's place open", "turns about two axes");
    let svd = SVD::try_new(rows, true, true, f64::EPSILON, 10_000).ok_or_else(refused)?;
    let shift = svd.solve(&right, 1e-12).map_err(|_| refused())?;
    let hand_from_camera = Isometry3::from_parts(
        Translation3::new(shift[0], shift[1], shift[2]),
        UnitQuaternion::from_rotation_matrix(&rotation),
    );
    let boards: Vec<Isometry3<f64>> = pairs.iter().map(|(a, b)| a * hand_from_camera * b).collect();
    let place = boards.iter().map(|w| w.translation.vector).sum::<Vector3<f64>>() / boards.len() as f64;
    let turn: Matrix3<f64> = boards.iter().map(|w| w.rotation.to_rotation_matrix().into_inner()).sum();
    let base_from_board =
        Isometry3::from_parts(place.into(), UnitQuaternion::from_rotation_matrix(&nearest_rotation(&turn)?));
    Ok(HandEye { hand_from_camera, base_from_board })
}

/// How far apart the images put the board, RMS [m].
fn spread_m(pairs: &[(Isometry3<f64>, Isometry3<f64>)], found: &HandEye) -> f64 {
    let off = |(a, b): &(Isometry3<f64>, Isometry3<f64>)| {
        let board = a * found.hand_from_camera * b;
        (board.translation.vector - found.base_from_board.translation.vector).norm_squared()
    };
    (pairs.iter().map(off).sum::<f64>() / pairs.len() as f64).sqrt()
}

/// How far the boards are from the camera, on average [m].
fn reach_m(pairs: &[(Isometry3<f64>, Isometry3<f64>)]) -> f64 {
    pairs.iter().map(|(_, b)| b.translation.vector.norm()).sum::<f64>() / pairs.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn pairs(truth: &HandEye, turns: &[[f64; 3]]) -> Vec<(Isometry3<f64>, Isometry3<f64>)> {
        turns
            .iter()
            .enumerate()
            .map(|(i, turn)| {
                let shift = Vector3::new(0.3 + 0.02 * i as f64, 0.1 * (i as f64).sin(), 0.4 + 0.03 * (i as f64).cos());
                let arm = Isometry3::new(shift, Vector3::from(*turn));
                (arm, truth.camera_from_board(&arm))
            })
            .collect()
    }

    fn truth(x: [f64; 3], w: [f64; 3]) -> HandEye {
        HandEye {
            hand_from_camera: Isometry3::new(Vector3::new(0.1, -0.02, 0.03), Vector3::from(x)),
            base_from_board: Isometry3::new(Vector3::new(0.5, 0.2, 0.05), Vector3::from(w)),
        }
    }

    const TURNS: [[f64; 3]; 5] =
        [[0.1, 0.0, 0.0], [0.5, 0.1, 0.2], [-0.3, 0.4, 0.1], [0.0, -0.5, 0.9], [0.2, 0.3, -0.6]];

    proptest! {
        #[test]
        fn exact_poses_give_the_exact_place(
            x in prop::array::uniform3(-1.5..1.5f64), w in prop::array::uniform3(-1.5..1.5f64),
        ) {
            let truth = truth(x, w);
            let found = guess(&pairs(&truth, &TURNS)).unwrap();
            for (a, b) in [
                (found.hand_from_camera, truth.hand_from_camera),
                (found.base_from_board, truth.base_from_board),
            ] {
                prop_assert!((a.translation.vector - b.translation.vector).norm() < 1e-9);
                prop_assert!(a.rotation.angle_to(&b.rotation) < 1e-7);
            }
        }
    }

    #[test]
    fn what_does_not_show_is_refused_with_the_reason() {
        let truth = truth([0.3, 0.2, 1.0], [0.0, 0.1, 0.5]);
        let fault = |turns: &[[f64; 3]]| guess(&pairs(&truth, turns)).unwrap_err().to_string();
        assert!(fault(&TURNS[..2]).contains("at least 3"));
        assert!(fault(&[[0.2, 0.0, 0.0]; 4]).contains("never turned"));
        assert!(fault(&[[0.0, 0.0, 0.1], [0.0, 0.0, 0.9], [0.0, 0.0, -0.5]]).contains("about one axis only"));
        let good = pairs(&truth, &TURNS);
        let inverse: Vec<_> = good.iter().map(|(a, b)| (a.inverse(), *b)).collect();
        assert!(guess(&inverse).unwrap_err().to_string().contains("inverse"));
        let mm = |a: &Isometry3<f64>| Isometry3::from_parts((a.translation.vector * 1e3).into(), a.rotation);
        let millimetres: Vec<_> = good.iter().map(|(a, b)| (mm(a), *b)).collect();
        assert!(guess(&millimetres).unwrap_err().to_string().contains("metres"));
        let shuffled: Vec<_> = good.iter().enumerate().map(|(i, (a, _))| (*a, good[(i + 2) % 5].1)).collect();
        assert!(guess(&shuffled).is_err());
    }
}
