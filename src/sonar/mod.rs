//! The ultrasonic ring: the laser's rival, by its physics. Pulses of 50 kHz from round pistons meet the faces, edges,
//! corners and round bodies of a world; what comes back over the receiver's stepped threshold first is the reading.
//!
//! ```text
//! Scene ─► Targets (faces, edges, corners …, once) ─► Search (echoes from j to i) ─► crossings ─► Reading
//! ```
//!
//! Closed forms throughout: image sources for flat mirrors, the uniform theory of diffraction for edges, geometrical optics
//! for round bodies, Lambert for what is rough; the tests in `reference` hold them against numerical integrals.
//!
//! Not modelled: edges that sound meets twice, corners where three faces meet (they are three corners of two), the fading
//! of rough echoes, what moves while one ping is under way, and draughts.

mod air;
mod beam;
mod diffuse;
mod face;
mod feature;
mod group;
mod hear;
mod need;
mod params;
mod receive;
#[cfg(test)]
mod reference;
mod reflect;
mod ring;
mod sight;
mod special;
mod statistics;
mod targets;
mod transducer;
mod wedge;
mod weld;

pub use air::Air;
pub use params::{RingParams, Schedule};
pub use reflect::EchoKind;
pub use ring::{Echo, Ping, Reading, Ring};
pub use sight::Aim;
pub use statistics::{BIN_M, JUMP_M, RangeStatistics};
pub use targets::Targets;
pub use transducer::TransducerParams;
