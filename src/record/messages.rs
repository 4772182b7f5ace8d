//! The messages of a recording: fields in the order of their schema (`schemas`), units and frames as REP-103 and REP-105.

use serde::{Deserialize, Serialize};

use crate::fault::{Fault, Result, number_within};
use crate::geometry::{Camera, Frame, Transform};
use crate::image::{Capture, Drop, Dropped, Line, Peak, Reading};
use crate::time::Stamp;

pub use super::bytes::Bytes;

macro_rules! messages {
    ($($(#[$doc:meta])* $name:ident as $ros:literal { $($(#[$note:meta])* $field:ident: $type:ty,)* })*) => {$(
        $(#[$doc])*
        #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
        pub struct $name { $($(#[$note])* pub $field: $type,)* }
        impl Message for $name { const TYPE: &'static str = $ros; }
    )*};
}

/// A message with a ROS 2 type.
pub trait Message: Serialize {
    /// The type's full name, such as `nav_msgs/msg/Odometry`.
    const TYPE: &'static str;
}

/// A 6 × 6 covariance, row by row (x, y, z, and turns about x, y, z); zeros where it is not known.
pub type Covariance = [[f64; 6]; 6];

messages! {
    /// Seconds and the nanoseconds beyond them.
    Time as "builtin_interfaces/msg/Time" {
        /// Whole seconds [s].
        sec: i32,
        /// Nanoseconds within the second [ns].
        nanosec: u32,
    }
    /// When and in which frame.
    Header as "std_msgs/msg/Header" {
        /// When.
        stamp: Time,
        /// The frame's name.
        frame_id: String,
    }
    /// Text.
    Text as "std_msgs/msg/String" {
        /// The text.
        data: String,
    }
    /// A vector, or a position [m].
    Vector3 as "geometry_msgs/msg/Vector3" {
        /// Along x.
        x: f64,
        /// Along y.
        y: f64,
        /// Along z.
        z: f64,
    }
    /// A rotation.
    Quaternion as "geometry_msgs/msg/Quaternion" {
        /// i.
        x: f64,
        /// j.
        y: f64,
        /// k.
        z: f64,
        /// Real part.
        w: f64,
    }
    /// Position and rotation; on the wire also `geometry_msgs/msg/Transform`.
    Pose as "geometry_msgs/msg/Pose" {
        /// Position [m].
        position: Vector3,
        /// Rotation.
        orientation: Quaternion,
    }
    /// A pose in a frame at a time.
    PoseStamped as "geometry_msgs/msg/PoseStamped" {
        /// When and where.
        header: Header,
        /// The pose.
        pose: Pose,
    }
    /// One edge of the pose tree: the pose of `child_frame_id` in the header's frame.
    TransformStamped as "geometry_msgs/msg/TransformStamped" {
        /// When, and the parent.
        header: Header,
        /// The child.
        child_frame_id: String,
        /// The child's pose in the parent.
        transform: Pose,
    }
    /// Edges of the pose tree.
    TfMessage as "tf2_msgs/msg/TFMessage" {
        /// The edges.
        transforms: Vec<TransformStamped>,
    }
    /// A pose with what is known of its error.
    PoseWithCovariance as "geometry_msgs/msg/PoseWithCovariance" {
        /// The pose.
        pose: Pose,
        /// Its covariance.
        covariance: Covariance,
    }
    /// Velocity, in the child frame.
    Twist as "geometry_msgs/msg/Twist" {
        /// [m/s].
        linear: Vector3,
        /// [rad/s].
        angular: Vector3,
    }
    /// A velocity with what is known of its error.
    TwistWithCovariance as "geometry_msgs/msg/TwistWithCovariance" {
        /// The velocity.
        twist: Twist,
        /// Its covariance.
        covariance: Covariance,
    }
    /// Odometry.
    Odometry as "nav_msgs/msg/Odometry" {
        /// When, and the frame of the pose.
        header: Header,
        /// The frame of the velocity.
        child_frame_id: String,
        /// The pose.
        pose: PoseWithCovariance,
        /// The mean velocity since the odometry before.
        twist: TwistWithCovariance,
    }
    /// Size and place of a grid.
    MapMetaData as "nav_msgs/msg/MapMetaData" {
        /// When it was made.
        map_load_time: Time,
        /// Side of a cell [m].
        resolution: f32,
        /// Cells along x.
        width: u32,
        /// Cells along y.
        height: u32,
        /// The lower left corner of cell (0, 0).
        origin: Pose,
    }
    /// The plan view.
    OccupancyGrid as "nav_msgs/msg/OccupancyGrid" {
        /// When and where.
        header: Header,
        /// Size and place.
        info: MapMetaData,
        /// int8, −1 unknown, 0 free to 100 occupied; row by row from the lowest y.
        data: Bytes,
    }
    /// Positions of joints.
    JointState as "sensor_msgs/msg/JointState" {
        /// When.
        header: Header,
        /// The joints.
        name: Vec<String>,
        /// Their angles [rad].
        position: Vec<f64>,
        /// Empty: not known.
        velocity: Vec<f64>,
        /// Empty: not known.
        effort: Vec<f64>,
    }
    /// One number of every point in a cloud.
    PointField as "sensor_msgs/msg/PointField" {
        /// Its name.
        name: String,
        /// Where in the point [bytes].
        offset: u32,
        /// 7 for a float32.
        datatype: u8,
        /// How many.
        count: u32,
    }
    /// Points.
    PointCloud2 as "sensor_msgs/msg/PointCloud2" {
        /// When and where.
        header: Header,
        /// Rows: 1.
        height: u32,
        /// Points a row.
        width: u32,
        /// What a point is made of.
        fields: Vec<PointField>,
        /// Byte order of `data`.
        is_bigendian: bool,
        /// Bytes a point.
        point_step: u32,
        /// Bytes a row.
        row_step: u32,
        /// The points.
        data: Bytes,
        /// No point is invalid.
        is_dense: bool,
    }
    /// Ranges over equally spaced angles.
    LaserScan as "sensor_msgs/msg/LaserScan" {
        /// When and where.
        header: Header,
        /// Angle of the first range [rad].
        angle_min: f32,
        /// Angle of the last range [rad].
        angle_max: f32,
        /// Angle from one to the next [rad].
        angle_increment: f32,
        /// 0: all at once [s].
        time_increment: f32,
        /// 0: not periodic [s].
        scan_time: f32,
        /// Least range [m].
        range_min: f32,
        /// Greatest range [m].
        range_max: f32,
        /// Ranges [m]; NaN where nothing was seen (REP-117), which does not mean free.
        ranges: Vec<f32>,
        /// Level of the peak over the background; 0 where nothing was seen.
        intensities: Vec<f32>,
    }
    /// One range of one transducer.
    Range as "sensor_msgs/msg/Range" {
        /// When it was fired, and the frame of the transducer: x along its axis.
        header: Header,
        /// 0 ultrasound, 1 infrared.
        radiation_type: u8,
        /// The arc in which what echoed may be [rad].
        field_of_view: f32,
        /// Nothing nearer is reported [m].
        min_range: f32,
        /// Nothing farther is reported [m].
        max_range: f32,
        /// The range [m]; +Inf where there was no echo (REP-117), which does not mean that nothing is there.
        range: f32,
        /// 0: not known [m²].
        variance: f32,
    }
    /// A part of an image.
    RegionOfInterest as "sensor_msgs/msg/RegionOfInterest" {
        /// [px].
        x_offset: u32,
        /// [px].
        y_offset: u32,
        /// [px].
        height: u32,
        /// [px].
        width: u32,
        /// Whether it is to be rectified.
        do_rectify: bool,
    }
    /// The camera's model.
    CameraInfo as "sensor_msgs/msg/CameraInfo" {
        /// When and where.
        header: Header,
        /// Rows.
        height: u32,
        /// Columns.
        width: u32,
        /// `plumb_bob`.
        distortion_model: String,
        /// k1, k2, p1, p2, k3.
        d: Vec<f64>,
        /// The camera matrix, row by row.
        k: [f64; 9],
        /// Rectification: identity.
        r: [f64; 9],
        /// Projection, row by row.
        p: [f64; 12],
        /// 0: none.
        binning_x: u32,
        /// 0: none.
        binning_y: u32,
        /// All zeros: the whole image.
        roi: RegionOfInterest,
    }
    /// An image in a file format.
    CompressedImage as "sensor_msgs/msg/CompressedImage" {
        /// When and where.
        header: Header,
        /// `png`.
        format: String,
        /// The file.
        data: Bytes,
    }
    /// A line of the log.
    Log as "rcl_interfaces/msg/Log" {
        /// When.
        stamp: Time,
        /// 10 debug, 20 info, 30 warning, 40 error.
        level: u8,
        /// Who.
        name: String,
        /// What.
        msg: String,
        /// Not given.
        file: String,
        /// Not given.
        function: String,
        /// Not given.
        line: u32,
    }
    /// A capture, bit for bit.
    CaptureMessage as "metromap_msgs/msg/Capture" {
        /// Middle of the exposure, in the camera's frame.
        header: Header,
        /// Number of the exposure.
        id: u64,
        /// Middle of the exposure [ns].
        stamp_ns: i64,
        /// Cylinder encoder [pulses].
        cylinder_pulse: i32,
        /// Mirror encoder [pulses].
        mirror_pulse: i32,
        /// The robot in odom.
        odom_from_robot: Pose,
        /// Columns of the image.
        image_width: u32,
        /// Rows of the image.
        image_height: u32,
        /// Level of a full pixel; 0 where there was no image.
        image_white: u8,
        /// Whether the image was recorded too.
        has_image: bool,
        /// Columns with a peak, ascending.
        column: Vec<u16>,
        /// Row of the peak in each [px].
        v: Vec<f32>,
        /// Its standard deviation [px].
        sigma: Vec<f32>,
        /// Its level.
        level: Vec<f32>,
        /// Why other columns have none.
        drop_reason: Vec<String>,
        /// How many of each.
        drop_count: Vec<u64>,
    }
}

impl Time {
    /// The same instant; an error beyond the 32 bits that ROS has for seconds.
    pub fn from_stamp(stamp: Stamp) -> Result<Self> {
        let expected = "a time within the 32 bits of seconds that ROS has";
        let sec =
            i32::try_from(stamp.0.div_euclid(1_000_000_000)).map_err(|_| Fault::new("stamp", stamp.0, expected))?;
        Ok(Self { sec, nanosec: stamp.0.rem_euclid(1_000_000_000) as u32 })
    }
}

impl Header {
    /// At `stamp` in `frame`.
    pub fn new(stamp: Stamp, frame: &str) -> Result<Self> {
        Ok(Self { stamp: Time::from_stamp(stamp)?, frame_id: frame.to_string() })
    }
}

impl<To, From> std::convert::From<&Transform<To, From>> for Pose {
    fn from(transform: &Transform<To, From>) -> Self {
        let (p, [x, y, z, w]) = (transform.xyz(), transform.quaternion());
        Self { position: Vector3 { x: p.x, y: p.y, z: p.z }, orientation: Quaternion { x, y, z, w } }
    }
}

impl Pose {
    /// The transform with these very numbers.
    pub fn transform<To, From>(&self) -> Transform<To, From> {
        let (p, q) = (&self.position, &self.orientation);
        Transform::from_stored([p.x, p.y, p.z], [q.x, q.y, q.z, q.w])
    }
}

/// What a capture says of its image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ImageNote {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Level of a full pixel; `None` where there was no image.
    pub white: Option<u8>,
    /// Whether the image was recorded too.
    pub recorded: bool,
}

/// Columns and rows an image may have: what `uint16 column` can number.
const SIDE_MAX: usize = 1 << 16;

impl CaptureMessage {
    /// The message of a capture whose reading is `line`.
    ///
    /// Errors: an image wider or higher than 65536, a stamp beyond 32 bits of seconds.
    pub fn new(capture: &Capture, line: &Line, white: Option<u8>, has_image: bool) -> Result<Self> {
        for (what, side) in [("line width", line.width()), ("line height", line.height)] {
            number_within(what, side as f64, 0.0, SIDE_MAX as f64)?;
        }
        let seen = || line.columns.iter().flatten();
        let column = line.columns.iter().enumerate().filter(|(_, peak)| peak.is_some()).map(|(u, _)| u as u16);
        Ok(Self {
            header: Header::new(capture.stamp, Camera::NAME)?,
            id: capture.id,
            stamp_ns: capture.stamp.0,
            cylinder_pulse: capture.cylinder_pulse,
            mirror_pulse: capture.mirror_pulse,
            odom_from_robot: Pose::from(&capture.odom_from_robot),
            image_width: line.width() as u32,
            image_height: line.height as u32,
            image_white: white.unwrap_or(0),
            has_image,
            column: column.collect(),
            v: seen().map(|peak| peak.v).collect(),
            sigma: seen().map(|peak| peak.sigma).collect(),
            level: seen().map(|peak| peak.level).collect(),
            drop_reason: line.dropped.0.keys().map(Drop::to_string).collect(),
            drop_count: line.dropped.0.values().copied().collect(),
        })
    }

    /// The capture with its line, and what is known of its image.
    ///
    /// Errors: arrays of different lengths, columns that do not ascend within the image, an unknown reason.
    pub fn capture(&self) -> Result<(Capture, ImageNote)> {
        let line = self.line()?;
        let note = ImageNote {
            width: line.width(),
            height: line.height,
            white: (self.image_white > 0).then_some(self.image_white),
            recorded: self.has_image,
        };
        let capture = Capture {
            id: self.id,
            stamp: Stamp(self.stamp_ns),
            cylinder_pulse: self.cylinder_pulse,
            mirror_pulse: self.mirror_pulse,
            odom_from_robot: self.odom_from_robot.transform(),
            reading: Reading::Line(line),
        };
        Ok((capture, note))
    }

    fn line(&self) -> Result<Line> {
        let (width, height) = (self.image_width as usize, self.image_height as usize);
        for (what, side) in [("image_width", width), ("image_height", height)] {
            number_within(what, side as f64, 0.0, SIDE_MAX as f64)?;
        }
        let count = self.column.len();
        for (what, length) in [("v", self.v.len()), ("sigma", self.sigma.len()), ("level", self.level.len())] {
            if length != count {
                return Err(Fault::new(what, format!("{length} values"), format!("{count}, one a column")));
            }
        }
        let mut columns = vec![None; width];
        let mut least = 0;
        for (((&u, &v), &sigma), &level) in self.column.iter().zip(&self.v).zip(&self.sigma).zip(&self.level) {
            let place = columns.get_mut(usize::from(u)).filter(|_| usize::from(u) >= least);
            let place =
                place.ok_or_else(|| Fault::new("column", u, format!("a column from {least} to below {width}")))?;
            *place = Some(Peak { v, sigma, level });
            least = usize::from(u) + 1;
        }
        Ok(Line { height, columns, dropped: self.dropped()? })
    }

    fn dropped(&self) -> Result<Dropped> {
        use serde::de::IntoDeserializer;
        let (reasons, counts) = (self.drop_reason.len(), self.drop_count.len());
        if reasons != counts {
            return Err(Fault::new("drop_count", format!("{counts} values"), format!("{reasons}, one a reason")));
        }
        let mut dropped = Dropped::default();
        for (reason, count) in self.drop_reason.iter().zip(&self.drop_count) {
            let name: serde::de::value::StrDeserializer<'_, serde::de::value::Error> =
                reason.as_str().into_deserializer();
            let why = Drop::deserialize(name)
                .map_err(|_| Fault::new("drop_reason", reason, "a reason this version knows"))?;
            if dropped.0.insert(why, *count).is_some() {
                return Err(Fault::new("drop_reason", format!("{reason} twice"), "every reason once"));
            }
        }
        Ok(dropped)
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::geometry::{Odom, Robot};
    use crate::record::cdr::{decode, encode};
    use proptest::prelude::*;

    fn captures() -> impl Strategy<Value = (Capture, Line)> {
        let number = || prop_oneof![Just(0.1f32), Just(-0.0), Just(f32::MIN_POSITIVE / 2.0), any::<f32>()];
        let peak = (number(), number(), number()).prop_map(|(v, sigma, level)| Peak { v, sigma, level });
        let columns = prop::collection::vec(prop::option::of(peak), 0..60);
        let pose = (prop::array::uniform3(any::<f64>()), prop::array::uniform4(any::<f64>()));
        (columns, 0usize..=65536, pose, any::<u64>(), -(1i64 << 60)..1i64 << 60, any::<(i32, i32)>(), 0u64..9).prop_map(
            |(columns, height, (xyz, q), id, ns, (cylinder_pulse, mirror_pulse), dark)| {
                let line =
                    Line { height, columns, dropped: Dropped([(Drop::Dark, dark), (Drop::Isolated, id)].into()) };
                let capture = Capture {
                    id,
                    stamp: Stamp(ns),
                    cylinder_pulse,
                    mirror_pulse,
                    odom_from_robot: Transform::<Odom, Robot>::from_stored(xyz, q),
                    reading: Reading::Line(line.clone()),
                };
                (capture, line)
            },
        )
    }

    /// All that `Capture` holds as bits, so that −0 and NaN count too.
    pub(crate) fn bits(capture: &Capture) -> String {
        let f = &capture.odom_from_robot;
        let pose: Vec<u64> = f.xyz().iter().copied().chain(f.quaternion()).map(f64::to_bits).collect();
        let head = (capture.id, capture.stamp, capture.cylinder_pulse, capture.mirror_pulse, pose);
        let Reading::Line(line) = &capture.reading else { return format!("{head:?} {:?}", capture.reading) };
        let of = |p: &Peak| [p.v.to_bits(), p.sigma.to_bits(), p.level.to_bits()];
        let columns: Vec<_> = line.columns.iter().map(|p| p.as_ref().map(of)).collect();
        format!("{head:?} {} {columns:?} {:?}", line.height, line.dropped)
    }

    proptest! {
        #[test]
        fn a_capture_comes_back_bit_for_bit((capture, line) in captures()) {
            let message = CaptureMessage::new(&capture, &line, Some(127), true).unwrap();
            let read: CaptureMessage = decode(&encode(&message).unwrap()).unwrap();
            let (back, note) = read.capture().unwrap();
            prop_assert_eq!(bits(&back), bits(&capture));
            let expected = ImageNote { width: line.width(), height: line.height, white: Some(127), recorded: true };
            prop_assert_eq!(note, expected);
        }
    }

    /// Worked out by hand from the schema; offsets count from after the encapsulation.
    #[test]
    fn the_bytes_of_a_capture_are_those_of_its_schema() {
        let line = Line {
            height: 480,
            columns: vec![None, Some(Peak { v: 250.5, sigma: 0.125, level: 64.0 }), None],
            dropped: Dropped([(Drop::Dark, 2)].into()),
        };
        let capture = Capture {
            id: 3,
            stamp: Stamp(1_500_000_000),
            cylinder_pulse: -2,
            mirror_pulse: 7,
            odom_from_robot: Transform::from_stored([1.0, -2.0, 0.5], [0.0, 0.0, 0.0, 1.0]),
            reading: Reading::Line(line.clone()),
        };
        let mut bytes: Vec<u8> = vec![0, 1, 0, 0];
        bytes.extend([1, 0, 0, 0, 0x00, 0x65, 0xCD, 0x1D]); // 0: 1 s, 500 000 000 ns
        bytes.extend([14, 0, 0, 0]); // 8: length with end mark
        bytes.extend(b"finder_camera\0"); // 12..26
        bytes.extend([0; 6]); // to 32
        bytes.extend([3, 0, 0, 0, 0, 0, 0, 0]); // 32: id
        bytes.extend([0x00, 0x2F, 0x68, 0x59, 0, 0, 0, 0]); // 40: stamp_ns = 0x59682F00
        bytes.extend([0xFE, 0xFF, 0xFF, 0xFF, 7, 0, 0, 0]); // 48: pulses
        for number in [0x3FF0u16, 0xC000, 0x3FE0, 0, 0, 0, 0x3FF0] {
            bytes.extend([0, 0, 0, 0, 0, 0]); // 56..112: the pose, high bytes 3FF0 = 1, C000 = −2, 3FE0 = 0.5
            bytes.extend(number.to_le_bytes());
        }
        bytes.extend([3, 0, 0, 0, 0xE0, 1, 0, 0]); // 112: 3 × 480
        bytes.extend([255, 0, 0, 0]); // 120: white, no image recorded, to 124
        bytes.extend([1, 0, 0, 0, 1, 0, 0, 0]); // 124: one column: 1; 130, to 132
        bytes.extend([1, 0, 0, 0, 0x00, 0x80, 0x7A, 0x43]); // 132: 250.5
        bytes.extend([1, 0, 0, 0, 0x00, 0x00, 0x00, 0x3E]); // 140: 0.125
        bytes.extend([1, 0, 0, 0, 0x00, 0x00, 0x80, 0x42]); // 148: 64
        bytes.extend([1, 0, 0, 0, 5, 0, 0, 0]); // 156: one string of 5
        bytes.extend(b"dark\0"); // 164..169
        bytes.extend([0, 0, 0]); // to 172
        bytes.extend([1, 0, 0, 0, 2, 0, 0, 0, 0, 0, 0, 0]); // 172: one count; 176: 2
        let message = CaptureMessage::new(&capture, &line, Some(255), false).unwrap();
        assert_eq!(encode(&message).unwrap(), bytes);
    }

    #[test]
    fn the_bytes_of_a_pose_tree_are_those_of_its_schema() {
        let mut bytes: Vec<u8> = vec![0, 1, 0, 0];
        bytes.extend([1, 0, 0, 0]); // 0: one edge
        bytes.extend([0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xC9, 0x9A, 0x3B]); // 4: −1 s + 999 999 999 ns = −1 ns
        bytes.extend([4, 0, 0, 0]); // 12
        bytes.extend(b"map\0"); // 16..20
        bytes.extend([5, 0, 0, 0]); // 20
        bytes.extend(b"odom\0"); // 24..29
        bytes.extend([0, 0, 0]); // to 32
        for number in [4.0f64, 0.0, -0.0, 0.0, 0.0, 0.6, 0.8] {
            bytes.extend(number.to_le_bytes()); // 32..88
        }
        let transform = Pose::from(&Transform::<Odom, Robot>::from_stored([4.0, 0.0, -0.0], [0.0, 0.0, 0.6, 0.8]));
        let header = Header::new(Stamp(-1), "map").unwrap();
        let edge = TransformStamped { header, child_frame_id: "odom".into(), transform };
        let message = TfMessage { transforms: vec![edge] };
        assert_eq!(encode(&message).unwrap(), bytes);
        assert_eq!(decode::<TfMessage>(&bytes).unwrap(), message);
    }

    #[test]
    fn a_capture_that_contradicts_itself_is_refused() {
        let good = CaptureMessage {
            image_width: 4,
            column: vec![1, 3],
            v: vec![0.0; 2],
            sigma: vec![0.0; 2],
            level: vec![0.0; 2],
            ..CaptureMessage::default()
        };
        assert!(good.capture().is_ok());
        for bad in [
            CaptureMessage { v: vec![0.0; 3], ..good.clone() },
            CaptureMessage { column: vec![3, 1], ..good.clone() },
            CaptureMessage { column: vec![1, 1], ..good.clone() },
            CaptureMessage { column: vec![1, 4], ..good.clone() },
            CaptureMessage { image_width: u32::MAX, ..good.clone() },
            CaptureMessage { drop_reason: vec!["dark".into()], ..good.clone() },
            CaptureMessage { drop_reason: vec!["gone".into()], drop_count: vec![1], ..good.clone() },
            CaptureMessage { drop_reason: vec!["dark".into(); 2], drop_count: vec![1, 2], ..good.clone() },
        ] {
            assert!(bad.capture().is_err(), "{bad:?}");
        }
        assert!(Time::from_stamp(Stamp(i64::MAX)).is_err());
    }
}
