//! Training and evaluation: readers, initialisation, the three-stage trainer, its checkpoints, scores of whole scenes. Plug-ins are
//! named in defaults, by the planner `auto`, and (`life`) by recovery and key frames only.

pub mod agreement;
pub mod auto;
pub mod blocks;
pub mod checkpoint;
pub mod checks;
pub mod code;
pub mod config;
pub mod data;
pub mod eval;
pub mod event_log;
mod field_box;
pub mod gaussian_set;
pub mod images;
pub mod init;
pub mod knn;
pub mod layers;
pub mod masks;
pub mod presets;
pub mod report;
mod sample;
pub mod schedule;
pub mod sweep;
pub mod train;
mod train_config;
pub mod trajectory;
