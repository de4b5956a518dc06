//! Error maps.

use cc4dgs_core::{Error, Image8, Result};

/// Black, violet, red, orange, pale yellow: lightness rises steadily, so the map also reads in grey.
const STOPS: [[f32; 3]; 5] = [[0.0, 0.0, 4.0], [87.0, 16.0, 110.0], [188.0, 55.0, 84.0], [249.0, 142.0, 9.0], [252.0, 255.0, 200.0]];

/// The colour of `value` in 0..1; what lies outside takes the nearer end.
pub fn heat_color(value: f32) -> [u8; 3] {
    let position = value.clamp(0.0, 1.0) * (STOPS.len() - 1) as f32;
    // A value that is not a number casts to 0 and is drawn black.
    let segment = (position as usize).min(STOPS.len() - 2);
    let t = position - segment as f32;
    std::array::from_fn(|c| (STOPS[segment][c] + t * (STOPS[segment + 1][c] - STOPS[segment][c]) + 0.5) as u8)
}

/// The mean absolute difference over the three colours of each pixel, as a heat map in which `full_scale` (in 0..1) is the brightest colour.
pub fn error_map(reference: &Image8, render: &Image8, full_scale: f32) -> Result<Image8> {
    let size = |i: &Image8| (i.width, i.height);
    if size(reference) != size(render) {
        let problem = format!("an image of {:?} pixels against one of {:?}", size(reference), size(render));
        return Err(Error::parameter("error map", problem, "Compare images of one size"));
    }
    if full_scale.is_nan() || full_scale <= 0.0 {
        return Err(Error::parameter("error map", format!("full scale {full_scale} is not positive"), "Give a difference in 0..1, such as 0.2"));
    }
    let pixels = |i: &Image8| -> Vec<[u8; 3]> { i.data.chunks_exact(i.channels as usize).map(|p| [p[0], p[1], p[2]]).collect() };
    let data = pixels(reference)
        .iter()
        .zip(&pixels(render))
        .flat_map(|(a, b)| {
            let sum: u32 = a.iter().zip(b).map(|(x, y)| u32::from(x.abs_diff(*y))).sum();
            heat_color(sum as f32 / (3.0 * 255.0 * full_scale))
        })
        .collect();
    Ok(Image8 { width: reference.width, height: reference.height, channels: 3, data })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_scale_runs_from_the_first_to_the_last_stop() {
        assert_eq!((heat_color(-1.0), heat_color(0.0)), ([0, 0, 4], [0, 0, 4]));
        assert_eq!((heat_color(1.0), heat_color(f32::INFINITY)), ([252, 255, 200], [252, 255, 200]));
        assert_eq!(heat_color(0.5), [188, 55, 84]);
        let lightness = |v: f32| heat_color(v).iter().map(|&c| u32::from(c)).sum::<u32>();
        assert!((0..100).all(|i| lightness(i as f32 / 100.0) <= lightness((i + 1) as f32 / 100.0)));
    }

    #[test]
    fn differences_are_means_over_colours() {
        let a = Image8 { width: 2, height: 1, channels: 3, data: vec![10, 20, 30, 0, 0, 0] };
        let b = Image8 { width: 2, height: 1, channels: 4, data: vec![10, 20, 30, 255, 153, 0, 0, 255] };
        let map = error_map(&a, &b, 0.4).unwrap();
        assert_eq!(map.data[..3], heat_color(0.0));
        assert_eq!(map.data[3..], heat_color(0.5));
        assert!(error_map(&a, &Image8 { width: 1, height: 2, ..a.clone() }, 0.4).is_err());
        assert!(error_map(&a, &a, f32::NAN).is_err());
    }
}
