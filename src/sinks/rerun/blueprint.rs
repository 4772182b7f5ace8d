//! How the viewer lays the drawing out when it opens.
//!
//! Rerun's own `Blueprint` cannot set eyes, bounds and time ranges, so the same entities are logged here one by one.
//! Ids within the layout are fixed, so that the layouts of all runs are alike.

use nalgebra::Vector3;
use rerun::external::re_log_encoding::rrd::Encoder;
use rerun::external::re_log_types::BlueprintActivationCommand;
use rerun::external::re_sdk_types::blueprint::archetypes::{
    ContainerBlueprint, EyeControls3D, LineGrid3D, PanelBlueprint, PlotLegend, SpatialInformation, TextLogColumns,
    TimeAxis, TimePanelBlueprint, ViewBlueprint, ViewContents, ViewportBlueprint, VisibleTimeRanges, VisualBounds2D,
};
use rerun::external::re_sdk_types::blueprint::components as parts;
use rerun::external::re_sdk_types::blueprint::datatypes::{TextLogColumn, TextLogColumnKind};
use rerun::external::re_sdk_types::datatypes;
use rerun::log::LogMsg;
use rerun::{ApplicationId, AsComponents, RecordingStream, RecordingStreamBuilder, RecordingStreamResult};

use super::{APPLICATION, Out, f32s};
use crate::fault::{Fault, Result};
use crate::geometry::{Frame, World};
use crate::record::topics;

/// What the layout depends on.
#[derive(Clone, Debug)]
pub(super) struct Layout {
    /// Size of the camera's image [px].
    pub image_px: [f32; 2],
    /// Lower and upper corner of what the 3D views shall show [m].
    pub bounds_m: [Vector3<f64>; 2],
    /// Whether there is a true scene to draw, and errors to plot.
    pub has_truth: bool,
    /// Whether there are ultrasonic ranges beside the laser's points.
    pub has_sonar: bool,
}

/// Half the viewer's vertical field of view: 55° [rad].
const HALF_FOV_RAD: f64 = 0.48;

/// Entities whose whole past is shown, not only their latest row.
const HISTORIES: [&str; 4] = ["/world/points", "/world/echoes", "/path/estimated", "/path/true"];

/// The timelines of what this crate draws.
const TIMES: [&str; 2] = ["sim_time", "scan"];

/// The timelines that the viewer gives an MCAP recording.
const RECORDING_TIMES: [&str; 2] = ["message_log_time", "message_publish_time"];

/// Logs parts of one layout and numbers them.
struct Book {
    stream: RecordingStream,
    parts: u8,
}

/// A part of the layout: its path and its number.
struct Part {
    path: String,
    number: u8,
}

/// Sends the layout down the stream, to be used at once and from then on.
pub(super) fn send(out: &Out, layout: &Layout, revision: i64) -> Result<()> {
    let info = out.0.store_info().ok_or_else(|| Fault::new("the viewer's layout", "no stream", "a stream"))?;
    let id = info.store_id.recording_id().to_string();
    let messages = messages(APPLICATION, &id, revision, |book| write(book, layout))?;
    let Some(first) = messages.first() else { return Ok(()) };
    let activation = BlueprintActivationCommand::make_active(first.store_id().clone());
    out.0.send_blueprint(messages, activation);
    Ok(())
}

/// The layout for a recording that the viewer opens under this application id, as the bytes of an `.rbl` file.
///
/// Without it the viewer makes a view for every topic, and none of them finds the frame `map`.
pub(super) fn of_recording(application: &str) -> Result<Vec<u8>> {
    let mut messages = messages(application, "recording", 0, write_recording)?;
    if let Some(first) = messages.first() {
        messages.push(BlueprintActivationCommand::make_active(first.store_id().clone()).into());
    }
    Encoder::encode(messages.into_iter().map(Ok)).map_err(|e| rejected(&e))
}

/// What a layout is made of, in one store of its own.
fn messages(
    application: &str,
    id: &str,
    revision: i64,
    write: impl FnOnce(&mut Book) -> RecordingStreamResult<()>,
) -> Result<Vec<LogMsg>> {
    let builder = RecordingStreamBuilder::new(ApplicationId::new_or_unknown(application))
        .enabled(true)
        .blueprint()
        .recording_id(id);
    let (stream, stored) = builder.memory().map_err(|e| rejected(&e))?;
    stream.set_log_tick_enabled(false);
    stream.set_log_time_enabled(false);
    stream.set_time_sequence("blueprint", revision);
    write(&mut Book { stream, parts: 0 }).map_err(|e| rejected(&e))?;
    Ok(stored.take())
}

fn rejected(error: &dyn std::fmt::Display) -> Fault {
    Fault::new("the viewer's layout", error, "a working Rerun stream")
}

/// The views of an MCAP recording: its topics in the frame `map`.
fn write_recording(book: &mut Book) -> RecordingStreamResult<()> {
    let world = book.view("3D", "World", "/", &["/**", &format!("- {}", topics::SCAN)])?;
    book.set(&world, "SpatialInformation", &SpatialInformation::new(World::NAME))?;
    book.whole_past(&world, &[topics::POINTS], &RECORDING_TIMES)?;
    let camera = book.view("2D", "Camera", topics::IMAGE, &["$origin/**"])?;
    let log = book.view("TextLog", "Log", "/", &[topics::LOG])?;
    let column = book.container(parts::ContainerKind::Vertical, &[camera, log], &[3.0, 2.0])?;
    let root = book.container(parts::ContainerKind::Horizontal, &[world, column], &[5.0, 3.0])?;
    book.finish(&root, RECORDING_TIMES[0])
}

fn write(book: &mut Book, layout: &Layout) -> RecordingStreamResult<()> {
    let scenes = if layout.has_sonar { both_sensors(book, layout)? } else { laser_alone(book, layout)? };
    let camera = camera_view(book, layout)?;
    let beside = if layout.has_sonar {
        let voxels = map_view(book, layout, "Occupancy: voxels", "/world/occupancy/**")?;
        let terrain = map_view(book, layout, "Terrain: mesh of the ground", "/world/terrain/**")?;
        book.container(parts::ContainerKind::Tabs, &[voxels, terrain], &[])?
    } else {
        plan_view(book, layout, "Plan view", "/plan")?
    };
    let mut plots = vec![];
    if layout.has_truth {
        plots.push(plot_view(book, "Errors", &["/metrics/point_rms_mm", "/metrics/pose_error_mm"])?);
    }
    plots.push(plot_view(book, "Counts", &["/metrics/points", "/metrics/dropped", "/metrics/lost"])?);
    let plots = book.container(parts::ContainerKind::Tabs, &plots, &[])?;
    let log = book.view("TextLog", "Log", "/", &["/log"])?;
    let columns = [TextLogColumnKind::LogLevel, TextLogColumnKind::Body];
    let columns = columns.map(|kind| parts::TextLogColumn(TextLogColumn { kind, visible: true.into() }));
    book.set(&log, "TextLogColumns", &TextLogColumns::new().with_text_log_columns(columns))?;
    let about = book.view("TextDocument", "About", "/", &["/about"])?;
    let words = book.container(parts::ContainerKind::Tabs, &[log, about], &[])?;
    let column =
        book.container(parts::ContainerKind::Vertical, &[camera, beside, plots, words], &[3.0, 3.0, 2.0, 2.0])?;
    let root = book.container(parts::ContainerKind::Horizontal, &[scenes, column], &[5.0, 3.0])?;
    book.finish(&root, TIMES[0])
}

/// The scene, and below it the maps that are made of points.
fn laser_alone(book: &mut Book, layout: &Layout) -> RecordingStreamResult<Part> {
    let name = if layout.has_truth { "World: true scene and measured points" } else { "World: measured points" };
    let world = world_view(book, layout, name, &[])?;
    let voxels = map_view(book, layout, "Occupancy: voxels", "/world/occupancy/**")?;
    let terrain = map_view(book, layout, "Terrain: mesh of the ground", "/world/terrain/**")?;
    let maps = book.container(parts::ContainerKind::Horizontal, &[voxels, terrain], &[1.0, 1.0])?;
    book.container(parts::ContainerKind::Vertical, &[world, maps], &[3.0, 2.0])
}

/// Laser and ultrasound side by side: the same scene twice, and below what each makes of it, and both together.
fn both_sensors(book: &mut Book, layout: &Layout) -> RecordingStreamResult<Part> {
    let not_laser = ["- /world/points", "- /world/profile", "- /world/robot/laser", "- /world/robot/finder/**"];
    let laser =
        world_view(book, layout, "Laser: sheet of light and points", &["- /world/sonar/**", "- /world/echoes"])?;
    let sound = world_view(book, layout, "Ultrasonic: ranges, and where the echoes came from", &not_laser)?;
    let scenes = book.container(parts::ContainerKind::Horizontal, &[laser, sound], &[1.0, 1.0])?;
    let plans = [
        plan_view(book, layout, "Map of the laser", "/plan")?,
        plan_view(book, layout, "Map of the ultrasonic ring", "/plan_ultrasonic")?,
        plan_view(book, layout, "Map of both", "/plan_fused")?,
    ];
    let plans = book.container(parts::ContainerKind::Horizontal, &plans, &[1.0, 1.0, 1.0])?;
    book.container(parts::ContainerKind::Vertical, &[scenes, plans], &[3.0, 2.0])
}

/// The true scene, the robot, and what it has measured, but for what is left `out`.
fn world_view(book: &mut Book, layout: &Layout, name: &str, out: &[&str]) -> RecordingStreamResult<Part> {
    let contents = ["/world/**", "/path/**", "- /world/occupancy/**", "- /world/terrain/**"];
    let view = book.view("3D", name, "/world", &[&contents[..], out].concat())?;
    book.set(&view, "EyeControls3D", &from_the_side(&layout.bounds_m))?;
    book.whole_past(&view, &HISTORIES, &TIMES)?;
    Ok(view)
}

/// One of the maps made of the points.
fn map_view(book: &mut Book, layout: &Layout, name: &str, map: &str) -> RecordingStreamResult<Part> {
    let view = book.view("3D", name, "/world", &[map, "/world/robot/**", "/path/**"])?;
    book.set(&view, "EyeControls3D", &from_the_side(&layout.bounds_m))?;
    book.whole_past(&view, &HISTORIES, &TIMES)?;
    Ok(view)
}

fn camera_view(book: &mut Book, layout: &Layout) -> RecordingStreamResult<Part> {
    let [width, height] = layout.image_px;
    let range = |end: f32| datatypes::Range1D([0.0, f64::from(end)]);
    let view = book.view("2D", "Camera: image and the line found", "/camera/image", &["/camera/image/**"])?;
    let bounds = datatypes::Range2D { x_range: range(width), y_range: range(height) };
    book.set(&view, "VisualBounds2D", &VisualBounds2D::new(parts::VisualBounds2D(bounds)))?;
    Ok(view)
}

fn plan_view(book: &mut Book, layout: &Layout, name: &str, plan: &str) -> RecordingStreamResult<Part> {
    let mut contents = vec![plan, "/path/**", "/world/robot/body"];
    contents.extend((plan == "/plan").then_some("/world/profile"));
    let view = book.view("3D", name, "/world", &contents)?;
    let [low, high] = layout.bounds_m;
    let (middle, size) = ((low + high) / 2.0, high - low);
    // Three plans beside each other are narrower than one, and ghosts make the ultrasonic one larger than the room.
    let (narrow, margin) = if layout.has_sonar { (1.0, 1.35) } else { (2.0, 1.05) };
    let above_m = (size.y.max(size.x / narrow).max(1.0) / 2.0) / HALF_FOV_RAD.tan() * margin;
    let floor = Vector3::new(middle.x, middle.y, 0.0);
    let eye = EyeControls3D::new()
        .with_position(f32s(&(floor + Vector3::z() * above_m)))
        .with_look_target(f32s(&floor))
        .with_eye_up([0.0, 1.0, 0.0]);
    book.set(&view, "EyeControls3D", &eye)?;
    book.set(&view, "LineGrid3D", &LineGrid3D::new().with_visible(false))?;
    book.whole_past(&view, &HISTORIES, &TIMES)?;
    Ok(view)
}

fn plot_view(book: &mut Book, name: &str, series: &[&str]) -> RecordingStreamResult<Part> {
    let view = book.view("TimeSeries", name, "/metrics", series)?;
    book.set(&view, "PlotLegend", &PlotLegend::new().with_corner(parts::Corner2D::LeftTop))?;
    let all = datatypes::TimeRange {
        start: datatypes::TimeRangeBoundary::Infinite,
        end: datatypes::TimeRangeBoundary::Infinite,
    };
    book.set(&view, "TimeAxis", &TimeAxis::new().with_view_range(parts::TimeRange(all)))?;
    Ok(view)
}

/// An eye that sees all of the box from behind and above.
fn from_the_side([low, high]: &[Vector3<f64>; 2]) -> EyeControls3D {
    let radius = ((high - low).norm() / 2.0).max(0.1);
    let target = (low + high) / 2.0;
    let direction = Vector3::new(-0.55, -0.65, 0.62).normalize();
    let position = target + direction * (radius * 0.78 / HALF_FOV_RAD.sin());
    EyeControls3D::new().with_position(f32s(&position)).with_look_target(f32s(&target)).with_eye_up([0.0, 0.0, 1.0])
}

impl Book {
    fn part(&mut self, kind: &str) -> Part {
        self.parts += 1;
        let hex: String = uuid_bytes(self.parts).iter().map(|byte| format!("{byte:02x}")).collect();
        let id = [&hex[..8], &hex[8..12], &hex[12..16], &hex[16..20], &hex[20..]].join("-");
        Part { path: format!("{kind}/{id}"), number: self.parts }
    }

    /// The outermost container, and panels out of the way; the latest of what is there is shown.
    fn finish(&self, root: &Part, timeline: &str) -> RecordingStreamResult<()> {
        let viewport = ViewportBlueprint::new()
            .with_root_container(parts::RootContainer(datatypes::Uuid { bytes: uuid_bytes(root.number) }))
            .with_auto_layout(false)
            .with_auto_views(false);
        self.stream.log("viewport", &viewport)?;
        for panel in ["blueprint_panel", "selection_panel"] {
            self.stream.log(panel, &PanelBlueprint::new().with_state(parts::PanelState::Collapsed))?;
        }
        let time = TimePanelBlueprint::new()
            .with_state(parts::PanelState::Collapsed)
            .with_timeline(timeline)
            .with_play_state(parts::PlayState::Following);
        self.stream.log("time_panel", &time)
    }

    fn view(&mut self, class: &str, name: &str, origin: &str, contents: &[&str]) -> RecordingStreamResult<Part> {
        let part = self.part("view");
        let contents = contents.iter().map(|query| parts::QueryExpression((*query).into()));
        self.stream.log(format!("{}/ViewContents", part.path), &ViewContents::new(contents))?;
        let view = ViewBlueprint::new(parts::ViewClass(class.into())).with_display_name(name).with_space_origin(origin);
        self.stream.log(part.path.as_str(), &view)?;
        Ok(part)
    }

    /// Sets a property of a view.
    fn set(&self, view: &Part, property: &str, value: &dyn AsComponents) -> RecordingStreamResult<()> {
        self.stream.log(format!("{}/{property}", view.path), value)
    }

    /// Shows the whole past of the entities that only grow.
    fn whole_past(&self, view: &Part, entities: &[&str], times: &[&str]) -> RecordingStreamResult<()> {
        let range = |timeline: &str| {
            parts::VisibleTimeRange(datatypes::VisibleTimeRange {
                timeline: timeline.into(),
                range: datatypes::TimeRange {
                    start: datatypes::TimeRangeBoundary::Infinite,
                    end: datatypes::TimeRangeBoundary::CursorRelative(datatypes::TimeInt(0)),
                },
            })
        };
        for entity in entities {
            let path = format!("{}/ViewContents/overrides{entity}/visualizers", view.path);
            self.stream.log(path, &VisibleTimeRanges::new(times.iter().map(|time| range(time))))?;
        }
        Ok(())
    }

    /// A container; `shares` of its space for each child, or none for tabs.
    fn container(
        &mut self,
        kind: parts::ContainerKind,
        children: &[Part],
        shares: &[f32],
    ) -> RecordingStreamResult<Part> {
        let part = self.part("container");
        let contents = children.iter().map(|child| parts::IncludedContent(child.path.as_str().into()));
        let mut container = ContainerBlueprint::new(kind).with_contents(contents);
        match kind {
            parts::ContainerKind::Horizontal => {
                container = container.with_col_shares(shares.iter().map(|s| parts::ColumnShare((*s).into())));
            }
            parts::ContainerKind::Vertical => {
                container = container.with_row_shares(shares.iter().map(|s| parts::RowShare((*s).into())));
            }
            parts::ContainerKind::Tabs | parts::ContainerKind::Grid => {
                if let Some(first) = children.first() {
                    container = container.with_active_tab(parts::ActiveTab(first.path.as_str().into()));
                }
            }
        }
        self.stream.log(part.path.as_str(), &container)?;
        Ok(part)
    }
}

/// A UUID (version 4 layout) that is the same in every run.
fn uuid_bytes(number: u8) -> [u8; 16] {
    let mut bytes = *b"metromAp\x80layout\0";
    bytes[15] = number;
    bytes
}

#[cfg(test)]
mod tests {
    use rerun::log::Chunk;

    use super::*;

    #[test]
    fn a_ring_gets_its_own_scene_and_maps_beside_the_lasers() {
        let views = |has_sonar, has_truth| {
            let bounds_m = [Vector3::zeros(), Vector3::repeat(1.0)];
            let layout = Layout { image_px: [640.0, 480.0], bounds_m, has_truth, has_sonar };
            let messages = messages("test", "test", 0, |book| write(book, &layout)).unwrap();
            let paths = messages.iter().filter_map(|message| match message {
                LogMsg::ArrowMsg(_, arrow) => Some(Chunk::from_arrow_msg(arrow).unwrap().entity_path().to_string()),
                _ => None,
            });
            paths.filter(|path| path.ends_with("/ViewContents")).count()
        };
        // Scene, voxels, terrain, camera, plan, counts, log and page; errors with a truth.
        assert_eq!(views(false, false), 8);
        assert_eq!(views(false, true), 9);
        // One more scene and two more plans.
        assert_eq!(views(true, true), 12);
    }
}
