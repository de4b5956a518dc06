//! Spherical harmonics of degree 0 to 4 as polynomials of a unit direction.

use super::real::Real;

/// The basis values up to `degree`, in the order of the coefficients.
pub fn basis<T: Real>(degree: usize, direction: [T; 3]) -> Vec<T> {
    let [x, y, z] = direction;
    let c = T::constant;
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let mut b = vec![c(0.28209479177387814)];
    if degree >= 1 {
        let k = c(0.4886025119029199);
        b.extend([-k * y, k * z, -k * x]);
    }
    if degree >= 2 {
        let k = c(1.0925484305920792);
        b.extend([k * x * y, -k * y * z, c(0.31539156525252005) * (c(2.0) * zz - xx - yy), -k * x * z, c(0.5462742152960396) * (xx - yy)]);
    }
    if degree >= 3 {
        let side = c(4.0) * zz - xx - yy;
        b.extend([
            c(-0.5900435899266435) * y * (c(3.0) * xx - yy),
            c(2.890611442640554) * x * y * z,
            c(-0.4570457994644658) * y * side,
            c(0.3731763325901154) * z * (c(2.0) * zz - c(3.0) * xx - c(3.0) * yy),
            c(-0.4570457994644658) * x * side,
            c(1.445305721320277) * z * (xx - yy),
            c(-0.5900435899266435) * x * (xx - c(3.0) * yy),
        ]);
    }
    if degree >= 4 {
        let seven = c(7.0) * zz;
        b.extend([
            c(2.5033429417967046) * x * y * (xx - yy),
            c(-1.7701307697799304) * y * z * (c(3.0) * xx - yy),
            c(0.9461746957575601) * x * y * (seven - c(1.0)),
            c(-0.6690465435572892) * y * z * (seven - c(3.0)),
            c(0.10578554691520431) * (zz * (c(35.0) * zz - c(30.0)) + c(3.0)),
            c(-0.6690465435572892) * x * z * (seven - c(3.0)),
            c(0.47308734787878004) * (xx - yy) * (seven - c(1.0)),
            c(-1.7701307697799304) * x * z * (xx - c(3.0) * yy),
            c(0.6258357354491761) * (xx * (xx - c(3.0) * yy) - yy * (c(3.0) * xx - yy)),
        ]);
    }
    b
}
