//! The conformance suite of attribute codecs.

use super::uniform;
use crate::gaussians::sh_rest_len;
use crate::{AttributeCodec, CodecContext, CodecPlugin, ExtraAttribute, HostGaussians, Limits, NeededRows, Result, Seed, Silent, Stream, StreamStage};
use std::panic::{AssertUnwindSafe, catch_unwind};

/// Name of the extra attribute that identifies the Gaussians after a codec has reordered them.
const MARK: &str = "conformance-mark";
/// Damaged versions tried per stream.
const DAMAGES: usize = 24;

/// Tests a codec. Each finding is a line; an empty list means that it passed.
///
/// - Unknown settings are refused.
/// - Decoding gives the same Gaussians in any order, with extra attributes bit for bit or as [`ExtraAttribute`] allows.
/// - The error of each column is at most the declared one.
/// - Equal inputs give equal bytes.
/// - Sets of no Gaussians and of one Gaussian can be stored; Gaussians that are not finite are refused.
/// - The streams of the first stages hold the first rows of the whole; coefficients of degrees that have streams of their own are 0 until their stage.
/// - Truncated, damaged and missing streams give an error or valid Gaussians within the limits, never a panic.
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
    note("settings", refuses_unknown_settings(plugin, profile, settings));
    for (count, degree) in [(0, 3), (1, 2), (2, 0), (700, 3), (400, 1)] {
        note(&format!("{count} Gaussians of degree {degree}"), comes_back(codec, &scene(count, degree)));
    }
    note("repeats", repeats(codec));
    for (count, degree) in [(0, 1), (1, 2), (300, 3)] {
        note(&format!("stages of {count} Gaussians"), arrives_in_stages(codec, &scene(count, degree)));
    }
    note("values that are not finite", refuses_what_is_not_finite(codec));
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

fn refuses_unknown_settings(plugin: &CodecPlugin, profile: &str, settings: &toml::Table) -> Result<Option<String>> {
    let mut settings = settings.clone();
    settings.insert("no_such_setting".into(), 1.into());
    Ok(match (plugin.build)(profile, &settings) {
        Ok(_) => Some("an unknown setting was accepted".into()),
        Err(e) if !e.to_string().contains("no_such_setting") => Some(format!("the error does not name the unknown setting: {e}")),
        Err(_) => (plugin.build)("no-such-profile", &toml::Table::new()).is_ok().then(|| "an unknown profile was accepted".into()),
    })
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
    let found = codec.decode(&codec.encode(given, &context())?, &context())?;
    if (found.len(), found.sh_degree) != (given.len(), given.sh_degree) {
        return Ok(Some(format!("{} Gaussians of degree {} came back", found.len(), found.sh_degree)));
    }
    let Some(marks) = found.extra.get(MARK).filter(|a| a.width == 1 && a.values.len() == given.len()) else {
        return Ok(Some("extra attributes were lost".into()));
    };
    let order: Vec<usize> = marks.values.iter().map(|&v| v as usize).collect();
    let mut all = order.clone();
    all.sort_unstable();
    if all != (0..given.len()).collect::<Vec<_>>() {
        return Ok(Some("extra attributes were changed".into()));
    }
    let expected = given.select(&order);
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
    let (first, second) = (codec.encode(&given, &context())?, codec.encode(&given, &context())?);
    if first != second {
        return Ok(Some("two encodings of the same Gaussians differ".into()));
    }
    let mut names: Vec<&str> = first.iter().map(|s| s.name.as_str()).collect();
    names.sort_unstable();
    if let Some(twice) = names.windows(2).find(|w| w[0] == w[1]) {
        return Ok(Some(format!("two streams are called {}", twice[0])));
    }
    let (a, b) = (codec.decode(&first, &context())?, codec.decode(&second, &context())?);
    Ok((a != b).then(|| "two decodings of the same streams differ".into()))
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

fn refuses_what_is_not_finite(codec: &dyn AttributeCodec) -> Result<Option<String>> {
    for value in [f32::NAN, f32::INFINITY] {
        let mut given = scene(20, 1);
        given.opacity_logits[3] = value;
        if codec.encode(&given, &context()).is_ok() {
            return Ok(Some(format!("an opacity of {value} was encoded")));
        }
    }
    Ok(None)
}

fn survives_damage(codec: &dyn AttributeCodec) -> Result<Option<String>> {
    let sound = codec.encode(&scene(60, 1), &context())?;
    let limits = Limits { max_gaussians: 1000, ..Limits::default() };
    let context = CodecContext { limits, ..context() };
    let mut tries: Vec<(String, Vec<Stream>)> = vec![("no streams".into(), Vec::new())];
    for index in 0..sound.len() {
        let name = &sound[index].name;
        let mut without = sound.clone();
        without.remove(index);
        // A stream may be optional, so both an error and a result are allowed without it.
        tries.push((format!("'{name}' is missing"), without));
        let length = sound[index].bytes.len();
        for k in 0..DAMAGES.min(2 * length) {
            let mut damaged = sound.clone();
            let bytes = &mut damaged[index].bytes;
            let at = (Seed::root(3).index((index * DAMAGES + k) as u64).value() % length as u64) as usize;
            let what = if k % 3 == 0 {
                bytes.truncate(at);
                "is truncated"
            } else {
                bytes[at] ^= 1 << (k % 8);
                "has a flipped bit"
            };
            tries.push((format!("'{name}' {what} at {at}"), damaged));
        }
        let mut longer = sound.clone();
        longer[index].bytes.extend([255; 9]);
        tries.push((format!("'{name}' has trailing bytes"), longer));
    }
    for (what, streams) in tries {
        for decode in [AttributeCodec::decode, AttributeCodec::decode_stage] {
            match catch_unwind(AssertUnwindSafe(|| decode(codec, &streams, &context))) {
                Err(_) => return Ok(Some(format!("it panics where {what}"))),
                Ok(Err(_)) => {}
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
