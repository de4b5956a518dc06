//! Training of the autoencoder on the Gaussians it encodes: minibatches, hand-written gradients, Adam.
//!
//! A batch is split into shards of fixed size. Each has its own gradient, and the gradients are added in order, so the result is the same for
//! any number of threads.

use super::network::{HALF, decoder, encoder};
use super::principal::{eigen, linear_half};
use super::profile::Settings;
use super::shard::{Data, Net, SHARD, Shard, backward, forward, half};
use cc4dgs_format::{Event, EventSink, Seed};
use rand::seq::SliceRandom;
use rayon::prelude::*;

/// Target and least number of steps; the batch size follows from them and the number of samples.
const STEPS_WANTED: usize = 1500;
const STEPS_LEAST: usize = 400;
const BATCH_LEAST: usize = 128;
const BATCH_MOST: usize = 8192;
/// Adam (Kingma and Ba 2015), learning rate with linear warm-up and cosine decay.
const RATE: f64 = 1e-3;
const WARM_UP: f64 = 0.05;
const BETA: (f32, f32) = (0.9, 0.999);
const EPSILON: f32 = 1e-8;
/// Gaussians used for the principal components.
const COVARIANCE_ROWS: usize = 100_000;

/// Trains on `data` (not empty) and returns the flat parameters of encoder and decoder. `bits` is the width of the latents: training adds
/// the noise of their quantisation.
pub(super) fn train(data: &Data, bits: u8, settings: &Settings, seed: Seed, events: &dyn EventSink) -> (Vec<f32>, Vec<f32>) {
    let net = Net::new(data.width);
    let n = data.len();
    let samples = settings.epochs.saturating_mul(n).min(usize::try_from(settings.sample_budget).unwrap_or(usize::MAX));
    let batch = (samples / STEPS_WANTED).clamp(BATCH_LEAST, BATCH_MOST);
    let steps = samples.div_ceil(batch).max(STEPS_LEAST);
    let mut parameters = principal_start(data, &net, seed.child("start"));
    let start = parameters.clone();
    let mut moments = vec![(0.0f32, 0.0f32); net.len()];
    let mut shards: Vec<Shard> = (0..batch.div_ceil(SHARD)).map(|_| Shard::default()).collect();
    let mut order = Order { rows: (0..n as u32).collect(), next: n, epoch: 0, seed: seed.child("order") };
    let mut latent_steps = vec![0.0f32; net.latents];
    let noise = seed.child("noise");
    for step in 0..steps {
        let mut left = batch;
        for shard in &mut shards {
            order.take(left.min(SHARD), &mut shard.rows);
            left -= shard.rows.len();
        }
        shards.par_iter_mut().enumerate().for_each(|(s, shard)| {
            let jitter = Some((noise.index(step as u64).index(s as u64), latent_steps.as_slice()));
            forward(&net, &parameters, data, shard, jitter);
            backward(&net, &parameters, data, shard, batch);
        });
        let progress = step as f64 / steps as f64;
        let decay = 0.5 * (1.0 + (std::f64::consts::PI * progress).cos());
        let rate = RATE * decay * ((step + 1) as f64 / (WARM_UP * steps as f64)).min(1.0);
        adam(&mut parameters, &mut moments, &shards, step, rate);
        for (j, latent_step) in latent_steps.iter_mut().enumerate() {
            let low = shards.iter().map(|s| s.latent_low[j]).fold(f32::INFINITY, f32::min);
            let high = shards.iter().map(|s| s.latent_high[j]).fold(f32::NEG_INFINITY, f32::max);
            *latent_step = (high - low) / ((1u32 << bits) - 1) as f32;
        }
        if step % 100 == 0 || step + 1 == steps {
            events.emit(&Event::Progress { task: "cca autoencoder".into(), done: step as u64 + 1, total: steps as u64 });
        }
    }
    // If training did not improve the network, keep the initial one; NaN counts as worse.
    let improved = total_loss(&net, &parameters, data) < total_loss(&net, &start, data);
    if !improved {
        parameters = start;
    }
    let decoder = parameters.split_off(net.encoder_len);
    (parameters, decoder)
}

/// The latents `[N, latents]` of all Gaussians.
pub(super) fn encode_all(data: &Data, encoder: &[f32]) -> Vec<f32> {
    let net = Net::new(data.width);
    let mut out = vec![0.0; data.len() * net.latents];
    out.par_chunks_mut(SHARD * net.latents).enumerate().for_each_init(Shard::default, |shard, (s, out)| {
        let rows = out.len() / net.latents;
        shard.rows = ((s * SHARD) as u32..(s * SHARD + rows) as u32).collect();
        half(&net.layers[..HALF], encoder, data, shard);
        out.copy_from_slice(&shard.out);
    });
    out
}

/// Random orders of the Gaussians, a new one per epoch.
struct Order {
    rows: Vec<u32>,
    next: usize,
    epoch: u64,
    seed: Seed,
}

impl Order {
    fn take(&mut self, count: usize, into: &mut Vec<u32>) {
        into.clear();
        while into.len() < count {
            if self.next == self.rows.len() {
                self.rows.shuffle(&mut self.seed.index(self.epoch).rng());
                (self.next, self.epoch) = (0, self.epoch + 1);
            }
            let some = (count - into.len()).min(self.rows.len() - self.next);
            into.extend(&self.rows[self.next..self.next + some]);
            self.next += some;
        }
    }
}

/// The best linear autoencoder of the weighted coefficients, as parameters of the network.
fn principal_start(data: &Data, net: &Net, seed: Seed) -> Vec<f32> {
    let (c, latents) = (data.width, net.latents);
    let root: Vec<f64> = data.column_weights.iter().map(|&w| f64::from(w).sqrt()).collect();
    let stride = data.len().div_ceil(COVARIANCE_ROWS);
    let rows: Vec<usize> = (0..data.len()).step_by(stride).collect();
    let partial: Vec<Vec<f64>> = rows
        .par_chunks(4096)
        .map(|rows| {
            let mut sum = vec![0.0; c * c];
            for &i in rows {
                let w = f64::from(data.row_weights[i]);
                let row: Vec<f64> = data.targets[i * c..(i + 1) * c].iter().zip(&root).map(|(&t, r)| f64::from(t) * r).collect();
                for (x, sums) in row.iter().zip(sum.chunks_exact_mut(c)) {
                    sums.iter_mut().zip(&row).for_each(|(s, y)| *s += w * x * y);
                }
            }
            sum
        })
        .collect();
    let mut covariance = vec![0.0; c * c];
    partial.iter().for_each(|p| covariance.iter_mut().zip(p).for_each(|(a, b)| *a += b));
    covariance.iter_mut().for_each(|v| *v /= rows.len() as f64);
    let (values, vectors) = eigen(covariance, c);
    let (mut into, mut out) = (vec![0.0f32; c * latents], vec![0.0f32; latents * c]);
    for j in 0..latents {
        let deviation = values[j].max(0.0).sqrt();
        // Directions without variance contain only rounding noise.
        if deviation > 1e-5 * values[0].max(0.0).sqrt() {
            for k in 0..c {
                let v = vectors[j * c + k];
                into[k * latents + j] = (v * root[k] / deviation) as f32;
                out[j * c + k] = if root[k] > 0.0 { (v * deviation / root[k]) as f32 } else { 0.0 };
            }
        }
    }
    let mut identity = vec![0.0f32; latents * latents];
    (0..latents).for_each(|j| identity[j * latents + j] = 1.0);
    let mut parameters = vec![0.0f32; net.len()];
    linear_half(&mut parameters[..net.encoder_len], &encoder(c), latents, &into, &identity, seed.child("encoder"));
    linear_half(&mut parameters[net.encoder_len..], &decoder(c), latents, &identity, &out, seed.child("decoder"));
    parameters
}

fn adam(parameters: &mut [f32], moments: &mut [(f32, f32)], shards: &[Shard], step: usize, rate: f64) {
    let t = (step + 1).min(i32::MAX as usize) as i32;
    let (c1, c2) = (1.0 - f64::from(BETA.0).powi(t), 1.0 - f64::from(BETA.1).powi(t));
    let (rate, c2) = ((rate / c1) as f32, (1.0 / c2) as f32);
    for (i, (p, (m, v))) in parameters.iter_mut().zip(moments).enumerate() {
        let g: f32 = shards.iter().map(|s| s.gradient[i]).sum();
        *m = BETA.0 * *m + (1.0 - BETA.0) * g;
        *v = BETA.1 * *v + (1.0 - BETA.1) * g * g;
        *p -= rate * *m / ((*v * c2).sqrt() + EPSILON);
    }
}

fn total_loss(net: &Net, parameters: &[f32], data: &Data) -> f64 {
    let starts: Vec<usize> = (0..data.len()).step_by(SHARD).collect();
    let losses: Vec<f64> = starts
        .par_iter()
        .map_init(Shard::default, |shard, &start| {
            shard.rows = (start as u32..(start + SHARD).min(data.len()) as u32).collect();
            forward(net, parameters, data, shard, None);
            shard.loss
        })
        .collect();
    losses.iter().sum()
}

#[cfg(test)]
mod tests {
    use super::super::geometry::CONDITIONS;
    use super::*;
    use cc4dgs_format::Silent;
    use rand::Rng;

    fn toy(n: usize, width: usize) -> (Vec<f32>, Vec<[f32; CONDITIONS]>) {
        let mut rng = Seed::root(5).rng();
        let conditions: Vec<[f32; CONDITIONS]> = (0..n).map(|_| std::array::from_fn(|_| rng.random_range(-1.0..1.0))).collect();
        // Half of the coefficients follow from the conditions by a curve, the rest is noise.
        let targets = (0..n * width)
            .map(|i| if i % 2 == 0 { (3.0 * conditions[i / width][i % width % CONDITIONS]).sin() } else { rng.random_range(-1.0..1.0) })
            .collect();
        (targets, conditions)
    }

    #[test]
    fn gradients_agree_with_finite_differences() {
        let width = 9;
        let (targets, conditions) = toy(20, width);
        let weights = vec![1.3; 20];
        let columns: Vec<f32> = (0..width).map(|c| 0.5 + 0.1 * c as f32).collect();
        let data = Data { width, targets: &targets, conditions: &conditions, row_weights: &weights, column_weights: &columns };
        let net = Net::new(width);
        let mut parameters = principal_start(&data, &net, Seed::root(1));
        let mut rng = Seed::root(2).rng();
        parameters.iter_mut().for_each(|p| *p += rng.random_range(-0.1..0.1));
        let mut shard = Shard::default();
        shard.rows.extend(0..20);
        forward(&net, &parameters, &data, &mut shard, None);
        backward(&net, &parameters, &data, &mut shard, 20);
        let mean = 1.0 / (20 * width) as f64;
        for layer in &net.layers {
            for at in [layer.at, layer.at + layer.inputs * layer.outputs / 2, layer.bias_at() + 1] {
                let h = 2e-3;
                let mut loss = |by: f32| {
                    let mut moved = parameters.clone();
                    moved[at] += by;
                    forward(&net, &moved, &data, &mut shard, None);
                    shard.loss * mean
                };
                let slope = (loss(h) - loss(-h)) / (2.0 * f64::from(h));
                let g = f64::from(shard.gradient[at]);
                assert!((g - slope).abs() < 2e-2 * slope.abs() + 2e-5, "parameter {at}: {g} against {slope}");
            }
        }
    }

    #[test]
    fn training_beats_principal_components_for_any_thread_count() {
        let width = 9;
        let (targets, conditions) = toy(600, width);
        let data = Data { width, targets: &targets, conditions: &conditions, row_weights: &[1.0; 600], column_weights: &[1.0; 9] };
        let settings = Settings { epochs: 100, ..Default::default() };
        let run = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| train(&data, 14, &settings, Seed::root(9), &Silent))
        };
        let (one, three) = (run(1), run(3));
        assert!(one == three, "the weights depend on the number of threads");
        let net = Net::new(width);
        let start = total_loss(&net, &principal_start(&data, &net, Seed::root(9).child("start")), &data);
        let trained: Vec<f32> = one.0.into_iter().chain(one.1).collect();
        let end = total_loss(&net, &trained, &data);
        assert!(end < 0.6 * start, "conditions explain half of the variance: {start} to {end}");
    }
}
