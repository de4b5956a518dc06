//! Writers of tiny datasets.

use cc4dgs_core::{Camera, Error, Limits, Registry, Scene, SceneOptions, Split};
use std::path::{Path, PathBuf};

pub fn options() -> SceneOptions {
    SceneOptions::default()
}

pub fn load(path: &Path) -> Result<Scene, Error> {
    open(path, &options(), &Limits::default())
}

/// Opens a dataset with all readers linked into the tests.
pub fn open(path: &Path, options: &SceneOptions, limits: &Limits) -> Result<Scene, Error> {
    cc4dgs_train::data::open(path, options, &Registry::collect().unwrap(), limits)
}

/// An image whose pixel (x, y) is [x, y, marker] (and alpha).
pub fn write_image(path: &Path, width: u32, height: u32, marker: u8) {
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    let pixels = image::RgbImage::from_fn(width, height, |x, y| image::Rgb([x as u8, y as u8, marker]));
    pixels.save(path).unwrap();
}

/// A depth image whose pixel (x, y) has `steps(x, y)`.
pub fn write_depth(path: &Path, width: u32, height: u32, steps: impl Fn(u32, u32) -> u16) {
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    image::ImageBuffer::from_fn(width, height, |x, y| image::Luma([steps(x, y)])).save(path).unwrap();
}

pub fn write_rgba_image(path: &Path, width: u32, height: u32, pixel: [u8; 4]) {
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    image::RgbaImage::from_pixel(width, height, image::Rgba(pixel)).save(path).unwrap();
}

/// Cameras on a circle of radius 4 around the origin, z up.
pub fn ring(count: usize, width: u32, height: u32) -> Vec<Camera> {
    (0..count)
        .map(|i| {
            let (s, c) = (i as f64 / count as f64 * std::f64::consts::TAU).sin_cos();
            Camera::look_at(&format!("c{i}"), (width, height), 0.8, [4.0 * c, 4.0 * s, 1.0], [0.0; 3], [0.0, 0.0, 1.0])
        })
        .collect()
}

/// OpenGL camera-to-world of an OpenCV world-to-camera, as JSON datasets store it.
pub fn opengl_camera_to_world(camera: &Camera) -> Vec<Vec<f64>> {
    let m = &camera.world_to_camera;
    let c = camera.center_world();
    let mut rows: Vec<Vec<f64>> = (0..3).map(|i| vec![m[0][i], -m[1][i], -m[2][i], c[i]]).collect();
    rows.push(vec![0.0, 0.0, 0.0, 1.0]);
    rows
}

/// Quaternion (w,x,y,z) and translation of a camera.
pub fn quaternion(camera: &Camera) -> ([f64; 4], [f64; 3]) {
    let (r, t) = camera.rotation_translation();
    let q = glam::DQuat::from_mat3(&r);
    ([q.w, q.x, q.y, q.z], t.to_array())
}

/// Pixel coordinates and depth of a world point.
pub fn project(camera: &Camera, p: [f64; 3]) -> (f64, f64, f64) {
    let m = &camera.world_to_camera;
    let c: Vec<f64> = (0..3).map(|i| m[i][0] * p[0] + m[i][1] * p[1] + m[i][2] * p[2] + m[i][3]).collect();
    (camera.fx * c[0] / c[2] + camera.cx, camera.fy * c[1] / c[2] + camera.cy, c[2])
}

/// The camera of a view, in the coordinates of the dataset.
pub fn dataset_camera(scene: &Scene, view: usize) -> Camera {
    scene.normalisation.inverse().apply_camera(scene.camera(view))
}

/// A position of a scene, in the coordinates of the dataset.
pub fn dataset_point(scene: &Scene, p: [f32; 3]) -> [f64; 3] {
    scene.normalisation.inverse().apply(p.map(f64::from))
}

pub fn same_pose(a: &Camera, b: &Camera) {
    for (x, y) in a.world_to_camera.iter().flatten().zip(b.world_to_camera.iter().flatten()) {
        assert!((x - y).abs() < 1e-9, "{}: {:?} against {:?}", a.name, a.world_to_camera, b.world_to_camera);
    }
}

/// A float64 `.npy`.
pub fn npy(shape: &[usize], values: &[f64]) -> Vec<u8> {
    let shape: String = shape.iter().map(|n| format!("{n}, ")).collect();
    let header = format!("{{'descr': '<f8', 'fortran_order': False, 'shape': ({shape}), }}\n");
    let mut out = b"\x93NUMPY\x01\x00".to_vec();
    out.extend((header.len() as u16).to_le_bytes());
    out.extend(header.as_bytes());
    values.iter().for_each(|v| out.extend(v.to_le_bytes()));
    out
}

/// A D-NeRF scene: `train` and `test` views, RGBA images of `size` pixels.
pub fn write_dnerf(root: &Path, train: usize, test: usize, size: u32) -> Vec<Camera> {
    let cameras = ring(train + test, size, size);
    for (name, range) in [("train", 0..train), ("test", train..train + test)] {
        let frames: Vec<_> = range
            .clone()
            .map(|i| {
                let index = i - range.start;
                write_rgba_image(&root.join(name).join(format!("r_{index:03}.png")), size, size, [10, 20, 30, 255]);
                let time = index as f64 / (range.len().max(2) - 1) as f64;
                serde_json::json!({"file_path": format!("./{name}/r_{index:03}"), "time": time, "transform_matrix": opengl_camera_to_world(&cameras[i])})
            })
            .collect();
        let document = serde_json::json!({"camera_angle_x": 0.8, "frames": frames});
        std::fs::write(root.join(format!("transforms_{name}.json")), document.to_string()).unwrap();
    }
    cameras
}

/// A PanopticSports scene with `train` + 1 cameras and `frames` times; returns the training cameras.
pub fn write_panoptic(root: &Path, train: usize, frames: usize) -> Vec<Camera> {
    let cameras = ring(train + 1, 16, 12);
    for (name, range) in [("train", 0..train), ("test", train..train + 1)] {
        let per_time = |f: &dyn Fn(usize, usize) -> serde_json::Value| -> Vec<Vec<serde_json::Value>> {
            (0..frames).map(|t| range.clone().map(|c| f(t, c)).collect()).collect()
        };
        let document = serde_json::json!({
            "w": 16, "h": 12,
            "k": per_time(&|_, c| serde_json::json!([[cameras[c].fx, 0.0, cameras[c].cx], [0.0, cameras[c].fy, cameras[c].cy], [0.0, 0.0, 1.0]])),
            "w2c": per_time(&|_, c| serde_json::json!(cameras[c].world_to_camera)),
            "fn": per_time(&|t, c| serde_json::json!(format!("{c}/{t:06}.png"))),
            "cam_id": per_time(&|_, c| serde_json::json!(c)),
        });
        std::fs::write(root.join(format!("{name}_meta.json")), document.to_string()).unwrap();
        for t in 0..frames {
            for c in range.clone() {
                write_image(&root.join(format!("ims/{c}/{t:06}.png")), 16, 12, (10 * c + t) as u8);
            }
        }
    }
    cameras
}

/// `poses_bounds.npy` for cameras at the given size.
pub fn llff_rows(cameras: &[Camera]) -> Vec<f64> {
    let mut values = Vec::new();
    for camera in cameras {
        let (m, c) = (&camera.world_to_camera, camera.center_world());
        let hwf = [f64::from(camera.height), f64::from(camera.width), camera.fx];
        for i in 0..3 {
            // Axes down, right, backwards.
            values.extend([m[1][i], m[0][i], -m[2][i], c[i], hwf[i]]);
        }
        values.extend([2.0, 9.0]);
    }
    values
}

/// COLMAP binary files for pinhole cameras, one per image, and a few points; returns (cameras, images, points3D).
pub fn colmap_binary(cameras: &[Camera], names: &[String]) -> [Vec<u8>; 3] {
    let n = (cameras.len() as u64).to_le_bytes();
    let (mut c, mut i, mut p) = (n.to_vec(), n.to_vec(), 2u64.to_le_bytes().to_vec());
    for (index, (camera, name)) in cameras.iter().zip(names).enumerate() {
        c.extend((index as u32 + 1).to_le_bytes());
        c.extend(1i32.to_le_bytes());
        c.extend(u64::from(camera.width).to_le_bytes());
        c.extend(u64::from(camera.height).to_le_bytes());
        [camera.fx, camera.fy, camera.cx, camera.cy].iter().for_each(|v| c.extend(v.to_le_bytes()));
        let (q, t) = quaternion(camera);
        i.extend((index as u32 + 1).to_le_bytes());
        q.iter().chain(&t).for_each(|v| i.extend(v.to_le_bytes()));
        i.extend((index as u32 + 1).to_le_bytes());
        i.extend(name.as_bytes());
        i.push(0);
        i.extend(1u64.to_le_bytes());
        i.extend([0u8; 24]);
    }
    for k in 0..2u64 {
        p.extend(k.to_le_bytes());
        [0.5 * k as f64, -1.0, 2.0].iter().for_each(|v: &f64| p.extend(v.to_le_bytes()));
        p.extend([255, 128, 0]);
        p.extend(0.1f64.to_le_bytes());
        p.extend(1u64.to_le_bytes());
        p.extend([0u8; 8]);
    }
    [c, i, p]
}

/// A COLMAP scene of three images, in binary form.
pub fn write_colmap(root: &Path) {
    let cameras = ring(3, 16, 12);
    let names: Vec<String> = (0..3).map(|i| format!("{i}.png")).collect();
    names.iter().for_each(|n| write_image(&root.join("images").join(n), 16, 12, 0));
    std::fs::create_dir_all(root.join("sparse/0")).unwrap();
    for (file, bytes) in ["cameras", "images", "points3D"].iter().zip(colmap_binary(&cameras, &names)) {
        std::fs::write(root.join(format!("sparse/0/{file}.bin")), bytes).unwrap();
    }
}

/// A LLFF scene of three images.
pub fn write_llff(root: &Path) {
    std::fs::write(root.join("poses_bounds.npy"), npy(&[3, 17], &llff_rows(&ring(3, 16, 12)))).unwrap();
    (0..3).for_each(|c| write_image(&root.join(format!("images/{c}.png")), 16, 12, 0));
}

/// A PLY of red points at `positions`, as COLMAP's stereo fusion writes it.
pub fn write_cloud(path: &Path, positions: &[[f32; 3]]) {
    let properties: String = ["float x", "float y", "float z", "uchar red", "uchar green", "uchar blue"].iter().map(|p| format!("property {p}\n")).collect();
    let mut ply = format!("ply\nformat binary_little_endian 1.0\nelement vertex {}\n{properties}end_header\n", positions.len()).into_bytes();
    for position in positions {
        ply.extend(position.iter().flat_map(|v| v.to_le_bytes()));
        ply.extend([255, 0, 0]);
    }
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    std::fs::write(path, ply).unwrap();
}

/// A nerfstudio scene of `count` images.
pub fn write_nerfstudio(root: &Path, count: usize) -> Vec<Camera> {
    let cameras = ring(count, 16, 12);
    let frame = |(i, camera): (usize, &Camera)| {
        write_image(&root.join(format!("images/{i:04}.png")), 16, 12, i as u8);
        serde_json::json!({"file_path": format!("images/{i:04}.png"), "transform_matrix": opengl_camera_to_world(camera)})
    };
    let frames: Vec<_> = cameras.iter().enumerate().map(frame).collect();
    let document = serde_json::json!({"fl_x": cameras[0].fx, "fl_y": cameras[0].fy, "cx": 8.0, "cy": 6.0, "w": 16, "h": 12, "frames": frames});
    std::fs::write(root.join("transforms.json"), document.to_string()).unwrap();
    cameras
}

/// A Technicolor scene called Painter with the given frames. Its images have a 64th of the size that its cameras are calibrated for; the returned ones have the
/// size of the images.
pub fn write_technicolor(root: &Path, count: u8, frames: &[u32]) -> Vec<Camera> {
    let cameras = ring(usize::from(count), 32, 17);
    let mut text = "header line\n".to_string();
    for camera in &cameras {
        let (q, t) = quaternion(camera);
        text += &format!("{} 1088 480 0 0 {} {} {} {} {} {} {}\n", 64.0 * camera.fx, q[0], q[1], q[2], q[3], t[0], t[1], t[2]);
    }
    std::fs::write(root.join("cameras_parameters.txt"), text).unwrap();
    for frame in frames {
        (0..count).for_each(|c| write_image(&root.join(format!("Painter_undist_{frame:05}_{c:02}.png")), 32, 17, c));
    }
    cameras
}

/// A folder of real data, in `CC4DGS_DATA` or beside the repository; prints a note and returns `None` if absent.
pub fn real(name: &str) -> Option<PathBuf> {
    let root = std::env::var_os("CC4DGS_DATA").map(PathBuf::from).unwrap_or_else(|| PathBuf::from("../../shared/data"));
    let path = root.join(name);
    if !path.is_dir() {
        eprintln!("skipped: {} is absent (set CC4DGS_DATA)", path.display());
        return None;
    }
    Some(path)
}

/// Training and test views.
pub fn train_count(scene: &Scene) -> (usize, usize) {
    (scene.split(Split::Train).len(), scene.split(Split::Test).len())
}
