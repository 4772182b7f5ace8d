//! The ultrasonic ring in the viewer: the sector that each transducer's last range allows, and where the echoes truly came
//! from.

use nalgebra::Vector3;
use rerun::{Clear, LineStrips3D, Points3D, Radius};

use super::{Out, entity, f32s};
use crate::fault::Result;
use crate::sinks::Ranged;
use crate::sonar::EchoKind;

/// Corners of an arc.
const ARC_STEPS: usize = 12;

/// Length of the fork that is drawn where there was no echo [m].
const SILENT_M: f32 = 0.3;

/// A reading with what the viewer says of it.
struct Told {
    colour: [u8; 3],
    /// Where the echo truly came from.
    place: Option<Vector3<f64>>,
}

/// What colours mean, for the page beside the drawing.
pub(super) const LEGEND: &str = "\
- **Sectors around the robot**: the last range of each ultrasonic transducer: what echoed may be anywhere on its arc. A short \
grey fork is a ping without an echo.\n\
- **Their colours, and the dots where the echo truly came from** (simulation): blue a smooth wall, teal a rough one, orange a \
corner, magenta an edge, green a cylinder or ball; **red a ghost**: sound that came round by other surfaces, from another \
transducer or an earlier ping. Where no truth is known they are light blue.\n\
- **Plan views**: laser, ultrasonic, and both; white is free, black occupied, grey-green unknown.\n";

/// Draws a range.
pub(super) fn draw(out: &Out, ranged: &Ranged) -> Result<()> {
    let reading = &ranged.step.reading;
    let name = entity(&["world", "sonar", &reading.frame]);
    let pose = &ranged.step.world_from_transducer;
    if !pose.is_finite() {
        return out.log(name, &Clear::flat());
    }
    let told = told(ranged);
    let half = reading.field_of_view_rad / 2.0;
    let place = |range: f32, angle: f32| {
        let (y, x) = angle.sin_cos();
        f32s(&(pose.iso * nalgebra::Point3::new(f64::from(range * x), f64::from(range * y), 0.0)).coords)
    };
    let strip: Vec<[f32; 3]> = match reading.range_m {
        Some(range) => {
            let arc = (0..=ARC_STEPS).map(|i| half * (2.0 * i as f32 / ARC_STEPS as f32 - 1.0));
            let arc = arc.map(|angle| place(range, angle));
            std::iter::once(place(0.0, 0.0)).chain(arc).chain([place(0.0, 0.0)]).collect()
        }
        None => vec![place(SILENT_M, -half), place(0.0, 0.0), place(SILENT_M, half)],
    };
    let width = if reading.range_m.is_some() { 1.2 } else { 0.6 };
    let drawn = LineStrips3D::new([strip]).with_colors([told.colour]).with_radii([Radius::new_ui_points(width)]);
    out.log(name, &drawn)?;
    let Some(place) = told.place.filter(|p| p.iter().all(|c| c.is_finite())) else { return Ok(()) };
    let dot = Points3D::new([f32s(&place)]).with_colors([told.colour]).with_radii([Radius::new_ui_points(3.5)]);
    out.log("/world/echoes", &dot)
}

fn told(ranged: &Ranged) -> Told {
    let Some(range_m) = ranged.step.reading.range_m else { return Told { colour: [120, 125, 135], place: None } };
    let Some(ping) = &ranged.ping else {
        let ahead = Vector3::new(f64::from(range_m), 0.0, 0.0);
        let place = ranged.step.world_from_transducer.iso * nalgebra::Point3::from(ahead);
        return Told { colour: [120, 200, 255], place: Some(place.coords) };
    };
    let cause = ping.causes.first().and_then(|index| ping.echoes.get(*index));
    Told {
        colour: cause.map_or([120, 200, 255], |echo| colour(echo.is_straight(ping.reading.transducer), echo.kind)),
        place: cause.map(|echo| echo.place.xyz),
    }
}

fn colour(straight: bool, kind: EchoKind) -> [u8; 3] {
    match kind {
        _ if !straight => [255, 50, 50],
        EchoKind::Wall => [70, 130, 255],
        EchoKind::Rough => [40, 190, 180],
        EchoKind::Corner => [255, 160, 40],
        EchoKind::Edge => [235, 80, 220],
        EchoKind::Cylinder | EchoKind::Sphere => [90, 210, 90],
    }
}
