//! The conformance suite of attribute codecs.

use super::{on_threads, uniform};
use crate::gaussians::sh_rest_len;
use crate::{AttributeCodec, CodecContext, CodecPlugin, ExtraAttribute, HostGaussians, Limits, NeededRows, Result, Seed, Silent, Stream, StreamStage, config};
use std::panic::{AssertUnwindSafe, catch_unwind};

/// Name of the extra attribute that identifies the Gaussians after a codec has reordered them.
const MARK: &str = "conformance-mark";
/// Damaged versions tried per stream.
const DAMAGES: usize = 24;
/// How far from the origin the Gaussians of [`far`] are along each axis; their centres differ by some 2.
const FAR: f32 = 1000.0;

/// Tests a codec. Each finding is a line; an empty list means that it passed.
///
/// - Its schema is TOML that it accepts; unknown settings and profiles are refused by name.
/// - Decoding gives the same Gaussians in any order, with extra attributes bit for bit or as [`ExtraAttribute`] allows.
/// - The error of each column is at most the declared one, also where all Gaussians are alike, and where they are far from the origin.
/// - Equal inputs give equal bytes, whatever the number of threads. Streams have names that an archive can hold, and are decoded in any order.
/// - Where [`AttributeCodec::keeps_motion`] says so, scores stay on their side of the threshold.
/// - Sets of no Gaussians and of one Gaussian can be stored; values that are not finite, in any column or attribute, and columns of a wrong length are refused.
/// - The streams of the first stages hold the first rows of the whole; coefficients of degrees that have streams of their own are 0 until their stage.
/// - Sound streams of more Gaussians or bytes than the limits allow are refused, and so are streams that end early or have bytes behind their end.
/// - Damaged and missing streams give an error or valid Gaussians within the limits, never a panic.
///
/// `profile` is the part after the colon of `name:profile`; `settings` can make an expensive codec fast.
pub fn codec(plugin: &CodecPlugin, profile: &str, settings: &toml::Table) -> Vec<String> {
    let name = format!("{}:{profile}", plugin.info.name);
    let codec = match (plugin.build)(profile, settings) {
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
    note("settings", reads_settings(plugin, profile, settings));
    for (count, degree) in [(0, 3), (1, 2), (2, 0), (700, 3), (400, 1)] {
        note(&format!("{count} Gaussians of degree {degree}"), comes_back(codec, &scene(count, degree)));
    }
    note("90 Gaussians that are alike", comes_back(codec, &alike(90, 1)));
    note("90 Gaussians far from the origin", comes_back(codec, &far(90, 1)));
    note("repeats", repeats(codec));
    note("motion", keeps_motion(codec));
    for (count, degree) in [(0, 1), (1, 2), (300, 3)] {
        note(&format!("stages of {count} Gaussians"), arrives_in_stages(codec, &scene(count, degree)));
    }
    note("invalid Gaussians", refuses_what_is_not_sound(codec));
    note("limits", keeps_limits(codec));
    note("damaged streams", survives_damage(codec));
    findings
}

fn context() -> CodecContext<'static> {
    CodecContext::new(Seed::root(7).child("conformance"), Limits::default(), &Silent)
}

/// Clustered Gaussians with correlated colours, numbered by an extra attribute.
fn scene(count: usize, sh_degree: usize) -> HostGaussians {
    let mut g = HostGaussians { sh_degree, ..Default::default() };
    let rest = 3 * sh_rest_len(sh_degree);
    let seed = Seed::root(21);
    for i in 0..count {
        let draw = |k: usize| uniform(seed.index(i as u64), k);
        let cluster = (i % 9) as f32;
        let p = [3.0 * cluster.sin() + 0.3 * draw(0), 3.0 * cluster.cos() + 0.3 * draw(1), 0.5 * draw(2)];
        g.means.extend(p);
        g.log_scales.extend([-4.0 + draw(3), -4.3 + draw(4), -5.0 + 2.0 * draw(5)]);
        g.quaternions.extend([0.5 + draw(6), draw(7), draw(8), draw(9)]);
        g.opacity_logits.push(4.0 * draw(10));
        g.sh_dc.extend([draw(11), draw(12), draw(13)]);
        g.sh_rest.extend((0..rest).map(|c| 0.2 * (p[c % 3] + c as f32).sin() + 0.02 * draw(14 + c)));
        g.dynamic_scores.push(if i % 5 == 0 { 8.0 + draw(100) } else { 0.3 * draw(100) });
    }
    g.extra.insert(MARK.into(), ExtraAttribute::exact(1, (0..count).map(|i| i as f32).collect()));
    g.extra.insert("conformance-pair".into(), ExtraAttribute::exact(2, (0..2 * count).map(|i| 0.1 + i as f32).collect()));
    let wave = || ExtraAttribute::exact(3, (0..3 * count).map(|i| (0.37 * i as f32).sin()).collect());
    g.extra.insert("conformance-near".into(), wave().within(1e-3));
    let moving = || (0..count).map(|i| i % 5 == 0).collect();
    g.extra.insert("conformance-moving".into(), wave().needed_in(moving(), 0.25));
    g.extra.insert("conformance-near-moving".into(), wave().within(0.02).needed_in(moving(), -0.5));
    g
}

/// The same with the columns of the first Gaussian in all rows. Attributes stay different.
fn alike(count: usize, sh_degree: usize) -> HostGaussians {
    let (mut g, first) = (scene(count, sh_degree), scene(1, sh_degree));
    for ((_, _, values), (_, _, row)) in g.columns_mut().into_iter().zip(first.columns()) {
        *values = row.repeat(count);
    }
    g
}

/// The Gaussians of [`scene`], far from the origin, where a rounding that is relative to the values loses more of what they differ by.
fn far(count: usize, sh_degree: usize) -> HostGaussians {
    let mut g = scene(count, sh_degree);
    g.means.iter_mut().for_each(|mean| *mean += FAR);
    g
}

/// The streams of `given`, and what they are decoded to.
fn stored(codec: &dyn AttributeCodec, given: &HostGaussians, context: &CodecContext) -> Result<(Vec<Stream>, HostGaussians)> {
    let streams = codec.encode(given, context)?;
    let found = codec.decode(&streams, &self::context())?;
    Ok((streams, found))
}

fn reads_settings(plugin: &CodecPlugin, profile: &str, settings: &toml::Table) -> Result<Option<String>> {
    let mut odd = settings.clone();
    odd.insert("no_such_setting".into(), 1.into());
    let of_setting = (plugin.build)(profile, &odd);
    let of_profile = (plugin.build)("no-such-profile", &toml::Table::new());
    for (built, what, name) in [(of_setting, "setting", "no_such_setting"), (of_profile, "profile", "no-such-profile")] {
        match built {
            Ok(_) => return Ok(Some(format!("an unknown {what} was accepted"))),
            Err(e) if !e.to_string().contains(name) => return Ok(Some(format!("the error does not name the unknown {what}: {e}"))),
            Err(_) => {}
        }
    }
    let stated = config::parse_table(&format!("schema of codec {}", plugin.info.name), plugin.info.schema)?;
    Ok((plugin.build)("", &stated).err().map(|e| format!("it refuses the settings that its schema states: {e}")))
}

fn relative_rms(before: &[f32], after: &[f32]) -> f64 {
    let n = before.len().max(1) as f64;
    let mean = before.iter().map(|&v| f64::from(v)).sum::<f64>() / n;
    let error: f64 = before.iter().zip(after).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum();
    let variance: f64 = before.iter().map(|&v| (f64::from(v) - mean).powi(2)).sum();
    // The standard deviation of a constant column is 0; its magnitude is used instead.
    let scale = if variance > 0.0 { variance } else { before.iter().map(|&v| f64::from(v).powi(2)).sum() };
    if error == 0.0 { 0.0 } else { (error / scale).sqrt() }
}

fn comes_back(codec: &dyn AttributeCodec, given: &HostGaussians) -> Result<Option<String>> {
    let (_, found) = stored(codec, given, &context())?;
    let expected = match in_order_of(&found, given) {
        Ok(expected) => expected,
        Err(finding) => return Ok(Some(finding)),
    };
    if !expected.extra.keys().eq(found.extra.keys()) {
        return Ok(Some("extra attributes are missing, or there are more of them".into()));
    }
    for (name, before) in &expected.extra {
        if let Some(finding) = attribute_changed(before, &found.extra[name]) {
            return Ok(Some(format!("extra attribute '{name}' {finding}")));
        }
    }
    let losses = codec.losses();
    for ((column, _, before), (_, _, after)) in expected.columns().into_iter().zip(found.columns()) {
        let allowed = losses.iter().find(|l| l.attribute == column).map_or(0.0, |l| l.relative_rms);
        if before.len() != after.len() || !after.iter().all(|v| v.is_finite()) {
            return Ok(Some(format!("{column} has another length or a value that is not finite")));
        }
        let lost = relative_rms(before, after);
        let exact = before.iter().zip(after.iter()).all(|(a, b)| a.to_bits() == b.to_bits());
        if lost > allowed || (allowed == 0.0 && !exact) {
            return Ok(Some(format!("{column} has a relative error of {lost:.2e}, declared is {allowed:.2e}")));
        }
    }
    Ok(None)
}

/// The Gaussians `given` in the order in which they were `found`; else what is wrong with these.
fn in_order_of(found: &HostGaussians, given: &HostGaussians) -> Result<HostGaussians, String> {
    if (found.len(), found.sh_degree) != (given.len(), given.sh_degree) {
        return Err(format!("{} Gaussians of degree {} came back", found.len(), found.sh_degree));
    }
    let marks = found.extra.get(MARK).filter(|a| a.width == 1 && a.values.len() == given.len()).ok_or("extra attributes were lost")?;
    let order: Vec<usize> = marks.values.iter().map(|&v| v as usize).collect();
    let mut all = order.clone();
    all.sort_unstable();
    if all != (0..given.len()).collect::<Vec<_>>() {
        return Err("extra attributes were changed".into());
    }
    Ok(given.select(&order))
}

/// How `after` violates what `before` allows; `None` if it does not.
fn attribute_changed(before: &ExtraAttribute, after: &ExtraAttribute) -> Option<String> {
    if after.width != before.width || after.values.len() != before.values.len() {
        return Some("has another shape".into());
    }
    for (i, (a, b)) in before.values.iter().zip(&after.values).enumerate() {
        let left_out = |needed: &NeededRows| !needed.rows[i / before.width] && b.to_bits() == needed.start.to_bits();
        let kept = match before.tolerance {
            None => a.to_bits() == b.to_bits(),
            Some(tolerance) => (f64::from(*a) - f64::from(*b)).abs() <= f64::from(tolerance),
        };
        if !kept && !before.needed.as_ref().is_some_and(left_out) {
            let allowed = before.tolerance.map_or("bit for bit".into(), |tolerance| format!("within {tolerance}"));
            return Some(format!("changed from {a} to {b}; it must be kept {allowed}"));
        }
    }
    None
}

fn repeats(codec: &dyn AttributeCodec) -> Result<Option<String>> {
    let given = scene(300, 2);
    let run = |threads: usize| on_threads(threads, || stored(codec, &given, &context()));
    let (first, again, parallel) = (run(1)??, run(1)??, run(3)??);
    if first.0 != again.0 {
        return Ok(Some("two encodings of the same Gaussians differ".into()));
    }
    if first.1 != again.1 {
        return Ok(Some("two decodings of the same streams differ".into()));
    }
    if first != parallel {
        return Ok(Some("streams or decoded Gaussians of one thread and of three differ".into()));
    }
    let (mut streams, found) = first;
    let mut names: Vec<&str> = streams.iter().map(|s| s.name.as_str()).collect();
    names.sort_unstable();
    if let Some(twice) = names.windows(2).find(|w| w[0] == w[1]) {
        return Ok(Some(format!("two streams are called {}", twice[0])));
    }
    if let Some(name) = names.iter().find(|n| n.is_empty() || n.len() > 255 || n.chars().any(char::is_control)) {
        return Ok(Some(format!("an archive cannot hold a stream that is called {name:?}")));
    }
    // Archives sort streams by their stages.
    streams.reverse();
    let same = codec.decode(&streams, &context()).is_ok_and(|turned| turned == found);
    Ok((!same).then(|| "streams in another order are not decoded to the same Gaussians".into()))
}

fn keeps_motion(codec: &dyn AttributeCodec) -> Result<Option<String>> {
    if !codec.keeps_motion() {
        return Ok(None);
    }
    let given = scene(300, 1);
    // All may move, those above the score of one that does not, a few, none.
    for threshold in [f32::NEG_INFINITY, given.dynamic_scores[1], 4.0, f32::INFINITY] {
        let (_, found) = stored(codec, &given, &CodecContext { dynamic_threshold: Some(threshold), ..context() })?;
        let expected = match in_order_of(&found, &given) {
            Ok(expected) => expected,
            Err(finding) => return Ok(Some(format!("with a threshold of {threshold}, {finding}"))),
        };
        let mut scores = expected.dynamic_scores.iter().zip(&found.dynamic_scores);
        if let Some((before, after)) = scores.find(|(before, after)| (**before > threshold) != (**after > threshold)) {
            return Ok(Some(format!("a score of {before} became {after}, across the threshold of {threshold}")));
        }
    }
    Ok(None)
}

fn arrives_in_stages(codec: &dyn AttributeCodec, given: &HostGaussians) -> Result<Option<String>> {
    let streams = codec.encode(given, &context())?;
    let whole = codec.decode(&streams, &context())?;
    let mut stages: Vec<StreamStage> = streams.iter().map(|s| codec.stage(&s.name)).collect();
    stages.sort_unstable();
    stages.dedup();
    let apart = stages.iter().any(|s| *s > StreamStage::BASE);
    let (mut before, last) = (0, stages.iter().copied().filter(|s| *s <= StreamStage::BASE).max());
    for stage in stages.into_iter().filter(|s| *s < StreamStage::WHOLE) {
        let arrived: Vec<Stream> = streams.iter().filter(|s| codec.stage(&s.name) <= stage).cloned().collect();
        let found = codec.decode_stage(&arrived, &context())?;
        let (rows, complete) = (found.len(), Some(stage) >= last);
        if rows < before || rows > whole.len() || complete && rows < whole.len() || found.sh_degree != whole.sh_degree {
            return Ok(Some(format!("{stage:?} has {rows} of {} Gaussians; the one before had {before}", whole.len())));
        }
        let degree = match stage {
            StreamStage::Layer(_) if apart => 0,
            StreamStage::Layer(_) => whole.sh_degree,
            StreamStage::Harmonics(degree) => usize::from(degree).min(whole.sh_degree),
        };
        let there = 3 * sh_rest_len(degree);
        for ((name, width, part), (_, _, all)) in found.columns().into_iter().zip(whole.columns()) {
            let missing = |at: usize| name == "sh_rest" && at % width >= there;
            let same = |(at, (a, b)): (usize, (&f32, &f32))| if missing(at) { *a == 0.0 } else { a.to_bits() == b.to_bits() };
            if part.len() != rows * width || !part.iter().zip(all).enumerate().all(same) {
                return Ok(Some(format!("{name} of {stage:?} is not that of the first rows of the whole, or not zero above the degree of the stage")));
            }
        }
        if complete && found.extra != whole.extra {
            return Ok(Some(format!("extra attributes of {stage:?}, which has all Gaussians, are not those of the whole")));
        }
        before = rows;
    }
    Ok(None)
}

fn refuses_what_is_not_sound(codec: &dyn AttributeCodec) -> Result<Option<String>> {
    let sound = scene(20, 1);
    let mut short = sound.clone();
    short.sh_dc.pop();
    let mut cases = vec![("a column of a wrong length".to_string(), short)];
    for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        for (column, (name, _, _)) in sound.columns().into_iter().enumerate() {
            let mut given = sound.clone();
            given.columns_mut()[column].2[7] = value;
            cases.push((format!("a value of {value} in {name}"), given));
        }
        for (name, attribute) in &sound.extra {
            let (mut given, mut odd) = (sound.clone(), attribute.clone());
            odd.values[7] = value;
            given.extra.insert(name.clone(), odd);
            cases.push((format!("a value of {value} in the attribute '{name}'"), given));
        }
    }
    for (what, given) in cases {
        match catch_unwind(AssertUnwindSafe(|| codec.encode(&given, &context()))) {
            Err(_) => return Ok(Some(format!("it panics at {what}"))),
            Ok(Ok(_)) => return Ok(Some(format!("{what} was encoded"))),
            Ok(Err(_)) => {}
        }
    }
    Ok(None)
}

fn keeps_limits(codec: &dyn AttributeCodec) -> Result<Option<String>> {
    let given = scene(60, 1);
    let streams = codec.encode(&given, &context())?;
    let floats = given.columns().iter().map(|(_, _, values)| values.len()).chain(given.extra.values().map(|a| a.values.len())).sum::<usize>();
    let few = Limits { max_gaussians: 59, ..Limits::default() };
    let small = Limits { max_bytes: 4 * floats as u64 - 1, ..Limits::default() };
    for (what, limits) in [("max_gaussians", few), ("max_bytes", small)] {
        for decode in [AttributeCodec::decode, AttributeCodec::decode_stage] {
            if decode(codec, &streams, &CodecContext { limits, ..context() }).is_ok() {
                return Ok(Some(format!("more than the limit {what} allows was decoded")));
            }
        }
    }
    Ok(None)
}

fn survives_damage(codec: &dyn AttributeCodec) -> Result<Option<String>> {
    let sound = codec.encode(&scene(60, 1), &context())?;
    let limits = Limits { max_gaussians: 1000, ..Limits::default() };
    let context = CodecContext { limits, ..context() };
    // What is damaged, whether that must be an error, and the streams.
    let mut tries: Vec<(String, bool, Vec<Stream>)> = vec![("there are no streams".into(), true, Vec::new())];
    for index in 0..sound.len() {
        let name = &sound[index].name;
        let mut without = sound.clone();
        without.remove(index);
        // A stream may be optional, so both an error and a result are allowed without it.
        tries.push((format!("'{name}' is missing"), false, without));
        let length = sound[index].bytes.len();
        for k in 0..DAMAGES.min(2 * length) {
            let mut damaged = sound.clone();
            let bytes = &mut damaged[index].bytes;
            let at = (Seed::root(3).index((index * DAMAGES + k) as u64).value() % length as u64) as usize;
            let cut = k % 3 == 0;
            let what = if cut {
                bytes.truncate(at);
                "is truncated"
            } else {
                bytes[at] ^= 1 << (k % 8);
                "has a flipped bit"
            };
            tries.push((format!("'{name}' {what} at {at}"), cut, damaged));
        }
        let mut longer = sound.clone();
        longer[index].bytes.extend([255; 9]);
        tries.push((format!("'{name}' has trailing bytes"), true, longer));
    }
    for (what, refused, streams) in tries {
        // The first stages do not read all streams.
        for (decode, refused) in [AttributeCodec::decode, AttributeCodec::decode_stage].into_iter().zip([refused, false]) {
            match catch_unwind(AssertUnwindSafe(|| decode(codec, &streams, &context))) {
                Err(_) => return Ok(Some(format!("it panics where {what}"))),
                Ok(Err(_)) => {}
                Ok(Ok(_)) if refused => return Ok(Some(format!("it decodes Gaussians where {what}"))),
                Ok(Ok(found)) => {
                    if found.validate("decoded", &limits).is_err() {
                        return Ok(Some(format!("invalid Gaussians were returned where {what}")));
                    }
                }
            }
        }
    }
    Ok(None)
}

#[cfg(test)]
mod tests;
