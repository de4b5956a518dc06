//! The memory that a plan may count on, and how much of it holds decoded images and recorded depth.

use super::Choice;
use crate::config::RunConfig;
use crate::train::LossTerms;
use cc4dgs_core::{Registry, Result, SceneOptions, plural};
use std::path::{Path, PathBuf};

/// The setting for the cache.
const CACHE: &str = "scene.cache_mb";
/// Bytes per pixel of a decoded image, at most (one without alpha has 3), and of its recorded depth. Masks are not in the cache of a scene.
const IMAGE_BYTES: f64 = 4.0;
const DEPTH_BYTES: f64 = size_of::<f32>() as f64;

/// Hierarchies of control groups, version 2 and version 1: controller in `/proc/self/cgroup`, folder that the hierarchy is mounted at, file with the limit.
const HIERARCHIES: [[&str; 3]; 2] = [["", "sys/fs/cgroup", "memory.max"], ["memory", "sys/fs/cgroup/memory", "memory.limit_in_bytes"]];

/// Memory in bytes that this process may use, where the system says: its part, if `processes` such processes share the machine, a container or a job.
pub(super) fn memory(processes: usize) -> Option<u64> {
    memory_below(Path::new("/")).map(|bytes| bytes / processes.max(1) as u64)
}

/// The memory of the machine whose files lie in `root`, or the smallest limit of the control group of this process and the groups around it (a container,
/// a Slurm job).
fn memory_below(root: &Path) -> Option<u64> {
    let text = std::fs::read_to_string(root.join("proc/meminfo")).ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("MemTotal:"))?;
    let machine = line.split_whitespace().next()?.parse::<u64>().ok()?.saturating_mul(1024);
    let groups = std::fs::read_to_string(root.join("proc/self/cgroup")).unwrap_or_default();
    let files = HIERARCHIES.iter().flat_map(|hierarchy| limit_files(root, &groups, *hierarchy));
    // Where there is no limit they say so in words or by a huge number.
    let limits = files.filter_map(|file| std::fs::read_to_string(file).ok()?.trim().parse::<u64>().ok());
    limits.chain([machine]).min()
}

/// The files with the limits of a group and the groups around it: the group that `groups`, the content of `/proc/self/cgroup`, names for a hierarchy.
fn limit_files(root: &Path, groups: &str, [controller, mount, name]: [&str; 3]) -> Vec<PathBuf> {
    let group = groups.lines().find_map(|line| {
        let (controllers, path) = line.split_once(':')?.1.split_once(':')?;
        controllers.split(',').any(|other| other == controller).then_some(path)
    });
    let mount = root.join(mount);
    // In a container the path may be that of the host. Its folders are then missing here, and the mounted folder is the group itself.
    let folders = Path::new(group.unwrap_or("/")).ancestors();
    folders.map(|folder| mount.join(folder.strip_prefix("/").unwrap_or(folder)).join(name)).collect()
}

/// The most views whose recorded depth a training reads: all `views` that are trained on, where a term of `loss` (`[[loss]]`) compares depth, else none.
///
/// # Errors
/// What the loss terms report of their settings.
pub(super) fn depths(views: usize, loss: &[toml::Table], registry: &Registry) -> Result<usize> {
    Ok(if LossTerms::build(registry, loss)?.want_depth() { views } else { 0 })
}

/// The cache for all `images`, decoded, and for the recorded depth of `depths` of them, each of so many `pixels`, as long as a third of the memory holds them.
/// `stated_mb` is the setting without a plan.
pub(super) fn cache(images: usize, depths: usize, pixels: f64, stated_mb: u64, memory: Option<u64>) -> Option<Choice> {
    let bytes = pixels * (images as f64 * IMAGE_BYTES + depths as f64 * DEPTH_BYTES);
    let (needed, stated) = (bytes / 1e6, stated_mb as f64);
    let most = memory.map_or(stated, |bytes| bytes as f64 / 3e6);
    let wanted = needed.min(most).ceil().max(1.0);
    let depth = if depths > 0 { format!(" and the depth of {depths}") } else { String::new() };
    let reason = if wanted > stated {
        format!("{images} {}{depth} {} kept decoded", plural(images, "image", "images"), plural(images + depths, "is", "are"))
    } else if wanted < needed.min(stated) {
        format!("{images} decoded {}{depth} would take more than a third of the memory", plural(images, "image", "images"))
    } else {
        return None;
    };
    Some(Choice { settings: vec![(CACHE, toml::Value::Integer(wanted as i64))], reason })
}

/// The options of `config` that its scene is opened with, where `processes` processes share the memory: the share of now may be another than that of a plan.
/// Results do not depend on the cache, so the configuration stays as it is.
pub(crate) fn scene_options(config: &RunConfig, processes: usize) -> SceneOptions {
    let stated_mb = config.scene.cache_mb;
    // Unless it was changed after the plan.
    let line = format!("{CACHE} = {stated_mb} (");
    let planned = config.auto.plan.iter().any(|choice| choice.starts_with(&line));
    SceneOptions { cache_mb: cache_mb(stated_mb, planned, processes, memory(processes)), ..config.scene.clone() }
}

/// The cache of a process: a third of its `memory` where a plan chose it, else what is stated, at most that third where other processes share the machine.
fn cache_mb(stated_mb: u64, planned: bool, processes: usize, memory: Option<u64>) -> u64 {
    match memory.map(|bytes| (bytes / 3_000_000).max(1)) {
        Some(most) if planned => most,
        Some(most) if processes > 1 => stated_mb.min(most),
        _ => stated_mb,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::Tensor;
    use cc4dgs_core::{LossInput, LossPlugin, LossTerm, Plugin, inventory};

    const GIB: u64 = 1 << 30;

    /// A loss term that compares depth if `of_depth` says so.
    struct Test {
        of_depth: bool,
    }

    impl LossTerm for Test {
        fn value(&self, _: &LossInput) -> Result<Option<Tensor<1>>> {
            Ok(None)
        }
        fn wants_depth(&self) -> bool {
            self.of_depth
        }
    }

    fn build(settings: &toml::Table) -> Result<Box<dyn LossTerm>> {
        Ok(Box::new(Test { of_depth: settings.get("of_depth").and_then(toml::Value::as_bool).unwrap_or(false) }))
    }

    inventory::submit! {
        LossPlugin { info: Plugin { name: "test", version: "1", summary: "a test", paper: "", schema: "", capabilities: &[] }, build, fuses: None }
    }

    #[test]
    fn depth_is_counted_where_a_term_compares_it() {
        let registry = Registry::collect().unwrap();
        let of = |loss: &str| {
            let table: toml::Table = format!("loss = [{loss}]").parse().unwrap();
            let loss: Vec<toml::Table> = table["loss"].as_array().unwrap().iter().map(|term| term.as_table().unwrap().clone()).collect();
            depths(40, &loss, &registry).map_err(|e| e.to_string())
        };
        assert_eq!(of("{kind='test'}"), Ok(0));
        assert_eq!(of("{kind='test'}, {kind='test', of_depth=true, weight=0.2}"), Ok(40));
        assert_eq!(of("{kind='test'}, {kind='test', of_depth=true, weight=0.0}"), Ok(0), "a term without weight wants nothing");
        assert!(of("{kind='tset'}").unwrap_err().contains("tset"));
    }

    /// The memory of a machine with 16 GiB and these files.
    fn memory_with(files: &[(&str, &str)]) -> Option<u64> {
        let root = tempfile::tempdir().unwrap();
        for (name, text) in [("proc/meminfo", "MemTotal:       16777216 kB\nMemFree:  1 kB\n")].iter().chain(files) {
            let path = root.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, text).unwrap();
        }
        memory_below(root.path())
    }

    #[test]
    fn the_smallest_limit_around_the_process_counts() {
        assert_eq!(memory_below(tempfile::tempdir().unwrap().path()), None);
        assert_eq!(memory_with(&[]), Some(16 * GIB));
        // Version 2: the job of a Slurm step has the limit, not the group of the task.
        let slurm = |limit| {
            memory_with(&[
                ("proc/self/cgroup", "0::/system.slice/slurmstepd.scope/job_7/step_batch/task_0\n"),
                ("sys/fs/cgroup/system.slice/slurmstepd.scope/job_7/memory.max", limit),
                ("sys/fs/cgroup/system.slice/slurmstepd.scope/job_7/step_batch/task_0/memory.max", "max\n"),
                ("sys/fs/cgroup/system.slice/slurmstepd.scope/job_8/memory.max", "4096\n"),
            ])
        };
        assert_eq!((slurm("4294967296\n"), slurm("max\n")), (Some(4 * GIB), Some(16 * GIB)));
        // Version 1, beside hierarchies of other controllers.
        let first = |own: &str| {
            memory_with(&[
                ("proc/self/cgroup", "9:name=systemd:/\n5:cpu,memory:/slurm/uid_0/job_7\n1:cpuset:/other\n0::/\n"),
                ("sys/fs/cgroup/memory/memory.limit_in_bytes", "9223372036854771712\n"),
                ("sys/fs/cgroup/memory/slurm/uid_0/memory.limit_in_bytes", "8589934592\n"),
                ("sys/fs/cgroup/memory/slurm/uid_0/job_7/memory.limit_in_bytes", own),
            ])
        };
        assert_eq!((first("2147483648\n"), first("9223372036854771712\n")), (Some(2 * GIB), Some(8 * GIB)));
        // A container that sees the path of the host.
        let container = [("proc/self/cgroup", "4:memory:/docker/abc\n"), ("sys/fs/cgroup/memory/memory.limit_in_bytes", "1073741824\n")];
        assert_eq!(memory_with(&container), Some(GIB));
    }

    #[test]
    fn processes_share_the_memory() {
        assert_eq!(memory(4), memory(1).map(|bytes| bytes / 4));
        assert_eq!(memory(0), memory(1));
    }

    #[test]
    fn the_cache_is_that_of_the_share_of_now() {
        let memory = Some(3_000_000_000);
        // A preset without a plan: 2000 MB, of a part of 3 GB at most 1000.
        assert_eq!((cache_mb(2000, false, 4, memory), cache_mb(500, false, 4, memory), cache_mb(2000, false, 1, memory)), (1000, 500, 2000));
        // A plan that was made beside more, or fewer, processes.
        assert_eq!((cache_mb(700, true, 4, memory), cache_mb(6000, true, 1, memory), cache_mb(6000, true, 4, None)), (1000, 1000, 6000));
        let mut config = RunConfig::resolve(Some("demo"), None, &["scene.cache_mb=987654321".into()]).unwrap();
        let part = |config: &RunConfig, processes| scene_options(config, processes).cache_mb;
        assert_eq!(part(&config, 1), 987_654_321, "it is stated");
        config.auto.plan = vec!["scene.cache_mb = 987654321 (1500 images are kept decoded)".into()];
        let expected = |processes| super::memory(processes).map_or(987_654_321, |bytes| bytes / 3_000_000);
        assert_eq!([part(&config, 1), part(&config, 3)], [expected(1), expected(3)]);
        config.scene.cache_mb = 5;
        assert_eq!(part(&config, 1), 5, "it was changed after the plan");
    }

    #[test]
    fn images_take_a_third_of_the_memory_at_most() {
        let cache = |views, memory| cache(views, 0, 1e6, 2000, memory).map(|choice| choice.settings[0].1.as_integer().unwrap());
        assert_eq!((cache(400, Some(24_000_000_000)), cache(1500, Some(24_000_000_000))), (None, Some(6000)));
        assert_eq!((cache(5000, Some(24_000_000_000)), cache(5000, None)), (Some(8000), None));
        // An eighth of that memory: a third of it is less than the setting states.
        assert_eq!((cache(1500, Some(3_000_000_000)), cache(100, Some(3_000_000_000))), (Some(1000), None));
    }

    #[test]
    fn depth_is_kept_beside_the_images() {
        let chosen = |choice: Choice| (choice.settings[0].1.as_integer().unwrap(), choice.reason);
        let cache = |images, depths, memory| cache(images, depths, 1e6, 2000, Some(memory)).map(chosen);
        assert_eq!((cache(400, 0, 24_000_000_000), cache(400, 100, 24_000_000_000)), (None, None), "2000 MB hold all");
        let more = Some((3200, "400 images and the depth of 400 are kept decoded".to_string()));
        assert_eq!(cache(400, 400, 24_000_000_000), more, "4 bytes per pixel of each");
        let reason = "400 decoded images and the depth of 300 would take more than a third of the memory";
        assert_eq!(cache(400, 300, 3_000_000_000), Some((1000, reason.to_string())));
        let reason = |depths| super::cache(1, depths, 1e9, 2000, None).map(|choice| choice.reason);
        assert_eq!([reason(0), reason(1)], [None, None], "without a known memory the setting stays");
        let reason = |depths| super::cache(1, depths, 1e9, 2000, Some(30_000_000_000)).map(|choice| choice.reason).unwrap();
        assert_eq!([reason(0), reason(1)], ["1 image is kept decoded", "1 image and the depth of 1 are kept decoded"]);
    }
}
