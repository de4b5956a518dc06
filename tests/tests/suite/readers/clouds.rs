//! First points of scenes whose poses are no COLMAP model: dense clouds of published scripts before sparse points, both in the world of the poses.

use super::common::*;
use cc4dgs_core::{Camera, Scene};
use std::path::Path;

/// The positions of the scene's points in the coordinates of the dataset, rounded to thousandths.
fn points(scene: &Scene) -> Vec<[i64; 3]> {
    let cloud = scene.points.as_ref().map(|cloud| cloud.positions.as_slice()).unwrap_or_default();
    cloud.iter().map(|p| dataset_point(scene, *p).map(|v| (1000.0 * v).round() as i64)).collect()
}

/// A COLMAP model of `cameras` in `folder`, with the two points of [`colmap_binary`].
fn write_model(folder: &Path, cameras: &[Camera], names: &[String]) {
    std::fs::create_dir_all(folder).unwrap();
    for (file, bytes) in ["cameras", "images", "points3D"].iter().zip(colmap_binary(cameras, names)) {
        std::fs::write(folder.join(format!("{file}.bin")), bytes).unwrap();
    }
}

const SPARSE: [[i64; 3]; 2] = [[0, -1000, 2000], [500, -1000, 2000]];

#[test]
fn llff_takes_dense_clouds_before_the_sparse_model() {
    let dir = tempfile::tempdir().unwrap();
    write_llff(dir.path());
    assert!(load(dir.path()).unwrap().points.is_none());
    let names: Vec<String> = (0..3).map(|i| format!("{i}.png")).collect();
    write_model(&dir.path().join("sparse/0"), &ring(3, 16, 12), &names);
    assert_eq!(points(&load(dir.path()).unwrap()), SPARSE);
    write_cloud(&dir.path().join("colmap/dense/workspace/fused.ply"), &[[0.25, 0.5, -0.25]]);
    let scene = load(dir.path()).unwrap();
    assert_eq!(points(&scene), [[250, 500, -250]]);
    assert_eq!(scene.points.as_ref().unwrap().colors, [[1.0, 0.0, 0.0]]);
    write_cloud(&dir.path().join("points3D_downsample2.ply"), &[[0.0, 0.5, 0.125], [0.5, 0.0, 0.0]]);
    let scene = load(dir.path()).unwrap();
    assert_eq!(points(&scene), [[0, 500, 125], [500, 0, 0]]);
    assert!(!scene.warnings.iter().any(|w| w.contains(".ply")), "{:?}", scene.warnings);
    // The model of the workspace counts by its poses, not by its names.
    let names: Vec<String> = (0..3).map(|i| format!("r_{i:03}.png")).collect();
    let workspace = dir.path().join("colmap/dense/workspace/sparse");
    write_model(&workspace, &ring(3, 16, 12), &names);
    assert_eq!(points(&load(dir.path()).unwrap()), [[0, 500, 125], [500, 0, 0]]);
    write_model(&workspace, &ring(9, 16, 12)[1..3], &names[..2]);
    let scene = load(dir.path()).unwrap();
    assert_eq!(points(&scene), SPARSE, "of the model whose poses agree");
    let told = scene.warnings.iter().filter(|w| w.contains("colmap/dense/workspace/sparse has its cameras elsewhere than poses_bounds.npy")).count();
    assert_eq!(told, 2, "{:?}", scene.warnings);
}

#[test]
fn technicolor_takes_dense_clouds_before_the_sparse_model() {
    let dir = tempfile::tempdir().unwrap();
    let cameras = write_technicolor(dir.path(), 12, &[100]);
    assert!(load(dir.path()).unwrap().points.is_none());
    let names: Vec<String> = (0..12).map(|i| format!("cam{i:02}.png")).collect();
    write_model(&dir.path().join("sparse/0"), &cameras, &names);
    assert_eq!(points(&load(dir.path()).unwrap()), SPARSE);
    // Of three points one lies above all images.
    write_cloud(&dir.path().join("points3D_downsample.ply"), &[[0.25, 0.5, -0.25], [0.0, 0.0, 90.0], [0.5, 0.0, 0.0]]);
    let scene = load(dir.path()).unwrap();
    assert_eq!(points(&scene), [[250, 500, -250], [500, 0, 0]]);
    assert!(scene.warnings.iter().any(|w| w.contains("points3D_downsample.ply: 1 of 3 points is outside of all images")), "{:?}", scene.warnings);
    write_cloud(&dir.path().join("points3D_downsample.ply"), &[[0.0, 0.0, 90.0]]);
    let scene = load(dir.path()).unwrap();
    assert_eq!(points(&scene), SPARSE);
    assert!(scene.warnings.iter().any(|w| w.contains("1 of 1 point is outside of all images, so it is in another world")), "{:?}", scene.warnings);
}
