//! The canonical Gaussians as burn tensors, and their conversion from and to plain arrays.
//!
//! All values are raw (before activation): scale = exp(log_scale), opacity = sigmoid(logit), rotation = normalise(quaternion).

use crate::{Error, Result};
use burn::tensor::{Device, Tensor, TensorData};
pub use cc4dgs_format::gaussians::{CORE_ATTRIBUTES, ExtraAttribute, HostGaussians, NeededRows, sh_rest_len};
use std::collections::BTreeMap;

/// Gaussians as burn tensors on one device.
#[derive(Clone, Debug)]
pub struct Gaussians {
    /// Spherical-harmonics degree stored in `sh_rest`, 0 to 4.
    pub sh_degree: usize,
    /// Centres in world units `[N,3]`.
    pub means: Tensor<2>,
    /// Natural logarithm of the standard deviations `[N,3]`.
    pub log_scales: Tensor<2>,
    /// Quaternions (w,x,y,z), not normalised `[N,4]`.
    pub quaternions: Tensor<2>,
    /// Opacity before the sigmoid `[N]`.
    pub opacity_logits: Tensor<1>,
    /// Degree-0 colour coefficients `[N,3]`.
    pub sh_dc: Tensor<2>,
    /// Higher colour coefficients `[N, (d+1)^2-1, 3]`.
    pub sh_rest: Tensor<3>,
    /// Dynamic scores `[N]`.
    pub dynamic_scores: Tensor<1>,
    /// Attributes of plug-ins by name `[N, width]`.
    pub extra: BTreeMap<String, Tensor<2>>,
}

impl Gaussians {
    /// Uploads plain arrays to `device`.
    pub fn from_host(host: &HostGaussians, device: &Device) -> Self {
        Self::of_host(host.clone(), device)
    }
    /// [`Gaussians::from_host`] of arrays that are not needed any more: on processors they become the tensors without a copy.
    pub fn of_host(host: HostGaussians, device: &Device) -> Self {
        let n = host.len();
        let two = |values: Vec<f32>, width: usize| Tensor::<2>::from_data(TensorData::new(values, [n, width]), device);
        let one = |values: Vec<f32>| Tensor::<1>::from_data(TensorData::new(values, [n]), device);
        Self {
            sh_degree: host.sh_degree,
            means: two(host.means, 3),
            log_scales: two(host.log_scales, 3),
            quaternions: two(host.quaternions, 4),
            opacity_logits: one(host.opacity_logits),
            sh_dc: two(host.sh_dc, 3),
            sh_rest: Tensor::<3>::from_data(TensorData::new(host.sh_rest, [n, sh_rest_len(host.sh_degree), 3]), device),
            dynamic_scores: one(host.dynamic_scores),
            extra: host.extra.into_iter().map(|(name, a)| (name, two(a.values, a.width))).collect(),
        }
    }
    /// Reads the tensors back into plain arrays.
    ///
    /// # Errors
    /// [`Error::Backend`] if a tensor cannot be read.
    pub fn to_host(&self) -> Result<HostGaussians> {
        Ok(HostGaussians {
            sh_degree: self.sh_degree,
            means: to_vec(self.means.clone(), "means")?,
            log_scales: to_vec(self.log_scales.clone(), "log_scales")?,
            quaternions: to_vec(self.quaternions.clone(), "quaternions")?,
            opacity_logits: to_vec(self.opacity_logits.clone(), "opacity_logits")?,
            sh_dc: to_vec(self.sh_dc.clone(), "sh_dc")?,
            sh_rest: to_vec(self.sh_rest.clone(), "sh_rest")?,
            dynamic_scores: to_vec(self.dynamic_scores.clone(), "dynamic_scores")?,
            extra: self
                .extra
                .iter()
                .map(|(name, t)| Ok((name.clone(), ExtraAttribute::exact(t.dims()[1], to_vec(t.clone(), name)?))))
                .collect::<Result<_>>()?,
        })
    }
    /// Names of all attributes: the core ones in the order of [`CORE_ATTRIBUTES`], then those of plug-ins.
    pub fn attribute_names(&self) -> Vec<String> {
        CORE_ATTRIBUTES.iter().map(ToString::to_string).chain(self.extra.keys().cloned()).collect()
    }
    /// An attribute by name, as rows `[N,width]`; `None` for an unknown name.
    pub fn attribute(&self, name: &str) -> Option<Tensor<2>> {
        let n = self.len();
        Some(match name {
            "means" => self.means.clone(),
            "log_scales" => self.log_scales.clone(),
            "quaternions" => self.quaternions.clone(),
            "opacity_logits" => self.opacity_logits.clone().reshape([n, 1]),
            "sh_dc" => self.sh_dc.clone(),
            "sh_rest" => self.sh_rest.clone().reshape([n, 3 * sh_rest_len(self.sh_degree)]),
            "dynamic_scores" => self.dynamic_scores.clone().reshape([n, 1]),
            other => self.extra.get(other)?.clone(),
        })
    }
    /// Gaussians from named attributes `[N,width]`. Names that are not core attributes are attributes of plug-ins.
    ///
    /// # Errors
    /// [`Error::Data`] if a core attribute is missing or has another width.
    pub fn from_attributes(sh_degree: usize, attributes: impl IntoIterator<Item = (String, Tensor<2>)>) -> Result<Self> {
        let mut by_name: BTreeMap<String, Tensor<2>> = attributes.into_iter().collect();
        let mut take = |name: &str, width: usize| match by_name.remove(name) {
            Some(values) if values.dims()[1] == width => Ok(values),
            Some(values) => {
                Err(Error::data(format!("attribute {name}"), format!("it has width {}, expected {width}", values.dims()[1]), "Use arrays of one model"))
            }
            None => Err(Error::data(format!("attribute {name}"), "it is missing", "Every Gaussian needs it")),
        };
        let rest = sh_rest_len(sh_degree);
        let (means, log_scales, quaternions) = (take("means", 3)?, take("log_scales", 3)?, take("quaternions", 4)?);
        let (opacity_logits, sh_dc, sh_rest, dynamic_scores) =
            (take("opacity_logits", 1)?, take("sh_dc", 3)?, take("sh_rest", 3 * rest)?, take("dynamic_scores", 1)?);
        let n = means.dims()[0];
        Ok(Self {
            sh_degree,
            means,
            log_scales,
            quaternions,
            opacity_logits: opacity_logits.reshape([n]),
            sh_dc,
            sh_rest: sh_rest.reshape([n, rest, 3]),
            dynamic_scores: dynamic_scores.reshape([n]),
            extra: by_name,
        })
    }
    /// The number of Gaussians N.
    pub fn len(&self) -> usize {
        self.means.dims()[0]
    }
    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// The first `count` rows of `values` `[N,…]`, as one piece: derivatives of burn's `narrow` go row by row.
pub fn first_rows<const D: usize>(values: Tensor<D>, count: usize) -> Tensor<D> {
    let mut dims = values.dims();
    if dims[0] == count {
        return values;
    }
    let [all, some] = [dims[0], count].map(|rows| rows * dims[1..].iter().product::<usize>());
    dims[0] = count;
    values.reshape([all]).narrow(0, 0, some).reshape(dims)
}

/// Reads a float tensor back, row-major; `object` names it in errors. On processors the values of a tensor with no other owner are not copied.
///
/// # Errors
/// [`Error::Backend`] if the device fails.
pub fn to_vec<const D: usize>(tensor: Tensor<D>, object: &str) -> Result<Vec<f32>> {
    let failed = |problem: String| Error::backend(object, format!("reading the tensor back failed: {problem}"), "Try another device (--device flex)");
    tensor.try_into_data().map_err(|e| failed(format!("{e:?}")))?.try_into_vec::<f32>().map_err(|e| failed(format!("{e:?}")))
}
