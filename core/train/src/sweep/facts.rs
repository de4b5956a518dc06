//! What a sweep runs on: datasets by content, devices by name.

use super::hash::ContentHash;
use super::location::locate;
use super::result::{DataFingerprint, DeviceFacts, TrainingDevice};
use crate::data::{named_files, project_folder};
use cc4dgs_core::{Error, Registry, Result, adapters, resolved_device};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::path::{Component, Path, PathBuf};
use xxhash_rust::xxh3::Xxh3;

/// Deepest folder of a dataset, and most files and folders: a link that leads in a circle ends here.
const MOST_DEPTH: usize = 32;
const MOST_ENTRIES: usize = 5_000_000;

/// A file of a dataset: name relative to the dataset, or the whole path where the dataset names it so, and bytes.
struct DataFile {
    name: String,
    path: PathBuf,
    bytes: u64,
}

/// All files of `root` in the order of their names; hidden ones are left out. Folders that are nested too deeply are an error, as a part of a dataset has no
/// fingerprint.
fn list(root: &Path) -> Result<Vec<DataFile>> {
    let mut files = Vec::new();
    let too_many = |what: &str, found: usize, most: usize| {
        let object = format!("dataset {}: {what}", root.display());
        Error::limit(object, found as u64, most as u64, "Name the folder of one dataset, and remove links that lead in a circle")
    };
    let mut entries = 0;
    let mut folders = vec![(root.to_path_buf(), String::new(), 0)];
    while let Some((folder, prefix, depth)) = folders.pop() {
        for entry in std::fs::read_dir(&folder).map_err(|e| Error::io(&folder, e))? {
            let path = entry.map_err(|e| Error::io(&folder, e))?.path();
            let Some(name) = path.file_name().map(|name| name.to_string_lossy().into_owned()).filter(|name| !name.starts_with('.')) else { continue };
            let facts = std::fs::metadata(&path).map_err(|e| Error::io(&path, e))?;
            let name = format!("{prefix}{name}");
            entries += 1;
            if entries > MOST_ENTRIES {
                return Err(too_many("files and folders", entries, MOST_ENTRIES));
            }
            if facts.is_dir() {
                if depth == MOST_DEPTH {
                    return Err(too_many("depth of folders", depth + 1, MOST_DEPTH));
                }
                folders.push((path, name + "/", depth + 1));
            } else if facts.is_file() {
                files.push(DataFile { name, bytes: facts.len(), path });
            }
        }
    }
    files.sort_by(|a, b| a.name.cmp(&b.name));
    Ok(files)
}

/// The folder of everything that readers take from the dataset at `path`: of a file the one it lies in, since images are named relative to it; of a COLMAP
/// model in a folder `sparse`, or in a folder of it, that of its project, where its images are; of any other model its own.
fn root_of(path: &Path) -> PathBuf {
    if path.is_file() {
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
        return folder.unwrap_or(Path::new(".")).to_path_buf();
    }
    project_folder(path)
}

/// Whether `list` takes the file or folder at `inner` of a dataset for a part of it: hidden ones are left out.
fn is_listed(inner: &Path) -> bool {
    inner.components().all(|part| matches!(part, Component::Normal(name) if !name.to_string_lossy().starts_with('.')))
}

/// Whether what is written into `folder`, which need not exist yet, would be a part of the dataset at `path`.
pub(super) fn would_be_part(folder: &Path, path: &Path) -> bool {
    let Ok(root) = root_of(path).canonicalize() else { return false };
    let whole = std::path::absolute(folder).unwrap_or_else(|_| folder.to_path_buf());
    // Links are followed as far as there are folders.
    let real = whole.ancestors().find_map(|known| Some(known.canonicalize().ok()?.join(whole.strip_prefix(known).ok()?)));
    real.is_some_and(|real| real.strip_prefix(&root).is_ok_and(is_listed))
}

/// All files of the dataset at `path`: those in its folder, then those elsewhere that its index names, each in the order of their names.
fn files_of(path: &Path) -> Result<Vec<DataFile>> {
    let root = root_of(path);
    let mut files = list(&root)?;
    let whole = root.canonicalize().map_err(|e| Error::io(&root, e))?;
    let mut elsewhere = BTreeMap::new();
    for path in named_files(path) {
        let inner = path.strip_prefix(&root).unwrap_or(&path);
        // It may be named by another way into the folder.
        if is_listed(inner) || path.canonicalize().is_ok_and(|real| real.strip_prefix(&whole).is_ok_and(is_listed)) {
            continue;
        }
        let (name, bytes) = (inner.to_string_lossy().into_owned(), std::fs::metadata(&path).map_err(|e| Error::io(&path, e))?.len());
        elsewhere.insert(name.clone(), DataFile { name, path, bytes });
    }
    files.extend(elsewhere.into_values());
    Ok(files)
}

/// Names and sizes of a dataset's files as one name: what is compared before a training begins, because it costs little.
///
/// # Errors
/// [`Error::Io`].
pub fn listing(path: &Path) -> Result<String> {
    let mut hash = ContentHash::default();
    if path.exists() {
        for file in files_of(path)? {
            hash.part(file.name.as_bytes());
            hash.part(&file.bytes.to_le_bytes());
        }
    }
    Ok(hash.name())
}

/// The fingerprint of the dataset that `text` names: names and contents of all files, those in other folders that its index names included, or the
/// name of a built-in scene.
///
/// # Errors
/// [`Error::Parameter`] for a path that no reader recognises, [`Error::Io`].
pub fn fingerprint(text: &str, registry: &Registry) -> Result<DataFingerprint> {
    let path = locate(text)?;
    let readers = registry.readers();
    let recognised = readers.iter().any(|reader| (reader.probe)(&path));
    if !path.exists() && !recognised {
        return Err(Error::parameter(format!("scene {text}"), "no such file or folder", "Check the path, or use `procedural:NAME` for a built-in scene"));
    }
    if !recognised {
        let known: Vec<String> = readers.iter().map(|r| format!("{} looks for {}", r.info.name, r.looks_for)).collect();
        return Err(Error::parameter(format!("scene {text}"), "no reader recognises it", format!("Known formats: {}", known.join("; "))));
    }
    let mut hash = ContentHash::default();
    if !path.exists() {
        // A built-in scene, which a variable may name.
        hash.part(path.to_string_lossy().as_bytes());
        return Ok(DataFingerprint { path: text.into(), hash: hash.name(), files: 0, bytes: 0 });
    }
    let files = files_of(&path)?;
    let contents: Vec<u64> = files.par_iter().map(|file| content(&file.path)).collect::<Result<_>>()?;
    for (file, content) in files.iter().zip(&contents) {
        hash.part(file.name.as_bytes());
        hash.part(&content.to_le_bytes());
    }
    let bytes = files.iter().map(|file| file.bytes).sum();
    Ok(DataFingerprint { path: text.into(), hash: hash.name(), files: files.len() as u64, bytes })
}

fn content(path: &Path) -> Result<u64> {
    let mut file = std::fs::File::open(path).map_err(|e| Error::io(path, e))?;
    let mut hash = Xxh3::new();
    let mut buffer = vec![0; 1 << 20];
    loop {
        match std::io::Read::read(&mut file, &mut buffer).map_err(|e| Error::io(path, e))? {
            0 => return Ok(hash.digest()),
            count => hash.update(&buffer[..count]),
        }
    }
}

/// What the device `name` is on this machine.
pub fn device_facts(name: &str) -> DeviceFacts {
    let name = resolved_device(name);
    let index = name.strip_prefix("wgpu").map(|rest| rest.strip_prefix(':').and_then(|index| index.parse().ok()).unwrap_or(0));
    let (adapter, driver) = match index.and_then(|index: usize| adapters().get(index)) {
        Some(adapter) => (Some(format!("{} ({})", adapter.name, adapter.api)), Some(adapter.driver.clone())),
        None if name == "cuda" => nvidia(),
        None => (None, None),
    };
    DeviceFacts {
        name: name.into(),
        adapter,
        driver,
        processor: processor(),
        threads: rayon::current_num_threads(),
        system: format!("{} {}", std::env::consts::OS, std::env::consts::ARCH),
    }
}

/// The device `name` of this machine, and the machine's name.
pub(super) fn training_device(name: &str) -> TrainingDevice {
    let host = std::fs::read_to_string("/proc/sys/kernel/hostname").ok().or_else(|| std::env::var("COMPUTERNAME").ok());
    TrainingDevice { device: device_facts(name), host: host.unwrap_or_default().trim().into() }
}

/// Model of the processor, where the system has a file that says.
fn processor() -> String {
    let text = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let value = |key: &str| text.lines().find(|line| line.starts_with(key)).and_then(|line| line.split_once(':')).map(|(_, value)| value.trim().to_string());
    value("model name").or_else(|| value("Model")).unwrap_or_default()
}

/// Model of the first NVIDIA card and version of the driver, where the driver's files say.
fn nvidia() -> (Option<String>, Option<String>) {
    let folder = Path::new("/proc/driver/nvidia");
    let version = std::fs::read_to_string(folder.join("version")).ok().and_then(|text| text.lines().next().map(str::to_string));
    let mut cards: Vec<PathBuf> =
        std::fs::read_dir(folder.join("gpus")).map(|d| d.flatten().map(|e| e.path().join("information")).collect()).unwrap_or_default();
    cards.sort();
    let text = cards.first().and_then(|card| std::fs::read_to_string(card).ok()).unwrap_or_default();
    let model = text.lines().find_map(|line| line.strip_prefix("Model:")).map(|model| model.trim().to_string());
    (model, version)
}

/// Measures the most resident memory of this process over a time. Two at once would disturb each other: a sweep has one per process.
pub struct PeakMemory {
    /// Whether the system forgot what was before.
    begun: bool,
}

impl PeakMemory {
    /// From now on.
    pub fn begin() -> Self {
        // Linux only (proc(5)): 5 sets the peak to what is resident now.
        Self { begun: std::fs::write("/proc/self/clear_refs", "5").is_ok() }
    }
    /// The peak since then, MB (10^6 bytes), where the system tells.
    pub fn mb(&self) -> Option<f64> {
        let text = self.begun.then(|| std::fs::read_to_string("/proc/self/status").ok())??;
        let line = text.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
        line.split_whitespace().next()?.parse::<f64>().ok().map(|kib| kib * 1024.0 / 1e6)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fingerprint_follows_names_and_contents() {
        let registry = Registry::collect().unwrap();
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        std::fs::write(at("transforms_train.json"), "{}").unwrap();
        std::fs::create_dir(at("train")).unwrap();
        std::fs::write(at("train/a.png"), "image").unwrap();
        let text = folder.path().to_str().unwrap();
        let of = || fingerprint(text, &registry).unwrap();
        let (first, first_listing) = (of(), listing(folder.path()).unwrap());
        assert_eq!((first.files, first.bytes), (2, 7));
        std::fs::write(at(".hidden"), "x").unwrap();
        assert_eq!(of(), first, "hidden files are no data");
        std::fs::write(at("train/a.png"), "IMAGE").unwrap();
        assert_ne!(of().hash, first.hash, "content of the same length");
        assert_eq!(listing(folder.path()).unwrap(), first_listing);
        std::fs::write(at("train/a.png"), "image").unwrap();
        std::fs::rename(at("train/a.png"), at("train/b.png")).unwrap();
        assert_ne!(of().hash, first.hash, "another name");
        assert_ne!(listing(folder.path()).unwrap(), first_listing);
    }

    #[test]
    fn images_beside_a_file_or_a_model_count() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        std::fs::create_dir_all(at("sparse/0")).unwrap();
        std::fs::create_dir(at("images")).unwrap();
        std::fs::write(at("sparse/0/cameras.bin"), "model").unwrap();
        std::fs::write(at("transforms.json"), "{}").unwrap();
        std::fs::write(at("images/a.png"), "image").unwrap();
        let of = || [at("transforms.json"), at("sparse/0")].map(|path| listing(&path).unwrap());
        let first = of();
        std::fs::write(at("images/a.png"), "another image").unwrap();
        let second = of();
        assert!(first[0] != second[0] && first[1] != second[1], "{first:?} {second:?}");
        assert_eq!(list(&root_of(&at("transforms.json"))).unwrap().len(), 3);
        // So would a sweep's folder in it.
        for scene in ["transforms.json", "sparse/0"] {
            for (out, expected) in [("", true), ("new/sweep", true), ("images/../new", true), (".runs/a", false), ("../other", false)] {
                assert_eq!(would_be_part(&at(out), &at(scene)), expected, "{out} in {scene}");
            }
        }
        assert!(!would_be_part(folder.path(), Path::new("procedural:tiny")));
        // A model beside its images, and one directly in `sparse`: what lies around the project belongs to something else.
        for (project, model) in [("flat/project", "flat/project"), ("direct/project", "direct/project/sparse")] {
            std::fs::create_dir_all(at(model)).unwrap();
            std::fs::write(at(model).join("cameras.txt"), "model").unwrap();
            std::fs::write(at(project).join("a.png"), "image").unwrap();
            let of = || listing(&at(model)).unwrap();
            let first = of();
            std::fs::write(at(project).join("../other"), "other").unwrap();
            assert_eq!(of(), first, "{model}");
            std::fs::write(at(project).join("a.png"), "another image").unwrap();
            assert_ne!(of(), first, "{model}");
        }
    }

    #[test]
    fn files_that_an_index_names_elsewhere_count() {
        let registry = Registry::collect().unwrap();
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        for name in ["scene/images", "scene/.cache", "shared"] {
            std::fs::create_dir_all(at(name)).unwrap();
        }
        let whole = at("shared/b.png").display().to_string();
        let named = ["images/a.png", "../scene/images/a.png", "../shared/a", "../shared/a.png", ".cache/c.png", "../shared/missing.png", whole.as_str()];
        let named: Vec<_> = named.iter().map(|name| serde_json::json!({"file_path": name})).collect();
        let document = serde_json::json!({"frames": named, "ply_file_path": "../shared/points.ply"}).to_string();
        let read = ["scene/images/a.png", "scene/.cache/c.png", "shared/a.png", "shared/b.png", "shared/points.ply"];
        for name in read.iter().chain(&["shared/other.png"]) {
            std::fs::write(at(name), "file").unwrap();
        }
        for document_name in ["transforms.json", "transforms_train.json"] {
            let file = at("scene").join(document_name);
            std::fs::write(&file, &document).unwrap();
            let of = || (fingerprint(at("scene").to_str().unwrap(), &registry).unwrap(), listing(&at("scene")).unwrap());
            let first = of();
            assert_eq!(first.0.files, 6, "each once, and the document");
            for name in read {
                std::fs::write(at(name), "FILE").unwrap();
                let changed = of();
                assert!(changed.0.hash != first.0.hash && changed.1 == first.1, "{name}");
                std::fs::write(at(name), "longer").unwrap();
                assert_ne!(of().1, first.1, "{name}");
                std::fs::write(at(name), "file").unwrap();
            }
            std::fs::write(at("shared/other.png"), "FILE, longer").unwrap();
            assert_eq!(of(), first, "nothing names it");
            assert_eq!(listing(&file).unwrap(), first.1, "the path of the document");
            std::fs::remove_file(file).unwrap();
        }
        std::fs::create_dir(at("model")).unwrap();
        std::fs::create_dir(at("images")).unwrap();
        for (name, text) in [("model/cameras.txt", ""), ("model/images.txt", "1 1 0 0 0 0 0 0 1 a.png\n\n"), ("images/a.png", "image"), ("images/b.png", "")] {
            std::fs::write(at(name), text).unwrap();
        }
        let of = || fingerprint(at("model").to_str().unwrap(), &registry).unwrap();
        let first = of();
        std::fs::write(at("images/b.png"), "nothing names it").unwrap();
        assert_eq!((of(), first.files), (first.clone(), 3));
        std::fs::write(at("images/a.png"), "other").unwrap();
        assert_ne!(of().hash, first.hash);
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn the_peak_is_that_of_its_own_time() {
        // Written, so that it is resident; other tests of this process use far less.
        let large = |mb: usize| std::hint::black_box(vec![1u8; mb * 1_000_000]).len();
        let first = PeakMemory::begin();
        large(300);
        let with = first.mb().unwrap();
        let second = PeakMemory::begin();
        large(1);
        assert!(with > 300.0 && second.mb().unwrap() < with - 150.0, "{with} MB, then {:?}", second.mb());
    }

    #[cfg(unix)]
    #[test]
    fn links_in_a_circle_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["a", "b"] {
            std::os::unix::fs::symlink(folder.path(), folder.path().join(name)).unwrap();
        }
        let message = listing(folder.path()).unwrap_err().to_string();
        assert!(message.contains("circle"), "{message}");
    }

    #[test]
    fn built_in_scenes_have_a_fingerprint_and_wrong_paths_none() {
        let registry = Registry::collect().unwrap();
        let tiny = fingerprint("procedural:tiny", &registry).unwrap();
        assert_eq!((tiny.files, tiny.path.as_str()), (0, "procedural:tiny"));
        assert_ne!(tiny.hash, fingerprint("procedural", &registry).unwrap().hash);
        assert!(fingerprint("no/such/folder", &registry).unwrap_err().to_string().contains("no such"));
        let facts = device_facts("flex");
        assert!(facts.name == "flex" && facts.adapter.is_none() && facts.threads > 0, "{facts:?}");
    }
}
