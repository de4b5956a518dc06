//! Every exporter of this crate with the conformance suite.

use cc4dgs_exporters::web::{PAGE_FILES, PAGE_VERSION};
use cc4dgs_format::playback::MaxError;
use cc4dgs_format::{Entries, Error, ExportFacts, ExportSource, ExporterPlugin, HostGaussians, Image8, Result, config, conformance};

/// A model whose export is interrupted once it has told so much progress.
struct Interrupted {
    model: conformance::MovingModel,
    left: usize,
}

impl ExportSource for Interrupted {
    fn facts(&self) -> &ExportFacts {
        self.model.facts()
    }
    fn gaussians(&mut self, time_norm: Option<f32>) -> Result<HostGaussians> {
        self.model.gaussians(time_norm)
    }
    fn image(&mut self, index: usize) -> Result<Image8> {
        self.model.image(index)
    }
    fn playable(&mut self, max_error: MaxError, baked: bool) -> Result<Vec<u8>> {
        self.model.playable(max_error, baked)
    }
    fn progress(&mut self, _: usize, _: usize) -> Result<()> {
        self.left = self.left.checked_sub(1).ok_or_else(|| Error::Interrupted("by the test".into()))?;
        Ok(())
    }
}

#[test]
fn an_interruption_while_a_file_is_encoded_leaves_none() {
    let exporters = Entries::<ExporterPlugin>::collect().unwrap();
    let folder = tempfile::tempdir().unwrap();
    for name in ["spz", "sog"] {
        let exporter = (exporters.get(name).unwrap().build)(&toml::Table::new()).unwrap();
        let path = folder.path().join(name);
        let written = |left: usize| exporter.write(&mut Interrupted { model: conformance::MovingModel::new(30, 1), left }, &path);
        assert!(matches!(written(1), Err(Error::Interrupted(_))) && !path.exists(), "{name}");
        assert!(written(2).is_ok() && path.exists(), "{name}");
    }
}

#[test]
fn every_exporter_conforms() {
    let folder = tempfile::tempdir().unwrap();
    let text = |name: &str| format!("/* {name} */\nexport const PAGE_VERSION = {PAGE_VERSION};\n");
    PAGE_FILES.iter().for_each(|name| std::fs::write(folder.path().join(name), text(name)).unwrap());
    let page = toml::Table::from_iter([("page".to_string(), folder.path().to_str().unwrap().into())]);
    let exporters: Vec<_> = Entries::<ExporterPlugin>::collect().unwrap().iter().collect();
    let settings = |plugin: &ExporterPlugin| if plugin.info.capabilities.contains(&"player") { page.clone() } else { toml::Table::new() };
    let findings: Vec<String> = exporters.iter().flat_map(|plugin| conformance::exporter(plugin, &settings(plugin))).collect();
    assert!(findings.is_empty() && exporters.len() == 7, "{} exporters\n{}", exporters.len(), findings.join("\n"));
}

#[test]
fn formats_for_other_viewers_say_that_they_lose_the_blur() {
    let (usual, mut facts) = (conformance::export_facts(3, 0), conformance::export_facts(3, 0));
    facts.blur = 0.1;
    for plugin in Entries::<ExporterPlugin>::collect().unwrap().iter().filter(|plugin| !plugin.info.capabilities.contains(&"player")) {
        let exporter = (plugin.build)(&toml::Table::new()).unwrap();
        let (usual, other) = (exporter.loses(&usual), exporter.loses(&facts));
        assert!(!usual.contains("blur") && other.contains("the blur of 0.1 square pixels"), "{}: {usual} / {other}", plugin.info.name);
    }
}

#[test]
fn formats_that_hold_degree_4_say_that_most_viewers_do_not() {
    let exporters = Entries::<ExporterPlugin>::collect().unwrap();
    for name in ["ply", "ply-sequence", "spz"] {
        let exporter = (exporters.get(name).unwrap().build)(&toml::Table::new()).unwrap();
        let says = |degree| exporter.loses(&conformance::export_facts(3, degree)).contains("most viewers harmonics over degree 3");
        assert!(says(4) && !says(3), "{name}");
    }
    for (version, refused) in [(3, true), (4, false)] {
        let settings = config::parse_table("test", &format!("version = {version}")).unwrap();
        let exporter = (exporters.get("spz").unwrap().build)(&settings).unwrap();
        let says = |degree| exporter.loses(&conformance::export_facts(3, degree)).contains("refuse files of version 3");
        assert!(says(4) == refused && !says(3), "version {version}");
    }
}

#[test]
fn spz_says_what_its_ranges_and_steps_lose() {
    let exporters = Entries::<ExporterPlugin>::collect().unwrap();
    let exporter = (exporters.get("spz").unwrap().build)(&toml::Table::new()).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let notes = |change: fn(&mut HostGaussians)| {
        let mut model = conformance::MovingModel::new(30, 1).with_gaussians(change);
        exporter.write(&mut model, &folder.path().join("model.spz")).unwrap().notes
    };
    assert_eq!(notes(|_| {}), ["SPZ version 4"]);
    let told = notes(|g| (g.log_scales[4], g.means[7]) = (-12.0, 1e6));
    assert_eq!(told[1], "limited to the range of the format: 1 scales (e^-10 to e^5.94)");
    assert!(told.len() == 4 && told[2].starts_with("centres are in steps of 0.125, ") && told[3].starts_with("centres have 3 fractional bits, "), "{told:?}");
    let told = notes(|g| g.log_scales.fill(-9.0));
    assert!(told.len() == 2 && told[1].contains("readers that want 12 refuse the file"), "{told:?}");
}

#[test]
fn sog_says_where_its_steps_of_centres_are_coarse() {
    let exporter = (Entries::<ExporterPlugin>::collect().unwrap().get("sog").unwrap().build)(&toml::Table::new()).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let notes = |count: usize, change: fn(&mut HostGaussians)| {
        let mut model = conformance::MovingModel::new(count, 0).with_gaussians(change);
        exporter.write(&mut model, &folder.path().join("model.sog")).unwrap().notes
    };
    // One far away widens the steps of all by the logarithm of its distance, which these Gaussians can bear.
    assert!(notes(30, |_| {}).is_empty() && notes(30, |g| g.means[7] = 1e6).is_empty() && notes(0, |_| {}).is_empty());
    // Small Gaussians, and centres far from the origin, where steps grow with the distance.
    let coarse: [fn(&mut HostGaussians); 2] = [|g| g.log_scales.fill(-9.0), |g| g.means.iter_mut().for_each(|v| *v *= 1e4)];
    for change in coarse {
        let told = notes(30, change);
        assert!(told.len() == 1 && told[0].starts_with("centres are in steps of ") && told[0].contains("(median), coarse beside"), "{told:?}");
    }
    assert!(exporter.loses(&conformance::export_facts(3, 0)).contains("all but 16 bits of positions"));
}

#[test]
fn rotations_that_are_no_numbers_are_refused_by_both_formats_of_ply() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["ply", "ply-sequence"] {
        let exporter = (Entries::<ExporterPlugin>::collect().unwrap().get(name).unwrap().build)(&toml::Table::new()).unwrap();
        let path = folder.path().join(name);
        if name == "ply-sequence" {
            std::fs::create_dir(&path).unwrap();
        }
        let mut model = conformance::MovingModel::new(20, 0).with_gaussians(|g| g.quaternions[74] = f32::NAN);
        let message = exporter.write(&mut model, &path).unwrap_err().to_string();
        assert!(message.contains("quaternions of Gaussian 18 is NaN"), "{name}: {message}");
    }
}

#[test]
fn settings_out_of_range_are_refused_before_a_model_is_read() {
    let exporters = Entries::<ExporterPlugin>::collect().unwrap();
    for (name, bad) in [
        ("spz", "version = 2"),
        ("spz", "sh1_bits = 9"),
        ("sog", "palette = 3"),
        ("sog", "iterations = 1000"),
        ("splatv", "samples = 0"),
        ("web", "max_error = '-1px'"),
    ] {
        let settings = config::parse_table("test", bad).unwrap();
        assert!((exporters.get(name).unwrap().build)(&settings).is_err(), "{name}: {bad}");
    }
}
