//! The loss of a run: a weighted sum of the terms that the configuration lists.

use super::watchdog::is_finite;
use burn::tensor::Tensor;
use cc4dgs_core::{Error, LossInput, LossTerm, Registry, Result, Scene, split_kind};

/// Loss terms with their weights.
pub(crate) struct LossTerms(Vec<Term>);

/// A term with its name.
struct Term {
    name: String,
    weight: f64,
    term: Box<dyn LossTerm>,
}

/// One `[[loss]]` section, read.
struct Listed {
    kind: String,
    weight: f64,
    settings: toml::Table,
}

impl LossTerms {
    /// Builds the terms of the `[[loss]]` sections. Terms that a plug-in computes together are replaced by it.
    pub fn build(registry: &Registry, sections: &[toml::Table]) -> Result<Self> {
        let mut listed = sections.iter().map(|section| read("loss", section)).collect::<Result<Vec<_>>>()?;
        listed.retain(|term| term.weight != 0.0);
        if listed.is_empty() {
            return Err(Error::parameter("loss", "no term has a weight", "List at least one, such as [[loss]] kind = \"l1\", weight = 1.0"));
        }
        let mut terms = Vec::new();
        for fusion in registry.losses().filter_map(|plugin| plugin.fuses.as_ref()) {
            let index_of = |kind: &&str| listed.iter().position(|term| term.kind == **kind && term.settings.is_empty());
            let Some(mut found) = fusion.kinds.iter().map(index_of).collect::<Option<Vec<usize>>>() else { continue };
            let weights: Vec<f64> = found.iter().map(|&index| listed[index].weight).collect();
            terms.push(Term { name: fusion.kinds.join(" + "), weight: 1.0, term: (fusion.build)(&weights)? });
            found.sort_unstable();
            found.into_iter().rev().for_each(|index| drop(listed.remove(index)));
        }
        for term in &listed {
            let built = (registry.loss(&term.kind)?.build)(&term.settings)?;
            terms.push(Term { name: term.kind.clone(), weight: term.weight, term: built });
        }
        Ok(Self(terms))
    }
    /// Builds the term of the score stage from the `[score_loss]` section, which errors name.
    pub fn build_score(registry: &Registry, section: &toml::Table) -> Result<Self> {
        let Listed { kind, weight, .. } = read("score_loss", section)?;
        if weight == 0.0 {
            let remedy = "Give a number above 0, or leave the score stage out: train.dynamic = \"all\" or \"none\"";
            return Err(Error::parameter(format!("score_loss {kind}: weight"), "0 leaves the score stage nothing to optimise", remedy));
        }
        Self::build(registry, std::slice::from_ref(section))
    }
    /// Whether a term compares recorded depth.
    pub fn want_depth(&self) -> bool {
        self.of_depth().is_some()
    }
    /// The first term that compares recorded depth.
    fn of_depth(&self) -> Option<&Term> {
        self.0.iter().find(|term| term.term.wants_depth())
    }
    /// The first term that compares recorded depth, as messages name it, and the problem, where no training view of `scene` has any.
    fn without_depth(&self, scene: &Scene) -> Result<Option<(String, String)>> {
        let Some(Term { name, .. }) = self.of_depth() else { return Ok(None) };
        if scene.has_depth()? {
            return Ok(None);
        }
        Ok(Some((format!("loss {name}"), format!("it compares recorded depth, and no training view of {} has any", scene.name))))
    }
    /// Refuses terms that compare recorded depth where no training view of `scene` has it.
    pub fn check_depth(&self, scene: &Scene) -> Result<()> {
        let Some((object, problem)) = self.without_depth(scene)? else { return Ok(()) };
        let remedy = "Name the 16-bit PNG files of depth as depth_file_path in transforms.json, or remove the term";
        Err(Error::parameter(object, problem, remedy))
    }
    /// As [`LossTerms::check_depth`], for the further training of a model: refuses `scene` only where no other term is left. Else returns object and message of
    /// the warning that the terms of depth are left out, if there are some.
    pub fn check_depth_further(&self, scene: &Scene) -> Result<Option<(String, String)>> {
        let Some((object, problem)) = self.without_depth(scene)? else { return Ok(None) };
        if self.0.iter().all(|term| term.term.wants_depth()) {
            let problem = format!("{problem}, so that no term of the loss has anything to optimise");
            let remedy = "Give the scene with the depth that the model was trained on, or train no further: compress with finetune=0, prune with --refit 0";
            return Err(Error::parameter(object, problem, remedy));
        }
        Ok(Some((object, format!("{problem}: the model is trained further with the other terms of the loss alone"))))
    }
    /// Refuses terms that compare recorded depth, of which the score stage has none.
    pub fn refuse_depth(&self) -> Result<()> {
        let Some(Term { name, .. }) = self.of_depth() else { return Ok(()) };
        let problem = "it compares recorded depth, which the score stage does not read";
        Err(Error::parameter(format!("score_loss {name}"), problem, "Choose another kind, such as mask-bce, and list the term under loss"))
    }
    /// The weighted sum `[1]` for one view.
    pub fn value(&self, input: &LossInput) -> Result<Tensor<1>> {
        let mut total: Option<Tensor<1>> = None;
        for Term { name, weight, term } in &self.0 {
            let Some(value) = term.value(input)? else { continue };
            let value = single(&format!("loss term {name}"), value)?;
            let value = if *weight == 1.0 { value } else { value.mul_scalar(*weight) };
            total = Some(match total {
                Some(sum) => sum + value,
                None => value,
            });
        }
        Ok(total.unwrap_or_else(|| Tensor::zeros([1], &input.planes.device())))
    }
    /// Name of the first term whose value is not finite.
    pub fn broken(&self, input: &LossInput) -> Result<Option<&str>> {
        for Term { name, term, .. } in &self.0 {
            if let Some(value) = term.value(input)?
                && !is_finite(&value, name)?
            {
                return Ok(Some(name));
            }
        }
        Ok(None)
    }
}

/// Refuses a `term` of the loss that is not one number: added to the others, it would count as often as it has numbers. `object` names it in errors.
pub(crate) fn single(object: &str, term: Tensor<1>) -> Result<Tensor<1>> {
    match term.dims() {
        [1] => Ok(term),
        [count] => Err(Error::parameter(object, format!("its value has {count} numbers"), "Return one number [1], such as the mean")),
    }
}

/// Reads a section called `name`.
fn read(name: &str, section: &toml::Table) -> Result<Listed> {
    let (kind, mut settings) = split_kind(name, section)?;
    let weight = match settings.remove("weight") {
        None => 1.0,
        Some(toml::Value::Float(weight)) => weight,
        Some(toml::Value::Integer(weight)) => weight as f64,
        Some(other) => return Err(Error::parameter(format!("{name} {kind}: weight"), format!("{other} is not a number"), "Give a number of 0 or more")),
    };
    if !weight.is_finite() || weight < 0.0 {
        return Err(Error::parameter(format!("{name} {kind}: weight"), format!("{weight} cannot be used"), "Give a finite number of 0 or more"));
    }
    Ok(Listed { kind, weight, settings })
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::{Device, Int};
    use cc4dgs_core::{Camera, DepthImage, FrameSource, Gaussians, HostGaussians, Image8, NoImages, Schedule, Split, View};
    use std::sync::Arc;

    /// As many ones.
    struct Ones(usize);

    impl LossTerm for Ones {
        fn value(&self, input: &LossInput) -> Result<Option<Tensor<1>>> {
            Ok(Some(Tensor::ones([self.0], &input.planes.device())))
        }
    }

    /// Compares recorded depth.
    struct OfDepth;

    impl LossTerm for OfDepth {
        fn value(&self, _: &LossInput) -> Result<Option<Tensor<1>>> {
            Ok(None)
        }
        fn wants_depth(&self) -> bool {
            true
        }
    }

    /// Depth of a pixel, and no images.
    struct Deep;

    impl FrameSource for Deep {
        fn load(&self, view: usize) -> Result<Image8> {
            NoImages.load(view)
        }
        fn depth(&self, _: usize) -> Result<Option<DepthImage>> {
            Ok(Some(DepthImage { width: 1, height: 1, values: vec![2.0] }))
        }
    }

    #[test]
    fn depth_that_is_not_there_is_refused_or_left_out_by_one_rule() {
        let scene = |source: Arc<dyn FrameSource>| {
            let camera = Camera::look_at("a", (1, 1), 1.0, [0.0, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]);
            let view = View { camera: 0, frame: 0, time_norm: 0.0, split: Split::Train };
            Scene::new("flat", vec![camera], vec![view], source, 0).unwrap()
        };
        let (flat, deep) = (scene(Arc::new(NoImages)), scene(Arc::new(Deep)));
        let term = |name: &str, term: Box<dyn LossTerm>| Term { name: name.into(), weight: 1.0, term };
        let [none, alone, beside] = [0, 1, 2].map(|case| {
            let ones = (case != 1).then(|| term("ones", Box::new(Ones(1))));
            let of_depth = (case > 0).then(|| term("far", Box::new(OfDepth)));
            LossTerms(ones.into_iter().chain(of_depth).collect())
        });
        let further = |terms: &LossTerms, scene: &Scene| terms.check_depth_further(scene).map_err(|e| e.to_string());
        for terms in [&none, &alone, &beside] {
            assert!(terms.check_depth(&deep).is_ok());
            assert_eq!(further(terms, &deep), Ok(None));
        }
        assert!(none.check_depth(&flat).is_ok());
        assert_eq!(further(&none, &flat), Ok(None));
        // A training that asks for depth gets it, whatever else it asks for.
        for terms in [&alone, &beside] {
            let message = terms.check_depth(&flat).unwrap_err().to_string();
            assert!(message.starts_with("loss far: it compares recorded depth, and no training view of flat has any. "), "{message}");
        }
        let message = further(&alone, &flat).unwrap_err();
        assert!(message.starts_with("loss far: it compares recorded depth, and no training view of flat has any, so that no term"), "{message}");
        let (object, message) = further(&beside, &flat).unwrap().unwrap();
        assert!(object == "loss far" && message.contains("no training view of flat has any") && message.contains("other terms"), "{object}: {message}");
    }

    #[test]
    fn weights_that_cannot_be_used_are_named_with_their_section() {
        let registry = Registry::collect().unwrap();
        let section = |weight: &str| format!("kind = 'mask-bce'\nweight = {weight}").parse::<toml::Table>().unwrap();
        for weight in ["0", "0.0", "-1.0", "'much'"] {
            let message = LossTerms::build_score(&registry, &section(weight)).err().unwrap().to_string();
            assert!(message.starts_with("score_loss mask-bce: weight: "), "{message}");
        }
        let message = LossTerms::build(&registry, &[section("-1.0")]).err().unwrap().to_string();
        assert!(message.starts_with("loss mask-bce: weight: "), "{message}");
    }

    #[test]
    fn a_term_that_is_not_one_number_is_named() {
        let device = Device::flex();
        let (planes, target) = (Tensor::<3>::zeros([5, 2, 2], &device), Tensor::<3>::zeros([3, 2, 2], &device));
        let none = HostGaussians { sh_degree: 1, ..Default::default() };
        let (gaussians, radii) = (Gaussians::from_host(&none, &device), Tensor::<1, Int>::zeros([1], &device));
        let camera = Camera::look_at("a camera", (2, 2), 1.0, [0.0, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]);
        let (view, schedule) = (View { camera: 0, frame: 0, time_norm: 0.5, split: Split::Train }, Schedule::main(1));
        let input = LossInput::new(&camera, &view, &planes, &target, &gaussians, &radii, &schedule);
        let of = |numbers: usize| LossTerms(vec![Term { name: "mine".into(), weight: 0.5, term: Box::new(Ones(numbers)) }]).value(&input);
        assert_eq!(of(1).unwrap().into_scalar::<f32>(), 0.5);
        let message = of(4).unwrap_err().to_string();
        assert!(message.starts_with("loss term mine: its value has 4 numbers"), "{message}");
    }
}
