//! A finder on paper: what it will see, how well, in what light and how safely, before anybody builds it.
//!
//! A rig, its lens and its light go in; fields of view, an error budget over range, levels, a hint at the laser's class, the
//! blind zone and the beams for a wanted volume come out, as numbers ([`Design`], JSON) and as a page ([`page`]). All in
//! the robot's frame with the cylinder straight ahead and the floor at z = 0. Pure: no files, no printing.
//!
//! What is left out: occlusion by the robot's own body, blooming, a second bounce, vignetting, and whatever the
//! calibration's own errors do together (only a pitch and a beam zero can be given).

mod beams;
mod bench;
mod budget;
mod changes;
mod detector;
mod light;
#[cfg(test)]
mod oracles;
mod page;
mod params;
mod pictures;
mod safety;
mod view;
mod words;

use serde::Serialize;

use bench::Bench;
use budget::Budget;

use crate::fault::{Fault, Result};

pub use beams::{Line, Unseen, Watch};
pub use budget::{FOUND, Row, STANDS_OUT, TERMS, Terms};
pub use changes::Change;
pub use light::{Facing, Light, Reach, SUN_W_PER_M2, TARGETS};
pub use page::page;
pub use params::{DesignParams, Instrument, Volume};
pub use safety::{Emission, Safety, limits_w, safety};
pub use view::{View, Width};
pub use words::{Finding, Kind};

/// Rows over the asked range.
const ROWS: usize = 60;

/// The slit optics: both forms of the paper.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Optics {
    /// Focal lengths of the four lenses [mm].
    pub lens_mm: [f64; 4],
    /// Distance between the two pairs [mm].
    pub gap_mm: f64,
    /// Diameter of the laser beam [mm].
    pub laser_mm: f64,
    /// Equivalent focal lengths of the pairs (11) [mm].
    pub pair_mm: [f64; 2],
    /// Half angle behind the first pair θ1 (14) [°].
    pub theta1_deg: f64,
    /// Half angle of the sheet θ2 [°].
    pub theta2_deg: f64,
    /// Width of the sheet at 3 m [m].
    pub width_at_3_m_m: f64,
    /// θ2 as the paper's printed formula has it [°].
    pub printed_theta2_deg: f64,
    /// Width at 3 m as the paper's printed formula (18) has it [m].
    pub printed_width_at_3_m_m: f64,
}

/// What went in, in the units of the command line.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Given {
    /// Power that leaves the finder [mW].
    pub power_mw: f64,
    /// Power of the bare beam [mW].
    pub source_mw: f64,
    /// Wavelength [nm].
    pub wavelength_nm: f64,
    /// Focal length over aperture.
    pub f_number: f64,
    /// Exposure time [ms].
    pub exposure_ms: f64,
    /// Focal length [mm].
    pub focal_mm: f64,
    /// Columns and rows.
    pub image_px: [usize; 2],
    /// Albedo in the error budget.
    pub albedo: f64,
    /// Standard deviation of the mirror's stop [mrad].
    pub mirror_stop_mrad: f64,
    /// Speed of the robot [m/s].
    pub speed_m_s: f64,
}

/// All that is found.
#[derive(Clone, Debug, Serialize)]
pub struct Design {
    /// Name of the rig.
    pub name: String,
    /// What went in.
    pub given: Given,
    /// The verdict in words.
    pub findings: Vec<Finding>,
    /// What the camera sees.
    pub view: View,
    /// The lenses that make the sheet, where they are known.
    pub optics: Option<Optics>,
    /// Error budget on the floor, over X; each row with the beam that meets it. Empty where no floor is seen.
    pub floor: Vec<Row>,
    /// Beam of the upright targets, below the horizontal [°].
    pub upright_beam_deg: f64,
    /// Error budget on upright targets that face the robot, over X, with one beam. May be empty.
    pub upright: Vec<Row>,
    /// Light.
    pub light: Light,
    /// The hint at the laser's class.
    pub safety: Safety,
    /// The volume.
    pub volume: Watch,
    /// What changes of the rig would do.
    pub changes: Vec<Change>,
    /// What was assumed, in sentences.
    pub assumed: Vec<String>,
    #[serde(skip)]
    instrument: Instrument,
    #[serde(skip)]
    params: DesignParams,
}

/// Works a design out.
///
/// Errors: parameters out of their ranges, lenses that make no sheet, a rig that cannot triangulate, a beam outside the
/// mirror's travel, and a camera that never meets the sheet in the asked range.
pub fn design(instrument: Instrument, params: DesignParams) -> Result<Design> {
    let (instrument, params) = (instrument.validated()?, params.validated()?);
    let bench = Bench::new(&instrument.rig, &instrument.image);
    let budget = Budget::new(&bench, &instrument, &params);
    let view = view::view(&bench, &params)?;
    let beam = reference_beam(&bench, &params, &view)?;
    let xs = samples(params.range_m);
    let upright: Vec<Row> = xs.iter().filter_map(|x| budget.upright(beam, *x)).collect();
    let floor: Vec<Row> = match view.floor_m {
        Some([near, far]) => {
            // The ends themselves, a hair inside.
            let ends =
                [near + 1e-4, far - 1e-4].into_iter().filter(|x| *x >= params.range_m[0] && *x <= params.range_m[1]);
            let mut xs: Vec<f64> = xs.iter().copied().filter(|x| *x > near && *x < far).chain(ends).collect();
            xs.sort_by(f64::total_cmp);
            xs.into_iter().filter_map(|x| budget.floor(x)).collect()
        }
        None => Vec::new(),
    };
    if floor.is_empty() && upright.is_empty() {
        let [near, far] = params.range_m;
        let found = format!("a view that never meets the sheet between {near} and {far} m ahead of the robot");
        return Err(Fault::new("camera", found, "a camera tilted so that it does, or another range"));
    }
    let volume = beams::watch(&bench, &instrument, &params)?;
    let light = light::light(&bench, &params, view.floor_m);
    let source_w = params.source_power_w.unwrap_or(instrument.rig.sheet.power_w);
    let changes = changes::changes(&instrument, &params);
    let mut all = Design {
        name: instrument.rig.name.clone(),
        given: given(&instrument, &params, source_w),
        findings: Vec::new(),
        optics: instrument.optics.map(optics),
        safety: safety(&instrument.rig.sheet, source_w),
        floor,
        upright_beam_deg: if bench.beam().is_some() { beam.to_degrees() } else { view.beam_deg[0] },
        view,
        upright,
        light,
        volume,
        changes,
        assumed: assumed(&instrument, &params),
        instrument: instrument.clone(),
        params,
    };
    all.findings = words::findings(&all);
    Ok(all)
}

/// X from the nearest to the farthest, evenly.
fn samples([near, far]: [f64; 2]) -> Vec<f64> {
    (0..=ROWS).map(|i| near + (far - near) * i as f64 / ROWS as f64).collect()
}

fn reference_beam(bench: &Bench, params: &DesignParams, view: &View) -> Result<f64> {
    let Some(axis) = bench.beam() else {
        return match params.beam_rad {
            Some(beam) => {
                let found = format!("{:.2}°, where the sheet stands still", beam.to_degrees());
                Err(Fault::new("beam", found, "no beam angle for this rig"))
            }
            None => Ok(0.0),
        };
    };
    if let Some(beam) = params.beam_rad {
        if !bench.in_travel(beam) {
            let [low, high] = view.beam_deg;
            let expected = format!("an angle within the mirror's travel, {low:.2}° to {high:.2}°");
            return Err(Fault::new("beam", format!("{:.2}°", beam.to_degrees()), expected));
        }
        return Ok(beam);
    }
    if (axis.pulse_min..=axis.pulse_max).contains(&0) && axis.zero_rad > 0.0 {
        return Ok(axis.zero_rad);
    }
    let middle = view.floor_m.map(|[near, far]| (near + far) / 2.0);
    let down = middle.and_then(|x| bench.floor_at(x)).and_then(|p| bench.beam_to(&p));
    Ok(down.unwrap_or(axis.zero_rad + f64::from(axis.pulse_min.midpoint(axis.pulse_max)) * axis.rad_per_pulse))
}

fn assumed(instrument: &Instrument, params: &DesignParams) -> Vec<String> {
    let mut list = instrument.assumed.clone();
    if !instrument.rig.knows_laser_origin() {
        let place = "the place on the sheet nearest to the camera is taken";
        list.push(format!("The rig does not say where its light comes from: {place}."));
    }
    list.push(format!(
        "Floor and targets have an albedo of {}, the ambient light within the filter is {} W/m², the robot's radius {} m, its pitch against \
         the floor good to {} mrad.",
        params.albedo,
        params.ambient_w_per_m2,
        params.robot_radius_m,
        params.tilt_sigma_rad * 1e3
    ));
    if instrument.sweep.is_none() && matches!(instrument.rig.laser, crate::optics::Laser::Mirror(_)) {
        list.push("Mirror and cylinder settle on whole pulses before each image, with METRO-I's servos.".into());
    }
    list
}

fn given(instrument: &Instrument, params: &DesignParams, source_w: f64) -> Given {
    let (rig, image) = (&instrument.rig, &instrument.image);
    Given {
        power_mw: rig.sheet.power_w * 1e3,
        source_mw: source_w * 1e3,
        wavelength_nm: rig.sheet.wavelength_m * 1e9,
        f_number: image.f_number,
        exposure_ms: image.exposure_s * 1e3,
        focal_mm: image.focal_length_m * 1e3,
        image_px: [rig.camera.width, rig.camera.height],
        albedo: params.albedo,
        mirror_stop_mrad: instrument.mirror_sigma_rad() * 1e3,
        speed_m_s: params.speed_m_s,
    }
}

fn optics(optics: crate::optics::SlitOptics) -> Optics {
    let (fan, printed) = (optics.fan(3000.0), optics.printed_fan(3000.0));
    Optics {
        lens_mm: [optics.set1.first_mm, optics.set1.second_mm, optics.set2.first_mm, optics.set2.second_mm],
        gap_mm: optics.between_mm,
        laser_mm: optics.laser_mm,
        pair_mm: [optics.set1.focal_mm(), optics.set2.focal_mm()],
        theta1_deg: fan.theta1_deg,
        theta2_deg: fan.theta2_deg,
        width_at_3_m_m: fan.width_mm * 1e-3,
        printed_theta2_deg: printed.theta2_deg,
        printed_width_at_3_m_m: printed.width_mm * 1e-3,
    }
}
