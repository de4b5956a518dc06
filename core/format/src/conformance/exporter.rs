//! The conformance suite of exporters.

use super::{settings_are_read, uniform};
use crate::exporter::export;
use crate::gaussians::sh_rest_len;
use crate::playback::MaxError;
use crate::{BLUR, Error, ExportFacts, ExportSource, ExporterPlugin, HostGaussians, Image8, Result, Seed};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

/// A model that moves: `gaussians` of degree `sh_degree`, of which every third moves along a curve, turns and fades. For tests of exporters.
pub struct MovingModel {
    facts: ExportFacts,
    canonical: HostGaussians,
}

/// Facts of a model of `gaussians` of degree `sh_degree` with five frames and two images.
pub fn export_facts(gaussians: usize, sh_degree: usize) -> ExportFacts {
    ExportFacts {
        name: "suite".into(),
        gaussians,
        moving: gaussians / 3,
        sh_degree,
        time_norm: None,
        times_norm: (0..5).map(|i| i as f32 / 4.0).collect(),
        frames_per_second: 5.0,
        antialiased: false,
        blur: BLUR,
        up: [0.0, 0.0, 1.0],
        home: None,
        images: 2,
    }
}

impl MovingModel {
    /// `gaussians` of degree `sh_degree`; the first third moves.
    pub fn new(gaussians: usize, sh_degree: usize) -> Self {
        let mut g = HostGaussians { sh_degree, ..Default::default() };
        let moving = gaussians / 3;
        for i in 0..gaussians {
            let draw = |k: usize| uniform(Seed::root(8).index(i as u64), k);
            g.means.extend([2.0 * draw(0), 2.0 * draw(1), 1.0 + draw(2)]);
            g.log_scales.extend([-3.0 + draw(3), -3.2 + draw(4), -3.5 + draw(5)]);
            g.quaternions.extend([0.8 + 0.5 * draw(6), draw(7), draw(8), draw(9)]);
            g.opacity_logits.push(1.0 + 2.0 * draw(10));
            g.sh_dc.extend([draw(11), draw(12), draw(13)]);
            g.sh_rest.extend((0..3 * sh_rest_len(sh_degree)).map(|c| 0.2 * draw(14 + c)));
            g.dynamic_scores.push(if i < moving { 5.0 } else { -5.0 });
        }
        Self { facts: export_facts(gaussians, sh_degree), canonical: g }
    }
    /// The same model with other facts, such as another time.
    pub fn with(mut self, change: impl FnOnce(&mut ExportFacts)) -> Self {
        change(&mut self.facts);
        self
    }
    /// The same model with other canonical Gaussians.
    pub fn with_gaussians(mut self, change: impl FnOnce(&mut HostGaussians)) -> Self {
        change(&mut self.canonical);
        self
    }
}

impl ExportSource for MovingModel {
    fn facts(&self) -> &ExportFacts {
        &self.facts
    }
    fn gaussians(&mut self, time_norm: Option<f32>) -> Result<HostGaussians> {
        let mut g = self.canonical.clone();
        let Some(t) = time_norm else { return Ok(g) };
        for i in 0..self.facts.moving {
            let draw = |k: usize| uniform(Seed::root(9).index(i as u64), k);
            for (k, mean) in g.means[3 * i..3 * i + 3].iter_mut().enumerate() {
                *mean += 0.5 * draw(k) * t + 0.3 * draw(3 + k) * t * t;
            }
            g.quaternions[4 * i + 1] += 0.2 * draw(6) * t;
            g.opacity_logits[i] -= if i % 2 == 0 { 2.0 * t } else { 0.0 };
        }
        Ok(g)
    }
    fn image(&mut self, index: usize) -> Result<Image8> {
        let (width, height) = (18, 10);
        let data = (0..3 * width * height).map(|i| (i as usize * 5 + index * 40) as u8).collect();
        Ok(Image8 { width, height, channels: 3, data })
    }
    /// No real archive: exporters pass its bytes on and do not look into them.
    fn playable(&mut self, _: MaxError, _: bool) -> Result<Vec<u8>> {
        crate::ply::to_bytes(&self.canonical, true)
    }
    fn progress(&mut self, _: usize, _: usize) -> Result<()> {
        Ok(())
    }
}

/// A source that fails at the second thing it is asked for.
struct Failing(MovingModel, usize);

impl Failing {
    fn count(&mut self) -> Result<()> {
        self.1 += 1;
        if self.1 < 2 { Ok(()) } else { Err(Error::Interrupted("by the suite".into())) }
    }
}

impl ExportSource for Failing {
    fn facts(&self) -> &ExportFacts {
        self.0.facts()
    }
    fn gaussians(&mut self, time_norm: Option<f32>) -> Result<HostGaussians> {
        self.count()?;
        self.0.gaussians(time_norm)
    }
    fn image(&mut self, index: usize) -> Result<Image8> {
        self.count()?;
        self.0.image(index)
    }
    fn playable(&mut self, max_error: MaxError, baked: bool) -> Result<Vec<u8>> {
        self.count()?;
        self.0.playable(max_error, baked)
    }
    fn progress(&mut self, _: usize, _: usize) -> Result<()> {
        self.count()
    }
}

/// Tests an exporter. Each finding is a line; an empty list means that it passed.
///
/// - Its schema is TOML that it accepts; unknown settings are refused by name.
/// - What is lost is one sentence.
/// - Equal inputs give equal bytes.
/// - Models of no, one and many Gaussians, of every degree of harmonics, still and moving, are written or refused with an error.
/// - So are far outliers, rotations of length zero and values that are not finite; nothing panics.
/// - An interruption is passed on and leaves nothing behind.
pub fn exporter(plugin: &ExporterPlugin, settings: &toml::Table) -> Vec<String> {
    let name = plugin.info.name;
    let mut findings = Vec::new();
    let mut note = |check: &str, outcome: Result<Option<String>>| match outcome {
        Ok(None) => {}
        Ok(Some(finding)) => findings.push(format!("{name}, {check}: {finding}")),
        Err(e) => findings.push(format!("{name}, {check}: {e}")),
    };
    note("settings", settings_are_read("exporter", &plugin.info, settings, |settings| (plugin.build)(settings).map(drop)));
    for (count, degree) in [(90, 0), (90, 3)] {
        note("a moving model", twice(plugin, settings, &|| MovingModel::new(count, degree)));
    }
    note("one instant", twice(plugin, settings, &|| MovingModel::new(60, 1).with(|f| f.time_norm = Some(0.5))));
    note("a still model", twice(plugin, settings, &|| MovingModel::new(60, 2).with(|f| (f.moving, f.times_norm) = (0, vec![0.0]))));
    // These may be refused, but not by a panic.
    let hostile: [(&str, MovingModel); 6] = [
        ("no Gaussians", MovingModel::new(0, 0)),
        ("one Gaussian", MovingModel::new(1, 0)),
        ("harmonics of degree 4", MovingModel::new(20, 4)),
        ("a far outlier", MovingModel::new(20, 1).with_gaussians(|g| g.means[0] = 3e37)),
        ("rotations of length zero", MovingModel::new(20, 1).with_gaussians(|g| g.quaternions.iter_mut().for_each(|q| *q = 0.0))),
        ("values that are not finite", MovingModel::new(20, 1).with_gaussians(|g| (g.log_scales[4], g.sh_dc[2]) = (f32::NAN, f32::INFINITY))),
    ];
    for (check, mut model) in hostile {
        let outcome = catch_unwind(AssertUnwindSafe(|| once(plugin, settings, &mut model).err()));
        note(check, Ok(outcome.is_err().then(|| "it panics".to_string())));
    }
    note("interruption", passes_interruption_on(plugin, settings));
    findings
}

/// The names and bytes that an export of `source` writes.
fn once(plugin: &ExporterPlugin, settings: &toml::Table, source: &mut dyn ExportSource) -> Result<Vec<(String, Vec<u8>)>> {
    let folder = tempfile::tempdir().map_err(|e| Error::io("a temporary folder", e))?;
    let exporter = (plugin.build)(settings)?;
    let path = folder.path().join(match plugin.target {
        crate::ExportTarget::File(extension) | crate::ExportTarget::FileOrFolder { file: extension, .. } => format!("suite.{extension}"),
        crate::ExportTarget::Folder(_) => "suite".to_string(),
    });
    let outcome = export(exporter.as_ref(), plugin.target, source, &path, false);
    let names = |path: &Path| -> Result<Vec<_>> {
        let mut paths: Vec<_> = std::fs::read_dir(path).map_err(|e| Error::io(path, e))?.filter_map(|e| Some(e.ok()?.path())).collect();
        paths.sort();
        Ok(paths)
    };
    if outcome.is_err() && !names(folder.path())?.is_empty() {
        return Err(Error::data(plugin.info.name, "a failed export left something behind", "Write to the given path alone"));
    }
    let (_, bytes) = outcome?;
    let files = if path.is_dir() { names(&path)? } else { vec![path] };
    let read = |path: &Path| Ok((path.file_name().unwrap_or_default().to_string_lossy().into_owned(), std::fs::read(path).map_err(|e| Error::io(path, e))?));
    let files = files.iter().map(|path| read(path)).collect::<Result<Vec<_>>>()?;
    let found: usize = files.iter().map(|(_, content)| content.len()).sum();
    if files.is_empty() || found as u64 != bytes {
        return Err(Error::data(plugin.info.name, format!("{} files of {found} bytes, {bytes} were reported", files.len()), "Correct the report"));
    }
    Ok(files)
}

fn twice(plugin: &ExporterPlugin, settings: &toml::Table, model: &dyn Fn() -> MovingModel) -> Result<Option<String>> {
    let sentence = (plugin.build)(settings)?.loses(model().facts());
    if sentence.len() < 8 || !sentence.ends_with('.') || sentence.contains('\n') || sentence.contains(". ") {
        return Ok(Some(format!("what is lost is not one sentence: '{sentence}'")));
    }
    let (first, second) = (once(plugin, settings, &mut model())?, once(plugin, settings, &mut model())?);
    Ok((first != second).then(|| "equal inputs gave other bytes".to_string()))
}

fn passes_interruption_on(plugin: &ExporterPlugin, settings: &toml::Table) -> Result<Option<String>> {
    let mut source = Failing(MovingModel::new(30, 1), 0);
    match once(plugin, settings, &mut source) {
        Err(Error::Interrupted(_)) => Ok(None),
        Err(other) => Ok(Some(format!("the interruption became: {other}"))),
        // One request was enough.
        Ok(_) if source.1 < 2 => Ok(None),
        Ok(_) => Ok(Some("it went on".into())),
    }
}
