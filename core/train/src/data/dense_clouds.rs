//! First points for readers whose poses are no COLMAP model: a dense cloud, as the scripts of 4DGS, Swift4D and E-D3DGS prepare it, else a sparse model.
//!
//! These scripts write the poses of `poses_bounds.npy` or `cameras_parameters.txt` into a COLMAP model, in the same world (only the axes of LLFF cameras are
//! renamed), and triangulate with the poses fixed. Their loaders use the clouds without a transform, and so does this.
//!
//! A reconstruction with free poses has another world. Its model shows that, because its cameras stand elsewhere. Where a cloud comes without a model, only
//! visibility is checked, which is a weak test: all cameras of a rig that faces one way may see a cloud of another world.

use super::{colmap, ply_points};
use cc4dgs_core::reader::files::read_bytes;
use cc4dgs_core::{Error, Limits, RawCamera, RawPoints, Result, plural};
use std::path::Path;

/// The models that a cloud may be computed from, relative to the folder of the scene; the first one there counts. In order: the workspace of all scripts, the
/// triangulation of 4DGS and Swift4D, that of E-D3DGS, and a workspace without `colmap/`.
const MODELS: [&str; 4] = ["colmap/dense/workspace/sparse", "colmap/sparse/0", "colmap/distorted/sparse", "dense/workspace/sparse"];

/// Clouds in order of preference, relative to the folder of the scene, with their models. 4DGS and Swift4D train with the first, E-D3DGS with the second; both
/// are downsampled from the third.
const CLOUDS: [(&str, &[&str]); 4] = [
    ("points3D_downsample2.ply", &MODELS),
    ("points3D_downsample.ply", &MODELS),
    ("colmap/dense/workspace/fused.ply", &MODELS),
    ("dense/workspace/fused.ply", &["dense/workspace/sparse"]),
];

/// The first points of the scene in the folder `path`, in the world of `cameras`: those of the first dense cloud that fits, else those of a sparse model with
/// the same poses. `poses` is the name of the file of poses. Warnings say which clouds are not used and why.
///
/// Errors: [`Error::Data`] and [`Error::Io`] for a cloud that cannot be read, [`Error::Limit`] for one over `limits`.
pub(super) fn first_points(path: &Path, poses: &str, cameras: &[RawCamera], limits: &Limits, warnings: &mut Vec<String>) -> Result<Option<RawPoints>> {
    for (name, models) in CLOUDS {
        let file = path.join(name);
        if !file.exists() {
            continue;
        }
        let object = file.display().to_string();
        let model = models.iter().find_map(|model| Some((model, colmap::stands_with(&path.join(model), cameras, limits)?)));
        if let Some((model, false)) = model {
            let problem = format!("its model {model} has its cameras elsewhere than {poses}");
            warnings.push(in_another_world(&object, &problem, poses));
            continue;
        }
        let cloud = read_bytes(&file, limits).and_then(|bytes| ply_points::points_or_none(&object, &bytes, limits)).map_err(or_remove)?;
        let count = cloud.positions.len();
        if count == 0 {
            warnings.push(format!("{object} is not used: it has no points"));
            continue;
        }
        let seen = cloud.positions.into_iter().zip(cloud.colors).filter(|(position, _)| is_seen(cameras, *position));
        let (positions, colors): (Vec<_>, Vec<_>) = seen.unzip();
        let unseen = count - positions.len();
        // Each point of a dense cloud was matched in several images.
        if 2 * unseen > count {
            let problem = format!("{unseen} of {count} {} outside of all images", plural(count, "point is", "points are"));
            warnings.push(in_another_world(&object, &problem, poses));
            continue;
        }
        if unseen > 0 {
            let [are, were] = [plural(unseen, "is", "are"), plural(unseen, "was", "were")];
            warnings.push(format!("{object}: {unseen} of {count} points {are} outside of all images and {were} left out"));
        }
        return Ok(Some(RawPoints { positions, colors }));
    }
    // The cameras do not need a sparse model.
    Ok(colmap::points_in_same_world(path, cameras, limits).unwrap_or_else(|error| {
        warnings.push(format!("the points of the COLMAP model beside {poses} are not used: {error}"));
        None
    }))
}

fn in_another_world(object: &str, problem: &str, poses: &str) -> String {
    format!("{object} is not used: {problem}, so it is in another world; compute it with the poses of {poses} (COLMAP's point_triangulator keeps them)")
}

/// The error of a damaged cloud, whose remedy says how to do without it.
fn or_remove(error: Error) -> Error {
    match error {
        Error::Data { object, problem, remedy } => Error::data(object, problem, format!("{remedy}, or remove it to start from other points")),
        other => other,
    }
}

/// Whether `position` is in the image of any camera, lenses aside.
fn is_seen(cameras: &[RawCamera], position: [f64; 3]) -> bool {
    cameras.iter().any(|camera| {
        let [x, y, z] = [0, 1, 2].map(|i| {
            let row = camera.world_to_camera[i];
            (0..3).map(|j| row[j] * position[j]).sum::<f64>() + row[3]
        });
        let (u, v) = (camera.focal[0] * x / z + camera.principal[0], camera.focal[1] * y / z + camera.principal[1]);
        z > 0.0 && (0.0..=f64::from(camera.size[0])).contains(&u) && (0.0..=f64::from(camera.size[1])).contains(&v)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::Distortion;
    use std::path::PathBuf;

    /// Cameras side by side that look along z.
    fn rig() -> Vec<RawCamera> {
        let camera = |i: i32| RawCamera {
            name: format!("cam{i:02}"),
            size: [8, 6],
            focal: [8.0; 2],
            principal: [4.0, 3.0],
            distortion: Distortion::None,
            world_to_camera: [[1.0, 0.0, 0.0, -f64::from(i)], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]],
        };
        (0..4).map(camera).collect()
    }

    fn write(folder: &Path, name: &str, bytes: &[u8]) -> PathBuf {
        let file = folder.join(name);
        std::fs::create_dir_all(file.parent().unwrap()).unwrap();
        std::fs::write(&file, bytes).unwrap();
        file
    }

    /// A PLY of red points, as COLMAP's stereo fusion writes it; `kind` is "double" for one of Open3D.
    fn ply(kind: &str, positions: &[[f64; 3]]) -> Vec<u8> {
        let numbers: String = ["x", "y", "z", "nx", "ny", "nz"].iter().map(|name| format!("property {kind} {name}\n")).collect();
        let colours = "property uchar red\nproperty uchar green\nproperty uchar blue\n";
        let mut bytes = format!("ply\nformat binary_little_endian 1.0\nelement vertex {}\n{numbers}{colours}end_header\n", positions.len()).into_bytes();
        for position in positions {
            for value in position.iter().chain(&[0.0, 0.0, 1.0]) {
                match kind {
                    "double" => bytes.extend(value.to_le_bytes()),
                    _ => bytes.extend((*value as f32).to_le_bytes()),
                }
            }
            bytes.extend([255, 0, 0]);
        }
        bytes
    }

    /// A model whose cameras stand `along` x from those of [`rig`], with the names of 4DGS.
    fn write_model(folder: &Path, name: &str, along: f64) {
        let image = |i: i32| format!("{} 1 0 0 0 {} 0 0 1 r_{i:03}.png\n\n", i + 1, -f64::from(i) - along);
        write(folder, &format!("{name}/images.txt"), (0..4).map(image).collect::<String>().as_bytes());
        write(folder, &format!("{name}/cameras.txt"), b"1 SIMPLE_PINHOLE 8 6 8 4 3\n");
    }

    fn read(folder: &Path) -> (Result<Option<RawPoints>>, String) {
        let mut warnings = Vec::new();
        let found = first_points(folder, "poses.npy", &rig(), &Limits::default(), &mut warnings);
        (found, warnings.join("\n"))
    }

    /// The positions that are found, and the warnings.
    fn positions(folder: &Path) -> (Vec<[f64; 3]>, String) {
        let (found, said) = read(folder);
        (found.unwrap().map(|points| points.positions).unwrap_or_default(), said)
    }

    #[test]
    fn the_first_cloud_in_the_order_of_preference_is_taken_as_it_is() {
        let dir = tempfile::tempdir().unwrap();
        assert_eq!(positions(dir.path()), (vec![], String::new()));
        for (index, (name, _)) in CLOUDS.iter().enumerate().rev() {
            let position = [0.25, -0.5, 4.0 + index as f64];
            write(dir.path(), name, &ply(if index < 2 { "double" } else { "float" }, &[position]));
            let (found, said) = read(dir.path());
            assert_eq!(found.unwrap(), Some(RawPoints { positions: vec![position], colors: vec![[1.0, 0.0, 0.0]] }), "{name}");
            assert_eq!(said, "");
        }
    }

    #[test]
    fn an_empty_cloud_gives_way_to_the_next() {
        let dir = tempfile::tempdir().unwrap();
        write(dir.path(), "points3D_downsample.ply", &ply("float", &[]));
        let (found, said) = positions(dir.path());
        assert!(found.is_empty() && said.contains("points3D_downsample.ply is not used: it has no points"), "{said}");
        write(dir.path(), "colmap/dense/workspace/fused.ply", &ply("float", &[[0.0, 0.0, 2.0]]));
        let (found, said) = positions(dir.path());
        assert_eq!(found, [[0.0, 0.0, 2.0]]);
        assert!(said.contains("it has no points"), "{said}");
    }

    #[test]
    fn damaged_clouds_and_claims_are_errors_that_name_the_file() {
        let dir = tempfile::tempdir().unwrap();
        // A sound cloud of less preference does not hide them.
        write(dir.path(), "dense/workspace/fused.ply", &ply("float", &[[0.0, 0.0, 2.0]]));
        let sound = ply("float", &[[0.0, 0.0, 2.0], [0.0, 0.0, 3.0]]);
        let claim = |count: &str| String::from_utf8_lossy(&ply("float", &[])).replace("vertex 0", &format!("vertex {count}")).into_bytes();
        for (bytes, problem) in [
            (sound[..sound.len() - 1].to_vec(), "2 vertices of 27 bytes need 54 bytes"),
            (sound[..40].to_vec(), "does not end"),
            (ply("float", &[[0.0, f64::NAN, 2.0]]), "NaN"),
            (claim("1000000"), "need 27000000 bytes"),
            (claim("18446744073709551615"), "over the limit"),
        ] {
            let file = write(dir.path(), "points3D_downsample2.ply", &bytes);
            let message = read(dir.path()).0.unwrap_err().to_string();
            assert!(message.starts_with(&file.display().to_string()) && message.contains(problem), "{message}");
            assert!(problem == "over the limit" || message.contains("or remove it to start from other points"), "{message}");
        }
    }

    #[test]
    fn what_no_camera_sees_is_left_out_and_a_cloud_of_such_points_refused() {
        let dir = tempfile::tempdir().unwrap();
        let (seen, behind, beside) = ([3.0, 0.0, 2.0], [0.0, 0.0, -2.0], [0.0, 2.0, 2.0]);
        write(dir.path(), "points3D_downsample2.ply", &ply("float", &[seen, behind, seen]));
        let (found, said) = positions(dir.path());
        assert_eq!(found, [seen, seen]);
        assert!(said.contains("1 of 3 points is outside of all images and was left out"), "{said}");
        write(dir.path(), "points3D_downsample2.ply", &ply("float", &[seen, behind, beside]));
        let (found, said) = positions(dir.path());
        assert!(found.is_empty() && said.contains("2 of 3 points are outside of all images, so it is in another world"), "{said}");
    }

    #[test]
    fn a_model_with_other_poses_tells_of_another_world_even_where_cameras_see_it() {
        let dir = tempfile::tempdir().unwrap();
        write(dir.path(), "points3D_downsample2.ply", &ply("float", &[[0.0, 0.0, 2.0]]));
        write_model(dir.path(), "colmap/sparse/0", 0.5);
        let (found, said) = positions(dir.path());
        assert!(found.is_empty() && said.contains("its model colmap/sparse/0 has its cameras elsewhere than poses.npy"), "{said}");
        // The model in the workspace comes first.
        write_model(dir.path(), "colmap/dense/workspace/sparse", 0.0);
        assert_eq!(positions(dir.path()), (vec![[0.0, 0.0, 2.0]], String::new()));
        // Files that are no model tell nothing.
        write(dir.path(), "colmap/dense/workspace/sparse/images.txt", b"none");
        write_model(dir.path(), "colmap/sparse/0", 0.0);
        assert_eq!(positions(dir.path()), (vec![[0.0, 0.0, 2.0]], String::new()));
    }
}
