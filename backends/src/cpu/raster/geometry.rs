//! EWA projection of Gaussians, a vector of them at a time, and its derivative.
//!
//! With M = R S (rotation times scales) the projected covariance is U U^T + blur, U = J W M being 2x3. The unblurred determinant is then
//! |U0 x U1|^2 and the blurred one a sum of positive terms, so neither cancels for needles.
//!
//! The exponent at an offset (dx, dy) from the centre is a sum of two squares: sigma = u^2 + t^2 with u = l1 dx + l2 dy and t = l3 dy. Written as
//! a dx^2 + b dx dy + c dy^2 it would cancel: at the end of a needle of 3,000 pixels the terms are millions of times larger than their sum.

use super::camera::{CameraConstants, MIN_COMPENSATION, QUATERNION_RANGE, RESCALE};
use crate::cpu::simd::{Lanes, Mask, each};
use pulp::Simd;
use std::f32::consts::FRAC_1_SQRT_2;

/// Three numbers per Gaussian.
pub type Vec3<S> = [Lanes<S>; 3];

#[inline(always)]
fn dot<S: Simd>(a: Vec3<S>, b: Vec3<S>) -> Lanes<S> {
    a[0].fma(b[0], a[1].fma(b[1], a[2] * b[2]))
}

#[inline(always)]
fn cross<S: Simd>(a: Vec3<S>, b: Vec3<S>) -> Vec3<S> {
    each(
        #[inline(always)]
        |k| {
            let (i, j) = ((k + 1) % 3, (k + 2) % 3);
            a[j].nfma(b[i], a[i] * b[j])
        },
    )
}

/// A unit quaternion (w,x,y,z) as a rotation matrix, by rows.
#[inline(always)]
pub fn rotation<S: Simd>(q: [Lanes<S>; 4]) -> [Vec3<S>; 3] {
    let [w, x, y, z] = q;
    let one = w.like(1.0);
    let two = w.like(2.0);
    let diagonal = |a: Lanes<S>, b: Lanes<S>| two.nfma(a.fma(a, b * b), one);
    [
        [diagonal(y, z), two * x.fma(y, -(w * z)), two * x.fma(z, w * y)],
        [two * x.fma(y, w * z), diagonal(x, z), two * y.fma(z, -(w * x))],
        [two * x.fma(z, -(w * y)), two * y.fma(z, w * x), diagonal(x, y)],
    ]
}

/// Gradient of a raw quaternion from that of the rotation matrix; `unit` is the normalised one and `inverse_norm` 1 / its former norm.
#[inline(always)]
pub fn rotation_backward<S: Simd>(unit: [Lanes<S>; 4], inverse_norm: Lanes<S>, d: [Vec3<S>; 3]) -> [Lanes<S>; 4] {
    let [w, x, y, z] = unit;
    let minus_two = w.like(-2.0);
    let g = [
        x * (d[2][1] - d[1][2]) + y * (d[0][2] - d[2][0]) + z * (d[1][0] - d[0][1]),
        minus_two * x * (d[1][1] + d[2][2]) + y * (d[0][1] + d[1][0]) + z * (d[0][2] + d[2][0]) + w * (d[2][1] - d[1][2]),
        x * (d[0][1] + d[1][0]) + minus_two * y * (d[0][0] + d[2][2]) + z * (d[1][2] + d[2][1]) + w * (d[0][2] - d[2][0]),
        x * (d[0][2] + d[2][0]) + y * (d[1][2] + d[2][1]) + minus_two * z * (d[0][0] + d[1][1]) + w * (d[1][0] - d[0][1]),
    ];
    // The matrix is quadratic in the quaternion: a factor 2 in all; then the part along the quaternion is projected out.
    let along = g[0].fma(w, g[1].fma(x, g[2].fma(y, g[3] * z)));
    let factor = inverse_norm * 2.0;
    each(
        #[inline(always)]
        |k| unit[k].nfma(along, g[k]) * factor,
    )
}

/// A projected vector of Gaussians with everything its derivative needs.
pub struct Projection<S: Simd> {
    /// Centre in camera axes, world units.
    pub point: Vec3<S>,
    /// Centre in the image, pixels.
    pub center: [Lanes<S>; 2],
    /// Covariance in square pixels with the blur: xx, xy, yy.
    pub covariance: Vec3<S>,
    /// Its determinant.
    pub determinant: Lanes<S>,
    /// l1, l2, l3 of sigma = (l1 dx + l2 dy)^2 + (l3 dy)^2.
    pub factors: Vec3<S>,
    /// sqrt(determinant before the blur / after), at least 0.005.
    pub compensation: Lanes<S>,
    /// Squared norm of the raw quaternion, rescaled where it is very short or very long.
    pub norm_squared: Lanes<S>,
    unit: [Lanes<S>; 4],
    inverse_norm: Lanes<S>,
    rotation: [Vec3<S>; 3],
    scales: Vec3<S>,
    turned: [Vec3<S>; 3],
    scaled: [Vec3<S>; 3],
    rows: [Vec3<S>; 2],
    raw_determinant: Lanes<S>,
    inverse_depth: Lanes<S>,
    ratio: [Lanes<S>; 2],
    inside: [Mask<S>; 2],
}

/// Projects Gaussians of centres `mean`, raw quaternions `quaternion` and linear scales `scales`.
#[inline(always)]
pub fn project<S: Simd>(camera: &CameraConstants, mean: Vec3<S>, quaternion: [Lanes<S>; 4], scales: Vec3<S>) -> Projection<S> {
    let like = |v: f32| mean[0].like(v);
    let w: [Vec3<S>; 3] = each(
        #[inline(always)]
        |i| {
            each(
                #[inline(always)]
                |j| like(camera.rotation[i][j]),
            )
        },
    );
    let point: Vec3<S> = each(
        #[inline(always)]
        |i| w[i][0].fma(mean[0], w[i][1].fma(mean[1], w[i][2].fma(mean[2], like(camera.translation[i])))),
    );
    let inverse_depth = like(1.0) / point[2];
    // Squares of very short and very long quaternions leave the range of float32: a power of two brings them back, and rounds nothing.
    let squares = |[q0, q1, q2, q3]: [Lanes<S>; 4]| q0.fma(q0, q1.fma(q1, q2.fma(q2, q3 * q3)));
    let first = squares(quaternion);
    let factor = like(1.0 / QUATERNION_RANGE).gt(first).select(like(RESCALE), first.gt(like(QUATERNION_RANGE)).select(like(1.0 / RESCALE), like(1.0)));
    let rescaled: [Lanes<S>; 4] = each(
        #[inline(always)]
        |k| quaternion[k] * factor,
    );
    let norm_squared = squares(rescaled);
    let inverse = like(1.0) / norm_squared.sqrt();
    let unit: [Lanes<S>; 4] = each(
        #[inline(always)]
        |k| rescaled[k] * inverse,
    );
    let inverse_norm = inverse * factor;
    let rotation = rotation(unit);
    let turned: [Vec3<S>; 3] = each(
        #[inline(always)]
        |i| {
            each(
                #[inline(always)]
                |j| w[i][0].fma(rotation[0][j], w[i][1].fma(rotation[1][j], w[i][2] * rotation[2][j])),
            )
        },
    );
    let scaled: [Vec3<S>; 3] = each(
        #[inline(always)]
        |i| {
            each(
                #[inline(always)]
                |j| turned[i][j] * scales[j],
            )
        },
    );
    let raw_ratio = [point[0] * inverse_depth, point[1] * inverse_depth];
    let limits: [[Lanes<S>; 2]; 2] = each(
        #[inline(always)]
        |i| {
            each(
                #[inline(always)]
                |j| like(camera.ratio_limits[i][j]),
            )
        },
    );
    let ratio: [Lanes<S>; 2] = each(
        #[inline(always)]
        |k| raw_ratio[k].max(limits[k][0]).min(limits[k][1]),
    );
    let inside: [Mask<S>; 2] = each(
        #[inline(always)]
        |k| raw_ratio[k].ge(limits[k][0]) & raw_ratio[k].le(limits[k][1]),
    );
    let rows: [Vec3<S>; 2] = each(
        #[inline(always)]
        |k| {
            let scale = inverse_depth * camera.focal[k];
            // J's third column is -f x / z^2 = -(f / z) (x / z).
            each(
                #[inline(always)]
                |j| scale * ratio[k].nfma(scaled[2][j], scaled[k][j]),
            )
        },
    );
    let (xx, xy, yy) = (dot(rows[0], rows[0]), dot(rows[0], rows[1]), dot(rows[1], rows[1]));
    let normal = cross(rows[0], rows[1]);
    let raw_determinant = dot(normal, normal);
    let determinant = raw_determinant + (xx + yy).fma(like(camera.blur), like(camera.blur * camera.blur));
    let inverse = like(1.0) / determinant;
    let covariance = [xx + camera.blur, xy, yy + camera.blur];
    // Roots before they are divided: of a huge footprint the quotients of squares would leave the range of float32.
    let root = covariance[2].sqrt();
    let l1 = root * FRAC_1_SQRT_2 / determinant.sqrt();
    Projection {
        point,
        center: each(
            #[inline(always)]
            |k| raw_ratio[k].fma(like(camera.focal[k]), like(camera.principal[k])),
        ),
        covariance,
        determinant,
        factors: [l1, -(xy / covariance[2] * l1), like(FRAC_1_SQRT_2) / root],
        compensation: (raw_determinant * inverse).max(like(MIN_COMPENSATION * MIN_COMPENSATION)).sqrt(),
        norm_squared,
        unit,
        inverse_norm,
        rotation,
        scales,
        turned,
        scaled,
        rows,
        raw_determinant,
        inverse_depth,
        ratio,
        inside,
    }
}

/// The upstream gradients of a [`Projection`].
pub struct ProjectionGradient<S: Simd> {
    /// d loss / d centre in pixels.
    pub center: [Lanes<S>; 2],
    /// Sums over pixels of d loss / d sigma times u^2, u t and t^2, where sigma = u^2 + t^2 ([`Projection::factors`]).
    pub moments: Vec3<S>,
    /// d loss / d camera depth.
    pub depth: Lanes<S>,
    /// d loss / d compensation.
    pub compensation: Lanes<S>,
}

/// The gradients of the inputs of a [`Projection`].
pub struct GeometryGradient<S: Simd> {
    /// d loss / d centre in world units.
    pub mean: Vec3<S>,
    /// d loss / d raw quaternion.
    pub quaternion: [Lanes<S>; 4],
    /// d loss / d linear scale.
    pub scales: Vec3<S>,
    /// d loss / d camera rotation, by rows.
    pub camera_rotation: [Vec3<S>; 3],
    /// d loss / d camera translation.
    pub camera_translation: Vec3<S>,
}

/// The derivative of [`project`].
#[inline(always)]
pub fn project_backward<S: Simd>(camera: &CameraConstants, mean: Vec3<S>, p: &Projection<S>, g: &ProjectionGradient<S>) -> GeometryGradient<S> {
    let like = |v: f32| mean[0].like(v);
    let w: [Vec3<S>; 3] = each(
        #[inline(always)]
        |i| {
            each(
                #[inline(always)]
                |j| like(camera.rotation[i][j]),
            )
        },
    );
    let scale: [Lanes<S>; 2] = each(
        #[inline(always)]
        |k| p.inverse_depth * camera.focal[k],
    );
    // Projected axes of unit length in the world: rows[k] = axes[k] times the scales.
    let axes: [Vec3<S>; 2] = each(
        #[inline(always)]
        |k| {
            each(
                #[inline(always)]
                |j| scale[k] * p.ratio[k].nfma(p.turned[2][j], p.turned[k][j]),
            )
        },
    );
    let squared: Vec3<S> = each(
        #[inline(always)]
        |j| p.scales[j] * p.scales[j],
    );
    let by_squares = |row: Vec3<S>| -> Vec3<S> {
        each(
            #[inline(always)]
            |j| row[j] * squared[j],
        )
    };
    // The adjugate of the unblurred covariance, times the axes. A needle's covariance nearly annihilates its own axis; written with cross products, nothing
    // cancels. With the blur and over the determinant, its first row is that of the conic K times the axes.
    let normal = cross(axes[0], axes[1]);
    let adjugate = [cross(by_squares(axes[1]), normal), cross(normal, by_squares(axes[0]))];
    let inverse = like(1.0) / p.determinant;
    // With L = ((l1, l2), (0, l3)): K = 2 L^T L and d covariance = -2 L^T Q L, where Q has the moments. L times the axes, from K times the axes.
    let [l1, l2, l3] = p.factors;
    let of_first = inverse * 0.5 / l1;
    let seen: [Vec3<S>; 2] = [
        each(
            #[inline(always)]
            |j| (axes[0][j] * camera.blur + adjugate[0][j]) * of_first,
        ),
        each(
            #[inline(always)]
            |j| axes[1][j] * l3,
        ),
    ];
    let [uu, ut, tt]: Vec3<S> = each(
        #[inline(always)]
        |k| g.moments[k] * 2.0,
    );
    // 2 Q L times the axes.
    let weighted: [Vec3<S>; 2] = [
        each(
            #[inline(always)]
            |j| uu.fma(seen[0][j], ut * seen[1][j]),
        ),
        each(
            #[inline(always)]
            |j| ut.fma(seen[0][j], tt * seen[1][j]),
        ),
    ];
    // Compensation^2 = raw determinant / determinant, where that is over its floor.
    let share = p.raw_determinant * inverse;
    let alive = share.gt(like(MIN_COMPENSATION * MIN_COMPENSATION));
    let d_share = alive.keep(g.compensation * 0.5 / p.compensation) * inverse;
    // 1 - share, which would cancel where the Gaussian is much larger than the blur.
    let of_blur = (p.covariance[0] + p.covariance[2] - camera.blur) * (inverse * camera.blur);
    let d_raw = d_share * of_blur;
    let d_trace = -(d_share * share * camera.blur);
    let two = like(2.0);
    let d_scales: Vec3<S> = each(
        #[inline(always)]
        |j| {
            let (k, l) = ((j + 1) % 3, (j + 2) % 3);
            // The squares of the unblurred determinant's terms with this scale, and the trace's.
            let raw = squared[k].fma(normal[l] * normal[l], squared[l] * normal[k] * normal[k]);
            let trace = axes[0][j].fma(axes[0][j], axes[1][j] * axes[1][j]);
            let shape = seen[0][j].fma(weighted[0][j], seen[1][j] * weighted[1][j]);
            two * p.scales[j] * d_raw.fma(raw, d_trace.fma(trace, -shape))
        },
    );
    let d_rows: [Vec3<S>; 2] = each(
        #[inline(always)]
        |k| {
            each(
                #[inline(always)]
                |j| {
                    let shape = if k == 0 { l1 * weighted[0][j] } else { l2.fma(weighted[0][j], l3 * weighted[1][j]) };
                    two * p.scales[j].fma(d_raw.fma(adjugate[k][j], -shape), d_trace * p.rows[k][j])
                },
            )
        },
    );
    // rows[k] = (f_k / z) (scaled[k] - ratio_k scaled[2]); 1/z scales all of them, as a common factor of the scales would.
    let mut d_point = [like(0.0), like(0.0), dot(d_scales, p.scales).nfma(p.inverse_depth, g.depth)];
    let mut d_scaled = [[like(0.0); 3]; 3];
    for k in 0..2 {
        d_scaled[k] = each(
            #[inline(always)]
            |j| d_rows[k][j] * scale[k],
        );
        let ratio = p.ratio[k];
        for j in 0..3 {
            d_scaled[2][j] = d_scaled[k][j].nfma(ratio, d_scaled[2][j]);
        }
        let d_ratio_row = -dot(d_scaled[k], p.scaled[2]);
        // The clamped ratio passes no gradient; the projected centre always does.
        let d_ratio = g.center[k].fma(like(camera.focal[k]), p.inside[k].keep(d_ratio_row));
        let step = d_ratio * p.inverse_depth;
        d_point[k] = step;
        let raw_ratio = p.point[k] * p.inverse_depth;
        d_point[2] = step.nfma(raw_ratio, d_point[2]);
    }
    let d_turned: [Vec3<S>; 3] = each(
        #[inline(always)]
        |i| {
            each(
                #[inline(always)]
                |j| d_scaled[i][j] * p.scales[j],
            )
        },
    );
    let d_rotation: [Vec3<S>; 3] = each(
        #[inline(always)]
        |i| {
            each(
                #[inline(always)]
                |j| w[0][i].fma(d_turned[0][j], w[1][i].fma(d_turned[1][j], w[2][i] * d_turned[2][j])),
            )
        },
    );
    GeometryGradient {
        mean: each(
            #[inline(always)]
            |i| w[0][i].fma(d_point[0], w[1][i].fma(d_point[1], w[2][i] * d_point[2])),
        ),
        quaternion: rotation_backward(p.unit, p.inverse_norm, d_rotation),
        scales: d_scales,
        camera_rotation: each(
            #[inline(always)]
            |i| {
                each(
                    #[inline(always)]
                    |j| d_point[i].fma(mean[j], dot(d_turned[i], p.rotation[j])),
                )
            },
        ),
        camera_translation: d_point,
    }
}
