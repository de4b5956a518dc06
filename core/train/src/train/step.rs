//! One photometric step: deform, render, loss, backward, optimizer. Shared by the coarse and the main stage.

use super::capacity::Drawn;
use super::dropout;
use super::log::Log;
use super::losses::single;
use super::probe::{broken_pose, psnr_db};
use super::rounded::{ExactWeights, Rounded};
use super::smoothness::{flicker, smoothness};
use super::state::{APPEARANCE, POSES};
use super::watchdog::{TOLERATED, Trouble, broken_rows_of, is_finite};
use super::{Context, TrainState, parameters};
use crate::gaussian_set::{Leaves, gaussian_rate};
use burn::tensor::{Gradients, Int, Tensor, TensorData};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{
    Camera, DeformerWork, Error, Event, LossInput, ParameterGroup, RenderSettings, Result, Scene, Schedule, SpatialInput, Splats, Stage, Statistic,
    StepSettings, View, ViewStatistics,
};
use cc4dgs_play::MovingRows;
use cc4dgs_play::model::ModelDeformer;
use std::collections::BTreeMap;

/// What the deformer has to say about this iteration's Gaussians before a time is known.
struct Spatial {
    input: SpatialInput,
    features: Tensor<2>,
    work: DeformerWork,
}

/// What became of an iteration.
enum Outcome {
    Stepped,
    Trouble(Trouble),
    /// More pairs than a capacity: nothing was learned.
    TooManyPairs,
}

/// A rendered view whose statistics wait for the backward pass.
struct Rendered<'a> {
    screen_probe: Option<Tensor<2>>,
    absolute_screen_probe: Option<Tensor<2>>,
    radii: Tensor<1, Int>,
    max_weights: Option<Tensor<1>>,
    camera: Camera,
    view: &'a View,
}

impl Context<'_> {
    /// One iteration on the views of `batch`. Losses and offsets are looked at where they are logged and where `check` asks for it, gradients where `check`
    /// does; what is not finite is returned, and the parameters are then as they were or unfit for use.
    pub(crate) fn photometric_step(&self, schedule: &Schedule, state: &mut TrainState, batch: &[usize], check: bool, log: &mut Log) -> Result<Option<Trouble>> {
        // Iterations that wait for the device anyway need no capacity; in fine-tuning weights would be rounded twice.
        let count = check || log.due(schedule.iteration) || state.rounded.is_some();
        let outcome = match self.attempt(schedule, state, batch, check, count, log)? {
            Outcome::TooManyPairs => self.attempt(schedule, state, batch, check, true, log)?,
            outcome => outcome,
        };
        Ok(if let Outcome::Trouble(trouble) = outcome { Some(trouble) } else { None })
    }

    /// One attempt at [`Context::photometric_step`]. With `count`, pairs are counted before a view is drawn. Without, there may be more than the capacity;
    /// parameters and statistics are then as they were.
    fn attempt(&self, schedule: &Schedule, state: &mut TrainState, batch: &[usize], check: bool, count: bool, log: &mut Log) -> Result<Outcome> {
        let train = &self.job.config.train;
        let scene = self.pyramid.at(schedule.image_scale);
        let (n, progress) = (state.set.len(), schedule.progress());
        let rows = state.moving_rows(&self.device)?;
        let moves = state.deformer.as_ref().is_some_and(|d| !d.field.is_static()) && rows.count() > 0;
        if let Some(deformer) = &mut state.deformer {
            deformer.field.set_progress(schedule.deformer_progress() as f32);
        }
        self.decide_smoothness(state, schedule, moves)?;

        let mut neighbours = if moves && train.strain > 0.0 { Some(state.current_neighbours(&self.device)?) } else { None };
        let learns = |name: &str| match name {
            "dynamic_scores" => false,
            "sh_rest" => schedule.iteration.is_multiple_of(train.sh_every),
            _ => true,
        };
        let leaves = state.rounded.as_ref().map_or(&state.set, |rounded| &rounded.gaussians).leaves(learns);
        let gaussians = leaves.gaussians()?;
        let autodiff = gaussians.means.device();
        let spatial = match &mut state.deformer {
            Some(deformer) if moves => {
                if let Some(rounded) = &mut state.rounded {
                    rounded.exchange_weights(deformer.field.parameters_mut());
                }
                parameters::track(deformer.field.parameters_mut());
                Some(spatial_pass(deformer, &leaves, &rows)?)
            }
            _ => None,
        };
        for (_, parameters) in state.of_cameras_mut() {
            parameters::track(parameters);
        }
        // Before anything is drawn, so that no view waits for the images before it until its pose is read.
        let posed = batch.iter().map(|&view| self.posed(scene, state, view)).collect::<Result<Vec<_>>>()?;
        if let Some(broken) = posed.iter().flatten().find(|posed| posed.camera.validate().is_err()) {
            return Ok(Outcome::Trouble(Trouble::of(POSES, broken_pose(&broken.camera))));
        }

        let statistics = state.density.statistics(schedule);
        let background_rgb = self.job.config.background()?;
        let max_weights = statistics.contains(&Statistic::MaxWeight);
        let settings = RenderSettings { max_weights, ..self.job.config.render.settings(Some(Tensor::from_inner(self.background.clone()))) };
        let mut total: Option<Tensor<1>> = None;
        let (mut rendered, mut pairs) = (Vec::with_capacity(batch.len()), Vec::with_capacity(batch.len()));
        let mut seen: Option<Tensor<1, Int>> = None;
        let read = log.due(schedule.iteration);
        let mut offsets = Vec::new();
        if let (Some(spatial), Some(deformer)) = (&spatial, &state.deformer) {
            let times: Vec<f32> = batch.iter().map(|&view| self.noisy_time(scene.views[view].time_norm, schedule, view)).collect();
            offsets = deformer.field.deform_all(spatial.features.clone(), &times)?;
            if offsets.len() != times.len() {
                let problem = format!("deform_all gave offsets at {} times for {}", offsets.len(), times.len());
                return Err(Error::parameter(format!("deformer {}", deformer.name()), problem, "Return the offsets at every time, in order"));
            }
        }
        let mut offsets = offsets.into_iter();
        for (&view, posed) in batch.iter().zip(&posed) {
            let camera = posed.as_ref().map_or_else(|| scene.camera(view), |posed| &posed.camera);
            let drawn = match (offsets.next(), &state.deformer) {
                (Some(offsets), Some(deformer)) => {
                    offsets.check(deformer.name(), rows.count())?;
                    if (read || check)
                        && let Some(head) = offsets.broken_head(deformer.name(), TOLERATED)?
                    {
                        return Ok(Outcome::Trouble(Trouble::of("deformer", format!("the offsets of deformer {}, head {head}", deformer.name()))));
                    }
                    // At the time of the first view: at all of them, strain would take longer than the deformer's functions of time.
                    if let (Some(neighbours), Some(means)) = (neighbours.take(), &offsets.means)
                        && let Some(strain) = neighbours.strain(means.clone())
                    {
                        let term = strain.mul_scalar(train.strain);
                        total = Some(total.map_or(term.clone(), |sum| sum + term));
                    }
                    offsets.apply(deformer.name(), &gaussians, rows.indices())?
                }
                _ => gaussians.clone(),
            };
            let mut splats = Splats::from_gaussians(&drawn, schedule.sh_degree);
            if train.dropout > 0.0 {
                let seed = self.seed.child("dropout").child(schedule.stage.name()).index(schedule.iteration as u64).index(view as u64);
                splats.opacities = dropout::dropped(splats.opacities, train.dropout * progress, seed);
            }
            let probe = |wanted| statistics.contains(&wanted).then(|| Tensor::<2>::zeros([n, 2], &autodiff).require_grad());
            let (screen_probe, absolute_screen_probe) = (probe(Statistic::ScreenGradient), probe(Statistic::AbsoluteScreenGradient));
            splats.screen_probe = screen_probe.clone();
            splats.absolute_screen_probe = absolute_screen_probe.clone();
            splats.camera_probe = posed.as_ref().map(|posed| posed.probe.clone());
            let key = (scene.views[view].camera, camera.width, camera.height);
            let capacity = if count { None } else { state.capacities.of(key) };
            let output = self.rasterizer.render(&splats, camera, &RenderSettings { pair_capacity: capacity, ..settings.clone() })?;
            pairs.push(Drawn::new(key, capacity, &output));
            let planes = state.appearance.apply(output.planes, self.training_camera.get(&scene.views[view].camera).copied())?;
            let target = Tensor::<3>::from_inner(self.rasterizer.upload(&scene.frame(view)?, background_rgb, &self.device));
            let radii = output.stats.radii;
            let depth = self.recorded_depth(scene, view)?;
            let input = LossInput::new(camera, &scene.views[view], &planes, &target, &drawn, &radii, schedule).moved_from(&gaussians);
            let input = input.with_depth(depth.as_ref());
            let loss = self.losses.value(&input)?;
            if (read || check) && !is_finite(&loss, "loss")? {
                let part = if is_finite(&planes, "image")? { self.losses.broken(&input)?.map(|term| format!("the loss term {term}")) } else { None };
                return Ok(Outcome::Trouble(Trouble::new(part.unwrap_or_else(|| format!("the image of camera {}", camera.name)))));
            }
            if read {
                log.psnr(psnr_db(planes.inner().narrow(0, 0, 3), target.inner())?);
            }
            let loss = if batch.len() == 1 { loss } else { loss.div_scalar(batch.len() as f32) };
            total = Some(match total {
                Some(sum) => sum + loss,
                None => loss,
            });
            seen = Some(match seen {
                Some(other) => other.max_pair(radii.clone()),
                None => radii.clone(),
            });
            let (max_weights, view) = (output.stats.max_weights, &scene.views[view]);
            let camera = camera.clone();
            rendered.push(Rendered { screen_probe, absolute_screen_probe, radii, max_weights, camera, view });
        }
        let Some(mut loss) = total else { return Ok(Outcome::Stepped) };
        if let (Some(deformer), Some(&view), Some(spatial)) = (&state.deformer, batch.first(), &spatial) {
            let time_norm = scene.views[view].time_norm;
            if state.smooth {
                let seed = self.seed.child("smoothness").index(schedule.iteration as u64);
                if let Some(term) = smoothness(deformer.field.as_ref(), &deformer.context, &spatial.input, time_norm, train, progress, seed)? {
                    loss = loss + term;
                }
            }
            if let Some(term) = deformer.field.regularizer(&spatial.input, time_norm, progress as f32)? {
                loss = loss + single(&format!("regularizer of deformer {}", deformer.name()), term)?;
            }
        }
        if let Some(term) = state.appearance.regularizer()? {
            loss = loss + single("regularizer of the appearance model", term)?;
        }
        if let Some(term) = state.poses.regularizer()? {
            loss = loss + single("regularizer of the pose model", term)?;
        }
        if read || check {
            let value = to_vec(loss.clone(), "loss")?.first().copied().unwrap_or(f32::NAN);
            if !value.is_finite() {
                // The terms of the images are finite, so it is one of the others.
                return Ok(Outcome::Trouble(Trouble::new("the regularizer of deformer, appearance or pose model, or smoothness")));
            }
            if read {
                log.loss(value);
            }
        }

        let gradients = loss.backward();
        if !state.capacities.sufficed(&pairs)? {
            return Ok(Outcome::TooManyPairs);
        }
        if let Some(Spatial { work, .. }) = &spatial {
            let moving = rows.count() as u64;
            log.count_deformer(work.vertices_decoded, work.vertices_queried - work.vertices_decoded, moving, n as u64 - moving);
        }
        for Rendered { screen_probe, absolute_screen_probe, radii, max_weights, camera, view } in rendered {
            let gradient_of = |probe: Option<Tensor<2>>| probe.and_then(|probe| probe.grad(&gradients));
            state.guard.saw(&radii);
            let mut of_view = ViewStatistics::new(camera, view.clone(), radii);
            (of_view.screen_gradient, of_view.absolute_screen_gradient) = (gradient_of(screen_probe), gradient_of(absolute_screen_probe));
            (of_view.max_weights, of_view.views) = (max_weights, batch.len());
            state.density.observe(&of_view)?;
        }
        let of_gaussians = leaves.gradients(&gradients);
        if check && let Some(trouble) = broken_gradient(state, &of_gaussians, &gradients)? {
            return Ok(Outcome::Trouble(trouble));
        }
        let deformed = spatial.is_some();
        // Whoever else holds the values would keep the optimizer from working in place.
        drop((leaves, gaussians, loss, spatial, posed));
        let visible = if train.sparse_adam { seen } else { None };
        if let Some(visible) = &visible
            && read
        {
            let shown = to_vec(visible.clone().greater_elem(0).float().sum(), "number of Gaussians that are shown")?.first().map_or(0, |shown| *shown as u64);
            log.count_optimizer(shown, n as u64 - shown.min(n as u64));
        }
        let extent = f64::from(schedule.extent);
        let of_plugin: BTreeMap<String, f64> =
            state.deformer.iter().flat_map(|d| d.field.attributes()).map(|a| (a.name.clone(), parameters::attribute_rate(&a, progress, extent))).collect();
        let scale = train.rate_scale(schedule, batch.len());
        let rates = state.rates.clone();
        let rate = |name: &str| rates.of_gaussians(name) * scale * of_plugin.get(name).copied().unwrap_or_else(|| gaussian_rate(&train.lr, name, schedule));
        match state.rounded.take() {
            Some(mut rounded) => {
                rounded.step_gaussians(state, of_gaussians, visible.as_ref())?;
                state.rounded = Some(rounded);
            }
            None => self.step_gaussians(state, of_gaussians, |name| StepSettings { visible: visible.as_ref(), ..StepSettings::new(rate(name)) })?,
        }
        let of_group = |group: &ParameterGroup| scale * parameters::rate(group, progress, extent);
        let TrainState { deformer, appearance, poses, optimizer, .. } = state;
        if let Some(deformer) = deformer.as_mut().filter(|_| deformed) {
            let groups = deformer.field.groups();
            let exact = state.rounded.as_mut().map(Rounded::exact).unwrap_or_default();
            parameters::update("deformer/", deformer.field.parameters_mut(), exact, &groups, &gradients, optimizer.as_mut(), |group| {
                rates.of_deformer() * of_group(group)
            })?;
        }
        let of_cameras = [(APPEARANCE, appearance.groups(), appearance.parameters_mut()), (POSES, poses.groups(), poses.parameters_mut())];
        for (part, groups, parameters) in of_cameras {
            let of_group = |group: &ParameterGroup| rates.of(part) * of_group(group);
            parameters::update(&format!("{part}/"), parameters, ExactWeights::default(), &groups, &gradients, optimizer.as_mut(), of_group)?;
        }
        log.step(self.job.events, schedule.iteration, state.set.len());
        Ok(Outcome::Stepped)
    }

    /// The recorded depth `[1,H,W]` of a view, where a loss term compares it and the view has it.
    fn recorded_depth(&self, scene: &Scene, view: usize) -> Result<Option<Tensor<3>>> {
        if !self.losses.want_depth() {
            return Ok(None);
        }
        let Some(depth) = scene.depth(view)? else { return Ok(None) };
        let data = TensorData::new(depth.values.clone(), [1, depth.height as usize, depth.width as usize]);
        Ok(Some(Tensor::from_inner(Tensor::from_data(data, &self.device))))
    }

    /// One optimizer step of the Gaussians' attributes that have a gradient.
    pub(crate) fn step_gaussians<'a>(
        &self,
        state: &mut TrainState,
        gradients: Vec<(String, Tensor<2>)>,
        settings: impl Fn(&str) -> StepSettings<'a>,
    ) -> Result<()> {
        let mut gradients: BTreeMap<String, Tensor<2>> = gradients.into_iter().collect();
        for (name, slot) in state.set.slots() {
            let Some(gradient) = gradients.remove(name) else { continue };
            let device = slot.device();
            // Moved out, so that the optimizer holds the only reference and works in place.
            let value = std::mem::replace(slot, Tensor::empty([0, 0], &device));
            *slot = state.optimizer.step(&format!("gaussians/{name}"), value, gradient, &settings(name))?;
        }
        Ok(())
    }

    /// `time_norm` with the noise of `train.time_noise`.
    fn noisy_time(&self, time_norm: f32, schedule: &Schedule, view: usize) -> f32 {
        let frames = self.job.config.train.time_noise * (1.0 - 2.0 * schedule.progress());
        let intervals = self.job.scene.frame_count.saturating_sub(1);
        if frames <= 0.0 || intervals == 0 {
            return time_norm;
        }
        let seed = self.seed.child("time noise").index(schedule.iteration as u64).index(view as u64);
        // The sum of twelve uniform numbers, minus six, is nearly standard normal.
        let normal = (0..12u64).map(|k| (seed.index(k).value() >> 11) as f64 / (1u64 << 53) as f64).sum::<f64>() - 6.0;
        (f64::from(time_norm) + normal * frames / intervals as f64).clamp(0.0, 1.0) as f32
    }

    /// At a quarter and at half of the main stage, when motion has taken shape: measure flicker, and switch smoothness on if the scene needs it.
    fn decide_smoothness(&self, state: &mut TrainState, schedule: &Schedule, moves: bool) -> Result<()> {
        let train = &self.job.config.train;
        if train.lambda_r <= 0.0 || state.smooth || schedule.stage != Stage::Main || !moves {
            return Ok(());
        }
        if !train.smooth_auto {
            state.smooth = true;
            return Ok(());
        }
        if ![0.25, 0.5].iter().any(|&share| schedule.iteration == schedule.iteration_at(share) as usize) {
            return Ok(());
        }
        let rows = state.moving_rows(&self.device)?;
        let Some(deformer) = &state.deformer else { return Ok(()) };
        let measured = flicker(deformer.field.as_ref(), &state.spatial_input(deformer, &rows)?, self.job.scene.frame_count)?;
        state.smooth = measured > train.flicker_threshold;
        if state.smooth {
            let message = format!("flicker {measured:.3} is over train.flicker_threshold {}: smoothness switched on", train.flicker_threshold);
            self.job.events.emit(&Event::Warning { object: "smoothness".into(), message });
        }
        Ok(())
    }
}

/// Features of the moving Gaussians. Their centres are constants, which makes caching in playback exact; attributes of the deformer are tracked.
fn spatial_pass(deformer: &ModelDeformer, leaves: &Leaves, rows: &MovingRows) -> Result<Spatial> {
    let means_world = Tensor::<2>::from_inner(rows.select(leaves.get("means")?.clone().inner()));
    let attributes = deformer.field.attributes().iter().map(|a| Ok(rows.select(leaves.get(&a.name)?.clone()))).collect::<Result<_>>()?;
    let input = SpatialInput { means_world, attributes };
    let spatial = deformer.field.spatial(&input)?;
    Ok(Spatial { input, features: spatial.values, work: spatial.work })
}

/// The first gradient that is not finite; of Gaussians, the first of which more rows are not than is tolerated.
fn broken_gradient(state: &TrainState, of_gaussians: &[(String, Tensor<2>)], gradients: &Gradients) -> Result<Option<Trouble>> {
    if let Some(trouble) = broken_rows_of(of_gaussians)? {
        return Ok(Some(trouble));
    }
    let deformer = state.deformer.iter().flat_map(|d| d.field.parameters()).map(|p| ("deformer", p));
    let of_cameras = state.of_cameras().into_iter().flat_map(|(part, parameters)| parameters.into_iter().map(move |p| (part, p)));
    let weights = deformer.chain(of_cameras);
    // Weights that took no part in the step are not tracked.
    for (part, parameter) in weights.filter(|(_, p)| p.value.is_require_grad()) {
        if let Some(gradient) = parameter.value.grad(gradients)
            && !is_finite(&gradient, &parameter.name)?
        {
            return Ok(Some(Trouble::of(part, format!("the gradient of the weights '{}' of {part}", parameter.name))));
        }
    }
    Ok(None)
}
