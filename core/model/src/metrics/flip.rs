//! FLIP for images of low dynamic range, after the formulas of Andersson, Nilsson, Akenine-Möller, Oskarsson, Åström and Fairchild, "FLIP: A Difference
//! Evaluator for Alternating Images" (2020): how visible a difference is to an observer who flips between the two images, from 0 (none) to 1.
//!
//! A colour branch filters both images with the contrast sensitivity of the eye and compares them in CIELab. A feature branch compares edges and points
//! of the luminance. The second raises the first to a power. Both depend on how many pixels the eye sees per degree.

use super::Planes;
use crate::{Error, Result};
use rayon::prelude::*;
use std::f64::consts::PI;

/// Pixels per degree of the paper's viewing condition: a display of 3,840 pixels and 0.7 m width, seen from 0.7 m.
pub const FLIP_PIXELS_PER_DEGREE: f64 = 3840.0 * PI / 180.0;

/// Contrast sensitivity of the achromatic, red-green and blue-yellow channel: pairs (a, b) of the sum of a sqrt(pi/b) exp(-pi^2 x^2 / b), x in degrees.
const SENSITIVITY: [&[(f64, f64)]; 3] = [&[(1.0, 0.0047)], &[(1.0, 0.0053)], &[(34.1, 0.04), (13.5, 0.025)]];
/// The largest b of [`SENSITIVITY`]: it decides the radius of all three filters.
const WIDEST: f64 = 0.04;
/// Width of a feature in degrees.
const FEATURE_WIDTH: f64 = 0.082;
/// Exponent of colour differences.
const COLOUR_EXPONENT: f64 = 0.7;
/// Exponent of feature differences.
const FEATURE_EXPONENT: f64 = 0.5;
/// Colour differences below this share of the largest one ...
const KNEE_AT: f64 = 0.4;
/// ... are spread over this share of 0..1.
const KNEE_TO: f64 = 0.95;

/// The mean of [`flip_map`].
///
/// # Errors
/// As [`flip_map`].
pub fn flip(reference: &Planes, render: &Planes, pixels_per_degree: f64) -> Result<f64> {
    let map = flip_map(reference, render, pixels_per_degree)?;
    let rows: Vec<f64> = map.par_chunks(reference.width()).map(|row| row.iter().sum()).collect();
    Ok(rows.iter().sum::<f64>() / map.len() as f64)
}

/// The visible difference of every pixel `[H,W]` in 0..1, of two sRGB images in 0..1.
///
/// # Errors
/// [`Error::Parameter`] for different shapes, other than three channels, or pixels per degree outside 1..1000.
pub fn flip_map(reference: &Planes, render: &Planes, pixels_per_degree: f64) -> Result<Vec<f64>> {
    reference.check_pair(render, None)?;
    if reference.channels() != 3 {
        return Err(Error::parameter("FLIP", format!("images of {} channels", reference.channels()), "Pass red, green and blue"));
    }
    if !(1.0..=1000.0).contains(&pixels_per_degree) {
        return Err(Error::parameter("FLIP", format!("{pixels_per_degree} pixels per degree"), "Choose a number from 1 to 1000; the usual one is 67"));
    }
    let (a, b) = (Seen::of(reference, pixels_per_degree), Seen::of(render, pixels_per_degree));
    let largest = hyab(hunt(lab([0.0, 1.0, 0.0])), hunt(lab([0.0, 0.0, 1.0]))).powf(COLOUR_EXPONENT);
    let difference = |i: usize| {
        let colour = spread(hyab(a.colours[i], b.colours[i]).powf(COLOUR_EXPONENT), largest);
        let feature = (a.edges[i] - b.edges[i]).abs().max((a.points[i] - b.points[i]).abs());
        colour.powf(1.0 - (feature * std::f64::consts::FRAC_1_SQRT_2).min(1.0).powf(FEATURE_EXPONENT))
    };
    Ok((0..a.colours.len()).into_par_iter().map(difference).collect())
}

/// An image as the eye sees it, per pixel.
struct Seen {
    /// Filtered colours in CIELab, chroma scaled by lightness (the Hunt effect).
    colours: Vec<[f64; 3]>,
    /// Strength of edges.
    edges: Vec<f64>,
    /// Strength of points and lines.
    points: Vec<f64>,
}

impl Seen {
    fn of(image: &Planes, pixels_per_degree: f64) -> Self {
        let width = image.width();
        let xyz: Vec<[f64; 3]> =
            (0..width * image.height()).into_par_iter().map(|i| to_xyz([0, 1, 2].map(|c| linear(image.plane(c)[i].clamp(0.0, 1.0))))).collect();
        // Relative to white, X and Z against Y: the linearised opponent colours of the filters. Scale and offset of the paper's YCxCz cancel in linear filters.
        let white = to_xyz([1.0; 3]);
        let opponent = |f: fn([f64; 3]) -> f64| xyz.par_iter().map(|v| f([0, 1, 2].map(|c| v[c] / white[c]))).collect::<Vec<f64>>();
        let channels = [opponent(|v| v[1]), opponent(|v| v[0] - v[1]), opponent(|v| v[1] - v[2])];
        let filtered: Vec<Vec<f64>> =
            channels.iter().zip(SENSITIVITY).map(|(plane, gaussians)| sensitivity(plane, width, gaussians, pixels_per_degree)).collect();
        let colours = (0..xyz.len())
            .into_par_iter()
            .map(|i| {
                let (y, cx, cz) = (filtered[0][i], filtered[1][i], filtered[2][i]);
                // What the filters made impossible is clamped to colours of the display.
                let rgb = to_rgb([(y + cx) * white[0], y * white[1], (y - cz) * white[2]]).map(|v| v.clamp(0.0, 1.0));
                hunt(lab(rgb))
            })
            .collect();
        let (edges, points) = features(&channels[0], width, pixels_per_degree);
        Self { colours, edges, points }
    }
}

/// The sum of Gaussians `a sqrt(pi/b) exp(-pi^2 r^2 / b)` over the distance r, as one filter of sum 1.
fn sensitivity(plane: &[f64], width: usize, gaussians: &[(f64, f64)], pixels_per_degree: f64) -> Vec<f64> {
    let radius = (3.0 * (WIDEST / (2.0 * PI * PI)).sqrt() * pixels_per_degree).ceil() as usize;
    let filters: Vec<(f64, Vec<f64>)> = gaussians
        .iter()
        .map(|(a, b)| {
            let taps = taps(radius, |x| (-PI * PI * (x / pixels_per_degree).powi(2) / b).exp());
            let sum: f64 = taps.iter().sum();
            (a * (PI / b).sqrt() * sum * sum, taps.iter().map(|t| t / sum).collect())
        })
        .collect();
    let total: f64 = filters.iter().map(|(weight, _)| weight).sum();
    let mut out = vec![0.0; plane.len()];
    for (weight, taps) in filters {
        let blurred = columns(&rows(plane, width, &taps), width, &taps);
        out.iter_mut().zip(&blurred).for_each(|(o, v)| *o += weight / total * v);
    }
    out
}

/// Magnitudes of the first (edges) and second (points) derivative of the luminance, taken with Gaussian derivatives whose positive and whose negative
/// weights sum to 1 each.
fn features(luminance: &[f64], width: usize, pixels_per_degree: f64) -> (Vec<f64>, Vec<f64>) {
    let sigma = 0.5 * FEATURE_WIDTH * pixels_per_degree;
    let radius = (3.0 * sigma).ceil() as usize;
    let gaussian = |x: f64| (-x * x / (2.0 * sigma * sigma)).exp();
    let smooth = balanced(taps(radius, gaussian));
    let magnitude = |derivative: Vec<f64>| -> Vec<f64> {
        let derivative = balanced(derivative);
        let x = columns(&rows(luminance, width, &derivative), width, &smooth);
        let y = columns(&rows(luminance, width, &smooth), width, &derivative);
        x.par_iter().zip(&y).map(|(x, y)| x.hypot(*y)).collect()
    };
    (magnitude(taps(radius, |x| -x * gaussian(x))), magnitude(taps(radius, |x| (x * x / (sigma * sigma) - 1.0) * gaussian(x))))
}

fn taps(radius: usize, value: impl Fn(f64) -> f64) -> Vec<f64> {
    (0..=2 * radius).map(|i| value(i as f64 - radius as f64)).collect()
}

/// Divides positive weights by their sum, and negative ones by the absolute value of theirs.
fn balanced(taps: Vec<f64>) -> Vec<f64> {
    let positive: f64 = taps.iter().filter(|t| **t > 0.0).sum();
    let negative: f64 = -taps.iter().filter(|t| **t < 0.0).sum::<f64>();
    taps.into_iter()
        .map(|t| {
            if t > 0.0 {
                t / positive
            } else if t < 0.0 {
                t / negative
            } else {
                0.0
            }
        })
        .collect()
}

/// Filters along rows; beyond the border the nearest pixel continues.
fn rows(plane: &[f64], width: usize, taps: &[f64]) -> Vec<f64> {
    let radius = taps.len() / 2;
    let mut out = vec![0.0; plane.len()];
    out.par_chunks_mut(width).zip(plane.par_chunks(width)).for_each(|(out, row)| {
        let mut padded = vec![row[0]; radius];
        padded.extend_from_slice(row);
        padded.resize(width + 2 * radius, row[width - 1]);
        for (k, tap) in taps.iter().enumerate() {
            out.iter_mut().zip(&padded[k..]).for_each(|(o, v)| *o += tap * v);
        }
    });
    out
}

/// The same along columns.
fn columns(plane: &[f64], width: usize, taps: &[f64]) -> Vec<f64> {
    let (radius, height) = (taps.len() / 2, plane.len() / width);
    let mut out = vec![0.0; plane.len()];
    out.par_chunks_mut(width).enumerate().for_each(|(y, out)| {
        for (k, tap) in taps.iter().enumerate() {
            let from = (y + k).saturating_sub(radius).min(height - 1);
            out.iter_mut().zip(&plane[from * width..(from + 1) * width]).for_each(|(o, v)| *o += tap * v);
        }
    });
    out
}

/// Linear light of an sRGB value (IEC 61966-2-1).
fn linear(v: f64) -> f64 {
    if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
}

/// Chromaticities (x, y) of red, green and blue of sRGB.
const PRIMARIES: [(f64, f64); 3] = [(0.64, 0.33), (0.30, 0.60), (0.15, 0.06)];
/// Chromaticity of D65.
const WHITE: (f64, f64) = (0.31271, 0.32902);

/// Linear sRGB to XYZ, rows first: the columns are the primaries, scaled so that their sum is the white of luminance 1.
fn rgb_to_xyz() -> &'static glam::DMat3 {
    static MATRIX: std::sync::OnceLock<glam::DMat3> = std::sync::OnceLock::new();
    MATRIX.get_or_init(|| {
        let xyz = |(x, y): (f64, f64)| glam::DVec3::new(x / y, 1.0, (1.0 - x - y) / y);
        let [r, g, b] = PRIMARIES.map(xyz);
        let primaries = glam::DMat3::from_cols(r, g, b);
        primaries * glam::DMat3::from_diagonal(primaries.inverse() * xyz(WHITE))
    })
}

fn to_xyz(rgb: [f64; 3]) -> [f64; 3] {
    (*rgb_to_xyz() * glam::DVec3::from_array(rgb)).to_array()
}

fn to_rgb(xyz: [f64; 3]) -> [f64; 3] {
    static INVERSE: std::sync::OnceLock<glam::DMat3> = std::sync::OnceLock::new();
    (*INVERSE.get_or_init(|| rgb_to_xyz().inverse()) * glam::DVec3::from_array(xyz)).to_array()
}

/// CIELab of linear sRGB.
fn lab(rgb: [f64; 3]) -> [f64; 3] {
    const DELTA: f64 = 6.0 / 29.0;
    let root = |v: f64| if v > DELTA * DELTA * DELTA { v.cbrt() } else { v / (3.0 * DELTA * DELTA) + 4.0 / 29.0 };
    let (xyz, white) = (to_xyz(rgb), to_xyz([1.0; 3]));
    let [x, y, z] = [0, 1, 2].map(|c| root(xyz[c] / white[c]));
    [116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)]
}

/// Chroma grows with lightness.
fn hunt([l, a, b]: [f64; 3]) -> [f64; 3] {
    [l, 0.01 * l * a, 0.01 * l * b]
}

/// The distance of Abasi et al. for large colour differences: city block between lightness and chroma, Euclidean within chroma.
fn hyab(p: [f64; 3], q: [f64; 3]) -> f64 {
    (p[0] - q[0]).abs() + (p[1] - q[1]).hypot(p[2] - q[2])
}

/// Maps colour differences to 0..1, the small ones to most of it.
fn spread(difference: f64, largest: f64) -> f64 {
    let knee = KNEE_AT * largest;
    if difference < knee { KNEE_TO * difference / knee } else { KNEE_TO + (difference - knee) / (largest - knee) * (1.0 - KNEE_TO) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flat(rgb: [f64; 3], width: usize, height: usize) -> Planes {
        Planes::new(rgb.iter().flat_map(|v| vec![*v; width * height]).collect(), 3, height, width).unwrap()
    }

    fn texture(shift: f64) -> Planes {
        let (width, height) = (33, 21);
        let value = |i: usize| {
            let (c, y, x) = (i / (width * height), i / width % height, i % width);
            0.5 + 0.3 * (0.5 * (x as f64 + shift) + 0.2 * y as f64 + c as f64).sin()
        };
        Planes::new((0..3 * width * height).map(value).collect(), 3, height, width).unwrap()
    }

    #[test]
    fn known_values() {
        let ppd = FLIP_PIXELS_PER_DEGREE;
        assert_eq!(flip(&texture(0.0), &texture(0.0), ppd).unwrap(), 0.0);
        // Green against blue is the largest difference by definition. Rounding may leave it a little below.
        assert!((flip(&flat([0.0, 1.0, 0.0], 9, 7), &flat([0.0, 0.0, 1.0], 9, 7), ppd).unwrap() - 1.0).abs() < 1e-9);
        // Black against white differs by 100 in lightness alone: 100^0.7 on the upper part of the curve, whose end is 308^0.7.
        let black_white = flip(&flat([0.0; 3], 9, 7), &flat([1.0; 3], 9, 7), ppd).unwrap();
        assert!((black_white - 0.968_9).abs() < 2e-3, "{black_white}");
    }

    #[test]
    fn it_is_symmetric_and_grows_with_the_difference() {
        let score = |shift: f64| flip(&texture(0.0), &texture(shift), 67.0).unwrap();
        assert!((score(0.4) - flip(&texture(0.4), &texture(0.0), 67.0).unwrap()).abs() < 1e-12);
        assert!(0.0 < score(0.1) && score(0.1) < score(0.4) && score(0.4) < score(1.5) && score(1.5) < 1.0);
        // The nearer the eye, the more of a fine difference it sees.
        let fine = |ppd: f64| {
            let stripes = Planes::new((0..3 * 40 * 40).map(|i| f64::from((i % 40 % 2) as u8)).collect(), 3, 40, 40).unwrap();
            flip(&stripes, &flat([0.5; 3], 40, 40), ppd).unwrap()
        };
        assert!(fine(20.0) > fine(120.0));
    }

    #[test]
    fn separable_filters_equal_the_two_dimensional_ones() {
        let (width, height, ppd) = (13usize, 11usize, 30.0);
        let plane: Vec<f64> = (0..width * height).map(|i| ((i * i % 97) as f64 / 97.0).sqrt()).collect();
        let got = sensitivity(&plane, width, SENSITIVITY[2], ppd);
        let radius = (3.0 * (WIDEST / (2.0 * PI * PI)).sqrt() * ppd).ceil() as isize;
        let kernel = |x: isize, y: isize| -> f64 {
            let r2 = ((x * x + y * y) as f64) / (ppd * ppd);
            SENSITIVITY[2].iter().map(|(a, b)| a * (PI / b).sqrt() * (-PI * PI * r2 / b).exp()).sum()
        };
        let window: Vec<(isize, isize)> = (-radius..=radius).flat_map(|y| (-radius..=radius).map(move |x| (x, y))).collect();
        let total: f64 = window.iter().map(|(x, y)| kernel(*x, *y)).sum();
        for (i, got) in got.iter().enumerate() {
            let (px, py) = ((i % width) as isize, (i / width) as isize);
            let at = |x: isize, y: isize| plane[y.clamp(0, height as isize - 1) as usize * width + x.clamp(0, width as isize - 1) as usize];
            let expected: f64 = window.iter().map(|(x, y)| kernel(*x, *y) * at(px + x, py + y)).sum::<f64>() / total;
            assert!((got - expected).abs() < 1e-12, "pixel {i}: {got} instead of {expected}");
        }
    }

    #[test]
    fn what_it_cannot_compare_is_refused() {
        let grey = Planes::new(vec![0.5; 12], 1, 3, 4).unwrap();
        assert!(flip(&grey, &grey, 67.0).is_err());
        assert!(flip(&texture(0.0), &flat([0.0; 3], 3, 3), 67.0).is_err());
        for bad in [0.0, f64::NAN, 1e9] {
            assert!(flip(&texture(0.0), &texture(0.0), bad).is_err(), "{bad}");
        }
        assert_eq!(flip(&flat([0.2; 3], 1, 1), &flat([0.2; 3], 1, 1), 67.0).unwrap(), 0.0);
    }

    /// Scores of the published evaluator on the golden images: `tests/fixtures/golden/perceptual.json`, made by `benches/perceptual_reference.py`.
    #[test]
    fn golden_flip() {
        let (mut compared, mut worst) = (0, 0.0f64);
        crate::metrics::golden::pairs(|name, a, b, expected| {
            for (key, ppd) in [("flip_67", 67.0), ("flip_20", 20.0)] {
                let (got, expected) = (flip(a, b, ppd).unwrap(), expected[key].as_f64().unwrap());
                assert!((got - expected).abs() < 1e-4, "{name}, {ppd} pixels per degree: {got} instead of {expected}");
                (compared, worst) = (compared + 1, worst.max((got - expected).abs()));
            }
        });
        eprintln!("{compared} scores, off by at most {worst:.1e}");
        assert!(compared >= 30, "only {compared} scores were compared");
    }
}
