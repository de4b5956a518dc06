//! Opens a model of any kind, made with the plug-ins of `sway` and `half-floats` or without, and writes one image of it.

use cc4dgs::{Orbit, Result, Session, write_png};
use half_floats as _;
use sway as _;

fn main() -> Result<()> {
    let mut arguments = std::env::args().skip(1);
    let (model, image) = (arguments.next().unwrap_or_default(), arguments.next().unwrap_or_default());
    let session = Session::new()?;
    let model = session.open(model)?;
    let camera = Orbit::default().around(&model.gaussians)?.remove(0);
    write_png(image, &session.player(&model)?.frame(&camera, 0.5)?)
}
