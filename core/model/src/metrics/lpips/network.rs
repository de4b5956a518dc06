//! The layers of a convolutional network that LPIPS needs: convolution as a matrix product over patches, ReLU, max pooling.

use gemm::Parallelism;
use rayon::prelude::*;

/// Feature planes `[channels, height, width]`.
#[derive(Clone, Debug, PartialEq)]
pub struct Map {
    pub channels: usize,
    pub height: usize,
    pub width: usize,
    pub values: Vec<f32>,
}

/// A convolution with square kernels.
#[derive(Clone, Debug)]
pub struct Conv {
    /// `[outputs, inputs, kernel, kernel]`.
    pub weight: Vec<f32>,
    /// `[outputs]`.
    pub bias: Vec<f32>,
    pub inputs: usize,
    pub outputs: usize,
    pub kernel: usize,
    pub stride: usize,
    pub padding: usize,
}

/// Floats of the patch matrix of one task: small enough for a cache, and for images of any size.
const PATCH_FLOATS: usize = 1 << 20;

impl Conv {
    /// Side of the output for an input of `side`; 0 where the kernel does not fit.
    pub fn output_side(&self, side: usize) -> usize {
        (side + 2 * self.padding).checked_sub(self.kernel).map_or(0, |rest| rest / self.stride + 1)
    }
    /// The convolution with zero padding, followed by ReLU.
    pub fn relu(&self, input: &Map) -> Map {
        debug_assert_eq!(input.channels, self.inputs);
        let (height, width) = (self.output_side(input.height), self.output_side(input.width));
        let depth = self.inputs * self.kernel * self.kernel;
        let rows_per_band = (PATCH_FLOATS / (depth * width).max(1)).clamp(1, height.max(1));
        let bands: Vec<Vec<f32>> = (0..height.div_ceil(rows_per_band))
            .into_par_iter()
            .map(|band| {
                let rows = band * rows_per_band..((band + 1) * rows_per_band).min(height);
                self.band(input, rows, width)
            })
            .collect();
        let mut values = vec![0.0; self.outputs * height * width];
        for (band, part) in bands.iter().enumerate() {
            let from = band * rows_per_band * width;
            let length = part.len() / self.outputs;
            for (output, line) in part.chunks_exact(length).enumerate() {
                values[output * height * width + from..][..length].copy_from_slice(line);
            }
        }
        Map { channels: self.outputs, height, width, values }
    }
    /// Output rows `rows`, as `[outputs, rows * width]`.
    fn band(&self, input: &Map, rows: std::ops::Range<usize>, width: usize) -> Vec<f32> {
        let (depth, columns) = (self.inputs * self.kernel * self.kernel, rows.len() * width);
        let mut patches = vec![0.0f32; depth * columns];
        for (k, line) in patches.chunks_exact_mut(columns).enumerate() {
            let (channel, ky, kx) = (k / (self.kernel * self.kernel), k / self.kernel % self.kernel, k % self.kernel);
            let plane = &input.values[channel * input.height * input.width..][..input.height * input.width];
            for (line, y) in line.chunks_exact_mut(width).zip(rows.clone()) {
                let Some(source) = (y * self.stride + ky).checked_sub(self.padding).filter(|y| *y < input.height) else { continue };
                let source = &plane[source * input.width..][..input.width];
                for (x, value) in line.iter_mut().enumerate() {
                    if let Some(v) = (x * self.stride + kx).checked_sub(self.padding).and_then(|x| source.get(x)) {
                        *value = *v;
                    }
                }
            }
        }
        let mut out: Vec<f32> = self.bias.iter().flat_map(|bias| std::iter::repeat_n(*bias, columns)).collect();
        assert!(self.weight.len() == self.outputs * depth && out.len() == self.outputs * columns, "a convolution whose arrays have other sizes than it says");
        // SAFETY: the three slices have the sizes that the strides below reach, and `out` is borrowed mutably. Seen column-major,
        // out^T [columns, outputs] += patches^T [columns, depth] * weight^T [depth, outputs].
        unsafe {
            gemm::gemm(
                columns,
                self.outputs,
                depth,
                out.as_mut_ptr(),
                columns as isize,
                1,
                true,
                patches.as_ptr(),
                columns as isize,
                1,
                self.weight.as_ptr(),
                depth as isize,
                1,
                1.0,
                1.0,
                false,
                false,
                false,
                Parallelism::None,
            );
        }
        out.iter_mut().for_each(|v| *v = v.max(0.0));
        out
    }
}

/// Windows of three by three pixels at every second pixel, those inside the image only. Sides below 3 give an empty map.
pub fn max_pool(input: &Map) -> Map {
    let side = |n: usize| n.checked_sub(3).map_or(0, |rest| rest / 2 + 1);
    let (height, width) = (side(input.height), side(input.width));
    let mut values = vec![0.0; input.channels * height * width];
    if !values.is_empty() {
        values.par_chunks_exact_mut(height * width).zip(input.values.par_chunks_exact(input.height * input.width)).for_each(|(out, plane)| {
            for (i, value) in out.iter_mut().enumerate() {
                let corner = 2 * (i / width) * input.width + 2 * (i % width);
                let rows = (0..3).flat_map(|dy| &plane[corner + dy * input.width..][..3]);
                *value = rows.fold(f32::NEG_INFINITY, |m, v| m.max(*v));
            }
        });
    }
    Map { channels: input.channels, height, width, values }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Numbers in -1..1 without a pattern that a wrong index would reproduce.
    fn random(name: &str, count: usize) -> Vec<f32> {
        let mut rng = crate::Seed::root(count as u64).child(name).value();
        let mut next = || {
            rng = rng.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (rng >> 40) as f32 / (1u64 << 23) as f32 - 1.0
        };
        (0..count).map(|_| next()).collect()
    }

    fn naive(conv: &Conv, input: &Map) -> Map {
        let (height, width) = (conv.output_side(input.height), conv.output_side(input.width));
        let mut values = Vec::new();
        for output in 0..conv.outputs {
            for y in 0..height {
                for x in 0..width {
                    let mut sum = f64::from(conv.bias[output]);
                    for channel in 0..conv.inputs {
                        for ky in 0..conv.kernel {
                            for kx in 0..conv.kernel {
                                let (sy, sx) =
                                    ((y * conv.stride + ky) as isize - conv.padding as isize, (x * conv.stride + kx) as isize - conv.padding as isize);
                                if (0..input.height as isize).contains(&sy) && (0..input.width as isize).contains(&sx) {
                                    let weight = conv.weight[((output * conv.inputs + channel) * conv.kernel + ky) * conv.kernel + kx];
                                    let value = input.values[(channel * input.height + sy as usize) * input.width + sx as usize];
                                    sum += f64::from(weight) * f64::from(value);
                                }
                            }
                        }
                    }
                    values.push(sum.max(0.0) as f32);
                }
            }
        }
        Map { channels: conv.outputs, height, width, values }
    }

    #[test]
    fn convolutions_equal_their_definition() {
        for (inputs, outputs, kernel, stride, padding, height, width) in
            [(3, 5, 11, 4, 2, 23, 31), (4, 6, 5, 1, 2, 7, 9), (5, 3, 3, 1, 1, 1, 4), (2, 2, 3, 2, 0, 40, 700)]
        {
            let (weight, bias) = (random("weight", outputs * inputs * kernel * kernel), random("bias", outputs));
            let conv = Conv { weight, bias, inputs, outputs, kernel, stride, padding };
            let input = Map { channels: inputs, height, width, values: random("input", inputs * height * width) };
            let (got, expected) = (conv.relu(&input), naive(&conv, &input));
            assert_eq!((got.channels, got.height, got.width), (expected.channels, expected.height, expected.width));
            assert!(expected.values.contains(&0.0) && expected.values.iter().any(|v| *v > 0.0), "ReLU has something to do");
            let worst = got.values.iter().zip(&expected.values).map(|(a, b)| (a - b).abs()).fold(0.0f32, f32::max);
            assert!(worst < 1e-4, "{inputs} to {outputs}, kernel {kernel}: off by {worst}");
        }
    }

    #[test]
    fn bands_do_not_show() {
        // 3 * 11 * 11 * 600 floats a row of patches: several bands.
        let conv = Conv { weight: random("weight", 2 * 363), bias: vec![0.1, -0.1], inputs: 3, outputs: 2, kernel: 11, stride: 4, padding: 2 };
        let input = Map { channels: 3, height: 60, width: 2400, values: random("input", 3 * 60 * 2400) };
        let (got, expected) = (conv.relu(&input), naive(&conv, &input));
        assert!(got.values.iter().zip(&expected.values).all(|(a, b)| (a - b).abs() < 1e-4));
    }

    #[test]
    fn pooling_takes_the_largest_of_nine() {
        let input = Map { channels: 2, height: 5, width: 6, values: (0..60).map(|i| ((i * 37) % 61) as f32 - 30.0).collect() };
        let out = max_pool(&input);
        assert_eq!((out.channels, out.height, out.width), (2, 2, 2));
        for (i, got) in out.values.iter().enumerate() {
            let (c, y, x) = (i / 4, 2 * (i / 2 % 2), 2 * (i % 2));
            let expected = (0..9).map(|k| input.values[c * 30 + (y + k / 3) * 6 + x + k % 3]).fold(f32::MIN, f32::max);
            assert_eq!(*got, expected);
        }
        assert!(max_pool(&Map { channels: 1, height: 2, width: 9, values: vec![0.0; 18] }).values.is_empty());
    }
}
