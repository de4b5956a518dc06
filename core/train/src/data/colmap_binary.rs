//! COLMAP's binary files. Every count is held against the bytes that are there before anything is allocated for it.

use super::colmap::ColmapImage;
use super::colmap_camera::{ColmapCamera, Model};
use cc4dgs_core::{Error, Limits, RawPoints, Result};
use std::collections::BTreeMap;

/// Bytes read from front to back.
struct Bytes<'a> {
    object: &'a str,
    rest: &'a [u8],
    length: usize,
}

impl<'a> Bytes<'a> {
    fn new(object: &'a str, bytes: &'a [u8]) -> Self {
        Self { object, rest: bytes, length: bytes.len() }
    }
    fn bad(&self, problem: String) -> Error {
        Error::data(self.object, problem, "The file is damaged or not a COLMAP model; export it again")
    }
    fn take(&mut self, n: u64) -> Result<&'a [u8]> {
        match usize::try_from(n).ok().and_then(|n| self.rest.split_at_checked(n)) {
            Some((head, tail)) => {
                self.rest = tail;
                Ok(head)
            }
            None => Err(self.bad(format!("at byte {}, {n} bytes are wanted and {} are left", self.length - self.rest.len(), self.rest.len()))),
        }
    }
    fn array<const N: usize>(&mut self) -> Result<[u8; N]> {
        let mut out = [0; N];
        out.copy_from_slice(self.take(N as u64)?);
        Ok(out)
    }
    fn u32(&mut self) -> Result<u32> {
        Ok(u32::from_le_bytes(self.array()?))
    }
    fn u64(&mut self) -> Result<u64> {
        Ok(u64::from_le_bytes(self.array()?))
    }
    fn floats<const N: usize>(&mut self) -> Result<[f64; N]> {
        let mut out = [0.0; N];
        for v in &mut out {
            *v = f64::from_le_bytes(self.array()?);
        }
        Ok(out)
    }
    /// A count of records of at least `size` bytes each.
    fn count(&mut self, what: &str, size: u64) -> Result<u64> {
        let count = self.u64()?;
        if count.checked_mul(size).is_none_or(|bytes| bytes > self.rest.len() as u64) {
            return Err(self.bad(format!("it claims {count} {what}, {} bytes are left for them", self.rest.len())));
        }
        Ok(count)
    }
}

/// `cameras.bin`, with cameras of models that are not read: images may use others.
pub(crate) fn cameras(object: &str, bytes: &[u8]) -> Result<BTreeMap<u32, ColmapCamera>> {
    let mut b = Bytes::new(object, bytes);
    let mut cameras = BTreeMap::new();
    for _ in 0..b.count("cameras", 24)? {
        let id = b.u32()?;
        let model = Model::from_number(b.u32()? as i32, &format!("{object}: camera {id}"))?;
        let size = [b.u64()?, b.u64()?];
        let mut parameters = Vec::with_capacity(model.parameters);
        for _ in 0..model.parameters {
            parameters.push(b.floats::<1>()?[0]);
        }
        cameras.insert(id, ColmapCamera { model: model.name.to_string(), size, parameters });
    }
    Ok(cameras)
}

/// `images.bin`; the two-dimensional points are passed over.
pub(crate) fn images(object: &str, bytes: &[u8]) -> Result<Vec<ColmapImage>> {
    let mut b = Bytes::new(object, bytes);
    let mut images = Vec::new();
    for _ in 0..b.count("images", 73)? {
        b.u32()?;
        let rotation = b.floats()?;
        let translation = b.floats()?;
        let camera = b.u32()?;
        let end = b.rest.iter().position(|&c| c == 0).ok_or_else(|| b.bad("an image's name has no end".into()))?;
        let name = String::from_utf8_lossy(b.take(end as u64)?).into_owned();
        b.take(1)?;
        let points = b.count("points in an image", 24)?;
        b.take(points * 24)?;
        images.push(ColmapImage { camera, name, rotation, translation });
    }
    Ok(images)
}

/// `points3D.bin`; tracks are passed over.
pub(crate) fn points(object: &str, bytes: &[u8], limits: &Limits) -> Result<RawPoints> {
    let mut b = Bytes::new(object, bytes);
    let count = b.count("points", 51)?;
    limits.check_gaussians(object, count)?;
    let mut cloud = RawPoints::default();
    for i in 0..count {
        b.u64()?;
        let p = b.floats::<3>()?;
        let rgb = b.array::<3>()?;
        b.floats::<1>()?;
        let track = b.count("track elements", 8)?;
        b.take(track * 8)?;
        if p.iter().any(|v| !(*v as f32).is_finite()) {
            return Err(b.bad(format!("point {i} is at {p:?}")));
        }
        cloud.positions.push(p);
        cloud.colors.push(rgb.map(|c| f32::from(c) / 255.0));
    }
    Ok(cloud)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn claimed_counts_are_not_believed() {
        let claim = u64::MAX.to_le_bytes();
        assert!(cameras("t", &claim).is_err() && images("t", &claim).is_err() && points("t", &claim, &Limits::default()).is_err());
        let claim = (u64::MAX / 51).to_le_bytes();
        assert!(points("t", &claim, &Limits::default()).is_err());
    }

    #[test]
    fn cameras_of_every_model_have_their_length() {
        let camera = |id: u32, model: i32, parameters: &[f64]| {
            let sizes = [64u64, 48].map(u64::to_le_bytes).concat();
            let numbers: Vec<u8> = parameters.iter().flat_map(|v| v.to_le_bytes()).collect();
            [&id.to_le_bytes()[..], &model.to_le_bytes(), &sizes[..], &numbers[..]].concat()
        };
        let file = |records: &[Vec<u8>]| cameras("t", &[&(records.len() as u64).to_le_bytes()[..], &records.concat()[..]].concat());
        for (number, name, count) in
            [(11, "RAD_TAN_THIN_PRISM_FISHEYE", 16), (12, "SIMPLE_DIVISION", 4), (13, "DIVISION", 5), (16, "EUCM", 6), (17, "EQUIRECTANGULAR", 2)]
        {
            let found = file(&[camera(7, number, &vec![0.5; count]), camera(8, 15, &[60.0, 61.0, 32.0, 24.0])]).unwrap();
            assert_eq!(found[&8], ColmapCamera { model: "FISHEYE".into(), size: [64, 48], parameters: vec![60.0, 61.0, 32.0, 24.0] });
            assert_eq!((found[&7].model.as_str(), found[&7].parameters.len()), (name, count));
            let read = found[&7].intrinsics("t: camera 7").map_err(|e| e.to_string());
            assert!(read.as_ref().map_or_else(|e| number == 17 && e.contains(&format!("camera model {name}")), |_| number != 17), "{read:?}");
        }
        for number in [99, -1] {
            let message = file(&[camera(7, number, &[0.5; 12])]).unwrap_err().to_string();
            assert!(message.contains("t: camera 7") && message.contains(&format!("camera model number {number}")), "{message}");
        }
    }
}
