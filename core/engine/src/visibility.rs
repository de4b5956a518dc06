//! Which Gaussians that move may be seen by a camera, decided before the field is asked about them.
//!
//! Decided for blocks of neighbours, on the host: a block is a box of centres, how far any of them may go, and how large any may become. Blocks that no
//! moment can bring into the picture cost a few operations each and nothing on the device.

use cc4dgs_core::Camera;

/// Gaussians per block.
pub const BLOCK: usize = 64;
/// Standard deviations that rasterizers draw, and a little more.
const SIGMAS: f64 = 3.4;
/// What the pixel filter adds to a footprint, and a little more, pixels.
const FILTER_PX: f64 = 4.0;
/// Rasterizers linearise the projection at most this many times the picture's half angle from its middle, and that of a centre beside the picture there.
const LINEARISED: f64 = 2.0;

/// A run of neighbouring rows and what they can reach, world units.
#[derive(Clone, Debug)]
struct Block {
    center: [f64; 3],
    half: [f64; 3],
    displacement: f64,
    sigma: f64,
}

/// What moving Gaussians can reach, whatever the time.
#[derive(Clone, Debug)]
pub struct MotionBounds {
    blocks: Vec<Block>,
    rows: usize,
}

impl MotionBounds {
    /// Of canonical centres [M,3] and log-scales [M,3], the largest displacements [M] and the largest growth of log-scales [M]. Blocks with a number that is
    /// not finite are always seen.
    pub fn new(means_world: &[f32], log_scales: &[f32], displacements: &[f32], growths: &[f32]) -> Self {
        let rows = displacements.len();
        let parts = means_world.chunks(3 * BLOCK).zip(log_scales.chunks(3 * BLOCK)).zip(displacements.chunks(BLOCK).zip(growths.chunks(BLOCK)));
        let blocks = parts.map(|((means, log_scales), (displacements, growths))| {
            let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
            for mean in means.chunks_exact(3) {
                for k in 0..3 {
                    low[k] = low[k].min(f64::from(mean[k]));
                    high[k] = high[k].max(f64::from(mean[k]));
                }
            }
            let sigma = |(own, growth): (&[f32], &f32)| f64::from(own.iter().copied().fold(f32::NEG_INFINITY, f32::max) + growth).exp();
            let finite = means.iter().chain(log_scales).chain(displacements).chain(growths).all(|v| v.is_finite());
            Block {
                center: std::array::from_fn(|k| 0.5 * (low[k] + high[k])),
                half: std::array::from_fn(|k| 0.5 * (high[k] - low[k])),
                displacement: if finite { displacements.iter().copied().fold(0.0, f32::max).into() } else { f64::INFINITY },
                sigma: log_scales.chunks_exact(3).zip(growths).map(sigma).fold(0.0, f64::max),
            }
        });
        Self { blocks: blocks.collect(), rows }
    }
    /// Runs of rows in order, and whether `camera` may see them: `(visible, rows)`.
    pub fn runs(&self, camera: &Camera) -> Vec<(bool, usize)> {
        let planes = planes(camera);
        let mut runs: Vec<(bool, usize)> = Vec::new();
        for (i, block) in self.blocks.iter().enumerate() {
            let visible = !planes.iter().any(|plane| plane.has_behind(block));
            let rows = BLOCK.min(self.rows - i * BLOCK);
            match runs.last_mut() {
                Some(last) if last.0 == visible => last.1 += rows,
                _ => runs.push((visible, rows)),
            }
        }
        runs
    }
}

/// Points with normal · point + offset < 0 are outside, by more than `per_sigma` times a Gaussian's deviation.
struct Plane {
    normal: [f64; 3],
    offset: f64,
    per_sigma: f64,
}

impl Plane {
    /// Whether all of a block stays outside. Comparisons with what is not a number are false, so such a block counts as seen.
    fn has_behind(&self, block: &Block) -> bool {
        let dot = |v: &[f64; 3]| (0..3).map(|k| self.normal[k] * v[k]).sum::<f64>();
        let box_reach: f64 = (0..3).map(|k| self.normal[k].abs() * block.half[k]).sum();
        let length = dot(&self.normal).sqrt();
        dot(&block.center) + self.offset + box_reach + length * block.displacement + self.per_sigma * block.sigma < 0.0
    }
}

/// The sides of what a camera sees, and the plane through its centre. A centre (x, y, z) lies right of the picture if fx x > (width - cx + filter) z; its
/// footprint reaches sigmas |J| z further, with J the projection's derivative times the depth: the side is a plane for footprints too.
fn planes(camera: &Camera) -> [Plane; 5] {
    let [width, height] = [f64::from(camera.width), f64::from(camera.height)];
    let limit = |c: f64, size: f64, f: f64| LINEARISED * c.max(size - c).max(0.5 * size) / f;
    let (limit_x, limit_y) = (limit(camera.cx, width, camera.fx), limit(camera.cy, height, camera.fy));
    let per_sigma = SIGMAS * (camera.fx.powi(2) * (1.0 + limit_x.powi(2)) + camera.fy.powi(2) * (1.0 + limit_y.powi(2))).sqrt();
    let m = &camera.world_to_camera;
    let plane = |a: [f64; 3], per_sigma: f64| Plane {
        normal: std::array::from_fn(|k| (0..3).map(|row| a[row] * m[row][k]).sum()),
        offset: (0..3).map(|row| a[row] * m[row][3]).sum(),
        per_sigma,
    };
    [
        plane([camera.fx, 0.0, camera.cx + FILTER_PX], per_sigma),
        plane([-camera.fx, 0.0, width - camera.cx + FILTER_PX], per_sigma),
        plane([0.0, camera.fy, camera.cy + FILTER_PX], per_sigma),
        plane([0.0, -camera.fy, height - camera.cy + FILTER_PX], per_sigma),
        plane([0.0, 0.0, 1.0], 0.0),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> Camera {
        Camera::look_at("", (200, 100), 1.0, [0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0])
    }
    fn seen(mean: [f32; 3], displacement: f32) -> bool {
        MotionBounds::new(&mean, &[-6.0; 3], &[displacement], &[0.0]).runs(&camera())[0].0
    }

    #[test]
    fn what_stays_outside_is_told_from_what_may_come_in() {
        assert!(seen([0.0, 0.0, 2.0], 0.0));
        for outside in [[4.0, 0.0, 2.0], [-4.0, 0.0, 2.0], [0.0, 3.0, 2.0], [0.0, -3.0, 2.0], [0.0, 0.0, -1.0]] {
            assert!(!seen(outside, 0.1), "{outside:?}");
            assert!(seen(outside, 4.0), "{outside:?} may come in");
        }
        assert!(seen([f32::NAN, 0.0, -5.0], 0.0), "what is not a number is not judged");
        assert!(seen([0.0, 0.0, -5.0], f32::INFINITY));
    }

    #[test]
    fn rows_are_told_in_runs() {
        let means: Vec<f32> = (0..3 * BLOCK + 5).flat_map(|i| [0.0, 0.0, if i < 2 * BLOCK { -5.0 } else { 5.0 }]).collect();
        let n = means.len() / 3;
        let bounds = MotionBounds::new(&means, &vec![-5.0; 3 * n], &vec![0.0; n], &vec![0.0; n]);
        assert_eq!(bounds.runs(&camera()), [(false, 2 * BLOCK), (true, BLOCK + 5)]);
    }
}
