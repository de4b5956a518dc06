//! Refuses what a grid states to no effect: settings that its own keys overrule, sizes of nothing, and families that no method is put on.

use super::grid::{Axis, Grid};
use super::plan::{PlannedTraining, within};
use cc4dgs_core::{Error, Registry, Result, config};

/// Refuses `grid`, which `object` names, where something that it states would have no effect. Files of settings (`config`) may state anything: the keys of the
/// grid are meant to take the place of theirs.
///
/// # Errors
/// [`Error::Parameter`] that names section, key, value and remedy.
pub(super) fn refuse_overruled(object: &str, grid: &Grid) -> Result<()> {
    let mut lists = vec![("set".to_string(), grid.set.as_slice())];
    lists.extend(lists_of("scene", &grid.scene).chain(lists_of("method", &grid.method)).chain(lists_of("setting", &grid.setting)));
    for (section, set) in lists {
        refuse_settings(grid, set).map_err(|error| within(&format!("{object}: {section}"), error))?;
    }
    if grid.minutes.is_none() && grid.iterations.is_none() {
        let mut sizes = sizes_of("scene", &grid.scene).chain(sizes_of("method", &grid.method)).chain(sizes_of("setting", &grid.setting));
        if let Some((section, size)) = sizes.find(|(_, size)| *size != 1.0) {
            let problem = format!("{size} has no effect: the grid states neither minutes nor iterations that it could multiply");
            let remedy = "Size the grid (minutes or iterations, or the options of these names), or remove size and set train.iterations";
            return Err(Error::parameter(format!("{object}: {section}, size"), problem, remedy));
        }
    }
    if !grid.method.iter().any(|method| method.own.preset.starts_with('+'))
        && let Some((scene, family)) = grid.scene.iter().find_map(|scene| Some((scene, scene.own.family.as_ref()?)))
    {
        let problem = format!("'{family}' has no effect: the preset of no [[method]] starts with '+'");
        let remedy = format!("Remove it, or write preset = \"+\" for {family}, or preset = \"+METHOD\" for {family}+METHOD");
        return Err(Error::parameter(format!("{object}: [[scene]] '{}', family", scene.name), problem, remedy));
    }
    Ok(())
}

/// Refuses `auto.minutes` in a `set` of `grid` that belongs to none of the `trainings` whose plan is still to be made.
///
/// # Errors
/// [`Error::Parameter`] that names section, value and remedy; as [`PlannedTraining::layers`].
pub(super) fn refuse_minutes(grid: &Grid, trainings: &[PlannedTraining], registry: &Registry) -> Result<()> {
    let mut planned = Vec::new();
    for training in trainings {
        if training.layers(registry)?.want_plan() {
            planned.push(training);
        }
    }
    refuse_minutes_in("set".into(), &grid.set, !planned.is_empty())?;
    for scene in &grid.scene {
        refuse_minutes_in(format!("[[scene]] '{}', set", scene.name), &scene.set, planned.iter().any(|training| training.scene == scene.name))?;
    }
    for method in &grid.method {
        refuse_minutes_in(format!("[[method]] '{}', set", method.name), &method.set, planned.iter().any(|training| training.method == method.name))?;
    }
    for setting in &grid.setting {
        refuse_minutes_in(format!("[[setting]] '{}', set", setting.name), &setting.set, planned.iter().any(|training| training.setting == setting.name))?;
    }
    Ok(())
}

/// Refuses `auto.minutes` in the list `set` of `section`, unless a training that it belongs to `is_planned`.
fn refuse_minutes_in(section: String, set: &[String], is_planned: bool) -> Result<()> {
    let mut stated = toml::Table::new();
    config::set_all(&mut stated, set)?;
    let Some(minutes) = value_at(&stated, "auto.minutes").filter(|_| !is_planned) else { return Ok(()) };
    let problem = format!("{minutes} has no effect: only the preset auto plans for a time");
    Err(Error::parameter(format!("{section}: auto.minutes"), problem, "Use a preset auto or auto+METHOD, or set train.iterations"))
}

/// The settings of each value of an axis, with their section in the grid.
fn lists_of<'a, T>(axis: &'a str, values: &'a [Axis<T>]) -> impl Iterator<Item = (String, &'a [String])> {
    values.iter().map(move |value| (format!("[[{axis}]] '{}', set", value.name), value.set.as_slice()))
}

/// The size of each value of an axis, with its section in the grid.
fn sizes_of<'a, T>(axis: &'a str, values: &'a [Axis<T>]) -> impl Iterator<Item = (String, f64)> {
    values.iter().map(move |value| (format!("[[{axis}]] '{}'", value.name), value.size))
}

/// Refuses a list of settings in which one is overruled by a key of `grid`.
fn refuse_settings(grid: &Grid, set: &[String]) -> Result<()> {
    let mut stated = toml::Table::new();
    config::set_all(&mut stated, set)?;
    let views = grid.validation_views();
    // The setting, what takes its place (if it is there), and what to write instead.
    let overruled = [
        ("device", Some(format!("device = \"{}\"", grid.device)), "State `device` once, at the top of the grid, or give --device"),
        ("seed", Some(format!("seeds = {:?}", grid.seeds)), "List the seeds of all trainings at the top of the grid, such as seeds = [0, 1], or give --seeds"),
        ("preset", Some("the preset of [[method]]".into()), "State it as the `preset` of a [[method]]"),
        ("train.validation", (views > 0).then(|| format!("validation = {views}")), "State `validation` once, at the top of the grid"),
        ("train.iterations", grid.iterations.map(|n| format!("iterations = {n}")), "Multiply the iterations by `size`, or remove `iterations` from the grid"),
        ("auto.minutes", grid.minutes.map(|m| format!("minutes = {m}")), "Multiply the minutes by `size`, or remove `minutes` from the grid"),
    ];
    for (key, by, remedy) in overruled {
        if let (Some(value), Some(by)) = (value_at(&stated, key), by) {
            return Err(Error::parameter(key, format!("{value} has no effect: {by} takes its place"), remedy));
        }
    }
    Ok(())
}

/// The value at `path`, such as `train.iterations`.
pub(super) fn value_at<'a>(table: &'a toml::Table, path: &str) -> Option<&'a toml::Value> {
    let mut keys = path.split('.');
    let first = table.get(keys.next()?);
    keys.fold(first, |value, key| value?.get(key))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What a grid with these keys at its top and in its tables is refused for.
    fn refused(top: &str, [scene, method, setting]: [&str; 3]) -> Option<String> {
        let tables = format!(
            "[[scene]]\nname = 's'\npath = 'procedural:tiny'\n{scene}\n[[method]]\nname = 'm'\npreset = '+'\n{method}\n[[setting]]\nname = 'x'\n{setting}\n"
        );
        let text = format!("name = 'g'\n{top}\n{tables}[[codec]]\nname = 'c'\ncodec = 'raw'\n");
        Grid::parse("g.toml", &text).err().map(|error| error.to_string())
    }

    #[test]
    fn settings_without_effect_name_key_value_and_remedy() {
        let cases = [
            ("set = ['device=wgpu']", ["", "", ""], ["g.toml: set: device", "wgpu", "device = \"flex\"", "--device"]),
            ("", ["set = ['device = wgpu:1']", "", ""], ["[[scene]] 's', set: device", "wgpu:1", "device = \"flex\"", "top of the grid"]),
            ("", ["", "set = ['seed=7']", ""], ["[[method]] 'm', set: seed", "7", "seeds = [0]", "--seeds"]),
            ("", ["", "", "set = ['preset=demo']"], ["[[setting]] 'x', set: preset", "demo", "[[method]]", "`preset`"]),
            ("split = 'validation'", ["", "set = ['train.validation=3']", ""], ["set: train.validation", "3", "validation = 12", "`validation`"]),
            ("validation = 5", ["", "", "set = ['train={validation=3}']"], ["set: train.validation", "3", "validation = 5", "`validation`"]),
            ("iterations = 90", ["set = ['train.iterations=50']", "", ""], ["set: train.iterations", "50", "iterations = 90", "`size`"]),
            ("minutes = 2.0", ["", "", "set = ['auto.minutes=7']"], ["set: auto.minutes", "7", "minutes = 2", "`size`"]),
            ("", ["size = 2.0", "", ""], ["[[scene]] 's', size", "2 has no effect", "neither minutes nor iterations", "iterations"]),
            ("", ["", "", "size = 0.5"], ["[[setting]] 'x', size", "0.5 has no effect", "neither minutes nor iterations", "iterations"]),
            ("set = ['nonsense']", ["", "", ""], ["g.toml: set", "nonsense", "'='", "key=value"]),
        ];
        for (top, tables, parts) in cases {
            let message = refused(top, tables).unwrap_or_else(|| panic!("{top} {tables:?} is accepted"));
            assert!(parts.iter().all(|part| message.contains(part)), "{message}");
        }
    }

    #[test]
    fn a_family_needs_a_method_on_it() {
        let grid = |family: &str, presets: [&str; 2]| {
            let methods: String = presets.iter().enumerate().map(|(i, preset)| format!("[[method]]\nname = 'm{i}'\npreset = '{preset}'\n")).collect();
            let text = format!("name = 'g'\n[[scene]]\nname = 's'\npath = 'procedural:tiny'\n{family}\n{methods}[[codec]]\nname = 'c'\ncodec = 'raw'\n");
            Grid::parse("g.toml", &text).map(drop).map_err(|error| error.to_string())
        };
        let message = grid("family = 'demo'", ["auto", ""]).unwrap_err();
        assert!(["g.toml", "[[scene]] 's', family", "'demo'", "preset = \"+\""].iter().all(|part| message.contains(part)), "{message}");
        for (family, presets) in [("", ["auto", ""]), ("family = 'demo'", ["auto", "+"]), ("family = 'demo'", ["+hexplane", ""])] {
            assert_eq!(grid(family, presets), Ok(()));
        }
    }

    #[test]
    fn settings_with_an_effect_are_accepted() {
        for (top, tables) in [
            ("device = 'wgpu'\nseeds = [7]\nset = ['train.batch=2']", ["size = 1.0", "", ""]),
            ("", ["", "set = ['train.validation=3']", ""]),
            ("", ["set = ['train.iterations=50']", "", "set = ['auto.minutes=7']"]),
            ("iterations = 90", ["size = 2.0", "set = ['auto.minutes=7']", ""]),
            ("minutes = 2.0", ["", "size = 2.0", ""]),
        ] {
            assert_eq!(refused(top, tables), None);
        }
    }
}
