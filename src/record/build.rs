//! Turns what this crate knows into messages of a recording.

use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion};

use super::messages::{
    Bytes, CameraInfo, CompressedImage, Header, JointState, LaserScan, Log, MapMetaData, OccupancyGrid, Odometry,
    PointCloud2, PointField, Pose, PoseStamped, PoseWithCovariance, Range, RegionOfInterest, TfMessage, Time,
    TransformStamped, Twist, TwistWithCovariance, Vector3,
};
use crate::fault::{Fault, Result};
use crate::geometry::{Camera as CameraFrame, Frame, Odom, Robot, Sensor, Transducer, Transform, World};
use crate::maps::PlanView;
use crate::optics::{Distortion, Laser, LaserPlane, Rig};
use crate::pipeline::{RangeStep, Step};
use crate::points::Profile;
use crate::ranges::RangeReading;
use crate::time::Stamp;

/// The frame of the light: origin where the fan opens, x along its middle, y to the left in the plane.
pub const LASER_FRAME: &str = "finder_laser";
/// What a range was measured with.
pub const ULTRASOUND: u8 = 0;
/// The joint that turns the cylinder.
pub const CYLINDER_JOINT: &str = "cylinder";
/// The joint that tilts the mirror.
pub const MIRROR_JOINT: &str = "mirror";

fn edge<To, From>(stamp: Stamp, parent: &str, child: &str, pose: &Transform<To, From>) -> Result<TransformStamped> {
    Ok(TransformStamped { header: Header::new(stamp, parent)?, child_frame_id: child.into(), transform: pose.into() })
}

/// The pose of the laser's frame.
fn laser_pose<F: Frame>(sheet: &LaserPlane<F>) -> Isometry3<f64> {
    let axes = Matrix3::from_columns(&[sheet.forward, sheet.lateral, sheet.forward.cross(&sheet.lateral)]);
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
    Isometry3::from_parts(Translation3::from(sheet.origin.xyz), rotation)
}

/// What moves in the pose tree at a step: map → odom → base_link → finder_base → finder_laser.
///
/// Errors: an encoder outside its travel.
pub fn pose_tree(rig: &Rig, step: &Step) -> Result<TfMessage> {
    let world_from_odom: Transform<World, Odom> = step.world_from_robot * step.odom_from_robot.inverse();
    let sensor_from_laser: Transform<Sensor, Sensor> = laser_pose(&rig.laser_plane(step.mirror_pulse)?).into();
    let at = step.stamp;
    let robot_from_sensor = rig.robot_from_sensor(step.cylinder_pulse)?;
    Ok(TfMessage {
        transforms: vec![
            edge(at, World::NAME, Odom::NAME, &world_from_odom)?,
            edge(at, Odom::NAME, Robot::NAME, &step.odom_from_robot)?,
            edge(at, Robot::NAME, Sensor::NAME, &robot_from_sensor)?,
            edge(at, Sensor::NAME, LASER_FRAME, &sensor_from_laser)?,
        ],
    })
}

/// The part of the pose tree that never moves: finder_base → finder_camera, and base_link → every transducer.
pub fn fixed_poses(rig: &Rig, transducers: &[(String, Transform<Robot, Transducer>)], at: Stamp) -> Result<TfMessage> {
    let camera = edge(at, Sensor::NAME, CameraFrame::NAME, &rig.sensor_from_camera);
    let others = transducers.iter().map(|(frame, pose)| edge(at, Robot::NAME, frame, pose));
    Ok(TfMessage { transforms: std::iter::once(camera).chain(others).collect::<Result<_>>()? })
}

/// Where the robot was when a range was measured: map → odom → base_link.
pub fn ranged_pose(step: &RangeStep) -> Result<TfMessage> {
    let (at, odom_from_robot) = (step.reading.stamp, step.reading.odom_from_robot);
    let world_from_odom: Transform<World, Odom> = step.world_from_robot * odom_from_robot.inverse();
    let (map, odom, robot) = (World::NAME, Odom::NAME, Robot::NAME);
    Ok(TfMessage { transforms: vec![edge(at, map, odom, &world_from_odom)?, edge(at, odom, robot, &odom_from_robot)?] })
}

/// An ultrasonic range as ROS has it; no echo is +Inf (REP-117).
pub fn range(reading: &RangeReading) -> Result<Range> {
    Ok(Range {
        header: Header::new(reading.stamp, &reading.frame)?,
        radiation_type: ULTRASOUND,
        field_of_view: reading.field_of_view_rad,
        min_range: reading.range_m_min,
        max_range: reading.range_m_max,
        range: reading.range_m.unwrap_or(f32::INFINITY),
        variance: 0.0,
    })
}

/// The odometry at a step, with the mean velocity since the one before; zero if there is none or no time has passed.
pub fn odometry(step: &Step, before: Option<(Stamp, Transform<Odom, Robot>)>) -> Result<Odometry> {
    let mut twist = Twist::default();
    if let Some((then, pose)) = before {
        let seconds = (step.stamp - then).as_secs();
        if seconds > 0.0 {
            let moved = pose.iso.inverse() * step.odom_from_robot.iso;
            let (linear, angular) = (moved.translation.vector / seconds, moved.rotation.scaled_axis() / seconds);
            twist.linear = Vector3 { x: linear.x, y: linear.y, z: linear.z };
            twist.angular = Vector3 { x: angular.x, y: angular.y, z: angular.z };
        }
    }
    Ok(Odometry {
        header: Header::new(step.stamp, Odom::NAME)?,
        child_frame_id: Robot::NAME.into(),
        pose: PoseWithCovariance { pose: Pose::from(&step.odom_from_robot), ..Default::default() },
        twist: TwistWithCovariance { twist, ..Default::default() },
    })
}

/// The robot in the map, as estimated.
pub fn pose(step: &Step) -> Result<PoseStamped> {
    Ok(PoseStamped { header: Header::new(step.stamp, World::NAME)?, pose: Pose::from(&step.world_from_robot) })
}

/// θR and θB.
///
/// Errors: an encoder outside its travel.
pub fn joints(rig: &Rig, step: &Step) -> Result<JointState> {
    let cylinder = rig.cylinder.angle("cylinder encoder", step.cylinder_pulse)?;
    Ok(JointState {
        header: Header::new(step.stamp, "")?,
        name: vec![CYLINDER_JOINT.into(), MIRROR_JOINT.into()],
        position: vec![cylinder, rig.beam_rad(step.mirror_pulse)?],
        ..JointState::default()
    })
}

/// The points of a profile: x, y, z [m] and the level of the peak, as float32, in the profile's frame.
pub fn cloud<F: Frame>(profile: &Profile<F>) -> Result<PointCloud2> {
    const FLOAT32: u8 = 7;
    const POINT_BYTES: u32 = 16;
    let field = |(i, name): (u32, &str)| PointField { name: name.into(), offset: 4 * i, datatype: FLOAT32, count: 1 };
    let mut data = Vec::with_capacity(profile.points.len() * POINT_BYTES as usize);
    for seen in &profile.points {
        let p = seen.point.xyz;
        for number in [p.x as f32, p.y as f32, p.z as f32, seen.level] {
            data.extend(number.to_le_bytes());
        }
    }
    let width = profile.points.len() as u32;
    Ok(PointCloud2 {
        header: Header::new(profile.stamp, F::NAME)?,
        height: 1,
        width,
        fields: (0..).zip(["x", "y", "z", "intensity"]).map(field).collect(),
        is_bigendian: false,
        point_step: POINT_BYTES,
        row_step: width * POINT_BYTES,
        data: Bytes(data),
        is_dense: true,
    })
}

/// The points of a profile as ranges from where the fan opens, in the plane of the light.
///
/// An approximation for programs that know no profiles: a range for each angle within the 1/e² width of the fan, as fine as
/// the camera's columns are where it looks straight; the nearest point where several fall on one angle. Angles without a
/// point are NaN: that no line was seen does not mean that the way is free.
pub fn scan(rig: &Rig, profile: &Profile<Robot>) -> Result<LaserScan> {
    const ANGLES_MAX: f64 = 4096.0;
    let half = (rig.sheet.width_per_m / 2.0).atan();
    let steps = (2.0 * half * rig.camera.fx).ceil().clamp(1.0, ANGLES_MAX);
    let increment = 2.0 * half / steps;
    let mut ranges = vec![f32::NAN; steps as usize + 1];
    let mut intensities = vec![0.0; ranges.len()];
    let laser_from_robot = laser_pose(&profile.sheet).inverse();
    for seen in &profile.points {
        let p = laser_from_robot * nalgebra::Point3::from(seen.point.xyz);
        let (angle, range) = (p.y.atan2(p.x), p.x.hypot(p.y) as f32);
        let index = ((angle + half) / increment).round();
        let inside = index >= 0.0 && index <= steps;
        let Some((place, level)) = ranges.get_mut(index as usize).zip(intensities.get_mut(index as usize)) else {
            continue;
        };
        if inside && (place.is_nan() || range < *place) {
            (*place, *level) = (range, seen.level);
        }
    }
    Ok(LaserScan {
        header: Header::new(profile.stamp, LASER_FRAME)?,
        angle_min: -half as f32,
        angle_max: half as f32,
        angle_increment: increment as f32,
        range_max: rig.range_m_max as f32,
        ranges,
        intensities,
        ..LaserScan::default()
    })
}

/// The camera as ROS knows it. Tsai's distortion is given as the first three terms of its inverse: for METRO-I within 0.12 px
/// at the corners of the image. The exact model is in the attached rig.
pub fn camera_info(rig: &Rig, at: Stamp) -> Result<CameraInfo> {
    let camera = &rig.camera;
    let d = match camera.distortion {
        Distortion::Pinhole => [0.0; 5],
        // r_u = r_d·(1 + k·r_d²) turned round: r_d = r_u·(1 − k·r_u² + 3k²·r_u⁴ − 12k³·r_u⁶ …).
        Distortion::Tsai { k } => [-k, 3.0 * k * k, 0.0, 0.0, -12.0 * k * k * k],
        Distortion::BrownConrady { k1, k2, p1, p2, k3 } => [k1, k2, p1, p2, k3],
    };
    let side = |what: &str, side: usize| u32::try_from(side).map_err(|_| Fault::new(what, side, "32 bits"));
    let (fx, fy, cx, cy) = (camera.fx, camera.fy, camera.cx, camera.cy);
    Ok(CameraInfo {
        header: Header::new(at, CameraFrame::NAME)?,
        height: side("camera.height", camera.height)?,
        width: side("camera.width", camera.width)?,
        distortion_model: "plumb_bob".into(),
        d: d.to_vec(),
        k: [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p: [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
        binning_x: 0,
        binning_y: 0,
        roi: RegionOfInterest::default(),
    })
}

/// An image that is already a PNG file.
pub fn image(at: Stamp, png: Vec<u8>) -> Result<CompressedImage> {
    Ok(CompressedImage { header: Header::new(at, CameraFrame::NAME)?, format: "png".into(), data: Bytes(png) })
}

/// The plan view.
pub fn plan(at: Stamp, plan: &PlanView) -> Result<OccupancyGrid> {
    let side = |what: &str, side: usize| u32::try_from(side).map_err(|_| Fault::new(what, side, "32 bits"));
    let [x, y] = plan.origin_m;
    Ok(OccupancyGrid {
        header: Header::new(at, World::NAME)?,
        info: MapMetaData {
            map_load_time: Time::from_stamp(at)?,
            resolution: plan.resolution_m as f32,
            width: side("plan width", plan.width)?,
            height: side("plan height", plan.height)?,
            origin: Pose::from(&Transform::<World, World>::planar(x, y, 0.0)),
        },
        data: Bytes(plan.cells.iter().map(|cell| cell.to_ne_bytes()[0]).collect()),
    })
}

/// A line of the log; `level` as in `tracing`.
pub fn log(at: Stamp, level: &str, text: &str) -> Result<Log> {
    let level = match level {
        "ERROR" => 40,
        "WARN" => 30,
        "DEBUG" | "TRACE" => 10,
        _ => 20,
    };
    Ok(Log { stamp: Time::from_stamp(at)?, level, name: "metromap".into(), msg: text.into(), ..Log::default() })
}

/// METRO-I as URDF, to be drawn: a drum of the published diameter, the finder's frames, and its two joints. What stands on
/// the drum is published nowhere; boxes mark camera and mirror.
pub fn robot_description(rig: &Rig) -> String {
    let origin = |pose: &Isometry3<f64>| {
        let (p, (r, h, y)) = (pose.translation.vector, pose.rotation.euler_angles());
        format!(r#"<origin xyz="{} {} {}" rpy="{r} {h} {y}"/>"#, p.x, p.y, p.z)
    };
    let marked = |link: &str, shape: &str, colour: &str| {
        format!(
            r#"  <link name="{link}"><visual><geometry>{shape}</geometry><material name="{link}"><color rgba="{colour} 1"/></material></visual></link>"#
        )
    };
    let limit = |axis: &crate::optics::Axis| {
        let ends = [axis.pulse_min, axis.pulse_max].map(|pulse| axis.zero_rad + f64::from(pulse) * axis.rad_per_pulse);
        let (low, high) = (ends[0].min(ends[1]), ends[0].max(ends[1]));
        format!(r#"<limit lower="{low}" upper="{high}" effort="1" velocity="1"/>"#)
    };
    let joint = |name: &str, kind: &str, parent: &str, child: &str, rest: String| {
        format!(
            r#"  <joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{rest}</joint>"#
        )
    };
    let (robot, sensor, camera) = (Robot::NAME, Sensor::NAME, CameraFrame::NAME);
    let laser = match rig.laser {
        Laser::Mirror(mirror) => {
            // Trans·Ry(θB)·Rx(roll) as URDF has it, Trans·Rx(roll)·R(axis, θB): the axis is y seen from the rolled frame.
            let (roll, [x, y, z]) = (mirror.roll_rad, mirror.mirror_m);
            let place = format!(r#"<origin xyz="{x} {y} {z}" rpy="{roll} 0 0"/>"#);
            let axis = format!(r#"<axis xyz="0 {} {}"/>"#, roll.cos(), -roll.sin());
            joint(MIRROR_JOINT, "revolute", sensor, LASER_FRAME, place + &axis + &limit(&mirror.beam))
        }
        Laser::Plane(_) => {
            let place = rig.laser_plane(0).map(|sheet| origin(&laser_pose(&sheet))).unwrap_or_default();
            joint(MIRROR_JOINT, "fixed", sensor, LASER_FRAME, place)
        }
    };
    let cylinder = origin(&rig.robot_from_finder.iso) + r#"<axis xyz="0 0 1"/>"# + &limit(&rig.cylinder);
    [
        r#"<?xml version="1.0"?>"#.to_string(),
        r#"<robot name="metro_i">"#.to_string(),
        r#"  <link name="base_link"><visual><origin xyz="0 0 0.25"/><geometry><cylinder radius="0.3" length="0.4"/></geometry><material name="base_link"><color rgba="0.7 0.7 0.72 1"/></material></visual></link>"#.to_string(),
        format!(r#"  <link name="{sensor}"/>"#),
        marked(camera, r#"<box size="0.06 0.06 0.1"/>"#, "0.2 0.2 0.2"),
        marked(LASER_FRAME, r#"<box size="0.03 0.08 0.03"/>"#, "0.8 0.1 0.1"),
        joint(CYLINDER_JOINT, "revolute", robot, sensor, cylinder),
        joint("camera", "fixed", sensor, camera, origin(&rig.sensor_from_camera.iso)),
        laser,
        "</robot>\n".to_string(),
    ]
    .join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::{Dropped, Line, Peak};
    use crate::optics::{Axis, MirrorLaser};
    use crate::points::profile;
    use nalgebra::{Point3, Unit, Vector3 as Vec3};

    fn step(mirror_pulse: i32) -> Step {
        let columns =
            (0..512).map(|u| Some(Peak { v: 200.0 + u as f32 * 0.2, sigma: 0.1, level: 40.0 + u as f32 })).collect();
        let line = Line { height: 480, columns, dropped: Dropped::default() };
        let (seen, dropped) = profile(&Rig::metro_i(), &line, Stamp(2_000_000_000), 700, mirror_pulse).unwrap();
        let world_from_robot = Transform::planar(1.0, 2.0, 0.5);
        Step {
            id: 0,
            stamp: Stamp(2_000_000_000),
            cylinder_pulse: 700,
            mirror_pulse,
            odom_from_robot: Transform::planar(1.0, 0.0, std::f64::consts::FRAC_PI_2),
            world_from_robot,
            line,
            placed: seen.moved(&world_from_robot),
            seen,
            dropped,
        }
    }

    /// The image of a point by ROS' own formula for `plumb_bob`.
    fn plumb_bob(info: &CameraInfo, ray: &Vec3<f64>) -> [f64; 2] {
        let (x, y, r2) = (ray.x, ray.y, ray.x * ray.x + ray.y * ray.y);
        let [k1, k2, p1, p2, k3] = info.d[..] else { panic!("{:?}", info.d) };
        let radial = 1.0 + k1 * r2 + k2 * r2 * r2 + k3 * r2 * r2 * r2;
        let bent_x = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x);
        let bent_y = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y;
        [info.k[0] * bent_x + info.k[2], info.k[4] * bent_y + info.k[5]]
    }

    #[test]
    fn the_camera_of_ros_is_ours_to_a_tenth_of_a_pixel() {
        let rig = Rig::metro_i();
        let info = camera_info(&rig, Stamp(0)).unwrap();
        for (u, v) in [(0.0, 0.0), (511.0, 0.0), (0.0, 479.0), (511.0, 479.0), (256.0, 239.0), (100.0, 400.0)] {
            let [ru, rv] = plumb_bob(&info, &rig.camera.ray(u, v).unwrap());
            assert!((ru - u).hypot(rv - v) < 0.13, "({u}, {v}) becomes ({ru}, {rv})");
        }
    }

    #[test]
    fn the_scan_puts_every_point_where_it_is() {
        let (rig, step) = (Rig::metro_i(), step(10));
        let message = scan(&rig, &step.seen).unwrap();
        let robot_from_laser = laser_pose(&step.seen.sheet);
        let last = message.angle_min + message.angle_increment * (message.ranges.len() - 1) as f32;
        assert!((last - message.angle_max).abs() < 1e-4);
        let mut found = 0;
        for (i, (&range, &level)) in message.ranges.iter().zip(&message.intensities).enumerate() {
            if range.is_nan() {
                assert_eq!(level, 0.0);
                continue;
            }
            let angle = f64::from(message.angle_min) + f64::from(message.angle_increment) * i as f64;
            let p = robot_from_laser * Point3::new(f64::from(range) * angle.cos(), f64::from(range) * angle.sin(), 0.0);
            let near = step.seen.points.iter().map(|seen| (seen.point.xyz - p.coords).norm()).fold(f64::MAX, f64::min);
            assert!(near < 0.003, "{near} m at {angle} rad");
            found += 1;
        }
        assert!(found > 400, "{found}");
    }

    #[test]
    fn the_cloud_holds_points_and_levels() {
        let step = step(0);
        let message = cloud(&step.placed).unwrap();
        assert_eq!(
            (message.width as usize, message.row_step as usize),
            (step.placed.points.len(), message.data.0.len())
        );
        let third: Vec<f32> =
            message.data.0[32..48].chunks(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
        let p = step.placed.points[2];
        assert_eq!(third, [p.point.xyz.x as f32, p.point.xyz.y as f32, p.point.xyz.z as f32, p.level]);
    }

    #[test]
    fn velocity_is_that_since_the_odometry_before_in_the_robots_frame() {
        let step = step(0);
        let before = (Stamp(1_500_000_000), Transform::planar(1.0, -0.2, std::f64::consts::FRAC_PI_2));
        let twist = odometry(&step, Some(before)).unwrap().twist.twist;
        assert!((twist.linear.x - 0.4).abs() < 1e-12 && twist.linear.y.abs() < 1e-12, "{twist:?}");
        assert_eq!(odometry(&step, None).unwrap().twist.twist, Twist::default());
        assert_eq!(odometry(&step, Some((step.stamp, Transform::identity()))).unwrap().twist.twist, Twist::default());
    }

    /// The pose of a joint's child by the rules of URDF: origin, then the turn about the axis.
    fn joint_pose(urdf: &str, name: &str, angle: f64) -> (String, Isometry3<f64>) {
        let document = roxmltree::Document::parse(urdf).unwrap();
        let joint =
            document.descendants().find(|n| n.has_tag_name("joint") && n.attribute("name") == Some(name)).unwrap();
        let child = |tag: &str| joint.children().find(|n| n.has_tag_name(tag));
        let numbers = |text: &str| -> Vec3<f64> {
            let numbers: Vec<f64> = text.split(' ').map(|number| number.parse().unwrap()).collect();
            Vec3::from_row_slice(&numbers)
        };
        let origin = child("origin").unwrap();
        let (xyz, rpy) = (numbers(origin.attribute("xyz").unwrap()), numbers(origin.attribute("rpy").unwrap()));
        let turn = child("axis").map_or(UnitQuaternion::identity(), |axis| {
            UnitQuaternion::from_axis_angle(&Unit::new_normalize(numbers(axis.attribute("xyz").unwrap())), angle)
        });
        let fixed = UnitQuaternion::from_euler_angles(rpy.x, rpy.y, rpy.z);
        let link = child("child").unwrap().attribute("link").unwrap().to_string();
        (link, Isometry3::from_parts(xyz.into(), fixed * turn))
    }

    #[test]
    fn the_urdf_moves_as_the_pose_tree_does() {
        let mut rig = Rig::metro_i();
        let Laser::Mirror(mirror) = rig.laser else { panic!() };
        rig.laser = Laser::Mirror(MirrorLaser { roll_rad: 0.1, mirror_m: [0.01, 0.02, 0.8], ..mirror });
        rig.cylinder = Axis { zero_rad: 0.3, ..rig.cylinder };
        rig.robot_from_finder = Transform::from_xyz_rpy([0.1, 0.0, 0.05], [0.0, 0.02, 0.0]);
        let step = step(25);
        let (urdf, angles) = (robot_description(&rig), joints(&rig, &step).unwrap().position);
        let tree = pose_tree(&rig, &step).unwrap();
        let robot = Transform::<World, Odom>::from(tree.transforms[0].transform.transform::<World, Odom>().iso)
            * tree.transforms[1].transform.transform::<Odom, Robot>();
        assert!((robot.iso.to_homogeneous() - step.world_from_robot.iso.to_homogeneous()).norm() < 1e-12);
        let fixed = fixed_poses(&rig, &[], step.stamp).unwrap();
        for (edge, name, angle) in [
            (&tree.transforms[2], CYLINDER_JOINT, angles[0]),
            (&fixed.transforms[0], "camera", 0.0),
            (&tree.transforms[3], MIRROR_JOINT, angles[1]),
        ] {
            let (link, pose) = joint_pose(&urdf, name, angle);
            assert_eq!(link, edge.child_frame_id);
            let ours = edge.transform.transform::<(), ()>().iso;
            assert!((pose.to_homogeneous() - ours.to_homogeneous()).norm() < 1e-12, "{name}: {pose} is not {ours}");
        }
    }

    #[test]
    fn a_fixed_plane_has_a_fixed_joint() {
        let plane = crate::optics::PlaneLaser { normal: [0.0, 1.0, 0.2], offset_m: 0.3, origin_m: None };
        let rig = Rig { laser: Laser::Plane(plane), ..Rig::metro_i() };
        let (_, pose) = joint_pose(&robot_description(&rig), MIRROR_JOINT, 0.0);
        assert!((pose.to_homogeneous() - laser_pose(&rig.laser_plane(0).unwrap()).to_homogeneous()).norm() < 1e-12);
    }
}
