//! Appearance models: corrections between the rendered image and the recorded image of a training camera.

mod affine;
mod none;
