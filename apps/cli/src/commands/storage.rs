//! The paper's storage table of one model: deformation grid, deformation network, point cloud, total.

use super::megabytes;
use serde::Serialize;

/// A row of the table, in MB = 10^6 bytes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct StorageRow {
    /// What is stored.
    pub part: &'static str,
    /// As float32.
    pub float32_mb: f64,
    /// As it lies on disk; the parts of a field lie there as one.
    pub stored_mb: Option<f64>,
}

/// Bytes of a model as float32 and, if it has been compressed, on disk.
#[derive(Clone, Copy, Debug)]
pub struct Storage {
    /// Weights of the field's spatial encoding, float32.
    pub deform_grid: u64,
    /// All other weights of the field, float32.
    pub deform_net: u64,
    /// The Gaussians, float32.
    pub point_cloud: u64,
    /// On disk: field, Gaussians, whole file.
    pub stored: Option<[u64; 3]>,
}

impl Storage {
    /// The rows of the table.
    pub fn rows(&self) -> Vec<StorageRow> {
        let row = |part, bytes, stored: Option<u64>| StorageRow { part, float32_mb: megabytes(bytes), stored_mb: stored.map(megabytes) };
        let deform = self.deform_grid + self.deform_net;
        vec![
            row("deform grid", self.deform_grid, None),
            row("deform net", self.deform_net, None),
            row("deform", deform, self.stored.map(|s| s[0])),
            row("point cloud", self.point_cloud, self.stored.map(|s| s[1])),
            row("total", deform + self.point_cloud, self.stored.map(|s| s[2])),
        ]
    }
}

/// The table for people.
pub fn table(rows: &[StorageRow]) -> Vec<String> {
    let mut lines = vec![format!("{:<14}{:>12}{:>12}", "storage, MB", "float32", "on disk")];
    lines.extend(rows.iter().map(|r| {
        let stored = r.stored_mb.map_or(String::new(), |mb| format!("{mb:.3}"));
        format!("{:<14}{:>12.3}{stored:>12}", r.part, r.float32_mb)
    }));
    lines
}
