//! What the window does that needs no window library. It is compiled for tests, too, so that these run without the feature `window`.

pub(crate) mod exact_view;
pub(crate) mod image_file;
pub(crate) mod live;
pub(crate) mod lost;
pub(crate) mod start;
