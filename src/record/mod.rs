//! Recordings: MCAP with profile `ros2` and CDR, so that they open in Rerun, in Foxglove and in ROS 2 alike.
//!
//! `messages` are the bytes' meaning, `schemas` their text for other programs, `cdr` the bytes themselves, `build` turns
//! what this crate knows into messages, `png` keeps images without loss, `frames` and
//! `reader` get out of a file what is in it, `recover` makes it whole, and `bag` writes: the only file that names the `mcap`
//! crate, and the door to them all.

pub mod bag;
pub mod build;
mod bytes;
pub mod cdr;
mod frames;
pub mod messages;
pub mod png;
mod reader;
mod recover;
pub mod schemas;

/// Topics of a recording.
pub mod topics {
    /// The pose tree that moves: tf2_msgs/msg/TFMessage.
    pub const TF: &str = "/tf";
    /// The pose tree that does not: tf2_msgs/msg/TFMessage.
    pub const TF_STATIC: &str = "/tf_static";
    /// Odometry: nav_msgs/msg/Odometry.
    pub const ODOM: &str = "/odom";
    /// The robot in the map, as estimated: geometry_msgs/msg/PoseStamped.
    pub const POSE: &str = "/pose";
    /// θR and θB: sensor_msgs/msg/JointState.
    pub const JOINTS: &str = "/joint_states";
    /// The points of a capture in the map: sensor_msgs/msg/PointCloud2.
    pub const POINTS: &str = "/finder/points";
    /// The points of a capture in the plane of the light: sensor_msgs/msg/LaserScan.
    pub const SCAN: &str = "/finder/scan";
    /// The camera: sensor_msgs/msg/CameraInfo.
    pub const CAMERA_INFO: &str = "/finder/camera_info";
    /// The images: sensor_msgs/msg/CompressedImage, PNG.
    pub const IMAGE: &str = "/finder/image";
    /// Every capture, bit for bit: metromap_msgs/msg/Capture.
    pub const CAPTURE: &str = "/finder/capture";
    /// The plan view: nav_msgs/msg/OccupancyGrid.
    pub const MAP: &str = "/map";
    /// The ultrasonic layer: nav_msgs/msg/OccupancyGrid.
    pub const MAP_ULTRASONIC: &str = "/map_ultrasonic";
    /// Laser and ultrasonic together: nav_msgs/msg/OccupancyGrid.
    pub const MAP_FUSED: &str = "/map_fused";
    /// The robot as URDF: std_msgs/msg/String.
    pub const ROBOT: &str = "/robot_description";
    /// The log: rcl_interfaces/msg/Log.
    pub const LOG: &str = "/rosout";

    /// The ranges of one ultrasonic transducer: sensor_msgs/msg/Range, a topic each, as RViz and Nav2 want it.
    pub fn range(frame: &str) -> String {
        format!("/{frame}/range")
    }
}

/// Name of the metadata record that holds `sinks::Start::metadata`.
pub const METADATA_START: &str = "metromap";
/// Name of the metadata record that says what the recording is of: key `name`.
pub const METADATA_RECORDING: &str = "metromap.recording";
