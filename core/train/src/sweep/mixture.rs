//! What the trainings of a table differ in beside their seeds. A plan sized in minutes times the machine, and may choose other settings for one seed than for
//! the next: the deviation of such a row is not that of its seeds alone, and tables say so. They also say which trainings learned from fewer views than others.

use super::result::CellResult;
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};

/// Keys that differ by nature: the seed, how far a training came in its time and what follows from it, what the training measured, the words of the plan, and
/// the memory for images, which follows that of the machine and changes no result.
const EXPECTED: [&str; 7] = ["auto", "scene.cache_mb", "seed", "train.checkpoint_every", "train.iterations", "train.stretch", "train.zeta"];

/// Notes on those `rows`, each a name and its results, whose trainings have different settings; rows that share their trainings have the same name.
pub(crate) fn notes<'a>(rows: impl IntoIterator<Item = (String, &'a [&'a CellResult])>) -> BTreeSet<String> {
    let of = |(name, row): (String, &[&CellResult])| {
        let texts: Vec<String> = differing(row).into_iter().map(|(key, values)| format!("{key} = {}", values.join(", "))).collect();
        let text = format!("{name}: the trainings of its seeds differ in more than the seed, so its deviation is not theirs alone: {}", texts.join("; "));
        (!texts.is_empty()).then_some(text)
    };
    rows.into_iter().filter_map(of).collect()
}

/// A note on those `rows`, each a name and its results, where their trainings kept different numbers of views out (`train.validation`), whatever they are
/// scored on: some learned from fewer views.
pub(crate) fn kept_out<'a>(rows: impl IntoIterator<Item = (String, &'a [&'a CellResult])>) -> Option<String> {
    let views = |result: &&CellResult| result.provenance.configuration.pointer("/train/validation").map_or_else(|| "0".to_string(), ToString::to_string);
    let mut found: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for (name, row) in rows {
        found.entry(name).or_default().extend(row.iter().map(views));
    }
    let named: Vec<String> = found.iter().map(|(name, own)| format!("{name} {}", own.iter().cloned().collect::<Vec<_>>().join(", "))).collect();
    let differ = found.values().flatten().collect::<BTreeSet<_>>().len() > 1;
    let text = "Trainings kept different numbers of views out (train.validation), so some learned from fewer views than others";
    differ.then(|| format!("{text}: {}.", named.join("; ")))
}

/// The settings that differ, and the program where that differs, with their values in the order of the results.
fn differing(row: &[&CellResult]) -> BTreeMap<String, Vec<String>> {
    let settings: Vec<BTreeMap<String, String>> = row
        .iter()
        .map(|result| {
            let mut found = BTreeMap::new();
            flatten("", &result.provenance.configuration, &mut found);
            found.insert("program".into(), format!("{} ({})", result.provenance.version, result.provenance.commit));
            found
        })
        .collect();
    let keys: BTreeSet<&String> = settings.iter().flat_map(BTreeMap::keys).collect();
    let values = |key: &String| settings.iter().map(|of| of.get(key).map_or("-", String::as_str).to_string()).collect::<Vec<_>>();
    keys.into_iter().map(|key| (key.clone(), values(key))).filter(|(_, values)| values.iter().any(|value| *value != values[0])).collect()
}

/// The values of `value` by dotted keys, but those of [`EXPECTED`].
fn flatten(key: &str, value: &Value, found: &mut BTreeMap<String, String>) {
    match value {
        _ if EXPECTED.contains(&key) => {}
        Value::Object(entries) => entries.iter().for_each(|(name, inner)| {
            let inner_key = if key.is_empty() { name.clone() } else { format!("{key}.{name}") };
            flatten(&inner_key, inner, found);
        }),
        _ => _ = found.insert(key.to_string(), value.to_string()),
    }
}

#[cfg(test)]
mod tests {
    use super::super::read::tests::cell;
    use super::*;

    #[test]
    fn settings_that_differ_are_named_once() {
        let with = |seed: u64, batch: u64, iterations: u64| {
            cell(&format!("{seed}"), |r| {
                r.axes.seed = seed;
                r.provenance.configuration =
                    serde_json::json!({ "seed": seed, "train": { "batch": batch, "iterations": iterations }, "auto": { "minutes": batch } });
            })
        };
        let (a, b, mut c) = (with(0, 1, 5000), with(1, 2, 3000), with(2, 1, 5100));
        // Planned beside fewer processes, which share the memory.
        c.provenance.configuration["scene"] = serde_json::json!({ "cache_mb": 6000 });
        assert!(notes([("cdf".into(), &[&a, &c][..])]).is_empty());
        let found = notes([("cdf".into(), &[&a, &b, &c][..]), ("cdf".into(), &[&a, &b, &c][..])]);
        assert_eq!(found.len(), 1);
        assert!(found.first().unwrap().ends_with(": train.batch = 1, 2, 1"), "{found:?}");
        // Another program is another method, too.
        let mut later = with(3, 1, 5000);
        later.provenance.commit = "later".into();
        let found = notes([("cdf".into(), &[&a, &later][..])]);
        assert!(found.len() == 1 && found.first().unwrap().contains(": program = ") && found.first().unwrap().ends_with(" (later)"), "{found:?}");
    }

    #[test]
    fn trainings_with_fewer_views_are_named() {
        let with = |seed: u64, views: u64| {
            cell(&format!("{seed}"), |r| {
                r.axes.seed = seed;
                r.provenance.configuration = serde_json::json!({ "train": { "validation": views } });
            })
        };
        let (none, twelve) = (with(0, 0), with(0, 12));
        // Older results do not state the setting.
        let old = cell("old", |r| r.provenance.configuration = serde_json::json!({}));
        assert_eq!(kept_out([("cdf".into(), &[&none, &old][..]), ("hexplane".into(), &[&none][..])]), None);
        let note = kept_out([("cdf".into(), &[&none][..]), ("hexplane".into(), &[&twelve][..]), ("hexplane".into(), &[&twelve][..])]).unwrap();
        assert!(note.contains("train.validation") && note.ends_with(": cdf 0; hexplane 12."), "{note}");
    }
}
