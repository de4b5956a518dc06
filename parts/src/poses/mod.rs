//! Pose models: corrections of the poses of training cameras.

mod none;
mod refined;
