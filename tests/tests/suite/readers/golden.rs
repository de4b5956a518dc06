//! The instant-ngp fox scene: lens, size and missing images as in `golden/fox.json`, with images of a fortieth of the size.

use super::common::*;
use cc4dgs_core::{Distortion, Split};
use cc4dgs_tests::golden::json;

#[test]
fn golden_fox() {
    let fox = json("fox.json");
    let (frames, present) = (fox["frames_in_transforms_json"].as_u64().unwrap() as usize, fox["images_present"].as_u64().unwrap() as usize);
    let missing: Vec<&str> = fox["frames_without_image"].as_array().unwrap().iter().map(|v| v.as_str().unwrap()).collect();
    assert_eq!(frames - missing.len(), present);

    let dir = tempfile::tempdir().unwrap();
    let number = |key: &str| fox["intrinsics"][key].as_f64().unwrap();
    let (w, h) = ((number("w") / 40.0) as u32, (number("h") / 40.0) as u32);
    let mut document = fox["intrinsics"].clone();
    // The missing names, and as many other names as there are images.
    let mut names: Vec<String> = missing.iter().map(|n| n.to_string()).collect();
    let others = (1..).map(|i| format!("images/{i:04}.jpg")).filter(|n| !missing.contains(&n.as_str()));
    names.extend(others.take(present));
    let poses = ring(frames, w, h);
    for name in names.iter().skip(missing.len()) {
        write_image(&dir.path().join(name), w, h, 0);
    }
    document["frames"] = names.iter().zip(&poses).map(|(n, c)| serde_json::json!({"file_path": n, "transform_matrix": opengl_camera_to_world(c)})).collect();
    std::fs::write(dir.path().join("transforms.json"), document.to_string()).unwrap();

    let scene = load(dir.path()).unwrap();
    assert_eq!(scene.views.len(), present);
    assert_eq!(scene.split(Split::Test).len(), present.div_ceil(8));
    assert!(scene.warnings.iter().any(|w| w.contains(&format!("{} of {frames}", missing.len())) && w.contains(missing[0])), "{:?}", scene.warnings);
    let camera = scene.camera(0);
    assert!((camera.fx - number("fl_x") / 40.0).abs() < 1e-9 && (camera.fy - number("fl_y") / 40.0).abs() < 1e-9);
    // The image is undistorted: red is the column that a pixel came from.
    let lens = Distortion::Brown { radial: [number("k1"), number("k2"), 0.0, 0.0], tangential: [number("p1"), number("p2")] };
    let image = scene.frame(0).unwrap();
    assert_eq!((image.width, image.height), (camera.width, camera.height));
    let mut worst = 0.0f64;
    for (row, column) in [(4u32, 4u32), (24, 13), (40, 20), (10, 22), (44, 3)] {
        let (x, y) = ((f64::from(column) + 0.5 - camera.cx) / camera.fx, (f64::from(row) + 0.5 - camera.cy) / camera.fy);
        let source = lens.distort(x, y).0 * camera.fx + number("cx") / 40.0 - 0.5;
        // JPEG compression changes values by a few grey levels.
        worst = worst.max((f64::from(image.data[((row * image.width + column) * 3) as usize]) - source).abs());
    }
    assert!(worst < 4.0, "columns off by {worst}");
}
