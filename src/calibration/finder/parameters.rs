//! The parameters of a finder as a calibration has them, and when one counts as found.

/// The parameters of the finder that every bundle has: name, unit, how far from its first guess it may be where nobody
/// knows better, and the change over which residuals bend.
pub(super) const PARAMETERS: [(&str, &str, f64, f64); 18] = [
    ("camera_height_m", "m", 1.0, 1.0),            // h_B
    ("x0_m", "m", 1.0, 1.0),                       // (38)
    ("tilt_rad", "rad", 0.5, 1.0),                 // θv
    ("roll_rad", "rad", 0.1, 1.0),                 // of the camera about its view
    ("pan_rad", "rad", 0.1, 1.0),                  // of the camera about the vertical
    ("mirror_height_m", "m", 1.0, 1.0),            // lA
    ("beam_zero_rad", "rad", 0.5, 1.0),            // θB at pulse 0
    ("beam_rad_per_pulse", "rad", 1.6e-5, 1.6e-3), // the gain: 1 %
    ("slit_roll_rad", "rad", 0.05, 1.0),           // of the slit about the beam
    ("mirror_x_m", "m", 0.02, 1.0),                // of A ahead of the cylinder's axis; beside it, no slit tells
    ("camera_y_m", "m", 0.02, 1.0),                // of the camera beside it
    ("axis_pitch_rad", "rad", 0.02, 1.0),          // of the cylinder's axis from the floor's normal
    ("axis_roll_rad", "rad", 0.02, 1.0),           //
    ("f_mm", "mm", 1.0, 10.0),                     // lf
    ("scale_u", "1", 0.1, 1.0),                    // Su (25)
    ("k_per_mm2", "1/mm2", 5e-3, 1e-2),            // (22), (23)
    ("cu_px", "px", 30.0, 500.0),                  // (25)
    ("cv_px", "px", 30.0, 500.0),                  // (26)
];

/// Where the camera's parameters start among these.
pub(super) const CAMERA_AT: usize = 13;
/// After those of the finder: where the tape begins (xR), and two for each wall.
pub(super) const TAPE_AT: usize = PARAMETERS.len();

/// A parameter counts as held by the data if they leave less than this part of what was believed before,
pub(super) const HELD: f64 = 0.2;
/// and if its standard deviation grows by no more than this when what is made up beforehand, of it and of all others, is
/// taken [`WIDER`] times as wide: otherwise it leans on a number that nobody knows.
pub(super) const GROWTH_MAX: f64 = 1.1;
/// See [`GROWTH_MAX`].
pub(super) const WIDER: f64 = 10.0;
