//! The settings of a training: those of grid, scene, method and setting, laid over its preset in this order.

use super::location::locate;
use super::overruled::value_at;
use cc4dgs_core::{Error, Result, config};

/// What a grid or one value of an axis states, each as `key=value`.
pub(super) struct Settings<'a> {
    /// The settings of its file, which come first.
    pub file: Vec<String>,
    /// Its own.
    pub set: &'a [String],
}

/// The settings of the configuration file that a grid names by `text`, but the name of its preset.
///
/// # Errors
/// [`Error::Io`], and [`Error::Parameter`] for text that is not TOML and for a variable that is not set.
pub(super) fn of_file(text: &str) -> Result<Vec<String>> {
    let path = locate(text)?;
    let content = std::fs::read_to_string(&path).map_err(|e| Error::io(&path, e))?;
    let mut table = config::parse_table(&path.display().to_string(), &content)?;
    // That of the method takes its place. A name of another preset would decide whether `auto` makes a plan, and which sizes a graphics card takes.
    table.remove("preset");
    let mut all = Vec::new();
    assignments(&table, "", &mut all);
    Ok(all)
}

/// Every value of `table` as `key.of.tables=value`. A table with keys that have no such form, such as names of cameras with a dot, is one value.
fn assignments(table: &toml::Table, prefix: &str, to: &mut Vec<String>) {
    let has_form = |key: &String| !key.is_empty() && key.trim() == key && !key.contains(['.', '=']);
    for (key, value) in table {
        match value {
            toml::Value::Table(inner) if inner.keys().all(has_form) => assignments(inner, &format!("{prefix}{key}."), to),
            value => to.push(format!("{prefix}{key}={value}")),
        }
    }
}

/// All settings of `stated`, in order, as overrides of `preset` for [`config::set_all`]: a plan does not change with the files. As in `cc4dgs train --config
/// FILE --set SECTION.kind=NAME`, a change of `kind` over a file drops the other settings that the file has of this section.
///
/// # Errors
/// [`Error::Parameter`] for text that is not `key=value`.
pub(super) fn laid_over(preset: toml::Table, stated: Vec<Settings>) -> Result<Vec<String>> {
    let mut table = preset;
    let mut below = Vec::with_capacity(stated.len());
    for Settings { file, set } in &stated {
        below.push(table.clone());
        config::set_all(&mut table, file)?;
        config::set_all(&mut table, set)?;
    }
    // From the last to the first: what a later file loses does not come over an earlier one.
    let mut over: Vec<String> = Vec::new();
    for (Settings { file, set }, base) in stated.into_iter().zip(below).rev() {
        over = [set, over.as_slice()].concat();
        if !file.is_empty() {
            over = [kept(base, file, &over)?, over].concat();
        }
    }
    Ok(over)
}

/// The settings of a `file` over `base` that are still there once `over` is laid over them, with their own or another value.
fn kept(mut base: toml::Table, file: Vec<String>, over: &[String]) -> Result<Vec<String>> {
    config::set_all(&mut base, &file)?;
    config::set_all(&mut base, over)?;
    let is_there = |assignment: &String| assignment.split_once('=').is_some_and(|(path, _)| value_at(&base, path).is_some());
    Ok(file.into_iter().filter(is_there).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layers::Layers;
    use cc4dgs_core::Registry;

    fn strings(texts: &[&str]) -> Vec<String> {
        texts.iter().map(ToString::to_string).collect()
    }

    #[test]
    fn a_file_and_overrides_make_the_configuration_of_train() {
        let (folder, registry) = (tempfile::tempdir().unwrap(), Registry::collect().unwrap());
        let file = folder.path().join("config.toml");
        let files = [
            "[density]\nkind = 'mcmc'\nmax_gaussians = 90\nrelocate = 0\n[train]\nbatch = 3\n[train.lr]\nmeans = 0.5\n",
            // Of the kind of the preset, `mcmc`.
            "[density]\nmax_gaussians = 90\n",
            "[density]\nkind = 'clone-split'\nevery = 50\n[deformer]\nkind = 'hexplane'\nfeatures = 4\n",
        ];
        let overrides: [&[&str]; 6] = [
            &[],
            &["density.kind=mcmc", "train.batch=2"],
            &["density.kind=clone-split"],
            &["density.max_gaussians=70", "density.kind=clone-split"],
            &["density={kind='clone-split'}"],
            &["deformer.kind=none", "density.kind=none"],
        ];
        for (text, sets) in files.iter().flat_map(|text| overrides.map(|sets| (text, strings(sets)))) {
            std::fs::write(&file, text).unwrap();
            let expected = Layers::collect(&registry, Some("demo"), Some(file.as_path()), &sets).unwrap();
            let own = Settings { file: of_file(&file.display().to_string()).unwrap(), set: &sets };
            let planned = laid_over(registry.preset("demo").unwrap(), vec![own]).unwrap();
            let found = Layers::collect(&registry, Some("demo"), None, &planned).unwrap();
            assert_eq!(found.table(), expected.table(), "{text} {sets:?}");
        }
    }

    #[test]
    fn a_kind_drops_the_settings_of_the_files_below_it_alone() {
        let list = strings(&["density.every=7"]);
        let grid = Settings { file: Vec::new(), set: &list };
        let scene = Settings { file: strings(&["density.kind=\"a\"", "density.x=1", "train.batch=2"]), set: &[] };
        let method = Settings { file: strings(&["density.kind=\"b\"", "density.x=2", "density.y=3"]), set: &[] };
        let back = strings(&["density.kind=a"]);
        let of = |stated| laid_over(toml::Table::new(), stated).unwrap();
        let (scene_file, method_file) = (scene.file.clone(), method.file.clone());
        let two = of(vec![grid, scene, method]);
        assert_eq!(two, [strings(&["density.every=7", "density.kind=\"a\"", "density.x=1", "train.batch=2"]), method_file.clone()].concat());
        // `density.x` of the scene is there, and that of the method comes over it.
        let stated = vec![Settings { file: scene_file, set: &[] }, Settings { file: method_file, set: &back }];
        let expected = ["density.kind=\"a\"", "train.batch=2", "density.kind=\"b\"", "density.kind=a"];
        assert_eq!(of(stated), expected);
    }
}
