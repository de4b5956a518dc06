//! Reading results back, and refusing to compare what cannot be compared.

use super::lines::{PATCH, read_lines};
use super::result::{CellResult, CodecChoice, KIND};
use cc4dgs_core::{Error, Result, plural};
use serde_json::{Map, Value};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Folder of the results inside that of a sweep.
pub const RESULTS: &str = "results";
/// Largest file of results, bytes.
const MOST_BYTES: u64 = 256 << 20;
/// What a protocol says of the images that a mean is over; images differ between scenes.
const FRAMES: &str = "frames";

/// Reads results: a `.json` file with one, a `.jsonl` file with one per line, the folder of a sweep, or a folder of such files. In a folder, JSON files of
/// another kind are skipped, and so are `.jsonl` files that begin with another kind. The results are in the order of their axes.
///
/// # Errors
/// [`Error::Parameter`] for a path that does not exist; [`Error::Data`] for damaged files, for a cell that is there twice with different content and where
/// there is no result; [`Error::Unsupported`] for other versions of the schema.
pub fn read_results(path: &Path) -> Result<Vec<CellResult>> {
    if !path.exists() {
        let remedy = "Give the folder of a sweep, a folder of results, or one file of them";
        return Err(Error::parameter(format!("results {}", path.display()), "no such file or folder", remedy));
    }
    let mut found: BTreeMap<String, CellResult> = BTreeMap::new();
    for file in files(path)? {
        for result in read_file(&file, path.is_dir())? {
            match found.get(&result.id) {
                Some(other) if *other != result => {
                    let problem = format!("cell {} is there twice, with different content", result.id);
                    return Err(Error::data(file.display().to_string(), problem, "Keep one of the two"));
                }
                _ => _ = found.insert(result.id.clone(), result),
            }
        }
    }
    if found.is_empty() {
        return Err(Error::data(path.display().to_string(), "there is no result", "Run the sweep first: cc4dgs sweep run DIR"));
    }
    let mut results: Vec<CellResult> = found.into_values().collect();
    results.sort_by(|a, b| a.axes.cmp(&b.axes).then_with(|| a.id.cmp(&b.id)));
    Ok(results)
}

/// The files of `path` that may hold results, in the order of their names.
fn files(path: &Path) -> Result<Vec<PathBuf>> {
    if path.is_file() {
        return Ok(vec![path.to_path_buf()]);
    }
    let inner = path.join(RESULTS);
    let folder = if inner.is_dir() { inner } else { path.to_path_buf() };
    let mut files = Vec::new();
    for entry in std::fs::read_dir(&folder).map_err(|e| Error::io(&folder, e))? {
        let file = entry.map_err(|e| Error::io(&folder, e))?.path();
        if file.is_file() && file.extension().is_some_and(|e| e == "json" || e == "jsonl") {
            files.push(file);
        }
    }
    files.sort();
    Ok(files)
}

/// The results of one file; with `lenient`, JSON of another kind is none, such as the log of a run.
fn read_file(file: &Path, lenient: bool) -> Result<Vec<CellResult>> {
    let object = file.display().to_string();
    let bytes = std::fs::metadata(file).map_err(|e| Error::io(file, e))?.len();
    if bytes > MOST_BYTES {
        return Err(Error::limit(object, bytes, MOST_BYTES, "Split the file"));
    }
    let text = std::fs::read_to_string(file).map_err(|e| Error::io(file, e))?;
    let of_lines = file.extension().is_some_and(|e| e == "jsonl");
    let head = if of_lines { text.lines().find(|line| !line.trim().is_empty()).unwrap_or_default() } else { text.as_str() };
    let is_ours = |value: Value| value.get("kind").and_then(Value::as_str).is_some_and(|kind| [KIND, PATCH].contains(&kind));
    if lenient && serde_json::from_str(head).is_ok_and(|value| !is_ours(value)) {
        return Ok(Vec::new());
    }
    if of_lines { read_lines(&object, &text) } else { Ok(vec![CellResult::from_json(&object, &text)?]) }
}

/// Refuses results that do not belong into one table: computed on different devices, scored on different sides of the split, by different protocols of a
/// metric, or, within a scene, on different data, image sizes or images; and results that differ in their seed alone by their axes, but were stored by
/// different codecs. Those that were trained on different devices are marked in tables instead.
///
/// # Errors
/// [`Error::Data`] that names two of the results and what differs.
pub fn check_comparable(results: &[CellResult]) -> Result<()> {
    let Some(first) = results.first() else { return Ok(()) };
    // The first result that states a metric, and the first one that states it of a scene.
    let mut of_metric: BTreeMap<&str, &CellResult> = BTreeMap::new();
    let mut of_scene: BTreeMap<(&str, &str), &CellResult> = BTreeMap::new();
    let mut data: BTreeMap<&str, &CellResult> = BTreeMap::new();
    let mut of_row: BTreeMap<[&str; 4], &CellResult> = BTreeMap::new();
    for result in results {
        let (a, b) = (&first.provenance.device, &result.provenance.device);
        if a != b {
            return Err(mixed("devices", first, &describe(a), result, &describe(b)));
        }
        if first.split != result.split {
            return Err(mixed("sides of the split", first, &format!("{:?}", first.split), result, &format!("{:?}", result.split)));
        }
        let axes = &result.axes;
        let same_row = *of_row.entry([&axes.scene, &axes.method, &axes.setting, &axes.codec]).or_insert(result);
        let (a, b) = (&same_row.provenance.codec, &result.provenance.codec);
        if a != b {
            return Err(mixed(&format!("codecs called '{}'", axes.codec), same_row, &stored_by(a), result, &stored_by(b)));
        }
        let same_scene = *data.entry(&result.axes.scene).or_insert(result);
        let (a, b) = (&same_scene.provenance.data, &result.provenance.data);
        if a.hash != b.hash {
            return Err(mixed("data", same_scene, &format!("{} ({})", a.path, a.hash), result, &format!("{} ({})", b.path, b.hash)));
        }
        let (a, b) = (same_scene.image_size, result.image_size);
        if a != b {
            return Err(mixed("image sizes", same_scene, &format!("{}x{}", a[0], a[1]), result, &format!("{}x{}", b[0], b[1])));
        }
        if images(same_scene) != images(result) {
            let of = |r: &CellResult| {
                let [images, frames] = [plural(r.images.len(), "image", "images"), plural(r.frames, "frame", "frames")];
                format!("{} {images} of {} {frames}", r.images.len(), r.frames)
            };
            return Err(mixed("sets of images", same_scene, &of(same_scene), result, &of(result)));
        }
        // The first image may be one that both leave as small as it is.
        let others_differ = same_scene.scored_pixels.zip(result.scored_pixels).is_some_and(|(a, b)| a != b);
        if others_differ || same_scene.sizes_differ != result.sizes_differ {
            let of = |r: &CellResult| r.image_sizes() + &r.scored_pixels.map_or_else(String::new, |pixels| format!(" ({pixels} pixels together)"));
            return Err(mixed("sets of image sizes", same_scene, &of(same_scene), result, &of(result)));
        }
        for (name, score) in &result.metrics {
            let other = *of_metric.entry(name).or_insert(result);
            if let Some((a, b)) = difference(&other.metrics[name].protocol, &score.protocol, |key| key != FRAMES) {
                return Err(mixed(&format!("protocols of {name}"), other, &a, result, &b));
            }
            let other = *of_scene.entry((name, &result.axes.scene)).or_insert(result);
            if let Some((a, b)) = difference(&other.metrics[name].protocol, &score.protocol, |key| key == FRAMES) {
                return Err(mixed(&format!("protocols of {name}"), other, &a, result, &b));
            }
        }
    }
    Ok(())
}

/// Camera and frame of each scored image.
fn images(result: &CellResult) -> Vec<(&str, usize)> {
    result.images.iter().map(|image| (image.camera.as_str(), image.frame)).collect()
}

/// A codec with its settings in words.
fn stored_by(choice: &CodecChoice) -> String {
    let settings: String = choice.settings.to_string().lines().map(|line| format!(", {line}")).collect();
    format!("{} with weights {}{settings}", choice.codec, choice.field_weights)
}

/// A device in words.
pub(super) fn describe(device: &super::result::DeviceFacts) -> String {
    let adapter = device.adapter.as_ref().map_or_else(String::new, |name| format!(" on {name}, driver {}", device.driver.as_deref().unwrap_or("unknown")));
    let processor = if device.processor.is_empty() { "unknown processor" } else { &device.processor };
    let threads = plural(device.threads, "thread", "threads");
    format!("{}{adapter}, {processor}, {} {threads}, {}", device.name, device.threads, device.system)
}

/// The first of the `wanted` entries that differs, as it is in both.
fn difference(a: &Map<String, Value>, b: &Map<String, Value>, wanted: impl Fn(&str) -> bool) -> Option<(String, String)> {
    let show = |map: &Map<String, Value>, key: &str| format!("{key} = {}", map.get(key).unwrap_or(&Value::Null));
    let differs = |key: &&String| wanted(key) && a.get(*key).unwrap_or(&Value::Null) != b.get(*key).unwrap_or(&Value::Null);
    a.keys().chain(b.keys()).find(differs).map(|key| (show(a, key), show(b, key)))
}

fn mixed(what: &str, a: &CellResult, of_a: &str, b: &CellResult, of_b: &str) -> Error {
    let name = |r: &CellResult| format!("{} ({} {} {} seed {})", r.id, r.axes.scene, r.axes.method, r.axes.codec, r.axes.seed);
    Error::data(
        "table of results",
        format!("two {what} do not go into one table: {of_a} in {}, and {of_b} in {}", name(a), name(b)),
        "Make a table of each, for example with --where KEY=VALUE, or run the cells again in one way",
    )
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// The example of the documentation.
    pub(in crate::sweep) fn example() -> CellResult {
        let text = include_str!("../../../../docs/results.md");
        let json = text.split("```json\n").nth(1).and_then(|rest| rest.split("```").next()).unwrap();
        CellResult::from_json("docs/results.md", json).unwrap()
    }

    /// The example as another cell.
    pub(in crate::sweep) fn cell(id: &str, change: impl FnOnce(&mut CellResult)) -> CellResult {
        let mut result = example();
        result.id = id.into();
        change(&mut result);
        result
    }

    #[test]
    fn the_documented_example_is_read_and_written() {
        let result = example();
        let line = result.to_line().unwrap();
        assert_eq!(CellResult::from_json("again", &line).unwrap(), result);
        assert!(!line.contains('\n') && result.size_mb() == 0.612345);
        let later = line.replacen("\"schema\":2", "\"schema\":3", 1);
        let error = CellResult::from_json("later.json", &later).unwrap_err();
        assert!(matches!(error, Error::Unsupported { .. }) && error.to_string().contains("version 3"), "{error}");
        for broken in ["{}", "[]", "nonsense", &line[..line.len() / 2], &line.replace("[260,2600]", "[260]"), &line.replace("\"frame\":[0]", "\"frame\":[0,1]")]
        {
            assert!(matches!(CellResult::from_json("broken.json", broken), Err(Error::Data { .. })), "{broken}");
        }
        let uneven = cell("uneven", |r| (r.validation_curve.iteration, r.validation_curve.psnr_db) = (vec![130], vec![20.0]));
        let error = CellResult::from_json("uneven.json", &uneven.to_line().unwrap()).unwrap_err();
        assert!(matches!(error, Error::Data { .. }) && error.to_string().contains("validation curve"), "{error}");
    }

    #[test]
    fn results_of_version_1_are_read() {
        let mut old: Value = serde_json::from_str(&example().to_line().unwrap()).unwrap();
        let image = serde_json::json!({
            "camera": "r_000", "frame": 0, "time_norm": 0.0, "scores": { "psnr_db": 31.25, "ssim": 0.9541 }, "blocks": [12, 1, 19.4],
            "truth": "images/d1077f2c5b9e8a46/truth/00000.png", "render": "images/4be29fd1c80a7e53/00000.png"
        });
        (old["schema"], old["images"]) = (1.into(), Value::Array(vec![image]));
        let cost = old["cost"].as_object_mut().unwrap();
        let peak = cost.remove("training_peak_memory_mb").unwrap();
        cost.remove("cell_peak_memory_mb");
        cost.insert("peak_memory_mb".into(), peak);
        let expected = cell("4be29fd1c80a7e53", |r| r.cost.cell_peak_memory_mb = None);
        assert_eq!(CellResult::from_json("old.json", &old.to_string()).unwrap(), expected);
    }

    #[test]
    fn results_are_read_from_files_and_folders() {
        let folder = tempfile::tempdir().unwrap();
        let (a, b) = (cell("a", |r| r.axes.seed = 1), cell("b", |r| r.axes.seed = 0));
        assert!(read_results(folder.path()).unwrap_err().to_string().contains("no result"));
        std::fs::write(folder.path().join("other.json"), "{\"kind\":\"something else\"}").unwrap();
        std::fs::write(folder.path().join("events.jsonl"), "{\"seconds\":0.5,\"event\":\"run-started\"}\n{\"sec").unwrap();
        assert!(read_results(folder.path()).unwrap_err().to_string().contains("no result"));
        std::fs::write(folder.path().join("all.jsonl"), format!("{}\n\n{}\n", a.to_line().unwrap(), b.to_line().unwrap())).unwrap();
        a.write(&folder.path().join("a.json")).unwrap();
        let read = read_results(folder.path()).unwrap();
        assert_eq!(read.iter().map(|r| r.id.as_str()).collect::<Vec<_>>(), ["b", "a"], "by axes, equal copies once");
        for (name, kind) in [("other.json", "\"something else\""), ("events.jsonl", "\"\"")] {
            let message = read_results(&folder.path().join(name)).unwrap_err().to_string();
            assert!(message.contains(kind) && message.contains("Name") && !message.contains("Remove"), "a file that is named must be a result: {message}");
        }
        cell("a", |r| r.gaussians += 1).write(&folder.path().join("c.json")).unwrap();
        assert!(read_results(folder.path()).unwrap_err().to_string().contains("twice"));
        // The folder of a sweep has the results in a folder of their own.
        std::fs::create_dir(folder.path().join(RESULTS)).unwrap();
        b.write(&folder.path().join(RESULTS).join("b.json")).unwrap();
        assert_eq!(read_results(folder.path()).unwrap(), [b]);
    }

    #[test]
    fn what_cannot_be_compared_is_refused() {
        let refused = |change: &dyn Fn(&mut CellResult)| {
            let error = check_comparable(&[example(), cell("other", change)]).unwrap_err().to_string();
            assert!(error.contains("4be29fd1c80a7e53") && error.contains("other ("), "{error}");
            error
        };
        check_comparable(&[]).unwrap();
        check_comparable(&[example(), cell("other", |r| r.axes.method = "hexplane".into())]).unwrap();
        let error = refused(&|r| r.provenance.device.name = "wgpu".into());
        assert!(error.contains("two devices") && error.contains("flex") && error.contains("wgpu"), "{error}");
        assert!(refused(&|r| r.provenance.device.threads = 8).contains("8 threads"));
        let error = refused(&|r| _ = r.metrics.get_mut("psnr_db").unwrap().protocol.insert("rounding".into(), "float".into()));
        assert!(error.contains("protocols of psnr_db") && error.contains("rounding = \"eight-bit\"") && error.contains("rounding = \"float\""), "{error}");
        let error = refused(&|r| _ = r.provenance.codec.settings.insert("finetune".into(), 0.into()));
        assert!(error.contains("two codecs called 'cca'") && error.contains("cca:default with weights fp16, finetune = 0 in other"), "{error}");
        check_comparable(&[example(), cell("other", |r| (r.axes.codec, r.provenance.codec.codec) = ("low".into(), "cca:low".into()))]).unwrap();
        assert!(refused(&|r| r.split = cc4dgs_core::Split::Validation).contains("split"));
        assert!(refused(&|r| r.provenance.data.hash = "0".into()).contains("data"));
        assert!(refused(&|r| r.image_size = [200, 200]).contains("200x200"));
        assert!(refused(&|r| (r.sizes_differ, r.scored_pixels) = (true, Some(240_000))).contains("various sizes (240000 pixels together)"));
        let various = |pixels: Option<u64>| cell("various", |r| (r.sizes_differ, r.scored_pixels) = (true, pixels));
        let error = check_comparable(&[various(Some(240_000)), various(Some(250_000))]).unwrap_err().to_string();
        assert!(error.contains("sets of image sizes") && error.contains("240000") && error.contains("250000"), "{error}");
        check_comparable(&[various(Some(240_000)), various(Some(240_000)), various(None)]).unwrap();
        // Other images belong to another scene, and only there.
        let other_images = |r: &mut CellResult| _ = r.metrics.get_mut("ssim").unwrap().protocol.insert("frames".into(), Value::Null);
        assert!(refused(&other_images).contains("protocols of ssim"));
        let on_black = |r: &mut CellResult| r.metrics.get_mut("ssim").unwrap().protocol["frames"]["background"] = serde_json::json!([0.0, 0.0, 0.0]);
        assert!(refused(&on_black).contains("[0.0,0.0,0.0]"));
        let other_scene = cell("other", |r| {
            other_images(r);
            (r.axes.scene, r.image_size) = ("basketball".into(), [640, 360]);
        });
        check_comparable(&[example(), other_scene]).unwrap();
    }
}
