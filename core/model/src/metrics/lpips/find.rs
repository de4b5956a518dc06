//! Where the weights of LPIPS are looked for.

use super::Lpips;
use cc4dgs_format::installed::{program_folder, user_data_folder, variable_path};
use std::path::PathBuf;
use std::sync::{Arc, OnceLock};

/// Variable that names a weights file; if it is set, no other path is searched.
pub const LPIPS_VARIABLE: &str = "CC4DGS_LPIPS";
/// Name of the weights file where the variable does not state one.
pub const LPIPS_FILE: &str = "lpips-alexnet.safetensors";

/// The weights that this program uses, and their source.
#[derive(Clone, Debug)]
pub struct InstalledLpips {
    /// The network.
    pub network: Arc<Lpips>,
    /// The file, or `built in`.
    pub source: String,
}

/// The files that [`installed_lpips`] searches, in order: the one that the variable `CC4DGS_LPIPS` names, or else `lpips-alexnet.safetensors` in the
/// user's data folder ([`user_data_folder`]) and in the folder of the program.
pub fn lpips_paths() -> Vec<PathBuf> {
    if let Some(file) = variable_path(LPIPS_VARIABLE) {
        return vec![file];
    }
    [user_data_folder(), program_folder()].into_iter().flatten().map(|folder| folder.join(LPIPS_FILE)).collect()
}

/// The weights that this process uses, read once: of the first file of [`lpips_paths`] that exists, else those that the feature `embed-lpips` built in.
///
/// # Errors
/// A sentence that says why there are none: no file exists, or the first one is unreadable.
pub fn installed_lpips() -> Result<&'static InstalledLpips, &'static str> {
    static FOUND: OnceLock<Result<InstalledLpips, String>> = OnceLock::new();
    FOUND.get_or_init(find).as_ref().map_err(String::as_str)
}

fn find() -> Result<InstalledLpips, String> {
    let paths = lpips_paths();
    let named = variable_path(LPIPS_VARIABLE).is_some();
    if let Some(file) = paths.iter().find(|file| named || file.is_file()) {
        let network = Lpips::read(file).map_err(|e| format!("LPIPS is not measured: {e}"))?;
        return Ok(InstalledLpips { network: Arc::new(network), source: file.display().to_string() });
    }
    match embedded() {
        Some(bytes) => {
            let network = Lpips::from_bytes(bytes).map_err(|e| format!("LPIPS is not measured: the weights built in: {e}"))?;
            Ok(InstalledLpips { network: Arc::new(network), source: "built in".into() })
        }
        // Results state this, and no paths of a machine.
        None => Err(format!(
            "LPIPS is not measured: its weights are neither built in nor where `cc4dgs doctor` looks for them. Make the file with benches/lpips_weights.py, or name one in \
             {LPIPS_VARIABLE}"
        )),
    }
}

#[cfg(feature = "embed-lpips")]
fn embedded() -> Option<&'static [u8]> {
    Some(include_bytes!(env!("CC4DGS_LPIPS", "the feature embed-lpips needs the variable CC4DGS_LPIPS: the absolute path of the weights file to build in")))
}

#[cfg(not(feature = "embed-lpips"))]
fn embedded() -> Option<&'static [u8]> {
    None
}
