//! The exchangeable parts of the trainer, one file each: density controls, loss terms, appearance models, pose models and optimizers. No code refers to them;
//! they are found in the registry by the names that configurations use.

mod appearance;
mod density;
mod loss;
mod optimizer;
mod poses;
