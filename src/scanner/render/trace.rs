//! Where the stripe crosses the image's columns.
//!
//! Each curve in which the sheet cuts a surface is projected through the calibrated lens and solved for the point that
//! falls on each image column, and on a third of a column to either side: so a stripe that ends within a column leaves its
//! share of light there, beside that of the surface behind. A point counts if the light reaches it and the camera sees it,
//! from the same side of the surface. Thirds are interpolated between the columns beside them where these agree on the
//! same stripe, and solved where they do not; so the shadow of a thing narrower than a column may be missed.

use super::light::Glimpse;
use super::{TrueSight, V3, View, column_of};
use crate::geometry::Point;
use crate::world::{Curve, Cut};

/// Parts of a column that light is gathered from: odd, so that one of them is the column's centre.
pub(super) const PARTS: i32 = 3;
/// Nearest thing that the camera can see [m].
const NEAR_M: f64 = 0.05;

/// A place on a cut that lies on an image column.
pub(super) struct Candidate {
    /// Column times `PARTS`.
    pub part: i32,
    /// Which stretch of which cut, from one turn to the next: it crosses a column at most once.
    stretch: usize,
    pub body: usize,
    pub point: V3,
    /// How far the stripe's place on the surface moves a metre of the sheet's thickness.
    pub across: V3,
    pub glimpse: Glimpse,
    pub seen: bool,
}

/// What of a sheet crosses the image's columns.
pub(super) struct Trace {
    /// The crossings of columns' centres, lit and seen or not, by column, then row.
    pub centres: Vec<Candidate>,
    /// What is seen a third of a column beside the centres.
    between: Vec<(i32, Glimpse)>,
    /// The sheet's cuts with all surfaces, also outside the image.
    pub cuts: Vec<Cut>,
}

/// A set of columns.
#[derive(Clone, Debug, Default)]
pub(super) struct Columns {
    /// First and last column of each run, in order, apart from each other.
    pub runs: Vec<(i32, i32)>,
}

impl Columns {
    pub fn is_empty(&self) -> bool {
        self.runs.is_empty()
    }

    pub fn has(&self, column: i32) -> bool {
        let after = self.runs.partition_point(|run| run.1 < column);
        self.runs.get(after).is_some_and(|run| run.0 <= column)
    }

    /// Adds all columns within `reach` of one that is not left of any added before.
    pub fn add_around(&mut self, column: i32, reach: i32) {
        let run = (column - reach, column + reach);
        match self.runs.last_mut().filter(|last| last.1 + 1 >= run.0) {
            Some(last) => last.1 = last.1.max(run.1),
            None => self.runs.push(run),
        }
    }
}

impl Candidate {
    pub fn sight(&self) -> TrueSight {
        TrueSight {
            column: column_of(self.part) as u16,
            v: self.glimpse.v,
            point: self.point.into(),
            body: self.body as u32,
            electrons: self.glimpse.electrons as f32,
        }
    }
}

impl Trace {
    /// Crossings of columns' centres that are lit and seen.
    pub fn seen(&self) -> impl Iterator<Item = &Candidate> {
        self.centres.iter().filter(|c| c.seen)
    }

    /// All that is seen, with its place in thirds of a column.
    pub fn glimpses(&self) -> impl Iterator<Item = (i32, &Glimpse)> {
        let between = self.between.iter().map(|(part, glimpse)| (*part, glimpse));
        self.seen().map(|c| (c.part, &c.glimpse)).chain(between)
    }

    /// The crossings of one column's centre.
    pub fn column(&self, column: i32) -> &[Candidate] {
        in_part(&self.centres, column * PARTS)
    }
}

/// A crossing of a third of a column that is not solved yet: it lies between these parameters and columns.
struct Crossing {
    part: i32,
    cut: usize,
    stretch: usize,
    from: (f64, f64),
    to: (f64, f64),
}

/// A parameter of a cut and the column it falls on; `None` where the lens sees nothing.
type Knot = Option<(f64, f64)>;

impl View<'_> {
    /// Where the stripe crosses the columns: all of them, or only some.
    pub fn trace(&self, only: Option<&Columns>) -> Trace {
        let cuts = self.cuts();
        let mut clipped = Vec::new();
        cuts.iter().for_each(|cut| self.clip(*cut, 0, &mut clipped));
        let (mut crossings, mut knots, mut stretch) = (Vec::new(), Vec::new(), 0);
        for (index, cut) in clipped.iter().enumerate() {
            self.follow(cut, &mut knots);
            let mut rising = None;
            for pair in knots.windows(2) {
                let now = pair[0].zip(pair[1]).map(|(a, b)| a.1 < b.1);
                stretch += usize::from(now != rising);
                rising = now;
                self.cross_columns((index, stretch), pair[0], pair[1], &mut crossings);
            }
            stretch += 1;
        }
        if let Some(columns) = only {
            crossings.retain(|c| columns.has(column_of(c.part)));
        }
        let solve = |c: &Crossing| {
            let cut = &clipped[c.cut];
            let t = self.solve(cut, c.from, c.to, f64::from(c.part) / f64::from(PARTS))?;
            let (point, across, glimpse) = self.glimpse(cut, t)?;
            Some(Candidate { part: c.part, stretch: c.stretch, body: cut.body, point, across, glimpse, seen: false })
        };
        let mut centres: Vec<_> = crossings.iter().filter(|c| c.part % PARTS == 0).filter_map(solve).collect();
        centres.sort_by(|a, b| {
            a.part.cmp(&b.part).then(a.glimpse.v.total_cmp(&b.glimpse.v)).then(a.stretch.cmp(&b.stretch))
        });
        for c in &mut centres {
            c.seen = self.clear(&c.point);
            if c.seen {
                self.speckled(c);
            }
        }
        let mut between = Vec::new();
        for crossing in crossings.iter().filter(|c| c.part % PARTS != 0) {
            let glimpse = match between_columns(&centres, crossing) {
                Some(same) => same,
                None => solve(crossing).filter(|c| self.reached(&centres, c)).map(|mut c| {
                    let own = in_part(&centres, column_of(c.part) * PARTS).iter().find(|o| o.stretch == c.stretch);
                    match own.filter(|own| own.seen) {
                        Some(own) => c.glimpse.grain = own.glimpse.grain,
                        None => self.speckled(&mut c),
                    }
                    c.glimpse
                }),
            };
            between.extend(glimpse.map(|glimpse| (crossing.part, glimpse)));
        }
        Trace { centres, between, cuts }
    }

    /// The curves in which the sheet cuts the world, as far as its light can get.
    fn cuts(&self) -> Vec<Cut> {
        let mut cuts = Vec::new();
        self.surfaces.cut(&self.beam.sheet, self.renderer.params.reach_m, &mut cuts);
        let Some(mirror) = &self.beam.mirror else { return cuts };
        let mut kept = Vec::new();
        cuts.into_iter().for_each(|cut| mirror.clip(cut, 0, &mut kept));
        kept
    }

    /// Gives a crossing the speckle of its place.
    fn speckled(&self, c: &mut Candidate) {
        let range_m = (c.point - self.eye).norm();
        c.glimpse.grain = self.renderer.speckle.at(self.seed, c.body, &c.point, range_m, c.glimpse.sigma_px);
    }

    /// Whether the laser reaches a point and the camera sees it.
    fn clear(&self, point: &V3) -> bool {
        let at = Point::from(*point);
        let lit = match &self.beam.mirror {
            None => !self.surfaces.blocked_to_light(self.beam.sheet.origin, at),
            Some(mirror) => mirror.lights(self.surfaces, point),
        };
        lit && !self.surfaces.blocked_to_light(at, self.eye.into())
    }

    /// The same for a third of a column, asked for only where the columns beside it do not agree.
    fn reached(&self, centres: &[Candidate], this: &Candidate) -> bool {
        let left = this.part.div_euclid(PARTS) * PARTS;
        let beside = |part: i32| {
            let apart = |c: &Candidate| (c.glimpse.v - this.glimpse.v).abs();
            let same = in_part(centres, part).iter().filter(|c| c.body == this.body && apart(c) < 1.5);
            same.min_by(|a, b| apart(a).total_cmp(&apart(b))).map(|c| c.seen)
        };
        match (beside(left), beside(left + PARTS)) {
            (Some(a), Some(b)) if a == b => a,
            _ => self.clear(&this.point),
        }
    }

    /// Clips a cut to what the camera may see, one bound of the field after the other.
    fn clip(&self, cut: Cut, bound: usize, out: &mut Vec<Cut>) {
        let [left, right, top, bottom] = self.renderer.field;
        let inward = [
            V3::new(0.0, 0.0, 1.0),
            V3::new(1.0, 0.0, -left),
            V3::new(-1.0, 0.0, right),
            V3::new(0.0, 1.0, -top),
            V3::new(0.0, -1.0, bottom),
        ];
        let Some(inward) = inward.get(bound) else { return out.push(cut) };
        let normal = self.turn.tr_mul(inward);
        let offset = normal.dot(&self.eye) + if bound == 0 { NEAR_M } else { 0.0 };
        cut.clipped(&normal, offset, |part| self.clip(part, bound + 1, out));
    }

    /// Where a point of the world falls in the image.
    pub fn project(&self, point: &V3) -> Option<[f64; 2]> {
        self.renderer.rig.camera.project(&(self.turn * (point - self.eye)))
    }

    fn column(&self, cut: &Cut, t: f64) -> Option<f64> {
        self.project(&cut.curve.at(t)).map(|[u, _]| u)
    }

    /// Parameters along a cut between which its column grows or falls steadily; a gap where the lens sees nothing.
    fn follow(&self, cut: &Cut, knots: &mut Vec<Knot>) {
        let (t0, t1) = cut.curve.span();
        let steps = match cut.curve {
            Curve::Segment { a, b } => match (self.project(&a), self.project(&b)) {
                (Some(a), Some(b)) => ((a[0] - b[0]).hypot(a[1] - b[1]) / 24.0).ceil().clamp(1.0, 32.0),
                _ => 32.0,
            },
            Curve::Arc { .. } => ((t1 - t0) * 8.0).ceil().clamp(4.0, 52.0),
        } as i32;
        let at = |i: i32| if i == steps { t1 } else { t0 + (t1 - t0) * f64::from(i) / f64::from(steps) };
        knots.clear();
        knots.extend((0..=steps).map(|i| self.column(cut, at(i)).map(|u| (at(i), u))));
        for i in 1..knots.len() - 1 {
            let (Some(a), Some(b), Some(c)) = (knots[i - 1], knots[i], knots[i + 1]) else { continue };
            if (b.1 - a.1) * (c.1 - b.1) < 0.0 {
                knots[i] = Some(self.turning_point(cut, a.0, b, c.0));
            }
        }
    }

    /// The column farthest to one side between `low` and `high`, by golden sections around `middle`.
    fn turning_point(&self, cut: &Cut, mut low: f64, middle: (f64, f64), mut high: f64) -> (f64, f64) {
        const GOLDEN: f64 = 0.618_033_988_749_895;
        let rising = self.column(cut, low).is_some_and(|u| u < middle.1);
        let height = |t: f64| self.column(cut, t).map_or(f64::NEG_INFINITY, |u| if rising { u } else { -u });
        let (mut a, mut b) = (high - GOLDEN * (high - low), low + GOLDEN * (high - low));
        let (mut fa, mut fb) = (height(a), height(b));
        for _ in 0..40 {
            if fa > fb {
                (high, b, fb) = (b, a, fa);
                a = high - GOLDEN * (high - low);
                fa = height(a);
            } else {
                (low, a, fa) = (a, b, fb);
                b = low + GOLDEN * (high - low);
                fb = height(b);
            }
        }
        let t = (low + high) / 2.0;
        self.column(cut, t).map_or(middle, |u| (t, u))
    }

    /// Adds a crossing for each third of a column between two knots. The lower end belongs to the stretch, the upper to
    /// the next one: where two cuts share a corner that falls on a column, one of them has it.
    fn cross_columns(&self, (cut, stretch): (usize, usize), from: Knot, to: Knot, out: &mut Vec<Crossing>) {
        let (Some(from), Some(to)) = (from, to) else { return };
        let (low, high) = (from.1.min(to.1), from.1.max(to.1));
        let parts = f64::from(PARTS);
        let last = (self.renderer.rig.camera.width as i32 - 1) * PARTS + PARTS / 2;
        let mut part = (low * parts).ceil().max(f64::from(-(PARTS / 2))) as i32;
        while part <= last && f64::from(part) / parts < high {
            out.push(Crossing { part, cut, stretch, from, to });
            part += 1;
        }
    }

    /// The parameter at which the cut crosses column `u`, to 1e-9 px: regula falsi, the Illinois way.
    fn solve(&self, cut: &Cut, a: (f64, f64), b: (f64, f64), u: f64) -> Option<f64> {
        let ((mut ta, mut fa), (mut tb, mut fb)) = ((a.0, a.1 - u), (b.0, b.1 - u));
        if fa == 0.0 {
            return Some(ta);
        }
        for _ in 0..100 {
            let t = (ta * fb - tb * fa) / (fb - fa);
            let f = self.column(cut, t)? - u;
            if f.abs() < 1e-9 {
                return Some(t);
            }
            if (f > 0.0) != (fb > 0.0) {
                (ta, fa) = (tb, fb);
            } else {
                fa /= 2.0;
            }
            (tb, fb) = (t, f);
        }
        None
    }
}

/// The candidates of one column's centre.
fn in_part(centres: &[Candidate], part: i32) -> &[Candidate] {
    let first = centres.partition_point(|c| c.part < part);
    let count = centres[first..].partition_point(|c| c.part == part);
    &centres[first..first + count]
}

/// What a third of a column gets of a stripe that both columns beside it see, or neither: `None` if that is not so.
fn between_columns(centres: &[Candidate], crossing: &Crossing) -> Option<Option<Glimpse>> {
    let left = crossing.part.div_euclid(PARTS) * PARTS;
    let same = |part: i32| in_part(centres, part).iter().find(|c| c.stretch == crossing.stretch);
    let (a, b) = (same(left)?, same(left + PARTS)?);
    if a.seen != b.seen {
        return None;
    }
    let share = f64::from(crossing.part - left) / f64::from(PARTS);
    let mix = |a: f64, b: f64| a + (b - a) * share;
    Some(a.seen.then(|| Glimpse {
        grain: if share < 0.5 { a.glimpse.grain } else { b.glimpse.grain },
        v: mix(a.glimpse.v, b.glimpse.v),
        sigma_px: mix(a.glimpse.sigma_px, b.glimpse.sigma_px),
        electrons: mix(a.glimpse.electrons, b.glimpse.electrons),
    }))
}
