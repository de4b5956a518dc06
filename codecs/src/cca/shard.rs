//! The autoencoder on one shard of Gaussians: forward pass and hand-written gradient.

use super::geometry::CONDITIONS;
use super::network::{HALF, Layer, decoder, encoder, gelu_with_slopes, latents};
use cc4dgs_format::Seed;
#[cfg(not(target_arch = "wasm32"))]
use gemm::Parallelism;
use rand::Rng;

/// Gaussians per shard.
pub(super) const SHARD: usize = 256;

/// Training data.
pub(super) struct Data<'a> {
    /// Coefficients per Gaussian.
    pub(super) width: usize,
    /// Normalised coefficients `[N,width]`.
    pub(super) targets: &'a [f32],
    /// Conditions `[N]`.
    pub(super) conditions: &'a [[f32; CONDITIONS]],
    /// Weight of each Gaussian `[N]`.
    pub(super) row_weights: &'a [f32],
    /// Weight of an error of each normalised coefficient `[width]`.
    pub(super) column_weights: &'a [f32],
}

impl Data<'_> {
    pub(super) fn len(&self) -> usize {
        self.conditions.len()
    }
}

/// All layers, whose weights lie in one flat array: encoder, then decoder.
pub(super) struct Net {
    pub(super) layers: Vec<Layer>,
    pub(super) encoder_len: usize,
    pub(super) latents: usize,
}

impl Net {
    pub(super) fn new(width: usize) -> Self {
        let encoder = encoder(width);
        let encoder_len = encoder[HALF - 1].end();
        let decoder = decoder(width).map(|l| Layer { at: l.at + encoder_len, ..l });
        Self { layers: encoder.into_iter().chain(decoder).collect(), encoder_len, latents: latents(width) }
    }
    pub(super) fn len(&self) -> usize {
        self.layers.last().map_or(0, Layer::end)
    }
}

/// One shard's activations and gradient.
#[derive(Default)]
pub(super) struct Shard {
    pub(super) rows: Vec<u32>,
    inputs: Vec<Vec<f32>>,
    slopes: Vec<Vec<f32>>,
    pub(super) out: Vec<f32>,
    delta: Vec<f32>,
    back: Vec<f32>,
    pub(super) gradient: Vec<f32>,
    pub(super) loss: f64,
    pub(super) latent_low: Vec<f32>,
    pub(super) latent_high: Vec<f32>,
}

/// Runs `layers` (one half); `shard.inputs` of the first layer must be set unless it is the encoder's, which is gathered here.
pub(super) fn half(layers: &[Layer], parameters: &[f32], data: &Data, shard: &mut Shard) {
    let rows = shard.rows.len();
    shard.inputs.resize_with(2 * HALF, Vec::new);
    shard.slopes.resize_with(2 * HALF, Vec::new);
    let first = if layers[0].inputs == data.width + CONDITIONS { 0 } else { HALF };
    if first == 0 {
        let input = &mut shard.inputs[0];
        input.clear();
        for &i in &shard.rows {
            input.extend_from_slice(&data.targets[i as usize * data.width..(i as usize + 1) * data.width]);
            input.extend_from_slice(&data.conditions[i as usize]);
        }
    }
    for (l, layer) in layers.iter().enumerate() {
        shard.out.clear();
        for _ in 0..rows {
            shard.out.extend_from_slice(&parameters[layer.bias_at()..layer.end()]);
        }
        let weights = &parameters[layer.at..layer.bias_at()];
        matmul([rows, layer.outputs, layer.inputs], (&shard.inputs[first + l], false), (weights, false), &mut shard.out, true);
        if l + 1 < HALF {
            let slopes = &mut shard.slopes[first + l];
            slopes.resize(rows * layer.outputs, 0.0);
            gelu_with_slopes(&mut shard.out, slopes);
            std::mem::swap(&mut shard.inputs[first + l + 1], &mut shard.out);
        }
    }
}

/// The whole network; `jitter` adds uniform noise of the given steps to the latents. Stores the loss and d loss / d output in `shard`.
pub(super) fn forward(net: &Net, parameters: &[f32], data: &Data, shard: &mut Shard, jitter: Option<(Seed, &[f32])>) {
    half(&net.layers[..HALF], parameters, data, shard);
    let latents = net.latents;
    shard.latent_low = vec![f32::INFINITY; latents];
    shard.latent_high = vec![f32::NEG_INFINITY; latents];
    let mut rng = jitter.map(|(seed, steps)| (seed.rng(), steps));
    let mut input = std::mem::take(&mut shard.inputs[HALF]);
    input.clear();
    for (z, &i) in shard.out.chunks_exact(latents).zip(&shard.rows) {
        for (j, &z) in z.iter().enumerate() {
            shard.latent_low[j] = shard.latent_low[j].min(z);
            shard.latent_high[j] = shard.latent_high[j].max(z);
            input.push(match &mut rng {
                Some((rng, steps)) => z + (rng.random::<f32>() - 0.5) * steps[j],
                None => z,
            });
        }
        input.extend_from_slice(&data.conditions[i as usize]);
    }
    shard.inputs[HALF] = input;
    half(&net.layers[HALF..], parameters, data, shard);
    shard.loss = 0.0;
    for (out, &i) in shard.out.chunks_exact_mut(data.width).zip(&shard.rows) {
        let (w, targets) = (data.row_weights[i as usize], &data.targets[i as usize * data.width..]);
        let mut row = 0.0f32;
        for ((o, t), c) in out.iter_mut().zip(targets).zip(data.column_weights) {
            let d = *o - t;
            row += c * d * d;
            *o = 2.0 * w * c * d;
        }
        shard.loss += f64::from(w) * f64::from(row);
    }
}

/// The gradient of the mean loss over a batch of `batch` Gaussians, after [`forward`].
pub(super) fn backward(net: &Net, parameters: &[f32], data: &Data, shard: &mut Shard, batch: usize) {
    let rows = shard.rows.len();
    shard.gradient.resize(net.len(), 0.0);
    std::mem::swap(&mut shard.delta, &mut shard.out);
    let mean = 1.0 / (batch * data.width) as f32;
    shard.delta.iter_mut().for_each(|d| *d *= mean);
    for (l, layer) in net.layers.iter().enumerate().rev() {
        let (weights, bias) = shard.gradient[layer.at..layer.end()].split_at_mut(layer.inputs * layer.outputs);
        matmul([layer.inputs, layer.outputs, rows], (&shard.inputs[l], true), (&shard.delta, false), weights, false);
        bias.fill(0.0);
        for row in shard.delta.chunks_exact(layer.outputs) {
            bias.iter_mut().zip(row).for_each(|(b, d)| *b += d);
        }
        if l == 0 {
            break;
        }
        shard.back.resize(rows * layer.inputs, 0.0);
        let weights = &parameters[layer.at..layer.bias_at()];
        matmul([rows, layer.inputs, layer.outputs], (&shard.delta, false), (weights, true), &mut shard.back, false);
        shard.delta.clear();
        if l == HALF {
            // The conditions are constants; only the latents pass a gradient on.
            shard.back.chunks_exact(layer.inputs).for_each(|row| shard.delta.extend_from_slice(&row[..net.latents]));
        } else {
            shard.delta.extend(shard.back.iter().zip(&shard.slopes[l - 1]).map(|(b, s)| b * s));
        }
    }
}

/// out `[m,n]` (+)= a `[m,k]` b `[k,n]`, all row-major; a flag is set if the array holds the transpose. Pages only decode: plain loops keep the library's
/// kernels out of what they fetch.
#[cfg(target_arch = "wasm32")]
fn matmul([m, n, k]: [usize; 3], (a, a_transposed): (&[f32], bool), (b, b_transposed): (&[f32], bool), out: &mut [f32], accumulate: bool) {
    assert!(a.len() == m * k && b.len() == k * n && out.len() == m * n, "matrix sizes");
    let a = |row: usize, column: usize| if a_transposed { a[column * m + row] } else { a[row * k + column] };
    let b = |row: usize, column: usize| if b_transposed { b[column * k + row] } else { b[row * n + column] };
    for (at, out) in out.iter_mut().enumerate() {
        let (row, column) = (at / n, at % n);
        let sum: f32 = (0..k).map(|i| a(row, i) * b(i, column)).sum();
        *out = if accumulate { *out + sum } else { sum };
    }
}

/// out `[m,n]` (+)= a `[m,k]` b `[k,n]`, all row-major; a flag is set if the array holds the transpose.
#[cfg(not(target_arch = "wasm32"))]
fn matmul([m, n, k]: [usize; 3], (a, a_transposed): (&[f32], bool), (b, b_transposed): (&[f32], bool), out: &mut [f32], accumulate: bool) {
    assert!(a.len() == m * k && b.len() == k * n && out.len() == m * n, "matrix sizes");
    let strides = |rows: usize, columns: usize, transposed: bool| if transposed { (1, rows as isize) } else { (columns as isize, 1) };
    let ((a_rs, a_cs), (b_rs, b_cs)) = (strides(m, k, a_transposed), strides(k, n, b_transposed));
    // SAFETY: the assertion above ensures that every element the strides reach lies inside its slice, and `out` is borrowed uniquely.
    unsafe {
        gemm::gemm(
            m,
            n,
            k,
            out.as_mut_ptr(),
            1,
            n as isize,
            accumulate,
            a.as_ptr(),
            a_cs,
            a_rs,
            b.as_ptr(),
            b_cs,
            b_rs,
            1.0f32,
            1.0f32,
            false,
            false,
            false,
            Parallelism::None,
        );
    }
}
