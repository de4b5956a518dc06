//! COLMAP's text files.

use super::colmap::ColmapImage;
use super::colmap_camera::{ColmapCamera, Model};
use cc4dgs_core::{Error, Limits, RawPoints, Result};
use std::collections::BTreeMap;
use std::str::FromStr;

fn bad(object: &str, number: usize, problem: impl std::fmt::Display) -> Error {
    Error::data(format!("{object}: line {}", number + 1), problem.to_string(), "The file is damaged or not a COLMAP model; export it again")
}

/// The next word of a line as a value.
fn next<T: FromStr>(words: &mut std::str::SplitWhitespace, object: &str, line: usize) -> Result<T> {
    let word = words.next().ok_or_else(|| bad(object, line, "a value is missing"))?;
    word.parse().map_err(|_| bad(object, line, format!("{word:?} is not the value expected there")))
}

fn floats<const N: usize>(words: &mut std::str::SplitWhitespace, object: &str, line: usize) -> Result<[f64; N]> {
    let mut out = [0.0; N];
    for v in &mut out {
        *v = next(words, object, line)?;
    }
    Ok(out)
}

/// Lines that are not comments, with their numbers. Empty lines count: an image without points has one.
fn lines(text: &str) -> impl Iterator<Item = (usize, &str)> {
    text.lines().enumerate().filter(|(_, l)| !l.trim_start().starts_with('#'))
}

/// What follows the first `count` words of a line, without the white space around it.
fn after_words(line: &str, count: usize) -> &str {
    (0..count).fold(line.trim(), |rest, _| rest.split_once(char::is_whitespace).map_or("", |(_, rest)| rest.trim_start()))
}

/// `cameras.txt`: CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]. Cameras of models that COLMAP does not have come without parameters.
pub(crate) fn cameras(object: &str, text: &str) -> Result<BTreeMap<u32, ColmapCamera>> {
    let mut cameras = BTreeMap::new();
    for (n, line) in lines(text).filter(|(_, l)| !l.trim().is_empty()) {
        let mut words = line.split_whitespace();
        let id = next(&mut words, object, n)?;
        let model: String = next(&mut words, object, n)?;
        let size = [next(&mut words, object, n)?, next(&mut words, object, n)?];
        let count = Model::from_name(&model).map_or(0, |model| model.parameters);
        let parameters = (0..count).map(|_| next(&mut words, object, n)).collect::<Result<_>>()?;
        cameras.insert(id, ColmapCamera { model, size, parameters });
    }
    Ok(cameras)
}

/// How many numbers an image's line has before its name.
const IMAGE_NUMBERS: usize = 9;

/// `images.txt`: two lines per image: IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME and its points.
pub(crate) fn images(object: &str, text: &str) -> Result<Vec<ColmapImage>> {
    let mut images = Vec::new();
    let mut rows = lines(text);
    while let Some((n, line)) = rows.next() {
        if line.trim().is_empty() {
            continue;
        }
        let mut words = line.split_whitespace();
        next::<u32>(&mut words, object, n)?;
        let rotation = floats(&mut words, object, n)?;
        let translation = floats(&mut words, object, n)?;
        let camera = next(&mut words, object, n)?;
        let name = after_words(line, IMAGE_NUMBERS).to_string();
        if name.is_empty() {
            return Err(bad(object, n, "the image has no name"));
        }
        images.push(ColmapImage { camera, name, rotation, translation });
        // Where empty lines were removed, this is the next image.
        if let Some((n, points)) = rows.next().filter(|(_, l)| !l.split_whitespace().count().is_multiple_of(3)) {
            let count = points.split_whitespace().count();
            return Err(bad(object, n, format!("{count} values, not three per point: each image needs a line of points after it, which may be empty")));
        }
    }
    Ok(images)
}

/// `points3D.txt`: POINT3D_ID X Y Z R G B ERROR TRACK[].
pub(crate) fn points(object: &str, text: &str, limits: &Limits) -> Result<RawPoints> {
    let mut cloud = RawPoints::default();
    for (n, line) in lines(text).filter(|(_, l)| !l.trim().is_empty()) {
        let mut words = line.split_whitespace();
        next::<u64>(&mut words, object, n)?;
        let p = floats::<3>(&mut words, object, n)?;
        let rgb: [u8; 3] = [next(&mut words, object, n)?, next(&mut words, object, n)?, next(&mut words, object, n)?];
        if p.iter().any(|v| !(*v as f32).is_finite()) {
            return Err(bad(object, n, format!("the point is at {p:?}")));
        }
        cloud.positions.push(p);
        cloud.colors.push(rgb.map(|c| f32::from(c) / 255.0));
        limits.check_gaussians(object, cloud.positions.len() as u64)?;
    }
    Ok(cloud)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_image_in_place_of_the_points_of_the_one_before_is_refused() {
        let line = |id: u32| format!("{id} 1 0 0 0 0 0 0 1 {id}.png\n");
        let with = |between: &str| images("t", &format!("# comment\n{}{between}{}", line(1), line(2)));
        assert_eq!(with("1.5 2.5 -1 3 4 7\n").unwrap().len(), 2);
        assert_eq!(with("\n").unwrap().len(), 2);
        let message = with("").unwrap_err().to_string();
        assert!(message.contains("line 3") && message.contains("10 values"), "{message}");
    }

    #[test]
    fn cameras_of_any_model_are_listed() {
        let found = cameras("t", "1 PINHOLE 64 48 60 61 32 24\n2 EUCM 64 48 60 61 32 24 0.5 1\n3 OTHER 64 48 1 2\n").unwrap();
        assert_eq!([1, 2, 3].map(|id| found[&id].parameters.len()), [4, 6, 0]);
        let message = found[&3].intrinsics("t: camera 3").unwrap_err().to_string();
        assert!(message.contains("t: camera 3") && message.contains("camera model OTHER"), "{message}");
        assert!(cameras("t", "1 FULL_OPENCV 64 48 60 61 32 24\n").unwrap_err().to_string().contains("a value is missing"));
    }

    #[test]
    fn names_keep_their_spaces_and_comments_may_be_indented() {
        let text = "# comment\r\n  # another\r\n1 1 0 0 0  0 0 0\t1 left  camera/\u{e9}t\u{e9} 1.JPG \r\n\r\n2 1 0 0 0 0 0 0 1 b.png";
        let names: Vec<String> = images("t", text).unwrap().into_iter().map(|image| image.name).collect();
        assert_eq!(names, ["left  camera/\u{e9}t\u{e9} 1.JPG", "b.png"]);
        assert!(images("t", "1 1 0 0 0 0 0 0 1 \n\n").unwrap_err().to_string().contains("no name"));
    }
}
