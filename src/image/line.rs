//! The laser line in one image: at most one peak a column.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

/// Where the line crosses a column.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Peak {
    /// Row [px] from the top, pixel centres at integers.
    pub v: f32,
    /// Standard deviation of the row [px].
    pub sigma: f32,
    /// Level of the peak over the background [levels].
    pub level: f32,
}

/// Why something was not used. `Display` and JSON give the name in snake_case.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Drop {
    /// A column without light.
    Dark,
    /// A column whose brightest place is not the line: too weak, too wide, or not like its neighbours' background.
    NotALine,
    /// The paper's distance test: neither neighbour is near (section 2.3, step 4).
    Isolated,
    /// The line of sight does not meet the sheet in front of the camera.
    NoPoint,
    /// Farther than the finder is trusted; an ultrasonic range outside its transducer's limits.
    OutOfRange,
    /// Triangulated to below the sheet's origin or with a covariance too large to be of use.
    Uncertain,
    /// A capture taken while cylinder or mirror still moved.
    Unsettled,
    /// A capture whose encoders are outside their travel.
    EncoderOutOfRange,
    /// A capture older than the one before it.
    TimeWentBack,
    /// A capture with the same time as the one before it.
    SameTime,
    /// A capture whose pose holds a number that is not finite.
    BadPose,
    /// A capture whose image or line has another size than the finder's camera.
    WrongSize,
    /// A map had reached its largest size, so an update was refused.
    MapFull,
    /// A file, message or record that could not be read.
    Unreadable,
}

impl Drop {
    /// Whether this is data that should have been there: exit code 3. Dark columns and unsettled frames are no loss.
    pub fn is_loss(self) -> bool {
        matches!(
            self,
            Self::EncoderOutOfRange
                | Self::TimeWentBack
                | Self::SameTime
                | Self::BadPose
                | Self::WrongSize
                | Self::MapFull
                | Self::Unreadable
        )
    }
}

impl std::fmt::Display for Drop {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Dark => "dark",
            Self::NotALine => "not_a_line",
            Self::Isolated => "isolated",
            Self::NoPoint => "no_point",
            Self::OutOfRange => "out_of_range",
            Self::Uncertain => "uncertain",
            Self::Unsettled => "unsettled",
            Self::EncoderOutOfRange => "encoder_out_of_range",
            Self::TimeWentBack => "time_went_back",
            Self::SameTime => "same_time",
            Self::BadPose => "bad_pose",
            Self::WrongSize => "wrong_size",
            Self::MapFull => "map_full",
            Self::Unreadable => "unreadable",
        })
    }
}

/// How many were not used, by reason.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Dropped(pub BTreeMap<Drop, u64>);

impl Dropped {
    /// Counts one more.
    pub fn add(&mut self, why: Drop) {
        self.add_many(why, 1);
    }

    /// Counts `count` more.
    pub fn add_many(&mut self, why: Drop, count: u64) {
        if count > 0 {
            *self.0.entry(why).or_default() += count;
        }
    }

    /// Adds another count to this one.
    pub fn merge(&mut self, other: &Self) {
        for (why, count) in &other.0 {
            self.add_many(*why, *count);
        }
    }

    /// How many were lost that should have been there.
    pub fn lost(&self) -> u64 {
        self.0.iter().filter(|(why, _)| why.is_loss()).map(|(_, count)| count).sum()
    }
}

/// The line in one image.
#[derive(Clone, Debug, PartialEq)]
pub struct Line {
    /// Rows of the image it was found in.
    pub height: usize,
    /// One entry a column; `None` where nothing was seen.
    pub columns: Vec<Option<Peak>>,
    /// Columns without a peak, by reason.
    pub dropped: Dropped,
}

impl Line {
    /// A line without columns, to be filled.
    pub fn empty() -> Self {
        Self { height: 0, columns: Vec::new(), dropped: Dropped::default() }
    }

    /// Columns of the image.
    pub fn width(&self) -> usize {
        self.columns.len()
    }

    /// How many columns have a peak.
    pub fn count(&self) -> usize {
        self.columns.iter().flatten().count()
    }
}
