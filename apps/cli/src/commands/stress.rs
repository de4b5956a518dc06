//! `cc4dgs stress`.

use super::Context;
use crate::args::Stress;
use cc4dgs::stress::{NO_ORACLE, StressJob, StressReport, stress};
use cc4dgs_core::{Error, Event, EventSink, Result, parse_device, plural, resolved_device};
use serde_json::json;
use std::collections::BTreeMap;

/// Optimizer steps without `--full`, and levels of each condition of a deformer, by device: a step of 64 values costs microseconds on `flex`, and a chain of
/// tensor operations or kernel launches elsewhere.
const SIZES: [(&str, usize, usize); 3] = [("flex", 20_000, 8), ("ndarray", 5_000, 8), ("", 1_000, 3)];
const FULL_STEPS: usize = 1_000_000;
/// Devices that share the kernels of the host.
const PROCESSORS: [&str; 2] = ["flex", "ndarray"];
/// All levels.
const ALL_LEVELS: usize = 8;

pub fn run(context: &Context, args: &Stress) -> Result<()> {
    let (device, host) = (parse_device(&args.device)?, parse_device("flex")?);
    let events = context.listeners(None)?;
    let name = resolved_device(&args.device).to_string();
    let (_, steps, deformer_levels) = SIZES.into_iter().find(|(device, ..)| name.starts_with(device)).unwrap_or(("", 1_000, 3));
    let job = StressJob {
        registry: &context.registry,
        device: &device,
        host: &host,
        other_kernels: !PROCESSORS.iter().any(|processor| name.starts_with(processor)),
        rasterizer: "tile",
        oracle: "reference",
        optimizer: "adam",
        steps: if args.full { FULL_STEPS } else { steps },
        deformer_levels: if args.full { ALL_LEVELS } else { deformer_levels },
    };
    let mut done = 0;
    let report = stress(&job, &mut |_| {
        done += 1;
        events.emit(&Event::Progress { task: "stress".into(), done, total: 0 });
    })?;
    // Ends the bar before the table is printed: how many cases there are is not known.
    drop(events);
    let failures: Vec<String> = report.failures().map(|c| format!("{}, {}, {}: {}", c.part, c.condition, c.level, c.outcome)).collect();
    let limits: Vec<_> = report.limits().into_iter().map(|(part, condition, level)| json!({ "part": part, "condition": condition, "level": level })).collect();
    let value = json!({ "device": name, "optimizer_steps": job.steps, "deformer_levels": job.deformer_levels, "cases": report.cases, "limits": limits, "failures": failures });
    context.output.result(&value, || table(&name, &report))?;
    match failures.as_slice() {
        [] => Ok(()),
        [first, ..] => {
            let behave = plural(failures.len(), "does not behave, it is", "do not behave, the first is");
            let problem = format!("{} of {} cases {behave} {first}", failures.len(), report.cases.len());
            Err(Error::backend(format!("stress on {name}"), problem, "The table has them all; report them as defects"))
        }
    }
}

/// One row per condition: how it went, the largest error, and the first level over the limit.
fn table(device: &str, report: &StressReport) -> String {
    struct Row<'a> {
        cases: usize,
        errors: usize,
        alone: bool,
        failed: Option<&'a str>,
        worst: Option<(f64, &'a str)>,
        limit: Option<&'a str>,
    }
    let mut order = Vec::new();
    let mut rows: BTreeMap<(&str, &str), Row> = BTreeMap::new();
    for case in &report.cases {
        let key = (case.part.as_str(), case.condition.as_str());
        let row = rows.entry(key).or_insert_with(|| {
            order.push(key);
            Row { cases: 0, errors: 0, alone: false, failed: None, worst: None, limit: None }
        });
        row.cases += 1;
        row.errors += usize::from(case.outcome.starts_with("error"));
        row.alone |= case.oracle.as_deref() == Some(NO_ORACLE);
        if !case.behaves {
            row.failed = row.failed.or(Some(&case.level));
        }
        if let Some(error) = case.error.filter(|e| row.worst.is_none_or(|(worst, _)| *e > worst)) {
            row.worst = Some((error, &case.level));
        }
    }
    for (part, condition, level) in report.limits() {
        if let Some(row) = rows.get_mut(&(part, condition)) {
            row.limit = level;
        }
    }
    let mut lines = vec![
        format!("float32 on {device} against float64; error: 95th percentile over the largest value; limit: the first level with an error over 1 %"),
        format!("{:<24} {:<34} {:>5}  {:<34} {:<26} {}", "part", "condition", "cases", "behaviour", "largest error at", "limit"),
    ];
    for key in order {
        let row = &rows[&key];
        let behaviour = match row.failed {
            Some(level) => format!("FAILS at {level}"),
            None if row.errors == 0 => "finite".to_string(),
            None => format!("finite, {} refused with an error", row.errors),
        };
        let unknown = if row.alone { NO_ORACLE } else { "" };
        let worst = row.worst.map_or_else(|| unknown.to_string(), |(error, level)| format!("{error:.1e} at {level}"));
        let limit = row.limit.unwrap_or(if row.worst.is_some() { "none" } else { "" });
        lines.push(format!("{:<24} {:<34} {:>5}  {behaviour:<34} {worst:<26} {limit}", key.0, key.1, row.cases));
    }
    lines.join("\n")
}
