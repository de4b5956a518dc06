//! The paper's storage table of one model: deformation grid, deformation network, point cloud, total.

use super::megabytes;
use serde::Serialize;

/// A row of the table, in MB = 10^6 bytes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct StorageRow {
    /// What is stored.
    pub part: &'static str,
    /// As float32; `None` where the deformer that would say is not linked.
    pub float32_mb: Option<f64>,
    /// On disk; the parts of a field are stored as one.
    pub stored_mb: Option<f64>,
}

/// Bytes of a model as float32 and, if it has been compressed, on disk.
#[derive(Clone, Copy, Debug)]
pub struct Storage {
    /// Weights of the field as float32: of its spatial encoding, and all others. `None` if they are not known.
    pub field: Option<(u64, u64)>,
    /// The Gaussians with their attributes, float32.
    pub point_cloud: u64,
    /// On disk: field, Gaussians, whole file.
    pub stored: Option<[u64; 3]>,
}

impl Storage {
    /// The rows of the table.
    pub fn rows(&self) -> Vec<StorageRow> {
        let row = |part, bytes: Option<u64>, stored: Option<u64>| StorageRow { part, float32_mb: bytes.map(megabytes), stored_mb: stored.map(megabytes) };
        let deform = self.field.map(|(grid, net)| grid + net);
        vec![
            row("deform grid", self.field.map(|f| f.0), None),
            row("deform net", self.field.map(|f| f.1), None),
            row("deform", deform, self.stored.map(|s| s[0])),
            row("point cloud", Some(self.point_cloud), self.stored.map(|s| s[1])),
            // An archive may claim any number of floats per Gaussian.
            row("total", deform.map(|d| d.saturating_add(self.point_cloud)), self.stored.map(|s| s[2])),
        ]
    }
}

/// The table for people.
pub fn table(rows: &[StorageRow]) -> Vec<String> {
    let mut lines = vec![format!("{:<14}{:>12}{:>12}", "storage, MB", "float32", "on disk")];
    lines.extend(rows.iter().map(|r| {
        let cell = |mb: Option<f64>, missing: &str| mb.map_or_else(|| missing.to_string(), |mb| format!("{mb:.3}"));
        format!("{:<14}{:>12}{:>12}", r.part, cell(r.float32_mb, "-"), cell(r.stored_mb, ""))
    }));
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn totals_of_absurd_claims_are_not_small() {
        let total = |point_cloud| Storage { field: Some((10_000_000, 5_000_000)), point_cloud, stored: None }.rows()[4].float32_mb;
        assert_eq!(total(1_000_000), Some(16.0));
        assert_eq!(total(u64::MAX), Some(megabytes(u64::MAX)));
    }
}
