//! What the trainings of a table ran on. Their times are not comparable between devices and numbers of threads, so tables mark them. Tables are not refused: a
//! training may be resumed with other threads, and everything else is comparable.

use super::read::describe;
use super::result::CellResult;
use cc4dgs_core::plural;
use std::collections::{BTreeMap, BTreeSet};

/// The devices that the trainings of some results ran on, each numbered by its index.
pub(crate) struct TrainingDevices<'a> {
    /// By their description: hosts and trainings.
    devices: BTreeMap<String, (BTreeSet<&'a str>, BTreeSet<&'a str>)>,
    /// Whether one of them is not the device that scored its result.
    elsewhere: bool,
}

impl<'a> TrainingDevices<'a> {
    /// Those of `results`.
    pub fn of(results: &'a [CellResult]) -> Self {
        let mut found = Self { devices: BTreeMap::new(), elsewhere: false };
        for (result, trained) in results.iter().flat_map(|result| result.cost.training_devices.iter().map(move |trained| (result, trained))) {
            let (hosts, trainings) = found.devices.entry(describe(&trained.device)).or_default();
            hosts.insert(if trained.host.is_empty() { "unknown" } else { trained.host.as_str() });
            trainings.insert(result.training.as_str());
            found.elsewhere |= trained.device != result.provenance.device;
        }
        found
    }
    /// Whether times of training are not comparable with each other.
    pub fn differ(&self) -> bool {
        self.devices.len() > 1
    }
    /// What stands behind the training time of a row: ` [1]`, or ` [1, 2]` where several devices took part; `?` is an older result, which does not say.
    /// Nothing where all trainings of the table ran on one device.
    pub fn mark(&self, row: &[&CellResult]) -> String {
        if !self.differ() {
            return String::new();
        }
        let own = of_row(row);
        let mut names: Vec<String> = self.devices.keys().enumerate().filter(|(_, name)| own.contains(*name)).map(|(i, _)| (i + 1).to_string()).collect();
        if row.iter().any(|result| result.cost.training_devices.is_empty()) {
            names.push("?".into());
        }
        format!(" [{}]", names.join(", "))
    }
    /// A sentence on what the trainings ran on, with the numbers of marks, where that is not the one device that scored them; else nothing.
    pub fn sentence(&self) -> String {
        if !self.elsewhere {
            return String::new();
        }
        let mut parts = Vec::new();
        for (i, (device, (hosts, trainings))) in self.devices.iter().enumerate() {
            let number = if self.differ() { format!("[{}] ", i + 1) } else { String::new() };
            let hosts: Vec<&str> = hosts.iter().copied().collect();
            parts.push(format!("{number}{device}, host {} (trainings: {})", hosts.join(", "), trainings.len()));
        }
        let warning = if self.differ() { "; those with different numbers do not compare" } else { "" };
        format!("Training times are wall times on {}{warning}.", parts.join("; "))
    }
}

/// The devices that the trainings of `row` ran on, in words.
fn of_row(row: &[&CellResult]) -> BTreeSet<String> {
    row.iter().flat_map(|result| &result.cost.training_devices).map(|trained| describe(&trained.device)).collect()
}

/// The same as one field of a table for programs, the same text for the same devices; empty for older results, which do not say.
pub(crate) fn trained_on(row: &[&CellResult]) -> String {
    of_row(row).into_iter().map(|device| device.replace(", ", "; ")).collect::<Vec<_>>().join(" + ")
}

/// A sentence on those `rows`, each the name of a training and its results, that went on after an interruption, and how often; `None` where none did.
pub(crate) fn interrupted<'a>(rows: impl IntoIterator<Item = (String, &'a [&'a CellResult])>) -> Option<String> {
    let mut found: BTreeMap<String, usize> = BTreeMap::new();
    for (name, row) in rows {
        // Rows of several codecs share their trainings.
        let own: usize = row.iter().map(|result| result.cost.resumed).sum();
        let most = found.entry(name).or_default();
        *most = own.max(*most);
    }
    found.retain(|_, times| *times > 0);
    let named: Vec<String> = found.iter().map(|(name, times)| format!("{name} ({times} {})", plural(*times, "interruption", "interruptions"))).collect();
    (!named.is_empty()).then(|| format!("Training times of trainings that were interrupted include the work that was repeated: {}.", named.join("; ")))
}

#[cfg(test)]
mod tests {
    use super::super::read::tests::{cell, example};
    use super::*;

    #[test]
    fn times_of_other_devices_are_marked() {
        let mut results = vec![example(), cell("resumed", |_| ()), cell("old", |r| r.cost.training_devices.clear())];
        let found = TrainingDevices::of(&results);
        let said = [found.mark(&[&results[0]]), found.mark(&[&results[2]]), found.sentence()];
        assert!(said.iter().all(String::is_empty), "all ran where they were scored: {said:?}");
        // A training that was resumed with other threads.
        let mut more = results[1].cost.training_devices[0].clone();
        more.device.threads = 8;
        results[1].cost.training_devices.push(more);
        super::super::check_comparable(&results).unwrap();
        let found = TrainingDevices::of(&results);
        assert_eq!([0, 1, 2].map(|i| found.mark(&[&results[i]])), [" [1]", " [1, 2]", " [?]"]);
        assert_eq!(found.mark(&[&results[0], &results[2]]), " [1, ?]");
        let sentence = found.sentence();
        let parts =
            ["on [1] flex, Example processor, 1 thread, linux x86_64, host node-1", "; [2] flex, Example processor, 8 threads, linux x86_64", "do not compare"];
        assert!(parts.iter().all(|part| sentence.contains(part)), "{sentence}");
        assert_eq!(trained_on(&[&results[0]]), "flex; Example processor; 1 thread; linux x86_64");
        assert_eq!(trained_on(&[&results[1]]).split(" + ").count(), 2);
        assert_eq!(trained_on(&[&results[2]]), "");
    }

    #[test]
    fn trainings_that_were_interrupted_are_named() {
        let (whole, once, twice) = (example(), cell("once", |r| r.cost.resumed = 1), cell("twice", |r| r.cost.resumed = 2));
        assert_eq!(interrupted([("cdf".into(), &[&whole][..])]), None);
        let said = interrupted([
            ("cdf".into(), &[&whole, &once][..]),
            ("cdf".into(), &[&once][..]),
            ("grid4d".into(), &[&whole][..]),
            ("hexplane".into(), &[&once, &twice][..]),
        ])
        .unwrap();
        assert!(said.ends_with(": cdf (1 interruption); hexplane (3 interruptions)."), "{said}");
    }
}
