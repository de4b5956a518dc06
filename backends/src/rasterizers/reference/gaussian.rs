//! One Gaussian onto the screen, written as the textbook has it: Sigma = R S S^T R^T, J W Sigma W^T J^T + blur, inverse of the result.

use super::real::Real;
use crate::ops::rasterize::RasterSettings;
use crate::ops::rasterize::camera::{ALPHA_MIN, FAR, RuleConstants};
use cc4dgs_core::ParameterSpace;

/// Least compensation.
const COMPENSATION_FLOOR: f64 = 0.005;
/// Side of Inria's tiles in pixels.
const SQUARE: usize = 16;

/// Tiles along x and y: first and end of each.
pub type TileRange = [[usize; 2]; 2];

/// 3x3, by rows.
pub type Matrix3<T> = [[T; 3]; 3];

/// The geometry of one Gaussian and the camera it is seen through.
#[derive(Clone, Copy)]
pub struct Gaussian<T> {
    /// Centre in world units.
    pub mean: [T; 3],
    /// Log-scales or scales.
    pub scales: [T; 3],
    /// Raw quaternion (w,x,y,z).
    pub quaternion: [T; 4],
    /// Logit or opacity.
    pub opacity: T,
    /// World to camera.
    pub view: [[T; 4]; 4],
}

/// A projected Gaussian.
#[derive(Clone, Copy)]
pub struct Projected<T> {
    /// Centre in pixels.
    pub center: [T; 2],
    /// (A,B,C).
    pub conic: [T; 3],
    /// Blurred covariance xx, xy, yy in square pixels.
    pub covariance: [T; 3],
    /// Opacity, compensation included where asked for.
    pub opacity: T,
    /// sqrt(determinant before the blur / after), at least 0.005.
    pub compensation: T,
    /// Unit direction from the camera centre.
    pub direction: [T; 3],
    /// Camera depth.
    pub depth: T,
}

impl<T: Real> Projected<T> {
    /// The same numbers in float64.
    pub fn widened(&self) -> Projected<f64> {
        Projected {
            center: self.center.map(T::value),
            conic: self.conic.map(T::value),
            covariance: self.covariance.map(T::value),
            opacity: self.opacity.value(),
            compensation: self.compensation.value(),
            direction: self.direction.map(T::value),
            depth: self.depth.value(),
        }
    }
}

fn dot<T: Real>(a: [T; 3], b: [T; 3]) -> T {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn multiply<T: Real>(a: Matrix3<T>, b: Matrix3<T>) -> Matrix3<T> {
    std::array::from_fn(|i| std::array::from_fn(|j| a[i][0] * b[0][j] + a[i][1] * b[1][j] + a[i][2] * b[2][j]))
}

fn transpose<T: Real>(a: Matrix3<T>) -> Matrix3<T> {
    std::array::from_fn(|i| std::array::from_fn(|j| a[j][i]))
}

/// The rotation matrix of a raw quaternion.
pub fn rotation<T: Real>(quaternion: [T; 4]) -> Matrix3<T> {
    let norm = quaternion.iter().fold(T::constant(0.0), |sum, &v| sum + v * v).sqrt();
    let [w, x, y, z] = quaternion.map(|v| v / norm);
    let (one, two) = (T::constant(1.0), T::constant(2.0));
    [
        [one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)],
        [two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x)],
        [two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y)],
    ]
}

/// The covariance R S S^T R^T of linear scales.
pub fn covariance<T: Real>(quaternion: [T; 4], scales: [T; 3]) -> Matrix3<T> {
    let r = rotation(quaternion);
    let m: Matrix3<T> = std::array::from_fn(|i| std::array::from_fn(|j| r[i][j] * scales[j]));
    multiply(m, transpose(m))
}

/// The camera centre: x of `view` (x, 1) = (0,0,0,1) up to scale, by elimination with pivots.
fn camera_center<T: Real>(view: [[T; 4]; 4]) -> [T; 3] {
    let mut rows: [[T; 5]; 4] = std::array::from_fn(|i| std::array::from_fn(|j| if j < 4 { view[i][j] } else { T::constant(f64::from(u8::from(i == 3))) }));
    for k in 0..4 {
        let pivot = (k..4).max_by(|&a, &b| rows[a][k].value().abs().total_cmp(&rows[b][k].value().abs())).unwrap_or(k);
        rows.swap(k, pivot);
        for i in 0..4 {
            if i != k {
                let factor = rows[i][k] / rows[k][k];
                for j in k..5 {
                    rows[i][j] = rows[i][j] - factor * rows[k][j];
                }
            }
        }
    }
    std::array::from_fn(|k| rows[k][4] / rows[k][k])
}

/// Projects without culling anything.
pub fn project<T: Real>(g: &Gaussian<T>, settings: &RasterSettings) -> Projected<T> {
    let c = T::constant;
    let (scales, opacity) = match settings.space {
        ParameterSpace::Raw => (g.scales.map(T::exp), c(1.0) / (c(1.0) + (-g.opacity).exp())),
        ParameterSpace::Activated => (g.scales, g.opacity),
    };
    let w: Matrix3<T> = std::array::from_fn(|i| std::array::from_fn(|j| g.view[i][j]));
    let point: [T; 3] = std::array::from_fn(|i| dot(w[i], g.mean) + g.view[i][3]);
    let z = point[2];
    let focal = [settings.fx, settings.fy];
    let principal = [settings.cx, settings.cy];
    let size = [settings.width as f64, settings.height as f64];
    let center: [T; 2] = std::array::from_fn(|k| c(focal[k]) * point[k] / z + c(principal[k]));
    let j: [[T; 3]; 2] = std::array::from_fn(|k| {
        let margin = 0.15 * size[k] / focal[k];
        let (low, high) = (-(principal[k] / focal[k] + margin), (size[k] - principal[k]) / focal[k] + margin);
        let clamped = z * (point[k] / z).larger(c(low)).smaller(c(high));
        let mut row = [c(0.0); 3];
        row[k] = c(focal[k]) / z;
        row[2] = -(c(focal[k]) * clamped / (z * z));
        row
    });
    let world = covariance(g.quaternion, scales);
    let camera = multiply(multiply(w, world), transpose(w));
    let half: [[T; 3]; 2] = std::array::from_fn(|i| std::array::from_fn(|k| dot(j[i], camera[k])));
    let (xx, xy, yy) = (dot(half[0], j[0]), dot(half[0], j[1]), dot(half[1], j[1]));
    let eps = c(settings.blur);
    let raw = xx * yy - xy * xy;
    let (bxx, byy) = (xx + eps, yy + eps);
    let determinant = bxx * byy - xy * xy;
    let floor = c(COMPENSATION_FLOOR * COMPENSATION_FLOOR);
    let compensation = (raw / determinant).larger(floor).sqrt();
    let eye = camera_center(g.view);
    let offset: [T; 3] = std::array::from_fn(|k| g.mean[k] - eye[k]);
    let distance = dot(offset, offset).sqrt();
    Projected {
        center,
        conic: [byy / determinant, -(xy / determinant), bxx / determinant],
        covariance: [bxx, xy, byy],
        opacity: if settings.antialiased { opacity * compensation } else { opacity },
        compensation,
        direction: offset.map(|v| v / distance),
        depth: z,
    }
}

/// Screen radius per axis and tile rectangle (first and end per axis) of a Gaussian, or nothing if it is culled.
pub fn extent(p: &Projected<f64>, settings: &RasterSettings) -> Option<([f64; 2], Option<TileRange>)> {
    let rules = RuleConstants::new(settings);
    let [xx, xy, yy] = p.covariance;
    let numbers = [p.center[0], p.center[1], p.conic[0], p.conic[1], p.conic[2], p.opacity, p.depth];
    let finite = numbers.iter().all(|v| v.is_finite());
    // The least opacity is a float32, as everything that is compared with alpha.
    if !finite || p.depth <= f64::from(rules.near) || p.depth >= f64::from(FAR) || p.opacity < f64::from(ALPHA_MIN) {
        return None;
    }
    if !rules.square_tiles {
        let radius = [(3.33 * xx.sqrt()).ceil(), (3.33 * yy.sqrt()).ceil()];
        let size = [settings.width as f64, settings.height as f64];
        let outside = (0..2).any(|k| p.center[k] + radius[k] <= 0.0 || p.center[k] - radius[k] >= size[k]);
        return if outside { None } else { Some((radius, None)) };
    }
    let mid = 0.5 * (xx + yy);
    let largest = mid + (mid * mid - (xx * yy - xy * xy)).max(0.1).sqrt();
    let radius = (3.0 * largest.sqrt()).ceil();
    let axis = |center: f64, size: usize| {
        let tiles = size.div_ceil(SQUARE) as f64;
        // Inria counts pixels from their centres: column 0 is at 0, not at 0.5.
        let center = center - 0.5;
        [
            ((center - radius) / SQUARE as f64).trunc().clamp(0.0, tiles) as usize,
            ((center + radius + (SQUARE - 1) as f64) / SQUARE as f64).trunc().clamp(0.0, tiles) as usize,
        ]
    };
    let tiles = [axis(p.center[0], settings.width), axis(p.center[1], settings.height)];
    if tiles.iter().any(|t| t[0] >= t[1]) { None } else { Some(([radius; 2], Some(tiles))) }
}
