//! Offsets, the output of a deformer, and their application to Gaussians.

use crate::gaussians::{first_rows, to_vec};
use crate::{Error, Gaussians, Result};
use burn::tensor::{Int, Tensor};

/// Lower bound on scales after a change, world units.
const LEAST_SCALE: f32 = 1e-7;
/// Upper bound on the opacity logits that fade: from 17 on their sigmoid is 1 in float32, and e^89 is infinite.
const MOST_LOGIT: f32 = 60.0;
/// Added to squared angles, so that the derivative at angle zero is finite.
const LEAST_SQUARED_ANGLE: f32 = 1e-14;
/// Lower bound on the norm of quaternions.
const LEAST_NORM: f32 = 1e-12;

/// Time-dependent changes of M Gaussians, a row per moving Gaussian. Every head is optional.
///
/// Offsets are added to the raw parameters, before activation (paper Section IV-B; Swift4D, 4DGS, E-D3DGS), except for the heads documented otherwise.
#[derive(Clone, Debug, Default)]
pub struct Offsets {
    /// Change of the centres in world units `[M,3]`.
    pub means: Option<Tensor<2>>,
    /// Change of the log-scales `[M,3]`.
    pub log_scales: Option<Tensor<2>>,
    /// Change of the scales after activation, world units `[M,3]` (Deformable 3DGS, Grid4D). Results stay positive.
    pub scales: Option<Tensor<2>>,
    /// Change of the raw quaternions `[M,4]`.
    pub quaternions: Option<Tensor<2>>,
    /// Rotations in front of the canonical ones, axis times angle in radians, world axes `[M,3]`. Unlike sums of quaternions they are exact for any angle.
    pub rotation_vectors: Option<Tensor<2>>,
    /// Whether quaternions are normalised before they are changed (Deformable 3DGS, Grid4D).
    pub unit_quaternions: bool,
    /// Change of the opacity logits `[M]`.
    pub opacity_logits: Option<Tensor<1>>,
    /// Logarithm of a factor of the opacity after its activation, at most 0 `[M]` (Gaussians that appear and vanish).
    pub opacity_log_factor: Option<Tensor<1>>,
    /// Change of all spherical-harmonics coefficients, degree 0 first `[M, (d+1)^2, 3]`.
    pub sh: Option<Tensor<3>>,
}

impl Offsets {
    /// Refuses heads whose shape for `count` Gaussians is not the documented one.
    ///
    /// # Errors
    /// [`Error::Parameter`] that names `deformer` and the head.
    pub fn check(&self, deformer: &str, count: usize) -> Result<()> {
        fn dims<const D: usize>(tensor: &Option<Tensor<D>>) -> Option<Vec<usize>> {
            tensor.as_ref().map(|t| t.dims().to_vec())
        }
        let heads = [
            ("means", dims(&self.means), vec![count, 3]),
            ("log_scales", dims(&self.log_scales), vec![count, 3]),
            ("scales", dims(&self.scales), vec![count, 3]),
            ("quaternions", dims(&self.quaternions), vec![count, 4]),
            ("rotation_vectors", dims(&self.rotation_vectors), vec![count, 3]),
            ("opacity_logits", dims(&self.opacity_logits), vec![count]),
            ("opacity_log_factor", dims(&self.opacity_log_factor), vec![count]),
        ];
        let bad = |head: &str, found: &[usize], wanted: String| {
            let problem = format!("its offsets have shape {found:?}; {count} Gaussians need {wanted}");
            Err(Error::parameter(format!("deformer {deformer}, head {head}"), problem, "Correct the shape that Deformer::deform returns"))
        };
        for (head, found, wanted) in heads {
            if let Some(found) = found.filter(|found| *found != wanted) {
                return bad(head, &found, format!("{wanted:?}"));
            }
        }
        match dims(&self.sh) {
            Some(found) if found[0] != count || found[2] != 3 || ![1, 4, 9, 16, 25].contains(&found[1]) => {
                bad("sh", &found, format!("[{count}, (degree + 1)^2, 3]"))
            }
            _ => Ok(()),
        }
    }
    /// Refuses offsets that are not finite; see [`Offsets::broken_head`].
    ///
    /// # Errors
    /// [`Error::Backend`] that names `deformer` and the head.
    pub fn check_finite(&self, deformer: &str) -> Result<()> {
        let Some(head) = self.broken_head(deformer, 0.0)? else { return Ok(()) };
        Err(Error::backend(
            format!("deformer {deformer}, head {head}"),
            "its offsets are not finite",
            "Lower the deformer's learning rates, or limit what the head returns",
        ))
    }
    /// The first head of which more than the share `tolerated` of the rows is not finite. Reads one number per head back from the device, and heads that are
    /// not finite.
    ///
    /// # Errors
    /// [`Error::Backend`] that names `deformer` and the head, if the device fails.
    pub fn broken_head(&self, deformer: &str, tolerated: f64) -> Result<Option<&'static str>> {
        fn finite(values: &[f32]) -> bool {
            values.iter().all(|value| value.is_finite())
        }
        fn is_broken<const D: usize>(head: &Option<Tensor<D>>, object: &str, tolerated: f64) -> Result<bool> {
            let Some(head) = head else { return Ok(false) };
            // A sum is finite only if every summand is; shader compilers do not optimise it away.
            if finite(&to_vec(head.clone().sum(), object)?) {
                return Ok(false);
            }
            let (rows, values) = (head.dims()[0].max(1), to_vec(head.clone(), object)?);
            let broken = values.chunks((values.len() / rows).max(1)).filter(|row| !finite(row)).count();
            Ok(broken as f64 > tolerated * rows as f64)
        }
        let object = |head: &str| format!("deformer {deformer}, head {head}");
        let wide = [
            ("means", &self.means),
            ("log_scales", &self.log_scales),
            ("scales", &self.scales),
            ("quaternions", &self.quaternions),
            ("rotation_vectors", &self.rotation_vectors),
        ];
        for (head, offsets) in wide {
            if is_broken(offsets, &object(head), tolerated)? {
                return Ok(Some(head));
            }
        }
        for (head, offsets) in [("opacity_logits", &self.opacity_logits), ("opacity_log_factor", &self.opacity_log_factor)] {
            if is_broken(offsets, &object(head), tolerated)? {
                return Ok(Some(head));
            }
        }
        Ok(is_broken(&self.sh, &object("sh"), tolerated)?.then_some("sh"))
    }
    /// Applies the offsets to the Gaussians with the indices `rows` `[M]`; `None` means the first M. All other Gaussians are returned unchanged.
    ///
    /// # Errors
    /// [`Error::Parameter`] with the name of `deformer` and of the head, for a head of another shape.
    pub fn apply(self, deformer: &str, canonical: &Gaussians, rows: Option<&Tensor<1, Int>>) -> Result<Gaussians> {
        let count = rows.map_or_else(|| self.rows().unwrap_or(0).min(canonical.len()), |rows| rows.dims()[0]);
        self.check(deformer, count)?;
        Ok(self.applied(canonical, rows))
    }
    /// Number of rows of the first head that is present.
    fn rows(&self) -> Option<usize> {
        let two = [&self.means, &self.log_scales, &self.scales, &self.quaternions, &self.rotation_vectors];
        let one = [&self.opacity_logits, &self.opacity_log_factor];
        let found = two.into_iter().flatten().map(|t| t.dims()[0]).chain(one.into_iter().flatten().map(|t| t.dims()[0])).next();
        found.or_else(|| self.sh.as_ref().map(|t| t.dims()[0]))
    }
    fn applied(self, canonical: &Gaussians, rows: Option<&Tensor<1, Int>>) -> Gaussians {
        let mut moved = canonical.clone();
        moved.means = add(moved.means, self.means, rows);
        moved.log_scales = add(moved.log_scales, self.log_scales, rows);
        if let Some(scales) = self.scales {
            let before = select(&moved.log_scales, rows, scales.dims()[0]);
            let after = (before.clone().exp() + scales).clamp_min(LEAST_SCALE).log();
            moved.log_scales = add(moved.log_scales, Some(after - before), rows);
        }
        let quaternions = self.quaternions.map(|change| {
            if !self.unit_quaternions {
                return change;
            }
            let raw = select(&moved.quaternions, rows, change.dims()[0]);
            // Limited before the root, whose gradient at 0 is infinite.
            let norm = raw.clone().powi_scalar(2).sum_dim(1).clamp_min(LEAST_NORM * LEAST_NORM).sqrt();
            raw.clone() / norm - raw + change
        });
        moved.quaternions = add(moved.quaternions, quaternions, rows);
        if let Some(vectors) = self.rotation_vectors {
            let before = select(&moved.quaternions, rows, vectors.dims()[0]);
            moved.quaternions = add(moved.quaternions, Some(turned(before.clone(), vectors) - before), rows);
        }
        moved.opacity_logits = add(moved.opacity_logits, self.opacity_logits, rows);
        if let Some(factor) = self.opacity_log_factor {
            let before = select(&moved.opacity_logits, rows, factor.dims()[0]);
            moved.opacity_logits = add(moved.opacity_logits, Some(fading(before, factor)), rows);
        }
        if let Some(sh) = self.sh {
            let [m, k, _] = sh.dims();
            let dc = sh.clone().slice([0..m, 0..1, 0..3]).reshape([m, 3]);
            moved.sh_dc = add(moved.sh_dc, Some(dc), rows);
            if k > 1 {
                let rest = sh.slice([0..m, 1..k, 0..3]);
                // A deformer may change fewer degrees than the Gaussians have.
                let stored = moved.sh_rest.dims()[1];
                let rest = if stored > k - 1 {
                    let padding = Tensor::zeros([m, stored - (k - 1), 3], &rest.device());
                    Tensor::cat(vec![rest, padding], 1)
                } else {
                    rest.slice([0..m, 0..stored, 0..3])
                };
                moved.sh_rest = add(moved.sh_rest, Some(rest), rows);
            }
        }
        moved
    }
    /// Applies the offsets to `moving` `[M]` and writes the results to the first M Gaussians of `frame` `[N >= M]`. The update is in place if `frame` holds the
    /// only reference. Attributes that no head changes and all other Gaussians stay unchanged.
    ///
    /// # Errors
    /// As [`Offsets::apply`].
    pub fn apply_over(self, deformer: &str, moving: &Gaussians, mut frame: Gaussians) -> Result<Gaussians> {
        let means = self.means.is_some();
        let scales = self.log_scales.is_some() || self.scales.is_some();
        let rotations = self.quaternions.is_some() || self.rotation_vectors.is_some();
        let opacities = self.opacity_logits.is_some() || self.opacity_log_factor.is_some();
        let colors = self.sh.is_some();
        self.check(deformer, moving.len())?;
        let moved = self.applied(moving, None);
        if means {
            frame.means = over(frame.means, moved.means);
        }
        if scales {
            frame.log_scales = over(frame.log_scales, moved.log_scales);
        }
        if rotations {
            frame.quaternions = over(frame.quaternions, moved.quaternions);
        }
        if opacities {
            frame.opacity_logits = over(frame.opacity_logits, moved.opacity_logits);
        }
        if colors {
            frame.sh_dc = over(frame.sh_dc, moved.sh_dc);
            frame.sh_rest = over(frame.sh_rest, moved.sh_rest);
        }
        Ok(frame)
    }
    /// The offsets of the first `count` Gaussians.
    pub fn first(self, count: usize) -> Self {
        let two = |head: Option<Tensor<2>>| head.map(|t| first_rows(t, count));
        let one = |head: Option<Tensor<1>>| head.map(|t| first_rows(t, count));
        Self {
            means: two(self.means),
            log_scales: two(self.log_scales),
            scales: two(self.scales),
            quaternions: two(self.quaternions),
            rotation_vectors: two(self.rotation_vectors),
            unit_quaternions: self.unit_quaternions,
            opacity_logits: one(self.opacity_logits),
            opacity_log_factor: one(self.opacity_log_factor),
            sh: self.sh.map(|t| first_rows(t, count)),
        }
    }
    /// All heads concatenated as one matrix `[M, total width]`, for regularisers; `None` without heads.
    pub fn concatenated(&self) -> Option<Tensor<2>> {
        let mut parts: Vec<Tensor<2>> = Vec::new();
        parts.extend(self.means.clone());
        parts.extend(self.log_scales.clone());
        parts.extend(self.scales.clone());
        parts.extend(self.quaternions.clone());
        parts.extend(self.rotation_vectors.clone());
        parts.extend(self.opacity_logits.clone().map(|o| o.unsqueeze_dim(1)));
        parts.extend(self.opacity_log_factor.clone().map(|o| o.unsqueeze_dim(1)));
        parts.extend(self.sh.clone().map(|s| s.flatten(1, 2)));
        if parts.is_empty() { None } else { Some(Tensor::cat(parts, 1)) }
    }
}

/// Quaternions `[M,4]` multiplied from the left by the rotations `vectors` `[M,3]` (axis times angle in radians); norms are unchanged.
fn turned(quaternions: Tensor<2>, vectors: Tensor<2>) -> Tensor<2> {
    let angle = (vectors.clone() * vectors.clone()).sum_dim(1).add_scalar(LEAST_SQUARED_ANGLE).sqrt();
    let half = angle.clone().mul_scalar(0.5);
    let (w, u) = (half.clone().cos(), vectors * (half.sin() / angle));
    let column = |t: &Tensor<2>, k: usize| t.clone().narrow(1, k, 1);
    let [ux, uy, uz] = [0, 1, 2].map(|k| column(&u, k));
    let [qw, qx, qy, qz] = [0, 1, 2, 3].map(|k| column(&quaternions, k));
    let product = |a: &Tensor<2>, b: &Tensor<2>| a.clone() * b.clone();
    Tensor::cat(
        vec![
            product(&w, &qw) - product(&ux, &qx) - product(&uy, &qy) - product(&uz, &qz),
            product(&w, &qx) + product(&ux, &qw) + product(&uy, &qz) - product(&uz, &qy),
            product(&w, &qy) + product(&uy, &qw) + product(&uz, &qx) - product(&ux, &qz),
            product(&w, &qz) + product(&uz, &qw) + product(&ux, &qy) - product(&uy, &qx),
        ],
        1,
    )
}

/// The change of `logits` x that multiplies their sigmoid by e^f: the odds become e^x e^f / (1 + e^x (1 - e^f)).
fn fading(logits: Tensor<1>, factor: Tensor<1>) -> Tensor<1> {
    let rest = factor.clone().exp().neg().add_scalar(1.0);
    let bounded = logits.clone().clamp_max(MOST_LOGIT);
    bounded.clone() - logits + factor - (bounded.exp() * rest).log1p()
}

/// The values of the Gaussians `rows`, or of the first `count`.
fn select<const D: usize>(values: &Tensor<D>, rows: Option<&Tensor<1, Int>>, count: usize) -> Tensor<D> {
    match rows {
        None => first_rows(values.clone(), count),
        Some(rows) => {
            let mut dims = values.dims();
            dims[0] = rows.dims()[0];
            as_rows(values.clone()).select(0, rows.clone()).reshape(dims)
        }
    }
}

/// `[N,…]` as a matrix `[N, rest]`: burn's CPU back end copies rows of matrices, and single elements of all other shapes.
fn as_rows<const D: usize>(values: Tensor<D>) -> Tensor<2> {
    let dims = values.dims();
    values.reshape([dims[0], dims[1..].iter().product()])
}

/// `base` `[N,…]` with its first rows replaced by `first` `[M,…]`.
fn over<const D: usize>(base: Tensor<D>, first: Tensor<D>) -> Tensor<D> {
    let (dims, len) = (base.dims(), first.dims().iter().product::<usize>());
    if len == 0 || first.dims() == dims {
        return if len == 0 { base } else { first };
    }
    // As one contiguous array, for any shape.
    let flat = base.reshape([dims.iter().product::<usize>()]);
    flat.slice_assign(burn::tensor::s![0..len], first.reshape([len])).reshape(dims)
}

fn add<const D: usize>(base: Tensor<D>, offset: Option<Tensor<D>>, rows: Option<&Tensor<1, Int>>) -> Tensor<D> {
    let Some(offset) = offset else { return base };
    let (m, n) = (offset.dims()[0], base.dims()[0]);
    match rows {
        Some(rows) => {
            let dims = base.dims();
            as_rows(base).select_assign(0, rows.clone(), as_rows(offset), burn::tensor::IndexingUpdateOp::Add).reshape(dims)
        }
        None if m == n => base + offset,
        None if m == 0 => base,
        None => {
            let mut rest = base.dims();
            rest[0] = n - m;
            let rest = Tensor::zeros(rest, &base.device());
            base + Tensor::cat(vec![offset, rest], 0)
        }
    }
}

#[cfg(all(test, feature = "cpu"))]
mod tests {
    use super::*;
    use burn::tensor::Device;

    #[test]
    fn the_first_head_that_is_not_finite_is_named() {
        let filled = |value: f32| Some(Tensor::<2>::full([4, 3], value, &Device::flex()));
        let of = |means: f32, scales: f32| Offsets { means: filled(means), scales: filled(scales), ..Offsets::default() };
        assert_eq!(of(0.5, 1.0).broken_head("d", 0.0).unwrap(), None);
        assert_eq!(Offsets::default().broken_head("d", 0.0).unwrap(), None);
        assert_eq!(of(0.5, f32::NAN).broken_head("d", 0.0).unwrap(), Some("scales"));
        assert_eq!(of(f32::INFINITY, f32::NAN).broken_head("d", 0.0).unwrap(), Some("means"));
        // One of four rows, and one of two.
        let one_of = |rows: usize| {
            let mut values = vec![0.5; 3 * rows];
            values[4] = f32::NAN;
            let means = Tensor::from_data(burn::tensor::TensorData::new(values, [rows, 3]), &Device::flex());
            Offsets { means: Some(means), ..Offsets::default() }
        };
        assert_eq!([4, 2].map(|rows| one_of(rows).broken_head("d", 0.25).unwrap()), [None, Some("means")]);
        assert_eq!(one_of(4).broken_head("d", 0.0).unwrap(), Some("means"));
        assert!(of(0.5, 1.0).check_finite("d").is_ok());
        let error = of(0.5, f32::NAN).check_finite("d").unwrap_err();
        assert!(error.to_string().starts_with("deformer d, head scales: its offsets are not finite"), "{error}");
    }
}
