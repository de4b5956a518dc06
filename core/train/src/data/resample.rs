//! Resizing images: exact area averages when shrinking, linear interpolation when growing.

use cc4dgs_core::Image8;

/// Source indices and weights of one output sample; weights sum to 1.
struct Taps {
    first: usize,
    weights: Vec<f32>,
}

fn taps(from: u32, to: u32) -> Vec<Taps> {
    let scale = f64::from(from) / f64::from(to);
    let last = from as usize - 1;
    (0..to)
        .map(|i| {
            if scale >= 1.0 {
                // Each source pixel counts by how much of it the output pixel covers.
                let (lo, hi) = (f64::from(i) * scale, f64::from(i + 1) * scale);
                let first = (lo.floor() as usize).min(last);
                let end = (hi.ceil() as usize).clamp(first + 1, from as usize);
                let raw: Vec<f64> = (first..end).map(|p| ((p + 1) as f64).min(hi) - (p as f64).max(lo)).map(|w| w.max(0.0)).collect();
                let sum: f64 = raw.iter().sum();
                Taps { first, weights: raw.iter().map(|w| (w / sum) as f32).collect() }
            } else {
                let center = ((f64::from(i) + 0.5) * scale - 0.5).clamp(0.0, last as f64);
                let first = (center.floor() as usize).min(last);
                let t = (center - first as f64) as f32;
                Taps { first, weights: if first == last { vec![1.0] } else { vec![1.0 - t, t] } }
            }
        })
        .collect()
}

/// `image` at another size. Colours are averaged as stored (gamma-coded) and weighted by alpha, so that shrinking and compositing over a
/// background commute. An 800 to 400 resize is the plain 2x2 mean.
pub fn resize(image: &Image8, width: u32, height: u32) -> Image8 {
    if (width, height) == (image.width, image.height) || width == 0 || height == 0 {
        return image.clone();
    }
    let c = image.channels as usize;
    let (columns, rows) = (taps(image.width, width), taps(image.height, height));
    let (in_row, out_row) = (image.width as usize * c, width as usize * c);
    let mut data = vec![0u8; out_row * height as usize];
    let mut line = vec![0.0f32; in_row];
    for (out, row) in data.chunks_exact_mut(out_row).zip(&rows) {
        line.fill(0.0);
        for (k, &w) in row.weights.iter().enumerate() {
            let source = &image.data[(row.first + k) * in_row..][..in_row];
            if c == 4 {
                for (l, px) in line.chunks_exact_mut(4).zip(source.chunks_exact(4)) {
                    let a = w * f32::from(px[3]);
                    for j in 0..3 {
                        l[j] += a * f32::from(px[j]) / 255.0;
                    }
                    l[3] += a;
                }
            } else {
                for (l, &v) in line.iter_mut().zip(source) {
                    *l += w * f32::from(v);
                }
            }
        }
        for (px, column) in out.chunks_exact_mut(c).zip(&columns) {
            let mut sum = [0.0f32; 4];
            for (k, &w) in column.weights.iter().enumerate() {
                for (s, v) in sum.iter_mut().zip(&line[(column.first + k) * c..][..c]) {
                    *s += w * v;
                }
            }
            if c == 4 && sum[3] > 0.0 {
                for j in 0..3 {
                    sum[j] *= 255.0 / sum[3];
                }
            }
            for (p, s) in px.iter_mut().zip(sum) {
                *p = (s + 0.5).clamp(0.0, 255.0) as u8;
            }
        }
    }
    Image8 { width, height, channels: image.channels, data }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gray(width: u32, height: u32, f: impl Fn(u32, u32) -> u8) -> Image8 {
        let data = (0..height).flat_map(|y| (0..width).map(move |x| (x, y))).flat_map(|(x, y)| [f(x, y); 3]).collect();
        Image8 { width, height, channels: 3, data }
    }

    #[test]
    fn halving_is_the_mean_of_four() {
        let out = resize(&gray(4, 4, |x, y| (16 * y + 3 * x) as u8), 2, 2);
        let mean = |x: u32, y: u32| {
            let s: u32 = [(0, 0), (1, 0), (0, 1), (1, 1)].iter().map(|(i, j)| 16 * (2 * y + j) + 3 * (2 * x + i)).sum();
            (f64::from(s) / 4.0 + 0.5) as u8
        };
        assert_eq!(out.data.iter().step_by(3).copied().collect::<Vec<_>>(), vec![mean(0, 0), mean(1, 0), mean(0, 1), mean(1, 1)]);
    }

    #[test]
    fn flat_images_stay_flat_at_any_size() {
        for (w, h) in [(1, 1), (3, 5), (7, 2), (20, 31)] {
            assert!(resize(&gray(10, 9, |_, _| 77), w, h).data.iter().all(|&v| v == 77), "{w}x{h}");
        }
    }

    #[test]
    fn transparent_pixels_lend_no_colour() {
        let image = Image8 { width: 2, height: 1, channels: 4, data: vec![200, 100, 50, 255, 0, 255, 0, 0] };
        assert_eq!(resize(&image, 1, 1).data, vec![200, 100, 50, 128]);
    }
}
