//! COLMAP on a tiny scene: both forms of a model, where its images lie, and its lenses.

use super::common::*;

fn colmap_names() -> Vec<String> {
    (0..9).map(|i| format!("im_{i:02}.png")).collect()
}

fn check_colmap(scene: &cc4dgs_core::Scene, cameras: &[cc4dgs_core::Camera]) {
    assert_eq!(train_count(scene), (7, 2), "every eighth is held out");
    for (view, v) in scene.views.iter().enumerate() {
        same_pose(&dataset_camera(scene, view), &cameras[v.camera]);
        assert_eq!(scene.frame(view).unwrap().data[2] as usize, v.camera);
    }
    let points = scene.points.as_ref().unwrap();
    for (found, truth) in points.positions.iter().zip([[0.0, -1.0, 2.0], [0.5, -1.0, 2.0]]) {
        let found = dataset_point(scene, *found);
        assert!((0..3).all(|k| (found[k] - truth[k]).abs() < 1e-5), "{found:?}");
    }
    assert_eq!(points.colors[0], [1.0, 128.0 / 255.0, 0.0]);
}

#[test]
fn colmap_in_both_forms() {
    let cameras = ring(9, 16, 12);
    let names = colmap_names();
    let dir = tempfile::tempdir().unwrap();
    names.iter().enumerate().for_each(|(i, n)| write_image(&dir.path().join("images").join(n), 16, 12, i as u8));
    let model = dir.path().join("sparse/0");
    std::fs::create_dir_all(&model).unwrap();
    for (file, bytes) in ["cameras", "images", "points3D"].iter().zip(colmap_binary(&cameras, &names)) {
        std::fs::write(model.join(format!("{file}.bin")), bytes).unwrap();
    }
    check_colmap(&load(dir.path()).unwrap(), &cameras);

    ["cameras", "images", "points3D"].iter().for_each(|f| std::fs::remove_file(model.join(format!("{f}.bin"))).unwrap());
    let (mut c, mut i) = ("# comment\n".to_string(), "# comment\n".to_string());
    for (index, (camera, name)) in cameras.iter().zip(&names).enumerate() {
        let (q, t) = quaternion(camera);
        c += &format!("{index} PINHOLE 16 12 {} {} 8 6\n", camera.fx, camera.fy);
        // One image has points, the next has an empty line for none.
        let points = if index % 2 == 0 { "1.0 2.0 -1" } else { "" };
        i += &format!("{index} {} {} {} {} {} {} {} {index} {name}\n{points}\n", q[0], q[1], q[2], q[3], t[0], t[1], t[2]);
    }
    std::fs::write(model.join("cameras.txt"), c).unwrap();
    std::fs::write(model.join("images.txt"), i).unwrap();
    std::fs::write(model.join("points3D.txt"), "# c\n1 0 -1 2 255 128 0 0.1 1 0\n2 0.5 -1 2 255 128 0 0.1\n").unwrap();
    check_colmap(&load(dir.path()).unwrap(), &cameras);
}

#[test]
fn colmap_images_are_where_their_names_are_and_other_models_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path().join("scene");
    write_colmap(&root);
    // The images move beside the model; a folder images/ above belongs to something else.
    (0..3).for_each(|i| std::fs::rename(root.join(format!("images/{i}.png")), root.join(format!("{i}.png"))).unwrap());
    std::fs::remove_dir(root.join("images")).unwrap();
    write_image(&dir.path().join("images/other.png"), 16, 12, 0);
    let scene = load(&root).unwrap();
    assert!(scene.views.len() == 3 && scene.warnings.is_empty(), "{:?}", scene.warnings);
    std::fs::create_dir(root.join("sparse/1")).unwrap();
    for file in ["cameras.bin", "images.bin"] {
        std::fs::copy(root.join("sparse/0").join(file), root.join("sparse/1").join(file)).unwrap();
    }
    (0..3).for_each(|i| write_image(&root.join(format!("sparse/1/{i}.png")), 16, 12, 0));
    let warned = |path: &std::path::Path| load(path).unwrap().warnings.iter().any(|w| w.contains("several models") && w.contains("3 images"));
    assert!(warned(&root) && !warned(&root.join("sparse/1")));
}

#[test]
fn masks_beside_the_images_are_told() {
    let dir = tempfile::tempdir().unwrap();
    write_colmap(dir.path());
    let told = |path: &std::path::Path| {
        let scene = load(path).unwrap();
        scene.warnings.iter().filter(|w| w.contains("masks")).cloned().collect::<Vec<_>>()
    };
    assert!(told(dir.path()).is_empty());
    write_image(&dir.path().join("masks/0.png"), 16, 12, 0);
    for path in [dir.path().to_path_buf(), dir.path().join("sparse/0")] {
        let said = told(&path);
        assert!(said.len() == 1 && said[0].contains("are not used") && said[0].contains("alpha channel"), "{said:?}");
    }
}

#[test]
fn texts_from_windows_are_read() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("cameras.txt"), "\u{feff}# Cameras\r\n1 SIMPLE_PINHOLE 64 48 60 32 24\r\n").unwrap();
    std::fs::write(dir.path().join("images.txt"), "\u{feff}# Images\r\n1 1 0 0 0 0 0 0 1 left  camera\\a.PNG\r\n\r\n").unwrap();
    write_image(&dir.path().join("images/left  camera/a.PNG"), 64, 48, 9);
    let scene = load(dir.path()).unwrap();
    assert_eq!((scene.views.len(), scene.frame(0).unwrap().data[2]), (1, 9));
}

#[test]
fn colmap_lenses_are_undone() {
    for (model, parameters) in [
        ("SIMPLE_PINHOLE", "60 32 24"),
        ("SIMPLE_RADIAL", "60 32 24 -0.1"),
        ("RADIAL", "60 32 24 -0.1 0.02"),
        ("OPENCV", "60 61 32 24 -0.1 0.02 0.001 -0.001"),
        ("OPENCV_FISHEYE", "60 61 32 24 0.01 0 0 0"),
        ("FULL_OPENCV", "60 61 32 24 0.5 -2.7 0.001 -0.001 1.5 0.4 -2.5 1.4"),
        ("FOV", "60 61 32 24 0.4"),
        ("SIMPLE_RADIAL_FISHEYE", "60 32 24 0.01"),
        ("RADIAL_FISHEYE", "60 32 24 0.01 0.001"),
        ("THIN_PRISM_FISHEYE", "60 61 32 24 0.01 0 0.001 -0.001 0 0 0.001 0.001"),
        ("RAD_TAN_THIN_PRISM_FISHEYE", "60 61 32 24 0.01 0 0 0 0 0 0.001 -0.001 0.001 0 0.001 0"),
        ("SIMPLE_DIVISION", "60 32 24 -0.1"),
        ("DIVISION", "60 61 32 24 -0.1"),
        ("EUCM", "60 61 32 24 0.5 1"),
        ("SIMPLE_FISHEYE", "60 32 24"),
        ("FISHEYE", "60 61 32 24"),
    ] {
        let dir = tempfile::tempdir().unwrap();
        // No image uses the second camera.
        std::fs::write(dir.path().join("cameras.txt"), format!("1 {model} 64 48 {parameters}\n2 EQUIRECTANGULAR 64 48 64 48\n")).unwrap();
        std::fs::write(dir.path().join("images.txt"), "1 1 0 0 0 0 0 0 1 a.png\n\n").unwrap();
        write_image(&dir.path().join("a.png"), 64, 48, 9);
        let scene = load(dir.path()).unwrap();
        let (camera, image) = (scene.camera(0), scene.frame(0).unwrap());
        assert_eq!((camera.width, camera.height), (image.width, image.height), "{model}");
        // The point on the optical axis keeps its colour: red and green are the source column and row.
        let p = (camera.cy as usize * image.width as usize + camera.cx as usize) * 3;
        assert!(image.data[p].abs_diff(32) <= 1 && image.data[p + 1].abs_diff(24) <= 1, "{model}: {:?}", &image.data[p..p + 3]);
        assert_eq!(camera.fx, 60.0, "{model}");
    }
}
