//! The poses of an SDF world: what a `<pose>` says, and relative to what.

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};
use roxmltree::Node;

use super::super::shapes::REACH_M;
use super::super::xml::{child, elements, fault, floats, line_of, tag, trimmed};
use super::{DEPTH_MAX, Loader};
use crate::fault::{Result, number_within};

/// The numbers of a `<pose>`: x y z roll pitch yaw, or x y z and a quaternion. An empty one is no pose.
pub(super) fn pose_numbers(pose: Node) -> Result<Isometry3<f64>> {
    let numbers = floats(pose)?;
    let degrees = matches!(pose.attribute("degrees").map(str::trim), Some("1" | "true"));
    let quaternion = match pose.attribute("rotation_format").map(str::trim) {
        None | Some("" | "euler_rpy") => false,
        Some("quat_xyzw") => true,
        Some(other) => {
            return Err(fault(pose, "rotation_format", format!("`{other}`"), "`euler_rpy` or `quat_xyzw`"));
        }
    };
    let turn = match (numbers.as_slice(), quaternion) {
        ([], _) => return Ok(Isometry3::identity()),
        ([_, _, _, roll, pitch, yaw], false) => {
            let unit = if degrees { 1.0_f64.to_radians() } else { 1.0 };
            UnitQuaternion::from_euler_angles(roll * unit, pitch * unit, yaw * unit)
        }
        ([_, _, _, x, y, z, w], true) => UnitQuaternion::try_new(Quaternion::new(*w, *x, *y, *z), 1e-9)
            .ok_or_else(|| fault(pose, "pose", "a quaternion of length 0", "a quaternion"))?,
        _ => {
            let expected = if quaternion { "7 numbers: x y z qx qy qz qw" } else { "6 numbers: x y z roll pitch yaw" };
            return Err(fault(pose, "pose", format!("{} numbers", numbers.len()), expected));
        }
    };
    let [x, y, z] = [numbers[0], numbers[1], numbers[2]];
    for coordinate in [x, y, z] {
        number_within("pose", coordinate, -REACH_M, REACH_M).map_err(|fault| fault.at_line(line_of(pose)))?;
    }
    Ok(Isometry3::from_parts(Translation3::new(x, y, z), turn))
}

impl Loader {
    /// Where `node` is in `scope`, the world or model that holds it. Without a scope only its own pose counts.
    pub(super) fn pose_within(&mut self, node: Node, scope: Option<Node>, depth: usize) -> Result<Isometry3<f64>> {
        if depth > DEPTH_MAX {
            return Err(fault(
                node,
                "relative_to",
                "frames relative to one another in a circle",
                "a frame to start from",
            ));
        }
        if depth == 0 {
            self.list_pose_attributes(node);
        }
        let pose = node_pose(node);
        let own = pose.map_or(Ok(Isometry3::identity()), pose_numbers)?;
        let reference = pose.and_then(|pose| relative_to(pose, "relative_to"));
        let reference = reference.or_else(|| relative_to(node, "attached_to").filter(|_| tag(node) == "frame"));
        let Some(name) = reference else { return Ok(own) };
        let base = match scope {
            Some(scope) => self.frame(name, scope, depth)?,
            None => {
                self.absent_frame(name);
                None
            }
        };
        Ok(base.unwrap_or_else(Isometry3::identity) * own)
    }

    /// Where the frame called `name` is in `scope`; `None` if it is not understood (and listed).
    pub(super) fn frame(&mut self, name: &str, scope: Node, depth: usize) -> Result<Option<Isometry3<f64>>> {
        if name == "__model__" || (name == "world" && tag(scope) == "world") {
            return Ok(Some(Isometry3::identity()));
        }
        let is_frame = |node: &Node| matches!(tag(*node), "link" | "model" | "include" | "frame");
        match elements(scope).filter(is_frame).find(|node| reference_name(*node).as_deref() == Some(name)) {
            Some(node) => self.pose_within(node, Some(scope), depth + 1).map(Some),
            None => {
                self.absent_frame(name);
                Ok(None)
            }
        }
    }

    fn absent_frame(&mut self, name: &str) {
        self.absent(format!("pose relative to `{name}`: taken as relative to its parent"));
    }

    pub(super) fn list_pose_attributes(&mut self, node: Node) {
        let Some(pose) = node_pose(node) else { return };
        // `frame` of old versions never had an effect in Gazebo.
        let known = |name: &str| matches!(name, "relative_to" | "degrees" | "rotation_format");
        for attribute in pose.attributes().filter(|a| !known(a.name()) && !a.value().trim().is_empty()) {
            self.absent(format!("attribute `{}` of <pose>", attribute.name()));
        }
    }
}

/// The `<pose>` of an element.
pub(super) fn node_pose<'a, 'i>(node: Node<'a, 'i>) -> Option<Node<'a, 'i>> {
    child(node, "pose")
}

/// The frame an attribute names, if it names one.
pub(super) fn relative_to<'a>(node: Node<'a, '_>, attribute: &str) -> Option<&'a str> {
    node.attribute(attribute).map(str::trim).filter(|name| !name.is_empty())
}

/// The name that others refer to it by: an include has it as an element.
fn reference_name(node: Node) -> Option<String> {
    if tag(node) == "include" { child(node, "name").map(trimmed) } else { node.attribute("name").map(str::to_string) }
}
