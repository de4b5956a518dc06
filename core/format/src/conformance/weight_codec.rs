//! The conformance suite of weight codecs.

use super::{settings_are_read, uniform};
use crate::{CodecContext, Limits, Result, Seed, Silent, Stream, WeightArray, WeightCodec, WeightCodecPlugin, WeightSteps};
use std::panic::{AssertUnwindSafe, catch_unwind};

/// Damaged versions tried per stream.
const DAMAGES: usize = 48;

/// Tests a weight codec. Each finding is a line; an empty list means that it passed.
///
/// - Its schema is TOML that it accepts; unknown settings are refused by name.
/// - Names, shapes and their order are kept; the error of every value is at most the declared one.
/// - Equal weights give equal bytes.
/// - Rounding gives what comes back, to the bit; so it is with [`CodecContext::weight_importance`], too.
/// - Where it states its steps, no value is further from what comes back than half of one; so it is with [`CodecContext::weight_importance`], too.
/// - Duplicate names, shapes that do not match the values and values that are not finite are refused.
/// - Damaged streams give an error or valid weights, never a panic.
pub fn weight_codec(plugin: &WeightCodecPlugin, settings: &toml::Table) -> Vec<String> {
    let name = plugin.info.name;
    let codec = match (plugin.build)(settings) {
        Ok(codec) => codec,
        Err(e) => return vec![format!("{name}: it cannot be built: {e}")],
    };
    let codec = codec.as_ref();
    let mut findings = Vec::new();
    let mut note = |check: &str, outcome: Result<Option<String>>| match outcome {
        Ok(None) => {}
        Ok(Some(finding)) => findings.push(format!("{name}, {check}: {finding}")),
        Err(e) => findings.push(format!("{name}, {check}: {e}")),
    };
    note("settings", settings_are_read("weight codec", &plugin.info, settings, |settings| (plugin.build)(settings).map(drop)));
    note("weights", comes_back(codec, &weights()));
    note("no weights", comes_back(codec, &[]));
    note("rounding", rounds_alike(codec, &context()));
    note("steps", keeps_steps(codec, &context()));
    let importance = importance();
    note("rounding by importance", rounds_alike(codec, &CodecContext { weight_importance: Some(&importance), ..context() }));
    note("steps by importance", keeps_steps(codec, &CodecContext { weight_importance: Some(&importance), ..context() }));
    note("repeats", repeats(codec));
    note("invalid weights", refuses_unsound(codec));
    note("damaged streams", survives_damage(codec));
    findings
}

fn context() -> CodecContext<'static> {
    CodecContext::new(Seed::root(8).child("conformance"), Limits::default(), &Silent)
}

/// Arrays of several sizes and magnitudes, one without values, one without dimensions.
fn weights() -> Vec<WeightArray> {
    let array = |name: &str, shape: &[usize], scale: f32| {
        let seed = Seed::root(4).child(name);
        let count = shape.iter().product();
        WeightArray { name: name.into(), shape: shape.to_vec(), values: (0..count).map(|k| scale * uniform(seed, k)).collect() }
    };
    vec![
        array("trunk.0.weight", &[24, 17], 0.1),
        array("trunk.0.bias", &[17], 3.0),
        array("table", &[3, 10, 10, 2], 1e-3),
        array("scale", &[], 40.0),
        array("none", &[0, 5], 1.0),
        WeightArray { name: "zeros".into(), shape: vec![65], values: vec![0.0; 65] },
    ]
}

fn comes_back(codec: &dyn WeightCodec, given: &[WeightArray]) -> Result<Option<String>> {
    let found = codec.decode(&codec.encode(given, &context())?, &context())?;
    let shapes = |arrays: &[WeightArray]| arrays.iter().map(|a| (a.name.clone(), a.shape.clone(), a.values.len())).collect::<Vec<_>>();
    if shapes(given) != shapes(&found) {
        return Ok(Some(format!("names and shapes became {:?}", shapes(&found))));
    }
    for (before, after) in given.iter().zip(&found) {
        let largest = before.values.iter().fold(0.0f64, |m, v| m.max(f64::from(v.abs())));
        let worst = before.values.iter().zip(&after.values).map(|(a, b)| (f64::from(*a) - f64::from(*b)).abs()).fold(0.0, f64::max);
        let allowed = codec.loss() * largest;
        let exact = before.values.iter().zip(&after.values).all(|(a, b)| a.to_bits() == b.to_bits());
        // NaN fails this comparison.
        let kept = if allowed == 0.0 && largest > 0.0 { exact } else { worst <= allowed };
        if !kept || after.values.iter().any(|v| !v.is_finite()) {
            return Ok(Some(format!("'{}' has a relative error of {worst:.2e}, declared is {allowed:.2e}", before.name)));
        }
    }
    Ok(None)
}

/// Values from none to large, some the same for many weights.
fn importance() -> Vec<Vec<f32>> {
    let of = |array: &WeightArray| {
        let seed = Seed::root(5).child(&array.name);
        (0..array.values.len()).map(|k| if k % 96 < 32 { 0.0 } else { libm::exp(20.0 * f64::from(uniform(seed, k / 16))) as f32 }).collect()
    };
    weights().iter().map(of).collect()
}

fn rounds_alike(codec: &dyn WeightCodec, context: &CodecContext) -> Result<Option<String>> {
    let given = weights();
    let (rounded, decoded) = (codec.round(&given, context)?, codec.decode(&codec.encode(&given, context)?, &self::context())?);
    let bits = |array: &WeightArray| (array.name.clone(), array.shape.clone(), array.values.iter().map(|v| v.to_bits()).collect::<Vec<_>>());
    let other = rounded.len() != decoded.len() || rounded.iter().zip(&decoded).any(|(a, b)| bits(a) != bits(b));
    Ok(other.then(|| "rounding gives other weights than encoding and decoding".into()))
}

fn keeps_steps(codec: &dyn WeightCodec, context: &CodecContext) -> Result<Option<String>> {
    let given = weights();
    // Nobody knows it who decodes.
    let found = codec.decode(&codec.encode(&given, context)?, &self::context())?;
    let lengths = |arrays: &[Vec<f32>]| arrays.iter().map(Vec::len).collect::<Vec<_>>();
    let expected: Vec<usize> = given.iter().map(|array| array.values.len()).collect();
    if found.iter().map(|array| array.values.len()).ne(expected.iter().copied()) {
        return Ok(Some("arrays changed their sizes".into()));
    }
    let Some(WeightSteps { steps, bit_slopes }) = codec.steps(&given, context)? else { return Ok(None) };
    if lengths(&steps) != expected || lengths(&bit_slopes) != expected {
        return Ok(Some("there are not as many steps as values".into()));
    }
    for ((before, after), (steps, slopes)) in given.iter().zip(&found).zip(steps.iter().zip(&bit_slopes)) {
        for ((a, b), (step, slope)) in before.values.iter().zip(&after.values).zip(steps.iter().zip(slopes)) {
            let (error, most) = ((f64::from(*a) - f64::from(*b)).abs(), 0.5 * f64::from(*step) + 1e-6 * f64::from(a.abs()));
            // NaN fails this comparison.
            if !(error <= most && slope.is_finite()) {
                return Ok(Some(format!("'{}' has an error of {error:.2e} and steps of {step:.2e}, its size a slope of {slope}", before.name)));
            }
        }
    }
    Ok(None)
}

fn repeats(codec: &dyn WeightCodec) -> Result<Option<String>> {
    let (first, second) = (codec.encode(&weights(), &context())?, codec.encode(&weights(), &context())?);
    if first != second {
        return Ok(Some("two encodings of the same weights differ".into()));
    }
    let mut names: Vec<&str> = first.iter().map(|s| s.name.as_str()).collect();
    names.sort_unstable();
    Ok(names.windows(2).find(|w| w[0] == w[1]).map(|twice| format!("two streams are called {}", twice[0])))
}

fn refuses_unsound(codec: &dyn WeightCodec) -> Result<Option<String>> {
    let mut cases = ["a NaN", "an infinity", "a name that is taken", "a shape that does not hold the values"].map(|what| (what, weights()));
    cases[0].1[0].values[3] = f32::NAN;
    cases[1].1[1].values[0] = f32::INFINITY;
    cases[2].1[1].name = cases[2].1[0].name.clone();
    cases[3].1[0].shape[0] += 1;
    let encoded = cases.into_iter().find(|(_, arrays)| codec.encode(arrays, &context()).is_ok());
    Ok(encoded.map(|(what, _)| format!("{what} was encoded")))
}

fn survives_damage(codec: &dyn WeightCodec) -> Result<Option<String>> {
    let sound = codec.encode(&weights(), &context())?;
    let mut tries: Vec<(String, Vec<Stream>)> = vec![("no streams".into(), Vec::new())];
    for index in 0..sound.len() {
        let (name, length) = (&sound[index].name, sound[index].bytes.len());
        for k in 0..DAMAGES.min(2 * length) {
            let mut damaged = sound.clone();
            let bytes = &mut damaged[index].bytes;
            let draw = Seed::root(6).index((index * DAMAGES + k) as u64).value();
            // Every second damage is in the first bytes, where counts and shapes usually are.
            let at = (draw >> 8) as usize % if k % 2 == 0 { length } else { length.min(64) };
            let what = if k % 3 == 0 {
                bytes.truncate(at);
                "is truncated"
            } else {
                bytes[at] ^= 1 << (draw % 8);
                "has a flipped bit"
            };
            tries.push((format!("'{name}' {what} at {at}"), damaged));
        }
        let mut longer = sound.clone();
        longer[index].bytes.extend([255; 9]);
        tries.push((format!("'{name}' has trailing bytes"), longer));
    }
    for (what, streams) in tries {
        match catch_unwind(AssertUnwindSafe(|| codec.decode(&streams, &context()))) {
            Err(_) => return Ok(Some(format!("it panics where {what}"))),
            Ok(Err(_)) => {}
            Ok(Ok(found)) => {
                let sound = |a: &WeightArray| a.values.iter().all(|v| v.is_finite()) && a.shape.iter().product::<usize>() == a.values.len();
                if !found.iter().all(sound) {
                    return Ok(Some(format!("invalid weights were returned where {what}")));
                }
            }
        }
    }
    Ok(None)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::storage::{StreamSet, read_shapes, value_count, write_shapes};
    use crate::{Error, Plugin};

    /// Float32, with a rounding that is right, or wrong in one array.
    struct Plain {
        right: bool,
    }

    impl WeightCodec for Plain {
        fn encode(&self, weights: &[WeightArray], _: &CodecContext) -> Result<Vec<Stream>> {
            let mut bytes = Vec::new();
            write_shapes(weights, &mut bytes)?;
            bytes.extend(weights.iter().flat_map(|array| &array.values).flat_map(|v| v.to_le_bytes()));
            Ok(vec![Stream { name: "all".into(), bytes }])
        }
        fn decode(&self, streams: &[Stream], context: &CodecContext) -> Result<Vec<WeightArray>> {
            let mut reader = StreamSet::new("plain", streams).reader("all")?;
            let mut arrays = read_shapes(&mut reader, &context.limits)?;
            for array in &mut arrays {
                array.values = reader.f32s(value_count(&array.shape).unwrap_or(0))?;
            }
            reader.finish()?;
            Ok(arrays)
        }
        fn round(&self, weights: &[WeightArray], _: &CodecContext) -> Result<Vec<WeightArray>> {
            let mut rounded = weights.to_vec();
            if !self.right {
                rounded[2].values[7] += 1e-6;
            }
            Ok(rounded)
        }
        fn loss(&self) -> f64 {
            0.0
        }
    }

    fn build(settings: &toml::Table, right: bool) -> Result<Box<dyn WeightCodec>> {
        match settings.keys().next() {
            Some(key) => Err(Error::parameter("plain", format!("there is no setting {key}"), "Leave it out")),
            None => Ok(Box::new(Plain { right })),
        }
    }

    #[test]
    fn a_rounding_that_is_not_what_comes_back_is_found() {
        let findings = |build: fn(&toml::Table) -> Result<Box<dyn WeightCodec>>| {
            let info = Plugin { name: "plain", version: "1", summary: "", paper: "", schema: "# no settings\n", capabilities: &[] };
            weight_codec(&WeightCodecPlugin { info, build }, &toml::Table::new())
        };
        assert_eq!(findings(|settings| build(settings, true)), Vec::<String>::new());
        let found = findings(|settings| build(settings, false));
        assert!(found.len() == 2 && found.iter().all(|line| line.contains("rounding gives other weights")), "{found:?}");
    }
}
