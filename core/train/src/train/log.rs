//! Numbers of a stage, gathered between two log events.

use super::record::LogRecord;
use cc4dgs_core::{Event, EventSink, Stage};
use std::time::Instant;

/// Gathers numbers between two log events.
pub(crate) struct Log {
    stage: Stage,
    length: usize,
    every: usize,
    loss: f32,
    psnr_db: f32,
    psnr_sum: (f32, u32),
    since: (Instant, usize),
    work: [(u64, u64); 3],
}

impl Log {
    pub(crate) fn new(stage: Stage, length: usize, every: usize) -> Self {
        Self { stage, length, every: every.max(1), loss: 0.0, psnr_db: 0.0, psnr_sum: (0.0, 0), since: (Instant::now(), 0), work: [(0, 0); 3] }
    }
    /// The log as it was at `iteration`, when the checkpoint with `record` was written.
    pub(crate) fn resumed(mut self, record: LogRecord, iteration: usize) -> Self {
        (self.loss, self.psnr_db) = (f32::from_bits(record.loss_bits), f32::from_bits(record.psnr_db_bits));
        self.psnr_sum = (f32::from_bits(record.psnr_sum_bits), record.psnr_views);
        self.since.1 = iteration;
        self.work = record.work;
        self
    }
    /// The stage is to have `length` iterations.
    pub(crate) fn set_length(&mut self, length: usize) {
        self.length = length;
    }
    /// What a checkpoint keeps of it.
    pub(crate) fn record(&self) -> LogRecord {
        LogRecord {
            loss_bits: self.loss.to_bits(),
            psnr_db_bits: self.psnr_db.to_bits(),
            psnr_sum_bits: self.psnr_sum.0.to_bits(),
            psnr_views: self.psnr_sum.1,
            work: self.work,
        }
    }
    /// Whether this iteration's numbers are read back.
    pub(crate) fn due(&self, iteration: usize) -> bool {
        iteration.is_multiple_of(self.every) || iteration == self.length
    }
    pub(crate) fn psnr(&mut self, psnr_db: f32) {
        self.psnr_sum.0 += psnr_db;
        self.psnr_sum.1 += 1;
    }
    pub(crate) fn loss(&mut self, loss: f32) {
        self.loss = if self.loss == 0.0 { loss } else { 0.9 * self.loss + 0.1 * loss };
    }
    pub(crate) fn count_deformer(&mut self, decoded: u64, reused: u64, moved: u64, still: u64) {
        self.work[0].0 += decoded;
        self.work[0].1 += reused;
        self.work[1].0 += moved;
        self.work[1].1 += still;
    }
    pub(crate) fn count_optimizer(&mut self, updated: u64, skipped: u64) {
        self.work[2].0 += updated;
        self.work[2].1 += skipped;
    }
    pub(crate) fn step(&mut self, events: &dyn EventSink, iteration: usize, gaussians: usize) {
        if !self.due(iteration) {
            return;
        }
        if self.psnr_sum.1 > 0 {
            let psnr = self.psnr_sum.0 / self.psnr_sum.1 as f32;
            self.psnr_db = if self.psnr_db == 0.0 { psnr } else { 0.9 * self.psnr_db + 0.1 * psnr };
            self.psnr_sum = (0.0, 0);
        }
        let steps = (iteration - self.since.1.min(iteration)).max(1);
        let ms = self.since.0.elapsed().as_secs_f32() * 1000.0 / steps as f32;
        self.since = (Instant::now(), iteration);
        let stage = self.stage.name().to_string();
        events.emit(&Event::Iteration { stage, iteration, of: self.length, loss: self.loss, psnr_db: self.psnr_db, gaussians, ms });
    }
    /// Tells the counted work of the stage.
    pub(crate) fn finish(&self, events: &dyn EventSink) {
        // The last is counted in the iterations that are logged alone.
        let names = ["vertices decoded", "Gaussians deformed", "Gaussians updated"];
        for (name, (done, skipped)) in names.into_iter().zip(self.work) {
            if done + skipped > 0 {
                events.emit(&Event::Work { stage: self.stage.name().into(), counter: name.into(), done, skipped });
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::Recorder;

    #[test]
    fn a_resumed_stage_counts_its_work_from_the_beginning() {
        let mut log = Log::new(Stage::Main, 10, 1);
        log.count_deformer(5, 7, 20, 30);
        log.count_optimizer(1, 2);
        let stored = serde_json::to_string(&log.record()).unwrap();
        let mut log = Log::new(Stage::Main, 10, 1).resumed(serde_json::from_str(&stored).unwrap(), 1);
        log.count_deformer(1, 1, 1, 1);
        let events = Recorder::default();
        log.finish(&events);
        let told = events.events().into_iter().filter_map(|event| if let Event::Work { done, skipped, .. } = event { Some((done, skipped)) } else { None });
        assert_eq!(told.collect::<Vec<_>>(), [(6, 8), (21, 31), (1, 2)]);
        assert!(!serde_json::to_string(&LogRecord::default()).unwrap().contains("work"));
    }
}
