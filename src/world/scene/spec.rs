//! The tables within `[world]`, as written.

use serde::Deserialize;
use toml::Spanned;

pub(super) type Number = Spanned<f64>;
pub(super) type Numbers = Spanned<Vec<f64>>;

/// A material; what is not set keeps its default.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct MaterialSpec {
    pub(super) albedo: Option<Number>,
    pub(super) gloss: Option<Number>,
    pub(super) transmission: Option<Number>,
    pub(super) gloss_spread_rad: Option<Number>,
    pub(super) acoustic_roughness_m: Option<Number>,
    pub(super) friction: Option<Number>,
    pub(super) colour: Option<[u8; 3]>,
}

/// `ground = true`, or a table.
#[derive(Clone, Debug)]
pub(super) enum GroundSpec {
    Default(bool),
    Table(GroundTable),
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct GroundTable {
    pub(super) z: Option<Number>,
    pub(super) material: Option<Spanned<String>>,
}

impl<'de> Deserialize<'de> for GroundSpec {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Visitor;
        impl<'de> serde::de::Visitor<'de> for Visitor {
            type Value = GroundSpec;

            fn expecting(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
                f.write_str("true, false or a table")
            }

            fn visit_bool<E>(self, ground: bool) -> Result<GroundSpec, E> {
                Ok(GroundSpec::Default(ground))
            }

            fn visit_map<A: serde::de::MapAccess<'de>>(self, map: A) -> Result<GroundSpec, A::Error> {
                GroundTable::deserialize(serde::de::value::MapAccessDeserializer::new(map)).map(GroundSpec::Table)
            }
        }
        deserializer.deserialize_any(Visitor)
    }
}

/// What every body has, by reference into its own table.
pub(super) struct Common<'a> {
    pub(super) kind: &'static str,
    pub(super) name: &'a Spanned<String>,
    pub(super) position: &'a Numbers,
    pub(super) yaw_deg: Option<&'a Number>,
    pub(super) rpy_deg: Option<&'a Numbers>,
    pub(super) material: Option<&'a Spanned<String>>,
    pub(super) mass_kg: Option<&'a Number>,
    pub(super) ground: Option<bool>,
    pub(super) mover: Option<&'a Spanned<String>>,
}

/// A table of a body: what all have and its own keys. (Serde's `flatten` would lose unknown keys and their lines.)
macro_rules! body_spec {
    ($name:ident { $($field:ident: $type:ty),* $(,)? }) => {
        #[derive(Clone, Debug, Deserialize)]
        #[serde(deny_unknown_fields)]
        pub(super) struct $name {
            pub(super) name: Spanned<String>,
            pub(super) position: Numbers,
            pub(super) yaw_deg: Option<Number>,
            pub(super) rpy_deg: Option<Numbers>,
            pub(super) material: Option<Spanned<String>>,
            pub(super) mass_kg: Option<Number>,
            pub(super) ground: Option<bool>,
            pub(super) mover: Option<Spanned<String>>,
            $(pub(super) $field: $type,)*
        }

        impl $name {
            pub(super) fn common(&self, kind: &'static str) -> Common<'_> {
                Common {
                    kind,
                    name: &self.name,
                    position: &self.position,
                    yaw_deg: self.yaw_deg.as_ref(),
                    rpy_deg: self.rpy_deg.as_ref(),
                    material: self.material.as_ref(),
                    mass_kg: self.mass_kg.as_ref(),
                    ground: self.ground,
                    mover: self.mover.as_ref(),
                }
            }
        }
    };
}

body_spec!(BoxSpec { size: Numbers });
body_spec!(CylinderSpec { radius: Number, height: Number });
body_spec!(SphereSpec { radius: Number });
body_spec!(TableSpec {
    size: Numbers,
    top_thickness: Option<Number>,
    leg_radius: Option<Number>,
    leg_inset: Option<Number>,
});
body_spec!(HeightfieldSpec {
    size: Option<Numbers>,
    spacing: Option<Number>,
    waves: Option<Spanned<Vec<WaveSpec>>>,
    noise: Option<Spanned<NoiseSpec>>,
    image: Option<Spanned<ImageSpec>>,
});
body_spec!(MeshSpec { file: Spanned<String>, scale: Option<Spanned<ScaleSpec>> });

/// Something that moves by script; bodies ride on it by their key `mover`, their positions in its frame.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct MoverSpec {
    pub(super) name: Spanned<String>,
    /// Waypoints: [x, y] or [x, y, z].
    pub(super) path: Spanned<Vec<Vec<f64>>>,
    /// At a steady speed from `start_s` on ...
    pub(super) speed_m_s: Option<Number>,
    pub(super) start_s: Option<Number>,
    /// ... or by a time for each waypoint.
    pub(super) times_s: Option<Numbers>,
    pub(super) r#loop: Option<bool>,
}

/// A rectangle of the ground that direct sun falls on.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct SunlitSpec {
    pub(super) from: Numbers,
    pub(super) to: Numbers,
    pub(super) w_per_m2: Option<Number>,
}

/// A wave of the ground: amplitude · sin(2π·(distance along `direction_deg`)/wavelength + phase).
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct WaveSpec {
    pub(super) amplitude: Number,
    pub(super) wavelength: Number,
    #[serde(default)]
    pub(super) direction_deg: Option<Number>,
    #[serde(default)]
    pub(super) phase_deg: Option<Number>,
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct NoiseSpec {
    pub(super) amplitude: Number,
    pub(super) wavelength: Number,
    #[serde(default)]
    pub(super) seed: u64,
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ImageSpec {
    pub(super) file: Spanned<String>,
    pub(super) m_per_level: Number,
    pub(super) m_per_pixel: Number,
}

/// One factor, or one for each axis.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(untagged, expecting = "a number or three of them")]
pub(super) enum ScaleSpec {
    All(f64),
    Each([f64; 3]),
}
