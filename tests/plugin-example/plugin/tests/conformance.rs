//! The suites that cc4dgs runs on its own plug-ins.

use cc4dgs_core::{Registry, conformance, parse_device, toml::Table};
use sway as _;

#[test]
fn the_deformer_conforms() {
    let registry = Registry::collect().unwrap();
    for device in ["flex", "ndarray", "wgpu"] {
        let device = match parse_device(device) {
            Ok(device) => device,
            // A machine without a graphics driver still runs the others; CI says that it has one.
            Err(e) if std::env::var_os("CC4DGS_REQUIRE_WGPU").is_none() => {
                eprintln!("{e}: skipped");
                continue;
            }
            Err(e) => panic!("{e}"),
        };
        let findings = conformance::deformer(registry.deformer("sway").unwrap(), &Table::new(), &device);
        assert!(findings.is_empty(), "{}", findings.join("\n"));
    }
}
