//! What is true of the plan view's cells, and how good a layer is against it.

use serde::Serialize;

use crate::fault::Result;
use crate::geometry::Point;
use crate::maps::{Layers, PlanParams, PlanView};
use crate::world::{Scene, Surfaces};

/// From where the ground is looked for, downwards [m].
const SKY_M: f64 = 1e3;
/// A surface on the edge between two cells is in the one with the higher coordinates [m].
const EDGE_M: f64 = 1e-6;
/// What is farther from the robot's way than the ranges that are mapped is not asked for [m].
const REACH_M: f64 = 5.0;
/// Nothing that is mapped is farther from the robot's way [m].
const MARGIN_M: f64 = 6.0;
/// Most cells of a truth; of a larger one only what the layers have.
const CELLS_MAX: f64 = 4e7;

const UNKNOWN: i8 = -1;
const FREE: i8 = 0;
const OCCUPIED: i8 = 100;

/// How good a layer is; rates of nothing are null.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct LayerVerdict {
    /// Share of the occupied cells with a true surface within one cell, also diagonally.
    pub precision: f64,
    /// Share of the cells with a surface in sight of the robot's way that have an occupied one as near.
    pub recall: f64,
    /// Intersection over union that follows from both, 1/(1/precision + 1/recall − 1).
    pub iou: f64,
    /// Share of the free cells to which the robot cannot roll: surfaces, holes, inside bodies, behind walls.
    pub free_space_error: f64,
    /// Share of the truly free cells in sight of the robot's way that are free.
    pub free_found: f64,
    /// Share of them that are occupied, with no surface within one cell.
    pub free_blocked: f64,
}

/// How good laser, ultrasound and both together are.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct LayerVerdicts {
    /// The laser's view.
    pub laser: LayerVerdict,
    /// The ultrasonic layer.
    pub ultrasonic: LayerVerdict,
    /// Both.
    pub fused: LayerVerdict,
}

/// What is true of the cells of a view.
#[derive(Clone, Debug, PartialEq)]
pub struct PlanTruth {
    /// Free: the robot can roll there from its way. Occupied: from there it hits a surface between the heights of its body, or
    /// a step of the ground higher than it clears. Unknown: inside bodies, on steps, in holes, behind walls. Its cells are
    /// those around the robot's way, whatever was mapped of them.
    pub view: PlanView,
    /// Whether a straight line leads to each cell from the robot's way, past occupied ones, no longer than 5 m.
    in_sight: Vec<bool>,
    /// Whether a surface lies over each cell at the height of the robot's body, also where the robot cannot come: the top of a
    /// box, a wall behind a wall.
    surface: Vec<bool>,
}

/// In what [`PlanTruth::of`] returns: a surface where the robot cannot come.
const BEYOND: i8 = 50;

impl PlanTruth {
    /// The truth around the robot's way, in cells of a grid that a view has; `way_m` are places where the robot was.
    ///
    /// # Errors
    /// What [`Surfaces::new`] refuses.
    pub fn new(
        like: &PlanView,
        scene: &Scene,
        surfaces: &Surfaces,
        plan: &PlanParams,
        way_m: &[[f64; 2]],
    ) -> Result<Self> {
        let ground = scene.bodies.iter().filter(|body| body.ground).cloned().collect();
        let ground = Surfaces::new(&Scene { bodies: ground, ..scene.clone() })?;
        let blank = around(like, way_m);
        let flood = Flood { view: blank, surfaces, ground, plan };
        let start_m = way_m.first().and_then(|at| index(&flood.view, *at)).map_or(0.0, |at| flood.floor_m(at));
        let over: Vec<bool> = (0..flood.view.cells.len()).map(|at| flood.is_hit(at, start_m)).collect();
        let view = flood.from(way_m);
        let surface = over.iter().zip(&view.cells).map(|(hit, cell)| *cell == OCCUPIED || *cell == UNKNOWN && *hit);
        let surface = surface.collect();
        let in_sight = seen_from(&view, way_m);
        Ok(Self { view, in_sight, surface })
    }

    /// Judges all three layers, whose cells are of the same grid.
    pub fn judge(&self, layers: &Layers) -> LayerVerdicts {
        LayerVerdicts {
            laser: self.verdict(&framed(&layers.laser, &self.view)),
            ultrasonic: self.verdict(&framed(&layers.ultrasonic, &self.view)),
            fused: self.verdict(&framed(&layers.fused, &self.view)),
        }
    }

    /// The truth of the cells that a view has, with 50 for surfaces where the robot cannot come.
    pub fn of(&self, view: &PlanView) -> PlanView {
        let cells = self.view.cells.iter().zip(&self.surface);
        let cells = cells.map(|(cell, surface)| if *cell == UNKNOWN && *surface { BEYOND } else { *cell }).collect();
        framed(&PlanView { cells, ..self.view.clone() }, view)
    }

    /// Judges one.
    fn verdict(&self, layer: &PlanView) -> LayerVerdict {
        let mut right = Share::default(); // of the occupied cells
        let mut found = Share::default(); // of the surfaces in sight
        let mut wrong = Share::default(); // of the free cells
        let (mut open, mut blocked) = (Share::default(), Share::default()); // of the free cells in sight
        let cells = self.view.cells.iter().zip(&layer.cells).zip(&self.in_sight);
        for (at, ((truth, said), in_sight)) in cells.enumerate() {
            let beside_surface = near(&self.view, at, |at| self.surface[at]);
            match *said {
                OCCUPIED => right.add(beside_surface),
                FREE => wrong.add(*truth != FREE),
                _ => {}
            }
            if *in_sight && *truth == OCCUPIED {
                found.add(near(layer, at, |at| layer.cells[at] == OCCUPIED));
            } else if *in_sight && *truth == FREE {
                open.add(*said == FREE);
                blocked.add(*said == OCCUPIED && !beside_surface);
            }
        }
        let (precision, recall) = (right.value(), found.value());
        LayerVerdict {
            precision,
            recall,
            // Nothing right is 0, not nothing measured.
            iou: match (right.yes, found.yes, right.all + found.all) {
                (0, _, 1..) | (_, 0, 1..) => 0.0,
                _ => 1.0 / (1.0 / precision + 1.0 / recall - 1.0),
            },
            free_space_error: wrong.value(),
            free_found: open.value(),
            free_blocked: blocked.value(),
        }
    }
}

/// How many of how many.
#[derive(Clone, Copy, Default)]
struct Share {
    yes: u64,
    all: u64,
}

impl Share {
    fn add(&mut self, yes: bool) {
        self.yes += u64::from(yes);
        self.all += 1;
    }

    /// NaN of nothing.
    fn value(self) -> f64 {
        self.yes as f64 / self.all as f64
    }
}

/// Unknown cells of a view's grid around the robot's way.
fn around(like: &PlanView, way_m: &[[f64; 2]]) -> PlanView {
    let side = like.resolution_m;
    let cell = |axis: usize, at: f64| ((at - like.origin_m[axis]) / side).floor();
    let ends = |axis: usize| {
        let of = way_m.iter().map(|at| at[axis]);
        let (low, high) = of.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), at| (low.min(at), high.max(at)));
        [cell(axis, low - MARGIN_M), cell(axis, high + MARGIN_M)]
    };
    let [x, y] = [ends(0), ends(1)];
    let [width, height] = [x, y].map(|[low, high]| high - low + 1.0);
    if !(width * height <= CELLS_MAX && width >= 1.0) {
        return PlanView { cells: vec![UNKNOWN; like.cells.len()], ..like.clone() };
    }
    let origin_m = [like.origin_m[0] + x[0] * side, like.origin_m[1] + y[0] * side];
    let (width, height) = (width as usize, height as usize);
    PlanView { resolution_m: side, origin_m, width, height, cells: vec![UNKNOWN; width * height] }
}

/// A view in the frame of another one of the same grid; unknown where it has no cells.
fn framed(view: &PlanView, frame: &PlanView) -> PlanView {
    let off: [i64; 2] =
        std::array::from_fn(|axis| ((frame.origin_m[axis] - view.origin_m[axis]) / frame.resolution_m).round() as i64);
    let mut cells = vec![UNKNOWN; frame.cells.len()];
    for (at, cell) in cells.iter_mut().enumerate() {
        let (x, y) = ((at % frame.width) as i64 + off[0], (at / frame.width) as i64 + off[1]);
        if (0..view.width as i64).contains(&x) && (0..view.height as i64).contains(&y) {
            *cell = view.cells[y as usize * view.width + x as usize];
        }
    }
    PlanView { cells, ..frame.clone() }
}

/// The lower left corner of a cell [m].
fn corner(view: &PlanView, at: usize) -> [f64; 2] {
    let (x, y) = (at % view.width, at / view.width);
    [view.origin_m[0] + x as f64 * view.resolution_m, view.origin_m[1] + y as f64 * view.resolution_m]
}

/// The cell over a place [m].
fn index(view: &PlanView, place_m: [f64; 2]) -> Option<usize> {
    let x = ((place_m[0] - view.origin_m[0]) / view.resolution_m).floor();
    let y = ((place_m[1] - view.origin_m[1]) / view.resolution_m).floor();
    let within = x >= 0.0 && y >= 0.0 && x < view.width as f64 && y < view.height as f64;
    within.then(|| y as usize * view.width + x as usize)
}

/// Whether this is so of a cell of a view or one of its eight neighbours.
fn near(view: &PlanView, at: usize, is_so: impl Fn(usize) -> bool) -> bool {
    let (x, y) = (at % view.width, at / view.width);
    let rows = y.saturating_sub(1)..(y + 2).min(view.height);
    rows.into_iter().any(|row| {
        let columns = x.saturating_sub(1)..(x + 2).min(view.width);
        columns.into_iter().any(|column| is_so(row * view.width + column))
    })
}

/// Follows the ground from where the robot was, as far as it can roll.
struct Flood<'a> {
    view: PlanView,
    surfaces: &'a Surfaces,
    /// The ground alone.
    ground: Surfaces,
    plan: &'a PlanParams,
}

impl Flood<'_> {
    fn from(mut self, way_m: &[[f64; 2]]) -> PlanView {
        let starts = way_m.iter().filter_map(|at| index(&self.view, *at));
        let mut open: Vec<(usize, f64)> = starts.map(|at| (at, self.floor_m(at))).collect();
        while let Some((at, from_m)) = open.pop() {
            if self.view.cells[at] != UNKNOWN {
                continue;
            }
            let floor_m = self.floor_m(at);
            let climbs = (floor_m - from_m).abs() <= self.plan.clearance_m;
            // A step up is hit; where the ground falls away nothing is.
            if !climbs && floor_m < from_m {
                continue;
            }
            if !climbs || self.is_hit(at, floor_m) {
                self.view.cells[at] = OCCUPIED;
                continue;
            }
            self.view.cells[at] = FREE;
            let (width, height) = (self.view.width, self.view.height);
            let (x, y) = (at % width, at / width);
            let beside = [
                (x > 0).then(|| at - 1),
                (x + 1 < width).then_some(at + 1),
                (y > 0).then(|| at - width),
                (y + 1 < height).then_some(at + width),
            ];
            open.extend(beside.into_iter().flatten().map(|next| (next, floor_m)));
        }
        self.view
    }

    /// The height of the ground in the middle of a cell; 0 where there is none.
    fn floor_m(&self, at: usize) -> f64 {
        let [x, y] = corner(&self.view, at).map(|c| c + self.view.resolution_m / 2.0);
        let hit = self.ground.cast(Point::new(x, y, SKY_M), &-nalgebra::Vector3::z(), 2.0 * SKY_M);
        hit.map_or(0.0, |hit| SKY_M - hit.range_m)
    }

    fn is_hit(&self, at: usize, floor_m: f64) -> bool {
        let [x, y] = corner(&self.view, at).map(|c| c - EDGE_M);
        let side = self.view.resolution_m;
        let heights = [self.plan.clearance_m, self.plan.height_m].map(|height_m| floor_m + height_m);
        self.surfaces.touches([x, y, heights[0]], [x + side, y + side, heights[1]])
    }
}

/// Which cells straight lines reach, rays half a cell apart at their ends.
fn seen_from(view: &PlanView, way_m: &[[f64; 2]]) -> Vec<bool> {
    let mut seen = vec![false; view.cells.len()];
    let step_m = view.resolution_m / 2.0;
    let rays = (std::f64::consts::TAU * REACH_M / step_m).ceil() as u32;
    let steps = (REACH_M / step_m) as u32;
    for [x, y] in way_m {
        for ray in 0..rays {
            let (sin, cos) = (f64::from(ray) / f64::from(rays) * std::f64::consts::TAU).sin_cos();
            for step in 0..=steps {
                let along = f64::from(step) * step_m;
                let Some(at) = index(view, [x + along * cos, y + along * sin]) else { break };
                seen[at] = true;
                if view.cells[at] == OCCUPIED {
                    break;
                }
            }
        }
    }
    seen
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::{Body, Material, Motion, Shape};
    use nalgebra::Isometry3;

    /// A room of 2 x 1 m with a box in it, on a floor.
    fn scene() -> Scene {
        let body = |name: &str, size: [f64; 3], at: [f64; 3]| Body {
            name: name.into(),
            shape: Shape::Box { size: size.into() },
            pose: Isometry3::translation(at[0], at[1], at[2]),
            material: Material::default(),
            motion: Motion::Static,
            ground: false,
        };
        let floor = Body {
            shape: Shape::Plane,
            pose: Isometry3::identity(),
            ground: true,
            ..body("floor", [1.0; 3], [0.0; 3])
        };
        let bodies = vec![
            floor,
            body("east", [0.1, 1.2, 1.0], [1.05, 0.0, 0.5]),
            body("west", [0.1, 1.2, 1.0], [-1.05, 0.0, 0.5]),
            body("north", [2.0, 0.1, 1.0], [0.0, 0.55, 0.5]),
            body("south", [2.0, 0.1, 1.0], [0.0, -0.55, 0.5]),
            body("block", [0.4, 0.4, 2.0], [0.5, 0.0, 1.0]),
            Body { ground: true, ..body("step", [0.5, 0.1, 0.1], [-0.75, 0.45, 0.05]) },
            body("lamp", [0.2, 0.2, 0.2], [-0.5, 0.0, 1.4]),
        ];
        Scene { bodies, ..Scene::default() }
    }

    fn blank() -> PlanView {
        let (width, height) = (48, 28);
        PlanView { resolution_m: 0.05, origin_m: [-1.2, -0.7], width, height, cells: vec![UNKNOWN; width * height] }
    }

    fn truth() -> PlanTruth {
        let scene = scene();
        let surfaces = Surfaces::new(&scene).unwrap();
        PlanTruth::new(&blank(), &scene, &surfaces, &PlanParams::default(), &[[-0.5, 0.0]]).unwrap()
    }

    fn cell(view: &PlanView, x: f64, y: f64) -> i8 {
        view.cells[index(view, [x, y]).unwrap()]
    }

    #[test]
    fn truth_is_surfaces_and_the_space_around_the_robot() {
        let truth = truth();
        let view = &truth.view;
        assert_eq!([cell(view, 1.02, 0.1), cell(view, 0.31, 0.01), cell(view, -0.3, 0.52)], [OCCUPIED; 3]);
        assert_eq!(
            [cell(view, -0.5, 0.0), cell(view, 0.9, 0.0), cell(view, 0.5, 0.4)],
            [FREE; 3],
            "also behind the block"
        );
        assert_eq!([cell(view, 0.5, 0.0), cell(view, 1.18, 0.0), cell(view, 0.0, 0.68)], [UNKNOWN; 3]);
        assert_eq!([cell(view, -0.8, 0.38), cell(view, -0.8, 0.42)], [FREE, OCCUPIED], "not up the step");
        assert_eq!(cell(view, -0.8, 0.47), UNKNOWN, "on the step");
        let seen = |x: f64, y: f64| truth.in_sight[index(view, [x, y]).unwrap()];
        assert!(seen(0.31, 0.01) && seen(-0.98, 0.0) && !seen(0.9, 0.0) && !seen(0.69, 0.01));
    }

    #[test]
    fn a_perfect_layer_is_perfect_and_each_mistake_shows_in_its_rate() {
        let truth = truth();
        let perfect = truth.verdict(&truth.view);
        assert_eq!(
            perfect,
            LayerVerdict {
                precision: 1.0,
                recall: 1.0,
                iou: 1.0,
                free_space_error: 0.0,
                free_found: 1.0,
                free_blocked: 0.0
            }
        );
        let nothing = truth.verdict(&framed(&blank(), &truth.view));
        assert!(nothing.precision.is_nan() && nothing.free_space_error.is_nan());
        assert_eq!((nothing.recall, nothing.free_found, nothing.iou), (0.0, 0.0, 0.0));
        // One cell of a wall called free, one in the open called occupied.
        let mut layer = truth.view.clone();
        let free = layer.cells.iter().filter(|cell| **cell == FREE).count() as f64;
        let [wall, open] = [[1.02, 0.1], [-0.5, 0.2]].map(|at| index(&layer, at).unwrap());
        (layer.cells[wall], layer.cells[open]) = (FREE, OCCUPIED);
        let verdict = truth.verdict(&layer);
        assert!((verdict.free_space_error - 1.0 / free).abs() < 1e-9, "{verdict:?}");
        assert!(verdict.precision < 1.0 && verdict.free_blocked > 0.0 && verdict.recall == 1.0, "{verdict:?}");
        assert!(verdict.iou < 1.0);
        // The top of the step is a surface too, and was seen from above; within the tall block is none.
        let said = |x: f64, y: f64| {
            let mut layer = truth.view.clone();
            let at = index(&layer, [x, y]).unwrap();
            layer.cells[at] = OCCUPIED;
            truth.verdict(&layer).precision
        };
        assert_eq!((cell(&truth.of(&layer), -0.7, 0.47), said(-0.7, 0.47)), (BEYOND, 1.0));
        assert!(cell(&truth.of(&layer), 0.5, 0.0) == UNKNOWN && said(0.5, 0.0) < 1.0);
        // What is claimed behind a wall is wrong, free or not.
        let mut behind = truth.view.clone();
        behind.cells[index(&layer, [1.25, 0.0]).unwrap()] = OCCUPIED;
        assert!(truth.verdict(&behind).precision < 1.0);
        behind.cells[index(&layer, [1.25, 0.0]).unwrap()] = FREE;
        let verdict = truth.verdict(&behind);
        assert!(
            (verdict.free_space_error - 1.0 / (free + 1.0)).abs() < 1e-9 && verdict.precision == 1.0,
            "{verdict:?}"
        );
    }

    #[test]
    fn the_verdict_on_a_layer_does_not_depend_on_the_size_of_the_maps() {
        let truth = truth();
        let part = {
            let low = index(&truth.view, [-0.6, -0.3]).unwrap();
            let (x, y) = (low % truth.view.width, low / truth.view.width);
            let origin_m = corner(&truth.view, low);
            let rows = (0..10).flat_map(|row| (0..12).map(move |column| (y + row) * truth.view.width + x + column));
            let cells = rows.map(|at| truth.view.cells[at]).collect();
            PlanView { origin_m, width: 12, height: 10, cells, ..truth.view.clone() }
        };
        let whole = framed(&part, &truth.view);
        assert_eq!(truth.of(&part), part);
        let layers = |view: &PlanView| Layers { laser: view.clone(), ultrasonic: view.clone(), fused: view.clone() };
        let (small, large) = (truth.judge(&layers(&part)), truth.judge(&layers(&whole)));
        assert_eq!(small.laser.free_found, large.laser.free_found);
        assert!(small.laser.free_found > 0.0 && small.laser.free_found < 1.0 && small.fused.recall == 0.0);
    }
}
