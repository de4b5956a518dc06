//! The box in which the features of a deformer lie, `train.field_box`.

use cc4dgs_core::{Error, HostGaussians, Result, Scene};
use serde::de::{Deserializer, Unexpected, Visitor};
use serde::{Deserialize, Serialize, Serializer};

/// Percentiles between which what may move lies, and the share of their distance by which the box is larger on each side.
const INNER: [f64; 2] = [0.001, 0.999];
const MARGIN: f32 = 0.05;

/// The box in which the features of a deformer lie: grids are spread over it. In configurations it is `"moving"`, `"all"`, `"points"` or a positive number.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FieldBox {
    /// Per axis from the 0.1 to the 99.9 percentile of the centres of what may move, 5 % larger on each side.
    Moving,
    /// Per axis from the least to the largest centre of all Gaussians.
    All,
    /// The box of the first points: that of the scene ([`Scene::init_box`]), else per axis from the least to the largest of its points ([`Scene::points`]), else
    /// as [`FieldBox::All`].
    Points,
    /// A cube of this half width around the origin of the dataset, in units of the dataset. In the normalised frame it lies around the image of that origin: axes
    /// keep their directions ([`cc4dgs_core::Similarity`]).
    Cube(f64),
}

impl FieldBox {
    /// Lower and upper corner in the normalised frame. `moving` are the Gaussians that may move; `all` gives all of them. Both without those that are not finite.
    /// No axis has the width 0.
    ///
    /// # Errors
    /// [`Error::Parameter`] for a cube that is too large for float32, and what `all` reports.
    pub(crate) fn corners(self, moving: &HostGaussians, all: impl FnOnce() -> Result<HostGaussians>, scene: &Scene) -> Result<[[f32; 3]; 2]> {
        let corners = match (self, scene.init_box.filter(|(low, high)| low.iter().chain(high).all(|v| v.is_finite())), &scene.points) {
            (Self::Moving, ..) => {
                let [low, high] = ends(&moving.means, INNER);
                let pad: [f32; 3] = std::array::from_fn(|k| (MARGIN * (high[k] - low[k])).max(least_pad(low[k], high[k])));
                return Ok([std::array::from_fn(|k| low[k] - pad[k]), std::array::from_fn(|k| high[k] + pad[k])]);
            }
            (Self::Cube(half), ..) => cube(half, scene)?,
            (Self::Points, Some((low, high)), _) => [low, high],
            (Self::Points, None, Some(points)) if points.positions.iter().any(is_finite) => {
                let means: Vec<f32> = points.positions.iter().filter(|p| is_finite(p)).flatten().copied().collect();
                ends(&means, [0.0, 1.0])
            }
            (Self::Points | Self::All, ..) => ends(&all()?.means, [0.0, 1.0]),
        };
        let [low, high] = corners;
        let pad: [f32; 3] = std::array::from_fn(|k| (least_pad(low[k], high[k]) - 0.5 * (high[k] - low[k])).max(0.0));
        Ok([std::array::from_fn(|k| low[k] - pad[k]), std::array::from_fn(|k| high[k] + pad[k])])
    }
}

fn is_finite(point: &[f32; 3]) -> bool {
    point.iter().all(|v| v.is_finite())
}

/// What a flat axis is widened by on each side: it still needs a width to be normalised by.
fn least_pad(low: f32, high: f32) -> f32 {
    1e-4 * (1.0 + low.abs().max(high.abs()))
}

/// The percentiles `shares` of the centres `means` `[N,3]` per axis; 0 where there are none.
fn ends(means: &[f32], shares: [f64; 2]) -> [[f32; 3]; 2] {
    let mut found = [[0.0f32; 3]; 2];
    for k in 0..3 {
        let mut values: Vec<f32> = means.iter().skip(k).step_by(3).copied().collect();
        values.sort_unstable_by(f32::total_cmp);
        for (end, share) in found.iter_mut().zip(shares) {
            end[k] = values.get((values.len().saturating_sub(1) as f64 * share).round() as usize).copied().unwrap_or(0.0);
        }
    }
    found
}

/// Corners of the cube of the half width `half` around the origin of the dataset of `scene`.
fn cube(half: f64, scene: &Scene) -> Result<[[f32; 3]; 2]> {
    let center = scene.normalisation.apply([0.0; 3]);
    let reach = half * scene.normalisation.scale;
    let corners = [-reach, reach].map(|reach| center.map(|c| (c + reach) as f32));
    if corners.iter().all(is_finite) {
        return Ok(corners);
    }
    let problem = format!("a cube of half width {half:e} in units of the dataset is {reach:e} in those of the normalised frame, too large for float32");
    Err(Error::parameter("train.field_box", problem, "Give a smaller half width, \"moving\", \"all\" or \"points\""))
}

impl Serialize for FieldBox {
    fn serialize<S: Serializer>(&self, serializer: S) -> std::result::Result<S::Ok, S::Error> {
        match self {
            Self::Moving => serializer.serialize_str("moving"),
            Self::All => serializer.serialize_str("all"),
            Self::Points => serializer.serialize_str("points"),
            Self::Cube(half) => serializer.serialize_f64(*half),
        }
    }
}

impl<'de> Deserialize<'de> for FieldBox {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> std::result::Result<Self, D::Error> {
        deserializer.deserialize_any(Choice)
    }
}

/// Reads a [`FieldBox`].
struct Choice;

impl Visitor<'_> for Choice {
    type Value = FieldBox;

    fn expecting(&self, formatter: &mut std::fmt::Formatter) -> std::fmt::Result {
        formatter.write_str("\"moving\", \"all\", \"points\" or a positive number")
    }
    fn visit_str<E: serde::de::Error>(self, name: &str) -> std::result::Result<FieldBox, E> {
        match name {
            "moving" => Ok(FieldBox::Moving),
            "all" => Ok(FieldBox::All),
            "points" => Ok(FieldBox::Points),
            _ => Err(E::invalid_value(Unexpected::Str(name), &self)),
        }
    }
    fn visit_f64<E: serde::de::Error>(self, half: f64) -> std::result::Result<FieldBox, E> {
        if half > 0.0 && half.is_finite() { Ok(FieldBox::Cube(half)) } else { Err(E::invalid_value(Unexpected::Float(half), &self)) }
    }
    fn visit_i64<E: serde::de::Error>(self, half: i64) -> std::result::Result<FieldBox, E> {
        self.visit_f64(half as f64)
    }
    fn visit_u64<E: serde::de::Error>(self, half: u64) -> std::result::Result<FieldBox, E> {
        self.visit_f64(half as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::RunConfig;
    use cc4dgs_core::{Camera, NoImages, PointCloud, Similarity, Split, View, config};
    use std::sync::Arc;

    fn scene() -> Scene {
        let camera = Camera::look_at("a", (8, 8), 1.0, [0.0, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]);
        let view = View { camera: 0, frame: 0, time_norm: 0.0, split: Split::Train };
        Scene::new("s", vec![camera], vec![view], Arc::new(NoImages), 0).unwrap()
    }

    /// `count` centres on a line from 0 to 1 in x, from 0 to `y` in y, at 2 in z.
    fn line(count: usize, y: f32) -> HostGaussians {
        let share = |i: usize| i as f32 / (count - 1) as f32;
        HostGaussians { means: (0..count).flat_map(|i| [share(i), y * share(i), 2.0]).collect(), ..Default::default() }
    }

    #[test]
    fn each_box_has_its_gaussians_or_points() {
        let (moving, mut scene) = (line(1001, 10.0), scene());
        let of = |kind: FieldBox, scene: &Scene| kind.corners(&moving, || Ok(line(3, -20.0)), scene).unwrap();
        // Of 1,001 values, the one beside each end, and 5 % of the distance.
        let [low, high] = of(FieldBox::Moving, &scene);
        let near = |found: f32, wanted: f32| (found - wanted).abs() < 1e-5;
        assert!(near(low[0], 0.001 - 0.0499) && near(high[0], 0.999 + 0.0499) && near(high[1], 9.99 + 0.499), "{low:?} {high:?}");
        // A flat axis has a width all the same.
        let flat = [2.0 - 3e-4, 2.0 + 3e-4];
        assert!(near(low[2], flat[0]) && near(high[2], flat[1]) && low[2] < high[2], "{low:?} {high:?}");
        let [low, high] = of(FieldBox::All, &scene);
        assert_eq!((low[..2].to_vec(), high[..2].to_vec()), (vec![0.0, -20.0], vec![1.0, 0.0]), "no margin");
        assert!(near(low[2], flat[0]) && near(high[2], flat[1]) && low[2] < high[2], "{low:?} {high:?}");
        assert_eq!(of(FieldBox::Points, &scene), [low, high], "there are no points");
        scene.points = Some(PointCloud { positions: vec![[1.0, 2.0, 3.0], [f32::NAN; 3], [-1.0, 4.0, 9.0]], colors: vec![[0.5; 3]; 3] });
        assert_eq!(of(FieldBox::Points, &scene), [[-1.0, 2.0, 3.0], [1.0, 4.0, 9.0]]);
        scene.init_box = Some(([-3.0; 3], [3.0; 3]));
        assert_eq!(of(FieldBox::Points, &scene), [[-3.0; 3], [3.0; 3]]);
        let nothing = FieldBox::Moving.corners(&HostGaussians::default(), || Ok(HostGaussians::default()), &scene).unwrap();
        assert_eq!(nothing, [[-1e-4; 3], [1e-4; 3]]);
    }

    #[test]
    fn cubes_are_in_units_of_the_dataset() {
        let mut scene = scene();
        scene.normalisation = Similarity { scale: 0.5, translation: [1.0, -2.0, 0.0] };
        let of = |half: f64| FieldBox::Cube(half).corners(&line(5, 1.0), || Ok(HostGaussians::default()), &scene);
        assert_eq!(of(4.0).unwrap(), [[-1.0, -4.0, -2.0], [3.0, 0.0, 2.0]]);
        let [low, high] = of(1e-30).unwrap();
        assert!((0..3).all(|k| low[k] < high[k]), "{low:?} {high:?}");
        let refused = of(1e300).unwrap_err().to_string();
        assert!(refused.contains("train.field_box") && refused.contains("1e300"), "{refused}");
    }

    #[test]
    fn configurations_name_a_box_or_a_half_width() {
        let read = |value: &str| RunConfig::resolve(Some("demo"), None, &[format!("train.field_box={value}")]);
        let named = [("moving", FieldBox::Moving), ("all", FieldBox::All), ("points", FieldBox::Points)];
        for (text, kind) in named.into_iter().chain([("1.6", FieldBox::Cube(1.6)), ("30", FieldBox::Cube(30.0))]) {
            let config = read(text).unwrap();
            assert_eq!(config.train.field_box, kind);
            let written: RunConfig = config::parse_section("written", &config.to_toml().unwrap().parse().unwrap()).unwrap();
            assert_eq!(written.train.field_box, kind);
        }
        assert_eq!(RunConfig::resolve(Some("demo"), None, &[]).unwrap().train.field_box, FieldBox::Moving);
        for value in ["mving", "0", "-1.5", "inf", "nan", "true", "[1, 2]"] {
            let refused = read(value).unwrap_err().to_string();
            assert!(refused.contains("field_box") && ["\"moving\"", "\"all\"", "\"points\""].iter().all(|name| refused.contains(name)), "{value}: {refused}");
        }
    }
}
