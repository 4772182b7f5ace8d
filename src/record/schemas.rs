//! The types of messages as `ros2msg` text: fields in the order of the bytes, with every type they are made of.

/// The encoding of the schemas in the registry of MCAP.
pub const SCHEMA_ENCODING: &str = "ros2msg";
/// The encoding of the messages in the registry of MCAP.
pub const MESSAGE_ENCODING: &str = "cdr";
/// The type of `/finder/capture`.
pub const CAPTURE_TYPE: &str = "metromap_msgs/msg/Capture";

const SEPARATOR: &str = "================================================================================";

/// Our own message.
const CAPTURE: &str = "\
# One exposure of the range finder, with all that is needed to map it again, bit for bit.
std_msgs/Header header                 # middle of the exposure; frame of the camera
uint64 id                              # number of the exposure, from 0
int64 stamp_ns                         # middle of the exposure [ns]
int32 cylinder_pulse                   # cylinder encoder
int32 mirror_pulse                     # mirror encoder
geometry_msgs/Pose odom_from_robot     # base_link in odom, as odometry has it
uint32 image_width                     # [px]
uint32 image_height                    # [px]
uint8 image_white                      # level of a full pixel; 0 where there was no image
bool has_image                         # its image stands before it, with the same log time
uint16[] column                        # columns that saw the line, ascending [px]
float32[] v                            # row of the line in each of them, from the top [px]
float32[] sigma                        # its standard deviation [px]
float32[] level                        # level of the peak over the background
string[] drop_reason                   # why other columns saw none
uint64[] drop_count                    # how many of each
";

/// Every type by its name without `msg/`, in no order that matters.
const TYPES: &[(&str, &str)] = &[
    ("builtin_interfaces/Time", "int32 sec\nuint32 nanosec\n"),
    ("std_msgs/Header", "builtin_interfaces/Time stamp\nstring frame_id\n"),
    ("std_msgs/String", "string data\n"),
    ("geometry_msgs/Vector3", "float64 x\nfloat64 y\nfloat64 z\n"),
    ("geometry_msgs/Point", "float64 x\nfloat64 y\nfloat64 z\n"),
    ("geometry_msgs/Quaternion", "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"),
    ("geometry_msgs/Pose", "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"),
    ("geometry_msgs/PoseStamped", "std_msgs/Header header\ngeometry_msgs/Pose pose\n"),
    ("geometry_msgs/PoseWithCovariance", "geometry_msgs/Pose pose\nfloat64[36] covariance\n"),
    ("geometry_msgs/Twist", "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n"),
    ("geometry_msgs/TwistWithCovariance", "geometry_msgs/Twist twist\nfloat64[36] covariance\n"),
    ("geometry_msgs/Transform", "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n"),
    (
        "geometry_msgs/TransformStamped",
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n",
    ),
    ("tf2_msgs/TFMessage", "geometry_msgs/TransformStamped[] transforms\n"),
    (
        "nav_msgs/Odometry",
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n\
         geometry_msgs/TwistWithCovariance twist\n",
    ),
    (
        "nav_msgs/MapMetaData",
        "builtin_interfaces/Time map_load_time\nfloat32 resolution\nuint32 width\nuint32 height\n\
         geometry_msgs/Pose origin\n",
    ),
    ("nav_msgs/OccupancyGrid", "std_msgs/Header header\nnav_msgs/MapMetaData info\nint8[] data\n"),
    (
        "sensor_msgs/JointState",
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n",
    ),
    (
        "sensor_msgs/PointField",
        "uint8 INT8=1\nuint8 UINT8=2\nuint8 INT16=3\nuint8 UINT16=4\nuint8 INT32=5\nuint8 UINT32=6\nuint8 FLOAT32=7\n\
         uint8 FLOAT64=8\nstring name\nuint32 offset\nuint8 datatype\nuint32 count\n",
    ),
    (
        "sensor_msgs/PointCloud2",
        "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\nbool is_bigendian\n\
         uint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense\n",
    ),
    (
        "sensor_msgs/LaserScan",
        "std_msgs/Header header\nfloat32 angle_min\nfloat32 angle_max\nfloat32 angle_increment\nfloat32 time_increment\n\
         float32 scan_time\nfloat32 range_min\nfloat32 range_max\nfloat32[] ranges\nfloat32[] intensities\n",
    ),
    // As from 2023 on; before, without the variance.
    (
        "sensor_msgs/Range",
        "uint8 ULTRASOUND=0\nuint8 INFRARED=1\nstd_msgs/Header header\nuint8 radiation_type\nfloat32 field_of_view\n\
         float32 min_range\nfloat32 max_range\nfloat32 range\nfloat32 variance\n",
    ),
    (
        "sensor_msgs/RegionOfInterest",
        "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify\n",
    ),
    (
        "sensor_msgs/CameraInfo",
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\n\
         float64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi\n",
    ),
    ("sensor_msgs/CompressedImage", "std_msgs/Header header\nstring format\nuint8[] data\n"),
    (
        "rcl_interfaces/Log",
        "byte DEBUG=10\nbyte INFO=20\nbyte WARN=30\nbyte ERROR=40\nbyte FATAL=50\nbuiltin_interfaces/Time stamp\n\
         uint8 level\nstring name\nstring msg\nstring file\nstring function\nuint32 line\n",
    ),
    ("metromap_msgs/Capture", CAPTURE),
];

/// The full text of a type such as `nav_msgs/msg/Odometry`: its fields, then those of every type in it. `None` for a type
/// that no recording of ours holds.
pub fn definition(ros_type: &str) -> Option<String> {
    let root = ros_type.replacen("/msg/", "/", 1);
    let fields = |name: &str| TYPES.iter().find(|(key, _)| *key == name).map(|(_, text)| *text);
    let mut text = fields(&root)?.to_string();
    let mut listed = types_in(&text);
    let mut next = 0;
    while let Some(name) = listed.get(next).cloned() {
        let inner = fields(&name)?;
        text.push_str(&format!("{SEPARATOR}\nMSG: {name}\n{inner}"));
        for deeper in types_in(inner) {
            if !listed.contains(&deeper) {
                listed.push(deeper);
            }
        }
        next += 1;
    }
    Some(text)
}

/// Whether two schemas have the same fields in the same order; comments and spaces do not count.
pub fn same_fields(a: &str, b: &str) -> bool {
    let lines = |text: &str| -> Vec<String> {
        let words = text.lines().map(|line| line.split('#').next().unwrap_or_default().split_whitespace());
        words.map(|words| words.collect::<Vec<_>>().join(" ")).filter(|line| !line.is_empty()).collect()
    };
    lines(a) == lines(b)
}

/// The types with a package that the fields name, each once, in their order.
fn types_in(fields: &str) -> Vec<String> {
    let mut found: Vec<String> = Vec::new();
    for line in fields.lines().filter(|line| !line.starts_with('#')) {
        let name = line.split([' ', '[']).next().unwrap_or_default();
        if name.contains('/') && !found.iter().any(|known| known == name) {
            found.push(name.to_string());
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_definition_holds_every_type_once() {
        let text = definition("tf2_msgs/msg/TFMessage").unwrap();
        let sections: Vec<&str> = text.lines().filter_map(|line| line.strip_prefix("MSG: ")).collect();
        assert_eq!(
            sections,
            [
                "geometry_msgs/TransformStamped",
                "std_msgs/Header",
                "geometry_msgs/Transform",
                "builtin_interfaces/Time",
                "geometry_msgs/Vector3",
                "geometry_msgs/Quaternion"
            ]
        );
        assert!(text.starts_with("geometry_msgs/TransformStamped[] transforms\n===="));
        assert!(definition("sensor_msgs/msg/Imu").is_none());
    }

    #[test]
    fn every_type_resolves_and_names_are_valid_ros() {
        let builtin = [
            "bool", "byte", "uint8", "uint16", "uint32", "uint64", "int8", "int32", "int64", "float32", "float64",
            "string",
        ];
        for (name, _) in TYPES {
            let text = definition(name).unwrap_or_else(|| panic!("{name} names a type that is not listed"));
            for line in text.lines().filter(|l| !l.starts_with(['#', '=']) && !l.starts_with("MSG: ")) {
                let mut words = line.split_whitespace();
                let (kind, field) = (words.next().unwrap(), words.next().unwrap());
                let base = kind.split('[').next().unwrap();
                assert!(base.contains('/') || builtin.contains(&base), "{name}: {line}");
                let constant = field.split_once('=').map(|(constant, _)| constant);
                let field_is_valid = field.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_');
                assert!(constant.is_some_and(|c| c.to_uppercase() == c) || field_is_valid, "{name}: {line}");
            }
        }
    }

    #[test]
    fn comments_are_no_difference_but_fields_are() {
        assert!(same_fields("int32 a # one\n\n# two\nint32  b\n", "int32 a\nint32 b"));
        assert!(!same_fields("int32 a\nint32 b", "int32 b\nint32 a"));
    }
}
