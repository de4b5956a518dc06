//! What lies between the rendered image and the one a camera recorded.

mod affine;
mod none;
