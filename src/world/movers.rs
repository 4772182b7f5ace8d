//! Things that move by script: a person that walks to and fro. They push what is in their way and are not pushed.

use nalgebra::{Isometry3, UnitQuaternion, Vector3};

use crate::fault::{Fault, Result, number_within};

/// Most waypoints of a path.
const WAYPOINTS_MAX: usize = 10_000;
/// Longest time and farthest place [s], [m].
const FAR: f64 = 1e6;

/// A way through the world: straight from waypoint to waypoint, x ahead.
#[derive(Clone, Debug, PartialEq)]
pub struct Track {
    /// When it is where; strictly later from one to the next.
    knots: Vec<(f64, Vector3<f64>)>,
    /// Whether it begins again where it ends.
    repeats: bool,
}

impl Track {
    /// A way with the times at which it is at each waypoint [s], [m]. Before the first it stands there; after the last too,
    /// unless it `repeats`: then the time from the first to the last is a round.
    ///
    /// # Errors
    /// No waypoints, numbers that are not finite or far away, times that do not grow, another number of times than of
    /// waypoints, a round that does not end where it began.
    pub fn new(waypoints_m: &[[f64; 3]], times_s: &[f64], repeats: bool) -> Result<Self> {
        if waypoints_m.is_empty() || waypoints_m.len() > WAYPOINTS_MAX {
            return Err(Fault::new(
                "path",
                format!("{} waypoints", waypoints_m.len()),
                format!("1 to {WAYPOINTS_MAX}"),
            ));
        }
        if times_s.len() != waypoints_m.len() {
            let expected = format!("{}, one for each waypoint", waypoints_m.len());
            return Err(Fault::new("times_s", format!("{} times", times_s.len()), expected));
        }
        for value in waypoints_m.iter().flatten() {
            number_within("path", *value, -FAR, FAR)?;
        }
        for (k, time) in times_s.iter().enumerate() {
            number_within("times_s", *time, 0.0, FAR)?;
            if k > 0 && *time <= times_s[k - 1] {
                return Err(Fault::new("times_s", time, format!("later than {}", times_s[k - 1])));
            }
        }
        let (first, last) = (waypoints_m[0], waypoints_m[waypoints_m.len() - 1]);
        if repeats && (waypoints_m.len() < 2 || first != last) {
            let expected = format!("{first:?}, where it begins: it repeats");
            return Err(Fault::new("last waypoint of path", format!("{last:?}"), expected));
        }
        let knots = times_s.iter().zip(waypoints_m).map(|(time, at)| (*time, Vector3::from(*at))).collect();
        Ok(Self { knots, repeats })
    }

    /// A way at a steady speed [m/s] from `start_s` on; one that repeats goes straight back to its first waypoint.
    ///
    /// # Errors
    /// As [`Self::new`]; a speed that is not above 0; two waypoints in the same place.
    pub fn steady(waypoints_m: &[[f64; 3]], speed_m_s: f64, start_s: f64, repeats: bool) -> Result<Self> {
        number_within("speed_m_s", speed_m_s, 1e-3, 100.0)?;
        let mut way = waypoints_m.to_vec();
        if let (true, Some(first), Some(last)) = (repeats, way.first().copied(), way.last().copied())
            && first != last
        {
            way.push(first);
        }
        let mut time = start_s;
        let mut times = Vec::with_capacity(way.len());
        for (k, at) in way.iter().enumerate() {
            if k > 0 {
                let step = (Vector3::from(*at) - Vector3::from(way[k - 1])).norm();
                if step == 0.0 {
                    return Err(Fault::new("path", format!("{at:?} twice in a row"), "another place each time"));
                }
                time += step / speed_m_s;
            }
            times.push(time);
        }
        Self::new(&way, &times, repeats)
    }

    /// Where it is at a time [s].
    pub fn at(&self, time_s: f64) -> Isometry3<f64> {
        let (first, last) = (self.knots[0].0, self.knots[self.knots.len() - 1].0);
        let time_s = match self.repeats && time_s > first {
            true => first + (time_s - first) % (last - first),
            false => time_s,
        };
        let after = self.knots.partition_point(|knot| knot.0 <= time_s).clamp(1, self.knots.len().max(2) - 1);
        let (Some(from), Some(to)) = (self.knots.get(after - 1), self.knots.get(after)) else {
            return Isometry3::translation(self.knots[0].1.x, self.knots[0].1.y, self.knots[0].1.z);
        };
        let share = ((time_s - from.0) / (to.0 - from.0)).clamp(0.0, 1.0);
        let way = to.1 - from.1;
        let place = from.1 + way * share;
        let heading = if way.x == 0.0 && way.y == 0.0 { 0.0 } else { way.y.atan2(way.x) };
        Isometry3::from_parts(place.into(), UnitQuaternion::from_axis_angle(&Vector3::z_axis(), heading))
    }
}

/// Bodies of a scene that ride along a track together.
#[derive(Clone, Debug, PartialEq)]
pub struct Mover {
    /// Its name.
    pub name: String,
    /// Indices of its bodies in the scene; their poses there are those at time 0.
    pub bodies: Vec<usize>,
    /// Its way.
    pub track: Track,
}

impl Mover {
    /// How its bodies have moved since time 0: world from world.
    pub fn moved(&self, time_s: f64) -> Isometry3<f64> {
        self.track.at(time_s) * self.track.at(0.0).inverse()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(track: &Track, time_s: f64) -> [f64; 3] {
        let pose = track.at(time_s);
        [pose.translation.x, pose.translation.y, pose.rotation.euler_angles().2.to_degrees().round()]
    }

    #[test]
    fn a_track_is_walked_to_and_fro() {
        let track = Track::steady(&[[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]], 0.5, 1.0, true).unwrap();
        assert_eq!(at(&track, 0.0), [0.0, 0.0, 0.0]);
        assert_eq!(at(&track, 3.0), [1.0, 0.0, 0.0]);
        assert_eq!(at(&track, 7.0), [1.0, 0.0, 180.0]);
        assert_eq!(at(&track, 11.0), [1.0, 0.0, 0.0]);
        let once = Track::new(&[[0.0; 3], [0.0, 1.0, 0.0]], &[2.0, 4.0], false).unwrap();
        assert_eq!(at(&once, 1.0), [0.0, 0.0, 90.0]);
        assert_eq!(at(&once, 3.0), [0.0, 0.5, 90.0]);
        assert_eq!(at(&once, 1e5), [0.0, 1.0, 90.0]);
        let stands = Track::new(&[[1.0, 2.0, 0.0]], &[0.0], false).unwrap();
        assert_eq!(at(&stands, 9.0), [1.0, 2.0, 0.0]);
    }

    #[test]
    fn riders_keep_their_place_on_the_mover() {
        let track = Track::new(&[[1.0, 0.0, 0.0], [1.0, 2.0, 0.0]], &[0.0, 2.0], false).unwrap();
        let mover = Mover { name: "m".into(), bodies: vec![0], track };
        let moved = mover.moved(1.0);
        assert!((moved.translation.vector - Vector3::y()).norm() < 1e-12 && moved.rotation.angle() < 1e-12);
    }

    #[test]
    fn tracks_that_cannot_be_walked_are_refused() {
        let fault = |way: &[[f64; 3]], times: &[f64], repeats| Track::new(way, times, repeats).unwrap_err().to_string();
        assert!(fault(&[], &[], false).starts_with("path: found 0 waypoints"));
        assert!(fault(&[[0.0; 3]], &[], false).starts_with("times_s: found 0 times"));
        assert!(fault(&[[f64::NAN, 0.0, 0.0]], &[0.0], false).starts_with("path"));
        assert!(fault(&[[0.0; 3], [1.0; 3]], &[1.0, 1.0], false).starts_with("times_s: found 1"));
        assert!(fault(&[[0.0; 3], [1.0; 3]], &[0.0, 1.0], true).starts_with("last waypoint"));
        assert!(fault(&[[0.0; 3]], &[0.0], true).starts_with("last waypoint"));
        assert!(Track::steady(&[[0.0; 3], [0.0; 3]], 1.0, 0.0, false).is_err());
        assert!(Track::steady(&[[0.0; 3], [1.0; 3]], 0.0, 0.0, false).is_err());
        assert!(Track::steady(&[], 1.0, 0.0, true).is_err());
    }
}
