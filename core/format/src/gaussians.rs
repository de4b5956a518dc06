//! The canonical Gaussians as plain arrays, for codecs and files.
//!
//! All values are raw (before activation): scale = exp(log_scale), opacity = sigmoid(logit), rotation = normalise(quaternion).

use crate::{Error, Limits, Result};
use std::collections::BTreeMap;

/// The number of spherical-harmonics coefficients above degree 0: (degree + 1)^2 - 1.
pub const fn sh_rest_len(degree: usize) -> usize {
    (degree + 1) * (degree + 1) - 1
}

/// What a file of static Gaussians of another program holds.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct GaussianFile {
    /// Valid Gaussians ([`HostGaussians::validate`]).
    pub gaussians: HostGaussians,
    /// Whether they are to be drawn with Mip-Splatting's 2D filter: opacity in proportion to the share of the footprint that the pixel blur did not add.
    pub antialiased: bool,
    /// What was ignored or is missing, in words.
    pub remarks: Vec<String>,
}

/// Names of the attributes every Gaussian has, in the order of [`HostGaussians::columns`].
pub const CORE_ATTRIBUTES: [&str; 7] = ["means", "log_scales", "quaternions", "opacity_logits", "sh_dc", "sh_rest", "dynamic_scores"];

/// A per-Gaussian attribute of a plug-in (an embedding, a second rotation): `width` floats per Gaussian.
///
/// `tolerance` and `needed` tell an encoder which errors are allowed. They are not stored; decoded attributes have neither.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct ExtraAttribute {
    /// Floats per Gaussian.
    pub width: usize,
    /// Row-major values `[N, width]`.
    pub values: Vec<f32>,
    /// Largest absolute error of a value after decoding. `None`: the deformer does not say; a codec that can measure what errors change in images may round
    /// by that, others store bit for bit.
    pub tolerance: Option<f32>,
    /// The rows that must be stored; `None` means all.
    pub needed: Option<NeededRows>,
}

/// The rows of an attribute that must be stored. A codec may omit the others; their values are then decoded as `start`.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct NeededRows {
    /// Whether each row is needed `[N]`.
    pub rows: Vec<bool>,
    /// Decoded value of rows that were not stored.
    pub start: f32,
}

impl ExtraAttribute {
    /// An attribute of which every row must be stored bit for bit. `values` are `[N,width]`, row-major.
    pub fn exact(width: usize, values: Vec<f32>) -> Self {
        Self { width, values, tolerance: None, needed: None }
    }
    /// The same values, with a largest absolute error of `tolerance`.
    pub fn within(self, tolerance: f32) -> Self {
        Self { tolerance: Some(tolerance), ..self }
    }
    /// The same values. Only rows whose flag in `rows` `[N]` is set must be stored; others may be decoded as `start`.
    pub fn needed_in(self, rows: Vec<bool>, start: f32) -> Self {
        Self { needed: Some(NeededRows { rows, start }), ..self }
    }
    /// The rows with the indices `keep`, in that order. The indices must be below N.
    pub fn select(&self, keep: &[usize]) -> Self {
        let needed = self.needed.as_ref().map(|n| NeededRows { rows: keep.iter().map(|&i| n.rows[i]).collect(), start: n.start });
        Self { width: self.width, values: pick(&self.values, self.width, keep), tolerance: self.tolerance, needed }
    }
}

/// The rows with the indices `keep` of `values` `[N,width]`, in that order.
fn pick(values: &[f32], width: usize, keep: &[usize]) -> Vec<f32> {
    let mut out = Vec::with_capacity(keep.len() * width);
    keep.iter().for_each(|&i| out.extend_from_slice(&values[i * width..(i + 1) * width]));
    out
}

/// Gaussians as plain row-major arrays.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct HostGaussians {
    /// Spherical-harmonics degree of `sh_rest`, 0 to 4.
    pub sh_degree: usize,
    /// Centres in world units `[N,3]`.
    pub means: Vec<f32>,
    /// Natural logarithm of the standard deviations `[N,3]`.
    pub log_scales: Vec<f32>,
    /// Quaternions (w,x,y,z), not normalised `[N,4]`.
    pub quaternions: Vec<f32>,
    /// Opacity before the sigmoid `[N]`.
    pub opacity_logits: Vec<f32>,
    /// Degree-0 colour coefficients `[N,3]`.
    pub sh_dc: Vec<f32>,
    /// Colour coefficients of degree 1 and up, coefficient-major `[N, (d+1)^2-1, 3]`.
    pub sh_rest: Vec<f32>,
    /// Dynamic scores (Swift4D's d, paper Section IV); a Gaussian moves if and only if its score is above the threshold `[N]`.
    pub dynamic_scores: Vec<f32>,
    /// Attributes of plug-ins by name.
    pub extra: BTreeMap<String, ExtraAttribute>,
}

/// The quaternion with length one; `None` where it has no length, and the Gaussian is not drawn.
pub fn unit_quaternion(q: &[f32; 4]) -> Option<[f32; 4]> {
    let norm = q.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
    (norm > 1e-15 && norm.is_finite()).then(|| q.map(|v| (f64::from(v) / norm) as f32))
}

/// Index of the first value that is not finite. Blocks are looked at whole, which compilers turn into vector instructions.
fn first_not_finite(values: &[f32]) -> Option<usize> {
    const BLOCK: usize = 1024;
    let odd = values.chunks(BLOCK).position(|block| block.iter().fold(false, |any, v| any | !v.is_finite()))? * BLOCK;
    Some(odd + values[odd..].iter().position(|v| !v.is_finite())?)
}

impl HostGaussians {
    /// The number of Gaussians N.
    pub fn len(&self) -> usize {
        self.opacity_logits.len()
    }
    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
    /// Lower and upper corner of the box that holds the middle `share` of the finite centres along each axis; zeros without any. With a share below 1, a few
    /// Gaussians far away do not decide how large a model is.
    pub fn central_box(&self, share: f64) -> [[f32; 3]; 2] {
        let tail = 0.5 * (1.0 - share.clamp(0.0, 1.0));
        let axis = |k: usize| {
            let mut values: Vec<f32> = self.means.iter().skip(k).step_by(3).copied().filter(|v| v.is_finite()).collect();
            let Some(end) = values.len().checked_sub(1) else { return [0.0; 2] };
            // Shares such as 0.9 are not exact.
            let left_out = ((tail * values.len() as f64 + 1e-6) as usize).min(end / 2);
            let low = *values.select_nth_unstable_by(left_out, f32::total_cmp).1;
            [low, *values.select_nth_unstable_by(end - left_out, f32::total_cmp).1]
        };
        let [x, y, z] = [0, 1, 2].map(axis);
        [0, 1].map(|end| [x[end], y[end], z[end]])
    }
    /// The named core arrays with their widths, in a fixed order.
    pub fn columns(&self) -> [(&'static str, usize, &Vec<f32>); 7] {
        [
            ("means", 3, &self.means),
            ("log_scales", 3, &self.log_scales),
            ("quaternions", 4, &self.quaternions),
            ("opacity_logits", 1, &self.opacity_logits),
            ("sh_dc", 3, &self.sh_dc),
            ("sh_rest", 3 * sh_rest_len(self.sh_degree), &self.sh_rest),
            ("dynamic_scores", 1, &self.dynamic_scores),
        ]
    }
    /// Mutable access to the same arrays in the same order.
    pub fn columns_mut(&mut self) -> [(&'static str, usize, &mut Vec<f32>); 7] {
        let rest = 3 * sh_rest_len(self.sh_degree);
        [
            ("means", 3, &mut self.means),
            ("log_scales", 3, &mut self.log_scales),
            ("quaternions", 4, &mut self.quaternions),
            ("opacity_logits", 1, &mut self.opacity_logits),
            ("sh_dc", 3, &mut self.sh_dc),
            ("sh_rest", rest, &mut self.sh_rest),
            ("dynamic_scores", 1, &mut self.dynamic_scores),
        ]
    }
    /// Whether every value of the Gaussian `row`, attributes of plug-ins included, is finite.
    pub fn is_finite(&self, row: usize) -> bool {
        let of_row = |width: usize, values: &[f32]| values[row * width..(row + 1) * width].iter().all(|v| v.is_finite());
        self.columns().iter().all(|(_, width, values)| of_row(*width, values)) && self.extra.values().all(|a| of_row(a.width, &a.values))
    }
    /// Refuses arrays of unequal length, a degree above 4, counts over `limits`, and values that are not finite, of Gaussians that a program made. `object`
    /// names them in errors.
    ///
    /// # Errors
    /// [`Error::Data`], [`Error::Limit`], and [`Error::Parameter`] for impossible tolerances or flags of extra attributes.
    pub fn validate(&self, object: &str, limits: &Limits) -> Result<()> {
        self.check(object, limits, "Correct the program that made them")
    }
    /// [`HostGaussians::validate`] of Gaussians that were read from a file or decoded: then the file is at fault.
    ///
    /// # Errors
    /// As [`HostGaussians::validate`].
    pub fn validate_read(&self, object: &str, limits: &Limits) -> Result<()> {
        self.check(object, limits, "The file is damaged; fetch or write it again")
    }
    /// Refuses arrays of unequal length and a degree above 4, of Gaussians that a program made or changed: what cannot be uploaded. Values may be any. `object`
    /// names them in errors.
    ///
    /// # Errors
    /// [`Error::Data`] that names the array.
    pub fn validate_shapes(&self, object: &str) -> Result<()> {
        self.check_shapes(object, "Correct the program that made them")
    }
    fn check_shapes(&self, object: &str, remedy: &str) -> Result<()> {
        let n = self.len();
        if self.sh_degree > 4 {
            return Err(Error::data(object, format!("spherical-harmonics degree {} is over 4", self.sh_degree), "Convert the model to degree 4 or lower"));
        }
        let extra = self.extra.iter().map(|(name, a)| (name.as_str(), a.width, &a.values));
        for (name, width, values) in self.columns().into_iter().chain(extra) {
            if values.len() != n * width {
                return Err(Error::data(object, format!("{name} has {} values, {n} Gaussians need {}", values.len(), n * width), remedy));
            }
        }
        Ok(())
    }
    fn check(&self, object: &str, limits: &Limits, remedy: &str) -> Result<()> {
        let n = self.len();
        limits.check_gaussians(object, n as u64)?;
        self.check_shapes(object, remedy)?;
        let extra = self.extra.iter().map(|(name, a)| (name.as_str(), a.width, &a.values));
        for (name, width, values) in self.columns().into_iter().chain(extra) {
            if let Some(i) = first_not_finite(values) {
                return Err(Error::data(object, format!("{name} of Gaussian {} is {}", i / width.max(1), values[i]), remedy));
            }
        }
        for (name, a) in &self.extra {
            let refuse = |problem: String, remedy: &str| Err(Error::parameter(format!("{object}: attribute {name}"), problem, remedy));
            if let Some(tolerance) = a.tolerance.filter(|t| !(t.is_finite() && *t >= 0.0)) {
                return refuse(format!("a tolerance of {tolerance}"), "Give a finite tolerance of at least 0, or none");
            }
            if let Some(needed) = a.needed.as_ref().filter(|needed| needed.rows.len() != n || !needed.start.is_finite()) {
                return refuse(format!("{} rows and a start value of {} for {n} Gaussians", needed.rows.len(), needed.start), "Give one flag per Gaussian");
            }
        }
        Ok(())
    }
    /// The Gaussians with the indices `keep`, in that order. The indices must be below N.
    pub fn select(&self, keep: &[usize]) -> Self {
        let mut out = Self { sh_degree: self.sh_degree, ..Default::default() };
        for ((_, width, from), (_, _, to)) in self.columns().into_iter().zip(out.columns_mut()) {
            *to = pick(from, width, keep);
        }
        out.extra = self.extra.iter().map(|(name, a)| (name.clone(), a.select(keep))).collect();
        out
    }
}

#[cfg(test)]
mod tests {
    use super::{ExtraAttribute, HostGaussians, unit_quaternion};
    use crate::Limits;

    #[test]
    fn rows_are_selected_in_the_order_asked_for() {
        let mut host = HostGaussians { sh_degree: 1, opacity_logits: vec![0.0; 4], ..Default::default() };
        host.columns_mut().into_iter().for_each(|(_, width, values)| *values = (0..4 * width).map(|k| (k / width) as f32).collect());
        host.extra.insert("a".into(), ExtraAttribute::exact(2, vec![0.0, 0.0, 1.0, 1.0, 2.0, 2.0, 3.0, 3.0]).needed_in(vec![false, true, false, true], 0.5));
        let found = host.select(&[3, 0, 3]);
        for (name, width, values) in found.columns() {
            assert_eq!(*values, [3.0f32, 0.0, 3.0].map(|v| vec![v; width]).concat(), "{name}");
        }
        assert_eq!(found.extra["a"], ExtraAttribute::exact(2, vec![3.0, 3.0, 0.0, 0.0, 3.0, 3.0]).needed_in(vec![true, false, true], 0.5));
    }

    #[test]
    fn whose_fault_invalid_gaussians_are_is_said() {
        let short = HostGaussians { opacity_logits: vec![0.0; 2], means: vec![0.0; 3], ..Default::default() };
        let mut odd = HostGaussians { opacity_logits: vec![f32::NAN], ..Default::default() };
        odd.columns_mut().into_iter().filter(|(name, _, _)| *name != "opacity_logits").for_each(|(_, width, values)| values.resize(width, 0.0));
        for (bad, problem) in [(short, "means has 3 values, 2 Gaussians need 6"), (odd, "opacity_logits of Gaussian 0 is NaN")] {
            let made = bad.validate("these", &Limits::default()).unwrap_err().to_string();
            assert_eq!(made, format!("these: {problem}. Correct the program that made them"));
            let read = bad.validate_read("a.cc4d", &Limits::default()).unwrap_err().to_string();
            assert_eq!(read, format!("a.cc4d: {problem}. The file is damaged; fetch or write it again"));
        }
    }

    #[test]
    fn quaternions_without_a_length_have_no_unit() {
        assert_eq!(unit_quaternion(&[0.0, -3.0, 0.0, 4.0]), Some([0.0, -0.6, 0.0, 0.8]));
        assert_eq!(unit_quaternion(&[1e-30; 4]), None);
        assert_eq!(unit_quaternion(&[f32::NAN; 4]), None);
    }

    #[test]
    fn few_gaussians_far_away_do_not_decide_how_large_a_model_is() {
        let mut host = HostGaussians { means: (0..100).flat_map(|i| [i as f32, -(i as f32), 1.0]).collect(), ..Default::default() };
        assert_eq!(host.central_box(1.0), [[0.0, -99.0, 1.0], [99.0, 0.0, 1.0]]);
        host.means[..3].copy_from_slice(&[1e9, f32::NAN, -1e9]);
        assert_eq!(host.central_box(0.9), [[6.0, -95.0, 1.0], [95.0, -5.0, 1.0]]);
        assert_eq!(HostGaussians::default().central_box(0.9), [[0.0; 3]; 2]);
        assert_eq!(HostGaussians { means: vec![4.0, 5.0, 6.0], ..Default::default() }.central_box(0.0), [[4.0, 5.0, 6.0]; 2]);
    }
}
