use super::*;
use crate::{Error, Plugin, ordered_sum};

/// The mean squared velocity of the Gaussians. With `strict`, Gaussians without velocities are an error; without `learns`, it has no gradient.
struct Slow {
    strict: bool,
    learns: bool,
}

impl LossTerm for Slow {
    fn value(&self, input: &LossInput) -> Result<Option<Tensor<1>>> {
        let velocities = match input.gaussians.extra.get("velocity") {
            Some(velocities) if !input.gaussians.is_empty() => velocities.clone(),
            None if self.strict => return Err(Error::parameter("loss slow", "there are no velocities", "Choose a deformer that has some")),
            _ => return Ok(None),
        };
        let velocities = if self.learns { velocities } else { velocities.detach() };
        Ok(Some(ordered_sum(velocities.powi_scalar(2)).div_scalar(3.0 * input.gaussians.len() as f32)))
    }
}

/// The mean square of how far Gaussians move along the direction in which the camera looks, or with `root` the root of it. The canonical ones get the share
/// `share` of their gradient.
struct Approach {
    root: bool,
    share: f32,
}

impl LossTerm for Approach {
    fn value(&self, input: &LossInput) -> Result<Option<Tensor<1>>> {
        let (gaussians, canonical, camera) = (input.gaussians, input.canonical.means.clone(), input.camera);
        if gaussians.is_empty() {
            return Ok(None);
        }
        assert_eq!([camera.height as usize, camera.width as usize], input.planes.dims()[1..]);
        let canonical = canonical.clone().mul_scalar(self.share) + canonical.detach().mul_scalar(1.0 - self.share);
        let forward = Tensor::<1>::from_floats(camera.forward_world().map(|x| x as f32), &canonical.device()).unsqueeze_dim::<2>(0);
        let moved = ((gaussians.means.clone() - canonical) * forward).sum_dim(1);
        let mean = ordered_sum(moved.powi_scalar(2)).div_scalar(gaussians.len() as f32);
        Ok(Some(if self.root { mean.sqrt() } else { mean }))
    }
}

/// The mean squared difference of rendered and recorded depth. With `strict`, a view without depth is an error.
struct Deep {
    wants: bool,
    strict: bool,
}

impl LossTerm for Deep {
    fn value(&self, input: &LossInput) -> Result<Option<Tensor<1>>> {
        match input.depth {
            Some(depth) => {
                let pixels = depth.dims().iter().product::<usize>();
                Ok(Some(ordered_sum((input.planes.clone().narrow(0, 4, 1) - depth.clone()).powi_scalar(2)).div_scalar(pixels as f32)))
            }
            None if self.strict => Err(Error::parameter("loss deep", "there is no depth", "Choose a scene that has some")),
            None => Ok(None),
        }
    }
    fn wants_depth(&self) -> bool {
        self.wants
    }
}

/// The sum of squared differences of colours, or of squared opacity logits.
struct Summed {
    gaussians: bool,
}

impl LossTerm for Summed {
    fn value(&self, input: &LossInput) -> Result<Option<Tensor<1>>> {
        if self.gaussians {
            let logits = input.gaussians.opacity_logits.clone();
            return Ok((!input.gaussians.is_empty()).then(|| ordered_sum(logits.powi_scalar(2))));
        }
        Ok(Some(ordered_sum((input.planes.clone().narrow(0, 0, 3) - input.target.clone()).powi_scalar(2))))
    }
}

type Build = fn(&toml::Table) -> Result<Box<dyn LossTerm>>;

fn findings(build: Build, attributes: &[AttributeSpec]) -> Vec<String> {
    let info = Plugin { name: "a-term", version: "1", summary: "", paper: "", schema: "", capabilities: &[] };
    let plugin = LossPlugin { info, build, fuses: None };
    loss_of_attributes(&plugin, &toml::Table::new(), attributes, &Registry::collect().unwrap(), &Device::flex())
}

/// `term`, which has no settings.
fn plain(settings: &toml::Table, term: impl LossTerm + 'static) -> Result<Box<dyn LossTerm>> {
    match settings.keys().next() {
        None => Ok(Box::new(term)),
        Some(key) => Err(Error::parameter(format!("loss: {key}"), "there is no such setting", "Remove it")),
    }
}

#[test]
fn a_term_may_compare_with_the_canonical_gaussians_and_know_the_camera() {
    assert_eq!(findings(|settings| plain(settings, Approach { root: false, share: 1.0 }), &[]), [""; 0]);
    let mistakes: [(Build, &str); 3] = [
        (|settings| plain(settings, Approach { root: true, share: 1.0 }), "standing still: the gradient of means is not finite"),
        (|settings| plain(settings, Approach { root: false, share: 0.5 }), "gradients: canonical means: the loss rises"),
        (|settings| plain(settings, Approach { root: false, share: 0.0 }), "gradients: no gradient reaches canonical means"),
    ];
    for (build, finding) in mistakes {
        let found = findings(build, &[]);
        assert!(found.iter().any(|line| line.contains(finding)), "{finding}: {found:?}");
    }
}

#[test]
fn sums_over_pixels_or_gaussians_are_found() {
    let cases: [(Build, &str); 2] = [
        (|settings| plain(settings, Summed { gaussians: false }), "normalisation: four times as many pixels"),
        (|settings| plain(settings, Summed { gaussians: true }), "normalisation: four times as many Gaussians"),
    ];
    for (build, finding) in cases {
        let found = findings(build, &[]);
        assert!(found.iter().any(|line| line.contains(finding)), "{finding}: {found:?}");
    }
}

#[test]
fn a_term_may_compare_recorded_depth() {
    assert_eq!(findings(|settings| plain(settings, Deep { wants: true, strict: false }), &[]), [""; 0]);
    let mistakes: [(Build, &str); 2] = [
        (|settings| plain(settings, Deep { wants: false, strict: false }), "it returns no value for an ordinary view"),
        (|settings| plain(settings, Deep { wants: true, strict: true }), "odd inputs: loss deep: there is no depth"),
    ];
    for (build, finding) in mistakes {
        let found = findings(build, &[]);
        assert!(found.iter().any(|line| line.contains(finding)), "{finding}: {found:?}");
    }
}

#[test]
fn a_term_may_read_attributes_of_a_deformer() {
    let velocity = [AttributeSpec::new("velocity", 3, 0.0, 1e-3)];
    assert_eq!(findings(|settings| plain(settings, Slow { strict: false, learns: true }), &velocity), [""; 0]);
    let mistakes: [(Build, &[AttributeSpec], &str); 3] = [
        (|settings| plain(settings, Slow { strict: false, learns: true }), &[], "it returns no value for an ordinary view"),
        (|settings| plain(settings, Slow { strict: true, learns: true }), &velocity, "there are no velocities"),
        (|settings| plain(settings, Slow { strict: false, learns: false }), &velocity, "gradients"),
    ];
    for (build, attributes, finding) in mistakes {
        let found = findings(build, attributes);
        assert!(found.iter().any(|line| line.contains(finding)), "{finding}: {found:?}");
    }
}
