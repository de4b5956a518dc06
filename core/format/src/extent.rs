//! How large a model is whose file states neither cameras nor units: what a first view shows of it, and the smallest depth drawn.

use crate::HostGaussians;

/// Share of the centres along each axis that a first view shows: a few far away would make the model a dot.
const SHOWN: f64 = 0.95;
/// Standard deviations of a Gaussian of middle size that a first view shows at least: a single one is no point.
const SHOWN_SIGMAS: f32 = 3.0;
/// Largest standard deviation that counts for it: beyond, sums of squares leave float32.
const MOST_SHOWN: f32 = 1e18;
/// The near plane of models without units, as a share of half the diagonal of their shown box.
const NEAR_OF_RADIUS: f64 = 0.01;
/// Smallest near plane of a player, in units of the model: depths are sorted by their logarithm.
pub const LEAST_NEAR: f32 = 1e-6;

impl HostGaussians {
    /// Lower and upper corner of the box of most centres (95 % along each axis), along each axis no smaller than a Gaussian of middle size; zeros without any.
    pub fn shown_box(&self) -> [[f32; 3]; 2] {
        let [lower, upper] = self.central_box(SHOWN);
        let mut sizes: Vec<f32> = self.log_scales.as_chunks::<3>().0.iter().map(|s| s[0].max(s[1]).max(s[2])).collect();
        if sizes.is_empty() {
            return [lower, upper];
        }
        let middle = sizes.len() / 2;
        let size = SHOWN_SIGMAS * sizes.select_nth_unstable_by(middle, f32::total_cmp).1.exp().min(MOST_SHOWN);
        let axis = |k: usize| {
            let center = 0.5 * lower[k] + 0.5 * upper[k];
            [lower[k].min(center - size), upper[k].max(center + size)]
        };
        let [x, y, z] = [0, 1, 2].map(axis);
        [0, 1].map(|end| [x[end], y[end], z[end]])
    }
}

/// The smallest depth drawn of a model whose file does not state its units (PLY, SPZ), in units of the model. `shown` is its [`HostGaussians::shown_box`];
/// cameras around a small model are near it. The result is at most `usual`, the near plane of the rules, and `usual` itself where the box has no size.
pub fn near_without_units([lower, upper]: [[f32; 3]; 2], usual: f32) -> f32 {
    let radius = 0.5 * lower.iter().zip(upper).map(|(low, high)| (f64::from(high) - f64::from(*low)).powi(2)).sum::<f64>().sqrt();
    if radius > 0.0 { usual.min((NEAR_OF_RADIUS * radius) as f32).max(LEAST_NEAR) } else { usual }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_shown_box_holds_a_gaussian_of_middle_size() {
        let one = HostGaussians { means: vec![1.0, 2.0, 3.0], log_scales: vec![-9.0, 0.0, -6.0], ..Default::default() };
        assert_eq!(one.shown_box(), [[-2.0, -1.0, 0.0], [4.0, 5.0, 6.0]]);
        assert_eq!(HostGaussians::default().shown_box(), [[0.0; 3]; 2]);
    }

    #[test]
    fn near_planes_without_units_follow_the_size_between_two_bounds() {
        let near = |size: f32| near_without_units([[-size, 0.0, 0.0], [size, 0.0, 0.0]], 0.01);
        assert_eq!([near(100.0), near(1e-9), near(0.0), near(f32::NAN), near(3e38)], [0.01, LEAST_NEAR, 0.01, 0.01, 0.01]);
        assert!((near(0.1) - 1e-3).abs() < 1e-9, "{}", near(0.1));
    }
}
