//! Motion during the exposure: the image is the sum of several instants, as many as the motion asks for.
//!
//! A stripe that moves by less than 0.3 rows is one instant: its blur of 0.09 px RMS widens a stripe of 0.45 px by 2 %. On
//! a flat floor a driving robot's stripe does not move at all; what moves are edges, and these count where there are any.

use super::trace::{PARTS, Trace};
use super::{Moment, Movement, V3, View, column_of};
use crate::fault::Result;
use crate::geometry::Point;

/// Most instants of an exposure; odd, so that one of them is its middle.
const INSTANTS_MAX: f64 = 7.0;
/// Rows that a stripe may move from one instant to the next [px].
const ROWS: f64 = 0.3;
/// Columns that an edge may move from one instant to the next [px].
const COLUMNS: f64 = 1.0;
/// One column in so many is followed.
const EVERY: i32 = 32;
/// A stripe that jumps by more rows than this has an edge in it [px].
const EDGE_PX: f64 = 2.0;

impl Moment {
    /// The moment a share of the movement later.
    pub(super) fn moved(&self, movement: &Movement, share: f64) -> Self {
        let still = crate::geometry::Transform::identity();
        Self {
            world_from_robot: self.world_from_robot * still.along_arc(&movement.robot, share),
            cylinder_rad: self.cylinder_rad + movement.cylinder_rad * share,
            beam_rad: self.beam_rad + movement.beam_rad * share,
        }
    }
}

impl View<'_> {
    /// How many instants show the movement.
    pub fn instants(&self, trace: &Trace, middle: &Moment, movement: &Movement) -> Result<u32> {
        if *movement == Movement::default() {
            return Ok(1);
        }
        let ends = [-0.5, 0.5].map(|share| middle.moved(movement, share));
        let (first, last) = (
            self.renderer.view(self.surfaces, &ends[0], self.seed)?,
            self.renderer.view(self.surfaces, &ends[1], self.seed)?,
        );
        let (mut rows, mut columns) = (0.0f64, 0.0f64);
        for c in trace.seen().filter(|c| (c.part / PARTS) % EVERY == EVERY / 2) {
            // The same ray of the fan at the shutter's opening and closing.
            let way = self.own(&(c.point - self.beam.sheet.origin.xyz));
            if let (Some(from), Some(to)) = (first.row_of_ray(&way, c.body), last.row_of_ray(&way, c.body)) {
                rows = rows.max((to - from).abs());
            }
            // The same place on the surface.
            if let (Some(from), Some(to)) = (first.project(&c.point), last.project(&c.point)) {
                columns = columns.max((to[0] - from[0]).abs());
            }
        }
        let edges = if has_edges(trace) { columns / COLUMNS } else { 0.0 };
        let count = (rows / ROWS).max(edges).min(INSTANTS_MAX).floor() as u32;
        Ok(count / 2 * 2 + 1)
    }

    /// A direction in terms of the sheet's own axes: forward, lateral, normal.
    fn own(&self, way: &V3) -> V3 {
        let sheet = &self.beam.sheet;
        V3::new(sheet.forward.dot(way), sheet.lateral.dot(way), sheet.plane.normal.dot(way))
    }

    /// The row in which the ray of the fan is seen, if it falls on this body.
    fn row_of_ray(&self, own: &V3, body: usize) -> Option<f64> {
        let sheet = &self.beam.sheet;
        let way = sheet.forward * own.x + sheet.lateral * own.y + sheet.plane.normal * own.z;
        let hit = self.surfaces.cast(sheet.origin, &way, self.renderer.params.reach_m)?;
        let place: Point<crate::geometry::World> = (sheet.origin.xyz + way.normalize() * hit.range_m).into();
        (hit.body == body).then(|| self.project(&place.xyz)).flatten().map(|[_, v]| v)
    }
}

/// Whether the stripe ends or jumps anywhere within the image.
fn has_edges(trace: &Trace) -> bool {
    let mut last: Option<(i32, f64)> = None;
    let mut jumps = false;
    for c in trace.seen() {
        let (column, v) = (column_of(c.part), c.glimpse.v);
        jumps |= last.is_some_and(|(before, row)| column - before > 1 || (v - row).abs() > EDGE_PX);
        last = Some((column, v));
    }
    jumps
}
