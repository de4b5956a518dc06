//! TOML configuration: strict parsing, overrides, layering.

use crate::{Error, Result};
use serde::de::DeserializeOwned;

/// Parses a section into `T`. `object` is the section's name in errors.
///
/// # Errors
/// [`Error::Parameter`] with section and key, for unknown keys, wrong types and missing values.
pub fn parse_section<T: DeserializeOwned>(object: &str, section: &toml::Table) -> Result<T> {
    read::<T>(section.clone()).map_err(|message| at_fault(object, section, &message, &|other| read::<T>(other).err()))
}

/// Reads a section, or says why not. All that is compiled for every type.
#[inline(never)]
fn read<T: DeserializeOwned>(section: toml::Table) -> std::result::Result<T, String> {
    T::deserialize(toml::Value::Table(section)).map_err(|e| e.message().to_string())
}

/// The largest size of a section in which the key at fault is looked for: every key costs a copy. Sections that people write are smaller; stored ones may be
/// hostile.
const MOST_SIZE: usize = 4096;
/// Bytes of text that count as a value.
const TEXT_OF_VALUE: usize = 16;

/// The number of values of `table`, those of inner tables and lists included, and what its keys and texts count for.
fn size(table: &toml::Table) -> usize {
    fn of(value: &toml::Value) -> usize {
        match value {
            toml::Value::Table(table) => 1 + size(table),
            toml::Value::Array(list) => 1 + list.iter().map(of).sum::<usize>(),
            toml::Value::String(text) => 1 + text.len() / TEXT_OF_VALUE,
            _ => 1,
        }
    }
    table.iter().map(|(key, value)| key.len() / TEXT_OF_VALUE + of(value)).sum()
}

/// The error of a section that fails with `message`. `fails` says why another section fails.
fn at_fault(object: &str, section: &toml::Table, message: &str, fails: &dyn Fn(toml::Table) -> Option<String>) -> Error {
    // The key without which the section does not fail in this way.
    let mut path: Vec<&str> = Vec::new();
    let mut inner = (size(section) <= MOST_SIZE).then_some(section);
    while let Some(table) = inner {
        let key = table.keys().find(|key| {
            let mut without = section.clone();
            let around = path.iter().try_fold(&mut without, |table, key| table.get_mut(*key)?.as_table_mut());
            around.is_some_and(|table| table.remove(key.as_str()).is_some()) && fails(without).is_none_or(|other| other != message)
        });
        path.extend(key.map(String::as_str));
        inner = key.and_then(|key| table[key].as_table());
    }
    let object = if path.is_empty() { object.to_string() } else { format!("{object}, {}", path.join(".")) };
    Error::parameter(object, in_words(message), "`cc4dgs plugins NAME` and the presets show the known keys")
}

/// A message of serde in the words of TOML.
fn in_words(message: &str) -> String {
    let message = message.trim();
    let parts = message.strip_prefix("invalid type: ").or_else(|| message.strip_prefix("invalid value: ")).and_then(|m| m.split_once(", expected "));
    let Some((found, expected)) = parts else { return message.to_string() };
    let found = match found {
        "map" => "a table".to_string(),
        "sequence" => "a list".to_string(),
        other => format!("the {}", other.replace("floating point", "number").replace("integer", "number")),
    };
    let expected = match expected {
        "u8" | "u16" | "u32" | "u64" | "usize" => "a whole number of 0 or more",
        "i8" | "i16" | "i32" | "i64" | "isize" => "a whole number",
        "f32" | "f64" => "a number",
        "a sequence" => "a list",
        "a map" => "a table",
        other if other.starts_with("struct ") => "a table",
        other => other,
    };
    format!("{found} where {expected} is expected")
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

/// A plug-in's section with the settings that its `schema` states where it has none of its own.
///
/// # Errors
/// [`Error::Parameter`] for a schema that is not TOML.
pub fn filled(schema: &str, section: &toml::Table) -> Result<toml::Table> {
    let mut full = parse_table("plug-in schema", schema)?;
    if let Some(kind) = section.get("kind") {
        full.insert("kind".into(), kind.clone());
    }
    merge(&mut full, section);
    Ok(full)
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

    #[test]
    fn keys_of_wrong_types_are_named() {
        #[derive(Debug, serde::Deserialize)]
        #[serde(deny_unknown_fields)]
        struct Train {
            #[allow(dead_code)]
            batch: usize,
        }
        #[derive(Debug, serde::Deserialize)]
        #[serde(deny_unknown_fields)]
        struct Run {
            #[allow(dead_code)]
            seed: u64,
            #[allow(dead_code)]
            train: Train,
        }
        let error = |text: &str| parse_section::<Run>("configuration", &parse_table("t", text).unwrap()).unwrap_err().to_string();
        let e = error("seed = 1\n[train]\nbatch = 'abc'");
        assert!(e.starts_with("configuration, train.batch: the string \"abc\" where a whole number of 0 or more is expected"), "{e}");
        let e = error("seed = -1\n[train]\nbatch = 1");
        assert!(e.contains("configuration, seed") && e.contains("-1"), "{e}");
        let e = error("seed = 1\n[train]\nbatch = 1\nnope = 2");
        assert!(e.contains("configuration, train.nope"), "{e}");
        let e = error("seed = 1\ntrain = 3");
        assert!(e.contains("configuration, train: the number `3` where a table is expected"), "{e}");
        let e = error("seed = 1\n[train]");
        assert!(e.contains("batch"), "{e}");
        // A search through all of these would take hours.
        let huge = (0..200_000).map(|k| format!("k{k} = [1, 2]\n")).collect::<String>() + "z = 'abc'";
        let e = parse_section::<std::collections::BTreeMap<String, Vec<u32>>>("kept", &parse_table("t", &huge).unwrap()).unwrap_err().to_string();
        assert!(e.starts_with("kept: the string \"abc\" where a list is expected"), "{e}");
    }
}
