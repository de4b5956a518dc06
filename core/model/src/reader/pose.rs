//! Conversion of camera poses to rigid OpenCV world-to-camera transforms. Errors are texts; the reader adds file and frame.

use glam::{DMat3, DQuat, DVec3};

/// Row-major 4x4.
pub type Matrix4 = [[f64; 4]; 4];

/// A JSON matrix of 3 or 4 rows with 4 columns.
pub fn matrix4(rows: &[Vec<f64>]) -> Result<Matrix4, String> {
    if !(rows.len() == 3 || rows.len() == 4) || rows.iter().any(|r| r.len() != 4) {
        return Err(format!("the matrix has {} rows of {:?} columns, not 4x4", rows.len(), rows.iter().map(Vec::len).collect::<Vec<_>>()));
    }
    let mut m = [[0.0, 0.0, 0.0, 0.0], [0.0; 4], [0.0; 4], [0.0, 0.0, 0.0, 1.0]];
    for (to, from) in m.iter_mut().zip(rows).take(3) {
        to.copy_from_slice(from);
    }
    Ok(m)
}

/// World-to-camera from the camera's axes (columns: right, down, forward) and centre in the world.
pub fn world_to_camera(axes: DMat3, center: DVec3) -> Matrix4 {
    let row = |a: DVec3| [a.x, a.y, a.z, -a.dot(center)];
    [row(axes.x_axis), row(axes.y_axis), row(axes.z_axis), [0.0, 0.0, 0.0, 1.0]]
}

/// Camera-to-world in OpenGL axes (x right, y up, z backwards) to OpenCV world-to-camera: the y and z columns change sign, then the inverse.
pub fn from_opengl_camera_to_world(m: &Matrix4) -> Result<Matrix4, String> {
    let column = |j: usize| DVec3::new(m[0][j], m[1][j], m[2][j]);
    let axes = orthonormal(DMat3::from_cols(column(0), -column(1), -column(2)))?;
    Ok(world_to_camera(axes, column(3)))
}

/// World-to-camera from a quaternion (w,x,y,z) and a translation, both world to camera.
pub fn from_quaternion(wxyz: [f64; 4], t: [f64; 3]) -> Result<Matrix4, String> {
    let q = DQuat::from_xyzw(wxyz[1], wxyz[2], wxyz[3], wxyz[0]);
    if !(q.length().is_finite() && q.length() > 1e-8) {
        return Err(format!("quaternion {wxyz:?} has norm zero or is not finite"));
    }
    let r = DMat3::from_quat(q.normalize());
    let row = |i: usize| [r.x_axis[i], r.y_axis[i], r.z_axis[i], t[i]];
    Ok([row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]])
}

/// The rotation of `m` by Gram-Schmidt. A uniform scale is removed; shear and mirroring are refused.
fn orthonormal(m: DMat3) -> Result<DMat3, String> {
    let lengths = [m.x_axis.length(), m.y_axis.length(), m.z_axis.length()];
    let mean = lengths.iter().sum::<f64>() / 3.0;
    if !(mean.is_finite() && mean > 1e-12) {
        return Err("the rotation is not finite or is zero".into());
    }
    let z = m.z_axis / lengths[2];
    let x = (m.x_axis - z * m.x_axis.dot(z)).normalize_or_zero();
    let r = DMat3::from_cols(x, z.cross(x), z);
    let error = (r - m * (1.0 / mean)).to_cols_array().iter().fold(0.0f64, |a, v| a.max(v.abs()));
    if error.is_nan() || error > 0.02 {
        return Err(format!("the rotation is not orthogonal or is mirrored (deviation {error:.3})"));
    }
    Ok(r)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn opengl_identity_looks_along_minus_z() {
        let m = matrix4(&[vec![1.0, 0.0, 0.0, 0.0], vec![0.0, 1.0, 0.0, 0.0], vec![0.0, 0.0, 1.0, 4.0], vec![0.0, 0.0, 0.0, 1.0]]).unwrap();
        let w2c = from_opengl_camera_to_world(&m).unwrap();
        // The origin is 4 in front of the camera; a point above it (y up) is above the centre (y down).
        let apply = |p: [f64; 3]| [0, 1, 2].map(|i| (0..3).map(|j| w2c[i][j] * p[j]).sum::<f64>() + w2c[i][3]);
        assert_eq!(apply([0.0, 0.0, 0.0]), [0.0, 0.0, 4.0]);
        assert_eq!(apply([1.0, 1.0, 0.0]), [1.0, -1.0, 4.0]);
    }

    #[test]
    fn scale_is_taken_out_and_mirrors_are_refused() {
        let eye = |s: [f64; 3]| vec![vec![s[0], 0.0, 0.0, 0.0], vec![0.0, s[1], 0.0, 0.0], vec![0.0, 0.0, s[2], 0.0]];
        let scaled = from_opengl_camera_to_world(&matrix4(&eye([2.0; 3])).unwrap()).unwrap();
        assert_eq!(scaled[0][0], 1.0);
        assert!(from_opengl_camera_to_world(&matrix4(&eye([-1.0, 1.0, 1.0])).unwrap()).is_err());
        assert!(from_opengl_camera_to_world(&matrix4(&eye([1.0, 1.0, 3.0])).unwrap()).is_err());
        assert!(from_opengl_camera_to_world(&matrix4(&eye([0.0; 3])).unwrap()).is_err());
        assert!(matrix4(&[vec![1.0]]).is_err());
    }
}
