//! Scored images of a result in columns, the form in files: names of metrics are written once, not once per image.

use super::result::ImageResult;
use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};

/// A column per field of [`ImageResult`]. A column that no image has is left out.
#[derive(Serialize, Deserialize)]
struct Columns {
    camera: Vec<String>,
    frame: Vec<usize>,
    time_norm: Vec<f32>,
    scores: BTreeMap<String, Vec<Option<f64>>>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    blocks: Option<Vec<Option<(usize, usize, f64)>>>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    truth: Option<Vec<Option<String>>>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    render: Option<Vec<Option<String>>>,
}

/// Writes `images` in columns.
pub fn serialize<S: Serializer>(images: &[ImageResult], serializer: S) -> Result<S::Ok, S::Error> {
    fn column<T>(images: &[ImageResult], of: impl Fn(&ImageResult) -> Option<T>) -> Option<Vec<Option<T>>> {
        let values: Vec<Option<T>> = images.iter().map(of).collect();
        values.iter().any(Option::is_some).then_some(values)
    }
    let names: BTreeSet<&String> = images.iter().flat_map(|image| image.scores.keys()).collect();
    let scores = names.into_iter().map(|name| (name.clone(), images.iter().map(|image| image.scores.get(name).copied()).collect())).collect();
    Columns {
        camera: images.iter().map(|image| image.camera.clone()).collect(),
        frame: images.iter().map(|image| image.frame).collect(),
        time_norm: images.iter().map(|image| image.time_norm).collect(),
        scores,
        blocks: column(images, |image| image.blocks),
        truth: column(images, |image| image.truth.clone()),
        render: column(images, |image| image.render.clone()),
    }
    .serialize(serializer)
}

/// Reads columns, which must have equal lengths, and the form of version 1 of the schema: a list with a table per image.
pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<ImageResult>, D::Error> {
    let value = Value::deserialize(deserializer)?;
    if value.is_array() {
        return serde_json::from_value(value).map_err(D::Error::custom);
    }
    let columns: Columns = serde_json::from_value(value).map_err(D::Error::custom)?;
    let n = columns.camera.len();
    let lengths = [Some(columns.frame.len()), Some(columns.time_norm.len()), columns.blocks.as_ref().map(Vec::len)]
        .into_iter()
        .chain([&columns.truth, &columns.render].map(|column| column.as_ref().map(Vec::len)))
        .chain(columns.scores.values().map(|column| Some(column.len())));
    if let Some(other) = lengths.flatten().find(|len| *len != n) {
        return Err(D::Error::custom(format!("the columns of its images differ in length: {n} and {other}")));
    }
    let name = |column: &Option<Vec<Option<String>>>, i: usize| column.as_ref().and_then(|column| column[i].clone());
    let image = |i: usize| ImageResult {
        camera: columns.camera[i].clone(),
        frame: columns.frame[i],
        time_norm: columns.time_norm[i],
        scores: columns.scores.iter().filter_map(|(name, column)| Some((name.clone(), column[i]?))).collect(),
        blocks: columns.blocks.as_ref().and_then(|column| column[i]),
        truth: name(&columns.truth, i),
        render: name(&columns.render, i),
    };
    Ok((0..n).map(image).collect())
}
