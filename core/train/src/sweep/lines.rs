//! Many results in one file, a line each. Cells share most of what they state, so every line but the first may be a JSON merge patch (RFC 7396) of the result
//! of the line before.

use super::result::{CellResult, KIND};
use cc4dgs_core::{Error, Result};
use serde_json::{Map, Value, json};

/// Value of `kind` of a line that is a patch.
pub(super) const PATCH: &str = "cc4dgs-result-patch";

/// The lines of `results`.
///
/// # Errors
/// As [`CellResult::to_line`].
pub fn write_lines(results: &[CellResult]) -> Result<String> {
    let (mut text, mut before) = (String::new(), Value::Null);
    for result in results {
        let whole = result.to_line()?;
        let value: Value = serde_json::from_str(&whole).map_err(|e| Error::backend("result", e.to_string(), "Report this as a defect"))?;
        let patch = difference(&before, &value);
        let mut patched = before;
        merge(&mut patched, &patch);
        // A patch cannot set null, and of unlike results it is no shorter.
        let line = json!({ "kind": PATCH, "patch": patch }).to_string();
        text += if patched == value && line.len() < whole.len() { &line } else { &whole };
        text.push('\n');
        before = value;
    }
    Ok(text)
}

/// The results of the lines of `text`; `object` names the file in errors.
///
/// # Errors
/// As [`CellResult::from_json`], and [`Error::Data`] for a patch of nothing.
pub fn read_lines(object: &str, text: &str) -> Result<Vec<CellResult>> {
    let (mut results, mut before) = (Vec::new(), Value::Null);
    for (number, line) in text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty()) {
        let name = format!("{object}, line {}", number + 1);
        let damaged = |problem: String| Error::data(&name, problem, "Make the file again: cc4dgs sweep collect DIR");
        let mut value: Value = serde_json::from_str(line).map_err(|e| damaged(e.to_string()))?;
        if value.get("kind").and_then(Value::as_str) == Some(PATCH) {
            if before.get("kind").and_then(Value::as_str) != Some(KIND) {
                return Err(damaged("it is a patch, and there is no result before it".into()));
            }
            let patch = value.get_mut("patch").map(Value::take).unwrap_or_default();
            if !patch.is_object() {
                return Err(damaged("its patch is no table".into()));
            }
            value = before;
            merge(&mut value, &patch);
        }
        results.push(CellResult::from_value(&name, value.clone())?);
        before = value;
    }
    Ok(results)
}

/// Applies a merge patch.
fn merge(target: &mut Value, patch: &Value) {
    let Value::Object(changes) = patch else {
        *target = patch.clone();
        return;
    };
    if !target.is_object() {
        *target = Value::Object(Map::new());
    }
    let Value::Object(map) = target else { return };
    for (key, change) in changes {
        if change.is_null() {
            map.remove(key);
        } else {
            merge(map.entry(key.clone()).or_insert(Value::Null), change);
        }
    }
}

/// The merge patch from `a` to `b`, as far as there is one.
fn difference(a: &Value, b: &Value) -> Value {
    let (Value::Object(a), Value::Object(b)) = (a, b) else { return b.clone() };
    let gone = a.keys().filter(|key| !b.contains_key(*key)).map(|key| (key.clone(), Value::Null));
    let changed = b.iter().filter(|(key, value)| a.get(*key) != Some(*value));
    let changed = changed.map(|(key, value)| (key.clone(), a.get(key).map_or_else(|| value.clone(), |old| difference(old, value))));
    Value::Object(gone.chain(changed).collect())
}

#[cfg(test)]
mod tests {
    use super::super::read::tests::cell;
    use super::*;

    #[test]
    fn equal_parts_are_written_once() {
        let results = [
            cell("a", |_| ()),
            cell("b", |r| {
                r.axes.codec = "raw".into();
                r.metrics.get_mut("ssim").unwrap().value = 0.5;
                r.absent.clear();
                r.images.truncate(0);
            }),
            cell("c", |r| _ = r.metrics.remove("ssim")),
            // No patch turns text into null.
            cell("d", |r| _ = r.metrics.get_mut("psnr_db").unwrap().protocol.insert("metric".into(), Value::Null)),
            cell("e", |r| r.provenance.device.adapter = Some("card".into())),
        ];
        let text = write_lines(&results).unwrap();
        assert_eq!(read_lines("all.jsonl", &text).unwrap(), results);
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines.iter().map(|line| line.contains(PATCH)).collect::<Vec<_>>(), [false, true, true, false, true]);
        assert!(4 * lines[4].len() < lines[0].len(), "{}", lines[4]);
        let error = read_lines("all.jsonl", lines[1]).unwrap_err().to_string();
        assert!(error.contains("all.jsonl, line 1") && error.contains("no result before it"), "{error}");
        assert!(read_lines("all.jsonl", &format!("{}\n{{\"kind\":\"{PATCH}\"}}\n", lines[0])).unwrap_err().to_string().contains("line 2"));
    }
}
