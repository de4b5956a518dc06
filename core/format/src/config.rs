//! TOML configuration: strict parsing, overrides, layering.

use crate::{Error, Result};
use serde::de::DeserializeOwned;

/// Parses a section into `T`. `object` is the section's name in errors.
///
/// # Errors
/// [`Error::Parameter`] with section and key, for unknown keys, wrong types and missing values.
pub fn parse_section<T: DeserializeOwned>(object: &str, section: &toml::Table) -> Result<T> {
    T::deserialize(toml::Value::Table(section.clone()))
        .map_err(|e| Error::parameter(object, e.message().trim().to_string(), "`cc4dgs plugins NAME` and the presets show the known keys"))
}

/// Parses TOML text into a table; `object` names the file in errors.
///
/// # Errors
/// [`Error::Parameter`] for text that is not TOML.
pub fn parse_table(object: &str, text: &str) -> Result<toml::Table> {
    text.parse::<toml::Table>().map_err(|e| Error::parameter(object, e.to_string().replace('\n', " ").trim().to_string(), "Correct the TOML"))
}

/// Merges `over` into `base`, table by table; values of `over` take precedence. A section whose `kind` changes drops the settings of the old plug-in.
pub fn merge(base: &mut toml::Table, over: &toml::Table) {
    for (key, value) in over {
        match (base.get_mut(key), value) {
            (Some(toml::Value::Table(inner)), toml::Value::Table(new)) => {
                // The settings of the old plug-in are not valid for the new one.
                let changes_kind = new.get("kind").is_some_and(|k| inner.get("kind") != Some(k));
                if changes_kind {
                    inner.clear();
                }
                merge(inner, new);
            }
            _ => {
                base.insert(key.clone(), value.clone());
            }
        }
    }
}

/// Applies one `--set a.b.c=value`. The value is parsed as TOML; bare words become strings.
///
/// # Errors
/// [`Error::Parameter`] for an assignment without `=` or with an empty part in its key.
pub fn set(table: &mut toml::Table, assignment: &str) -> Result<()> {
    let object = format!("--set {assignment}");
    let Some((path, text)) = assignment.split_once('=') else {
        return Err(Error::parameter(object, "no '=' found", "Write --set section.key=value"));
    };
    let text = text.trim();
    let value = format!("v = {text}").parse::<toml::Table>().ok().and_then(|mut t| t.remove("v")).unwrap_or_else(|| toml::Value::String(text.to_string()));
    let keys: Vec<&str> = path.trim().split('.').collect();
    if keys.iter().any(|k| k.is_empty()) {
        return Err(Error::parameter(object, "the key has an empty part", "Write --set section.key=value"));
    }
    let mut over = toml::Table::new();
    over.insert(keys[keys.len() - 1].to_string(), value);
    for key in keys[..keys.len() - 1].iter().rev() {
        over = toml::Table::from_iter([(key.to_string(), toml::Value::Table(over))]);
    }
    merge(table, &over);
    Ok(())
}

/// Applies several assignments in order, those of `kind` first. So `deformer.levels=3` before `deformer.kind=cdf` sets the levels of `cdf`; with [`set`]
/// alone, the change of `kind` would drop them.
pub fn set_all(table: &mut toml::Table, assignments: &[String]) -> Result<()> {
    let chooses = |assignment: &&String| assignment.split('=').next().is_some_and(|path| path.trim().ends_with(".kind"));
    let (kinds, others): (Vec<&String>, Vec<&String>) = assignments.iter().partition(chooses);
    kinds.into_iter().chain(others).try_for_each(|assignment| set(table, assignment))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn plug_ins_are_chosen_before_their_settings() {
        let start = parse_table("test", "[deformer]\nkind = \"cdf\"\nlevels = 5").unwrap();
        let with = |assignments: [&str; 3]| {
            let mut table = start.clone();
            set_all(&mut table, &assignments.map(String::from)).unwrap();
            table["deformer"].as_table().unwrap().clone()
        };
        let late = with(["deformer.width=3", "deformer.kind=hexplane", "train.batch=1"]);
        assert_eq!(late, with(["deformer.kind=hexplane", "deformer.width=3", "train.batch=1"]));
        assert_eq!((late["width"].as_integer(), late.get("levels")), (Some(3), None));
        assert_eq!(with(["deformer.levels=3", "deformer.levels=4", "deformer.kind=cdf"])["levels"].as_integer(), Some(4));
    }

    #[test]
    fn set_reads_numbers_and_bare_words() {
        let mut t = parse_table("test", "[deformer]\nkind = \"cdf\"\nlevels = 5\n[train]\niterations = 10").unwrap();
        set(&mut t, "train.iterations=20").unwrap();
        set(&mut t, "deformer.kind=none").unwrap();
        assert_eq!(t["train"]["iterations"].as_integer(), Some(20));
        assert_eq!(t["deformer"]["kind"].as_str(), Some("none"));
        assert!(t["deformer"].get("levels").is_none(), "settings of another plug-in must be dropped");
        assert!(set(&mut t, "nonsense").is_err());
    }

    #[test]
    fn unknown_keys_are_named() {
        #[derive(serde::Deserialize)]
        #[serde(deny_unknown_fields)]
        struct S {
            #[allow(dead_code)]
            a: i32,
        }
        let e = parse_section::<S>("train", &parse_table("t", "a = 1\niteratons = 3").unwrap()).err().unwrap().to_string();
        assert!(e.contains("iteratons") && e.contains("train"), "{e}");
    }
}
