//! An edge within the sheet's thickness: part of the light falls on the near surface, part passes it and falls on what is
//! behind. The column then holds two stripes, or one that is neither, where their rows are near.
//!
//! Every eighth column and those near the ends of a stripe are asked whether the flanks of the sheet, 1.5 σ to either side, fall
//! on the same surface and are seen like its middle. Around those where they do not, the sheet is cut into 17 thinner
//! ones, so each part's share is right to 6 %; so an edge that parts less than a few columns may be missed.

use super::trace::{Candidate, Columns, Trace};
use super::{Beam, TrueSight, V3, View};
use crate::geometry::{Plane, Point};
use crate::optics::LaserPlane;

/// One column in so many is asked.
const EVERY: i32 = 8;
/// The flanks that are asked for, in RMS half thicknesses of the sheet.
const FLANK: f64 = 1.5;
/// Thin sheets on either side of the middle one.
const SIDE: i32 = 8;
/// From one to the next, in RMS half thicknesses of the whole sheet.
const STEP: f64 = 0.3;
/// Thickness of a thin sheet over that of the whole: they overlap to a smooth profile.
const THINNESS: f64 = 0.35;
/// Stripes of one column nearer than this are one [px].
const APART_PX: f64 = 1.5;
/// A part of the stripe with less than this share of a full one is no sight of its own.
const SHARE_MIN: f64 = 0.05;

impl View<'_> {
    /// The columns in which an edge parts the stripe.
    pub fn parted(&self, trace: &Trace) -> Columns {
        let mut parted = Columns::default();
        if !self.renderer.params.split {
            return parted;
        }
        for c in &trace.centres {
            let column = super::column_of(c.part);
            if (column % EVERY == 0 || is_near_end(trace, c, column)) && self.is_parted(c) {
                parted.add_around(column, EVERY);
            }
        }
        parted
    }

    /// Whether a flank of the sheet meets another surface than its middle, or is seen where that is not.
    fn is_parted(&self, c: &Candidate) -> bool {
        let source = self.beam.sheet.origin;
        let range = (c.point - source.xyz).norm();
        let flank = c.across * (FLANK * self.renderer.rig.sheet.thickness_m(range) / 2.0);
        let tolerance = 2e-3 + 0.3 * flank.norm();
        [flank, -flank].iter().any(|flank| {
            let place = c.point + flank;
            let way = place - source.xyz;
            let is_lit = self
                .surfaces
                .cast(source, &way, way.norm() + tolerance)
                .is_some_and(|hit| hit.range_m > way.norm() - tolerance);
            (is_lit && !self.surfaces.blocked(place.into(), self.eye.into())) != c.seen
        })
    }

    /// Adds the light of these columns, thin sheet by thin sheet, and gives what is true in them.
    pub fn shine_parts(&self, whole: &Trace, only: &Columns, share: f64, light: &mut super::Light) -> Vec<TrueSight> {
        let ranges = whole.centres.iter().filter(|c| only.has(super::column_of(c.part)));
        let (sum, count) = ranges
            .fold((0.0, 0.0), |(sum, count), c| (sum + (c.point - self.beam.sheet.origin.xyz).norm(), count + 1.0));
        let range = f64::max(sum / f64::max(count, 1.0), 0.1);
        let sigma_rad = self.renderer.rig.sheet.thickness_m(range) / 2.0 / range;
        // Normal weights whose spread with that of the thin sheets is the whole one's.
        let weight = |k: i32| (-(f64::from(k) * STEP).powi(2) / (2.0 * (1.0 - THINNESS * THINNESS))).exp();
        let all: f64 = (-SIDE..=SIDE).map(weight).sum();
        let mut sights: Vec<(TrueSight, bool)> = Vec::new();
        for k in -SIDE..=SIDE {
            let sheet = turned(&self.beam.sheet, f64::from(k) * STEP * sigma_rad);
            let Some(sheet) = sheet else { continue };
            let share_of_sheet = weight(k) / all;
            let view = self.with(Beam { sheet, share: share_of_sheet, thinness: THINNESS, mirror: None });
            let trace = view.trace(Some(only));
            for (part, glimpse) in trace.glimpses() {
                view.add(part, glimpse, share, light);
            }
            sights.extend(trace.seen().map(|c| (c.sight(), k == 0)));
        }
        let full = |column: i32| whole.column(column).iter().map(|c| c.glimpse.electrons).fold(0.0, f64::max);
        merged(sights, full)
    }
}

/// Whether a stripe ends two columns farther: an edge that is steeper than that parts no more than a column or two.
fn is_near_end(trace: &Trace, c: &Candidate, column: i32) -> bool {
    let goes_on = |at: i32| {
        let same =
            |o: &Candidate| o.body == c.body && o.seen == c.seen && (o.glimpse.v - c.glimpse.v).abs() < 4.0 * APART_PX;
        trace.column(at).iter().any(same)
    };
    [-1, 1].iter().any(|side| !goes_on(column + 3 * side) && goes_on(column + 2 * side))
}

/// The sheet tilted about its lateral axis: since its thickness grows with the range, one of its flanks.
fn turned(sheet: &LaserPlane<crate::geometry::World>, angle: f64) -> Option<LaserPlane<crate::geometry::World>> {
    let (sin, cos) = angle.sin_cos();
    let normal: V3 = sheet.plane.normal * cos - sheet.forward * sin;
    let forward = sheet.forward * cos + sheet.plane.normal * sin;
    let plane = Plane::through(Point::from(sheet.origin.xyz), normal)?;
    Some(LaserPlane { plane, forward, ..*sheet })
}

/// One sight for the thin sheets that lie together in a column. The middle one, if it is among them, says where.
fn merged(mut sights: Vec<(TrueSight, bool)>, full: impl Fn(i32) -> f64) -> Vec<TrueSight> {
    sights.sort_by(|(a, _), (b, _)| a.column.cmp(&b.column).then(a.v.total_cmp(&b.v)));
    let together = |(a, _): &(TrueSight, bool), (b, _): &(TrueSight, bool)| {
        a.column == b.column && a.body == b.body && (b.v - a.v).abs() < APART_PX
    };
    let mut out = Vec::new();
    for group in sights.chunk_by(together) {
        let light: f64 = group.iter().map(|(s, _)| f64::from(s.electrons)).sum();
        let mean = group.iter().map(|(s, _)| s.v * f64::from(s.electrons)).sum::<f64>() / light;
        let nearest = group.iter().min_by(|(a, _), (b, _)| (a.v - mean).abs().total_cmp(&(b.v - mean).abs()));
        let middle = group.iter().find(|(_, is_middle)| *is_middle);
        let Some((sight, is_middle)) = middle.or(nearest) else { continue };
        if light >= SHARE_MIN * full(i32::from(sight.column)) {
            let v = if *is_middle { sight.v } else { mean };
            out.push(TrueSight { v, electrons: light as f32, ..*sight });
        }
    }
    out
}
