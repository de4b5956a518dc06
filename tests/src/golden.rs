//! Golden fixtures: arrays of reference code with the sizes, constants and float32 noise that their JSON files state. Tests read sizes and constants here and
//! nowhere else, so that a case of another size in the folder is checked like the committed ones.

use safetensors::{Dtype, SafeTensors};
use serde_json::Value;
use std::path::PathBuf;

/// The folder of fixtures: `CC4DGS_GOLDEN`, or the committed folder.
pub fn folder() -> PathBuf {
    let committed = PathBuf::from("fixtures/golden");
    std::env::var_os("CC4DGS_GOLDEN").map_or(committed, PathBuf::from)
}

/// The JSON file `name` of the folder.
pub fn json(name: &str) -> Value {
    let path = folder().join(name);
    let text = std::fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    serde_json::from_str(&text).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// The fixtures called `kind`, or `kind_` and more: cases of one kind in different sizes. The committed folder has those called `committed`, and no others.
pub fn cases(kind: &str, committed: &[&str]) -> Vec<Fixture> {
    let files = std::fs::read_dir(folder()).unwrap_or_else(|e| panic!("{}: {e}", folder().display()));
    let names = files.filter_map(|entry| entry.expect("an entry").file_name().into_string().ok());
    let mut stems: Vec<String> = names.filter_map(|name| name.strip_suffix(".f64.safetensors").map(str::to_string)).collect();
    stems.retain(|stem| stem.strip_prefix(kind).is_some_and(|rest| rest.is_empty() || rest.starts_with('_')));
    stems.sort();
    assert!(!stems.is_empty(), "no fixture {kind} in {}", folder().display());
    assert!(std::env::var_os("CC4DGS_GOLDEN").is_some() || stems == committed, "fixtures {stems:?} in tests/{}, not {committed:?}", folder().display());
    stems.iter().map(|stem| Fixture::open(stem)).collect()
}

/// Arrays of one file, and its JSON file where it has one.
pub struct Fixture {
    /// Name of the file without extension.
    pub name: String,
    /// What the JSON file states; null without one.
    pub facts: Value,
    bytes: Vec<u8>,
}

impl Fixture {
    /// `name.f64.safetensors`, or `name.f32.safetensors` where only that exists.
    pub fn open(name: &str) -> Self {
        let wide = folder().join(format!("{name}.f64.safetensors"));
        let path = if wide.is_file() { wide } else { folder().join(format!("{name}.f32.safetensors")) };
        let bytes = std::fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        let facts = if folder().join(format!("{name}.json")).is_file() { json(&format!("{name}.json")) } else { Value::Null };
        Self { name: name.to_string(), facts, bytes }
    }
    /// Names of the arrays.
    pub fn keys(&self) -> Vec<String> {
        self.tensors().names().into_iter().map(ToString::to_string).collect()
    }
    /// Whether an array is there.
    pub fn has(&self, key: &str) -> bool {
        self.tensors().tensor(key).is_ok()
    }
    /// Shape of an array.
    pub fn shape(&self, key: &str) -> Vec<usize> {
        self.tensors().tensor(key).unwrap_or_else(|e| panic!("{} {key}: {e}", self.name)).shape().to_vec()
    }
    /// Values of an array of any type, as float64.
    pub fn get(&self, key: &str) -> Vec<f64> {
        let file = self.tensors();
        let view = file.tensor(key).unwrap_or_else(|e| panic!("{} {key}: {e}", self.name));
        let data = view.data();
        match view.dtype() {
            Dtype::F64 => data.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b)).collect(),
            Dtype::F32 => data.as_chunks::<4>().0.iter().map(|b| f64::from(f32::from_le_bytes(*b))).collect(),
            Dtype::I32 => data.as_chunks::<4>().0.iter().map(|b| f64::from(i32::from_le_bytes(*b))).collect(),
            Dtype::U8 => data.iter().map(|&b| f64::from(b)).collect(),
            other => panic!("{} {key}: unexpected type {other:?}", self.name),
        }
    }
    /// The same in float32.
    pub fn narrow(&self, key: &str) -> Vec<f32> {
        narrow(&self.get(key))
    }
    /// A number that the JSON file states, by its path, such as `["const", "lr"]`.
    pub fn number(&self, path: &[&str]) -> f64 {
        let found = path.iter().fold(&self.facts, |value, key| &value[*key]);
        found.as_f64().unwrap_or_else(|| panic!("{}.json has no number {}", self.name, path.join(".")))
    }
    /// A count that the JSON file states.
    pub fn count(&self, key: &str) -> usize {
        self.facts[key].as_u64().unwrap_or_else(|| panic!("{}.json has no count {key}", self.name)) as usize
    }
    /// Ten times the relative L2 error of `key` in the reference's own float32 run, at least `floor`.
    pub fn tolerance(&self, key: &str, floor: f64) -> f64 {
        (10.0 * self.number(&["noise_f32", key, "rel_l2"])).max(floor)
    }
    fn tensors(&self) -> SafeTensors<'_> {
        SafeTensors::deserialize(&self.bytes).unwrap_or_else(|e| panic!("{}: {e}", self.name))
    }
}

/// Float32 of float64 values.
pub fn narrow(values: &[f64]) -> Vec<f32> {
    values.iter().map(|&v| v as f32).collect()
}

/// Float64 of float32 values.
pub fn widen(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&v| f64::from(v)).collect()
}

/// |a - b| / |b| in the Euclidean norm; |a| where b is zero.
pub fn relative_l2(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len(), "arrays of different lengths");
    let norm = b.iter().map(|v| v * v).sum::<f64>().sqrt();
    let difference = a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt();
    if norm > 0.0 { difference / norm } else { difference }
}

/// The largest absolute difference.
pub fn largest_difference(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len(), "arrays of different lengths");
    a.iter().zip(b).map(|(a, b)| if a.is_nan() || b.is_nan() { f64::INFINITY } else { (a - b).abs() }).fold(0.0, f64::max)
}
