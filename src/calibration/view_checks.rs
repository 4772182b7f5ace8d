//! Which views of a board are taken: what is refused before a camera is sought, and what is left out while it is.

use nalgebra::Vector3;

use super::report::Rejected;
use super::tsai::Shape;
use super::views::View;
use super::zhang::misfit;
use crate::fault::{Fault, Result};

/// Most views that are taken.
const VIEWS_MAX: usize = 100;
/// Marks that a view must have.
const MARKS_MIN: usize = 6;

/// Refuses views that are none; the views and how the marks lie on the board.
pub(super) fn checked(views: &[View]) -> Result<(Vec<View>, Shape)> {
    if views.len() < 2 {
        let expected = "at least 2 views at different tilts, better 6: one view of a flat board does not give a camera";
        return Err(Fault::new("board", format!("seen {} times", views.len()), expected));
    }
    if views.len() > VIEWS_MAX {
        return Err(Fault::new("views", views.len(), format!("at most {VIEWS_MAX}")));
    }
    for view in views {
        let named = |fault: Fault| fault.in_file(&view.name);
        for mark in &view.marks {
            let numbers = [mark.target.xyz.x, mark.target.xyz.y, mark.target.xyz.z, mark.u_px, mark.v_px];
            if let Some(bad) = numbers.iter().find(|n| !n.is_finite()) {
                return Err(named(Fault::new(format!("mark {}", mark.line), bad, "finite numbers")));
            }
        }
        if view.marks.len() < MARKS_MIN {
            return Err(named(Fault::new("marks", view.marks.len(), format!("at least {MARKS_MIN} in each view"))));
        }
        let own: Vec<Vector3<f64>> = view.marks.iter().map(|m| m.target.xyz).collect();
        Shape::of(&own).at_least_flat().map_err(named)?;
    }
    let all: Vec<Vector3<f64>> = views.iter().flat_map(|v| v.marks.iter().map(|m| m.target.xyz)).collect();
    let shape = Shape::of(&all);
    if !shape.is_flat() {
        let found = format!("marks {:.3} mm RMS off one plane", shape.extents_m[2] * 1e3);
        return Err(Fault::new("board", found, "a flat board (a block with depth has its own method)"));
    }
    if !(1e-3..10.0).contains(&shape.extents_m[0]) {
        let found = format!("{:.6} m RMS across", shape.extents_m[0]);
        return Err(Fault::new("board", found, "1 mm to 10 m: metres and millimetres mixed?"));
    }
    Ok((views.to_vec(), shape))
}

/// Leaves out the views whose pixels do not lie as the marks of a plane do.
pub(super) fn ordered(views: Vec<View>, shape: &Shape) -> Result<(Vec<View>, Vec<Rejected>)> {
    const MISFIT_MAX: f64 = 0.05;
    let (mut kept, mut rejected) = (Vec::with_capacity(views.len()), Vec::new());
    for view in views {
        let misfit = misfit(&view.marks, shape).map_err(|fault| fault.in_file(&view.name))?;
        if misfit < MISFIT_MAX {
            kept.push(view);
        } else {
            let why = format!("its pixels are not a view of these marks (off by {:.0} % of the board)", misfit * 100.0);
            rejected.push(Rejected { what: view.name, why });
        }
    }
    if kept.len() < 2 {
        let found = format!("{} views of which {} fit the board", kept.len() + rejected.len(), kept.len());
        return Err(Fault::new("views", found, "pixels that belong to the marks beside them"));
    }
    Ok((kept, rejected))
}

/// Drops the marks that are off, and views that lose more than half of theirs.
pub(super) fn left(views: Vec<View>, off: Vec<Vec<(usize, f64)>>, rejected: &mut Vec<Rejected>) -> Vec<View> {
    let mut kept = Vec::with_capacity(views.len());
    for (mut view, off) in views.into_iter().zip(off) {
        if off.len() * 2 > view.marks.len() || view.marks.len() - off.len() < MARKS_MIN {
            let why = format!("{} of its {} marks do not fit", off.len(), view.marks.len());
            rejected.push(Rejected { what: view.name, why });
            continue;
        }
        for &(i, size) in off.iter().rev() {
            let mark = view.marks.remove(i);
            let what = format!("{}: mark {}", view.name, mark.line);
            rejected.push(Rejected { what, why: format!("{size:.2} px from where the other marks put it") });
        }
        kept.push(view);
    }
    kept
}
