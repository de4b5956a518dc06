//! What a file holds.

use crate::memory;
use crate::scene::Scene;
use cc4dgs_format::archive::{Archive, MAGIC, Presentation, StreamKind};
use cc4dgs_format::{BLUR, BLUR_RANGE, Error, GaussianFile, LEAST_NEAR, Limits, Result, Rules, Silent, StoredModel, near_without_units, ply, spz};

/// Greatest near plane.
const MOST_NEAR: f32 = 1e6;

/// A file's model with everything a player wants to know of it.
pub struct Content {
    /// The Gaussians and their motion.
    pub scene: Scene,
    /// Clock and cameras.
    pub presentation: Presentation,
    /// Frames of the sequence.
    pub frame_count: usize,
    /// Whether the model moves, but the file has no playback layer: it is shown as it stands.
    pub lacks_motion: bool,
    /// What the file holds and is not shown, a sentence or two each.
    pub remarks: Vec<String>,
    /// Size of the file in bytes.
    pub bytes: u64,
}

impl Content {
    /// Reads an archive, a PLY file of 3D Gaussian splatting or an SPZ file, by its first bytes; `object` names it in errors.
    ///
    /// # Errors
    /// [`Error::Data`] for files that are damaged or none of these, [`Error::Limit`], [`Error::Unsupported`].
    pub fn read(object: &str, bytes: Vec<u8>, limits: &Limits) -> Result<Self> {
        let size = bytes.len() as u64;
        limits.check_bytes(object, size)?;
        if bytes.starts_with(&MAGIC) {
            let archive = Archive::from_bytes(object, bytes, limits)?;
            memory::check_archive(object, &archive)?;
            return Self::of_archive(object, &archive, limits);
        }
        memory::check_file(object, &bytes)?;
        let file = if bytes.starts_with(b"ply\n") || bytes.starts_with(b"ply\r") {
            // Its remarks are of dynamic scores and unknown properties, which no player shows.
            GaussianFile { remarks: Vec::new(), ..ply::from_bytes(object, &bytes, limits)? }
        } else if spz::begins_as_spz(&bytes) {
            spz::from_spz(object, &bytes, limits)?
        } else {
            let remedy = "Give a .cc4d archive, a PLY file of 3D Gaussian splatting or an SPZ file";
            return Err(Error::data(object, "it begins like no model", remedy));
        };
        let mut scene = Scene { antialiased: file.antialiased, ..Scene::new(&file.gaussians, None)? };
        // The file does not say its units: cameras around a small model are near it too.
        scene.near = near_without_units(scene.bounds, scene.near);
        let remarks = file.remarks.iter().map(|remark| format!("{object}: {remark}.")).collect();
        Ok(Self { scene, presentation: Presentation::default(), frame_count: 1, lacks_motion: false, remarks, bytes: size })
    }
    /// The model of an archive.
    ///
    /// # Errors
    /// As [`StoredModel::read`].
    pub fn of_archive(object: &str, archive: &Archive, limits: &Limits) -> Result<Self> {
        crate::link();
        Self::of_model(StoredModel::read(object, archive, limits, &Silent)?, archive.total_bytes()?)
    }
    /// The same of a model that was read already; `bytes` is the size of its file.
    ///
    /// # Errors
    /// As [`Scene::new`].
    pub fn of_model(model: StoredModel, bytes: u64) -> Result<Self> {
        let lacks_motion = model.playback.is_none() && model.moves();
        let (manifest, moves) = (&model.manifest, model.playback.is_some());
        let mut scene = Scene::new(&model.gaussians, model.playback)?;
        let rules = manifest.rasterizer.rules;
        scene.background = manifest.background;
        scene.antialiased = manifest.rasterizer.antialiased;
        scene.blur = Some(manifest.rasterizer.blur).filter(|blur| blur.is_finite()).unwrap_or(BLUR).clamp(*BLUR_RANGE.start(), *BLUR_RANGE.end()) as f32;
        scene.focal = manifest.rasterizer.focal.filter(|focal| focal.is_finite() && *focal > 0.0);
        scene.square = rules == Rules::Inria;
        scene.near = manifest.rasterizer.near.filter(|near| near.is_finite()).unwrap_or(rules.near()).clamp(LEAST_NEAR, MOST_NEAR);
        scene.alpha_max = if rules == Rules::Gsplat0999 { 0.999 } else { 0.99 };
        let frame_count = if moves { manifest.frame_count } else { 1 };
        let still = "This archive has no playback layer, so it stands still here. Add one with: cc4dgs bake MODEL --out FILE.cc4d";
        let remarks = lacks_motion.then(|| still.to_string()).into_iter().collect();
        Ok(Self { scene, presentation: manifest.presentation.clone(), frame_count, lacks_motion, remarks, bytes })
    }
    /// Leaves out the highest degrees of the spherical harmonics until the rest take at most `most_words` 32-bit numbers: what one array of a device holds.
    /// `remarks` say so then: the `array` that is too small for more, such as "a buffer", and what shows all degrees (`remedy`, a sentence without its full
    /// stop).
    pub fn fit_harmonics(&mut self, most_words: u64, array: &str, remedy: &str) {
        self.scene.fit_harmonics(most_words);
        let (drawn, stored) = (self.scene.drawn_degree, self.scene.sh_degree);
        if drawn < stored {
            self.remarks.push(format!("Spherical harmonics are shown up to degree {drawn} of {stored}: more do not fit into {array}. {remedy}."));
        }
    }
    /// The small image to show while the rest is fetched, PNG or JPEG bytes, if the archive has one.
    ///
    /// # Errors
    /// As [`Archive::read_kind`].
    pub fn poster(archive: &Archive) -> Result<Option<Vec<u8>>> {
        Ok(archive.read_kind(StreamKind::Poster)?.into_iter().next().map(|s| s.bytes))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Navigator;
    use crate::scene::tests::three;
    use cc4dgs_format::archive::{CodecEntry, DeformerEntry, Manifest};
    use cc4dgs_format::spz::SpzOptions;
    use cc4dgs_format::{DeformerContext, HostGaussians, Moving, Seed};

    #[test]
    fn extensions_of_spz_files_that_are_not_read_are_said() {
        let remarks = |bytes: &[u8]| Content::read("a.spz", bytes.to_vec(), &Limits::default()).unwrap().remarks;
        let mut bytes = spz::to_spz(&three(0), &SpzOptions::version(4)).unwrap();
        assert!(remarks(&bytes).is_empty());
        // The flag of vendor extensions in the header.
        bytes[14] |= 2;
        let said = remarks(&bytes);
        assert!(said.len() == 1 && said[0].starts_with("a.spz: vendor extensions are not read") && said[0].ends_with('.'), "{said:?}");
        assert!(remarks(&ply::to_bytes(&three(0), false).unwrap()).is_empty());
    }

    #[test]
    fn degrees_that_do_not_fit_into_an_array_of_the_device_are_left_out_and_said() {
        let content = |most_words: u64| {
            let mut content = Content::read("t", ply::to_bytes(&three(3), false).unwrap(), &Limits::default()).unwrap();
            content.fit_harmonics(most_words, "a buffer", "Use another device");
            (content.scene.drawn_degree, content.remarks)
        };
        // Three Gaussians of 23 words each.
        assert_eq!(content(69), (3, Vec::new()));
        let said = "Spherical harmonics are shown up to degree 2 of 3: more do not fit into a buffer. Use another device.";
        assert_eq!(content(68), (2, vec![said.to_string()]));
    }

    #[test]
    fn models_that_move_and_have_no_layer_say_so() {
        let context = DeformerContext { box_min: [0.0; 3], box_max: [1.0; 3], frame_count: 2, sh_degree: 0, seed: Seed::root(0) };
        let deformer = DeformerEntry { name: "d".into(), version: "1".into(), settings: Default::default(), context, weights: CodecEntry::default() };
        let manifest = Manifest { deformer: Some(deformer), ..Default::default() };
        let remarks = |moving: Moving| {
            let model = StoredModel { manifest: manifest.clone(), gaussians: three(0), moving, playback: None };
            Content::of_model(model, 0).unwrap().remarks
        };
        assert!(remarks(Moving::Nothing).is_empty());
        let said = remarks(Moving::Everything);
        assert!(said.len() == 1 && said[0].contains("no playback layer"), "{said:?}");
    }

    #[test]
    fn small_files_are_drawn_from_nearer() {
        let near = |size: f32| {
            let means = vec![0.0, 0.0, 0.0, size, 0.0, 0.0, 0.0, size, 0.0];
            let gaussians = HostGaussians { means, log_scales: vec![(0.1 * size).ln(); 9], ..three(0) };
            let near = Content::read("t", ply::to_bytes(&gaussians, false).unwrap(), &Limits::default()).unwrap().scene.near;
            // As the rasterizer of an exact image draws them.
            assert_eq!(near, near_without_units(gaussians.shown_box(), Rules::default().near()));
            near
        };
        let usual = Rules::default().near();
        assert_eq!(near(100.0), usual);
        assert!((1e-6..0.01 * usual).contains(&near(1e-3)), "{}", near(1e-3));
    }

    #[test]
    fn a_single_gaussian_is_seen_whole() {
        let one = HostGaussians { log_scales: vec![-9.0, -4.0, -6.0], ..three(0).select(&[0]) };
        let scene = Content::read("t", ply::to_bytes(&one, false).unwrap(), &Limits::default()).unwrap().scene;
        let [lower, upper] = scene.bounds;
        let navigator = Navigator::new(&Presentation::default(), lower, upper);
        let (distance, sigma) = ((navigator.eye - navigator.target).length(), f64::from(-4f32).exp());
        assert!(distance > f64::from(scene.near) && (5.0..20.0).contains(&(distance / sigma)), "{distance} from {sigma}, drawn from {}", scene.near);
        assert_eq!(Scene::new(&HostGaussians::default(), None).unwrap().bounds, [[0.0; 3]; 2]);
    }

    #[test]
    fn foreign_bytes_are_named() {
        let error = Content::read("x.bin", vec![1, 2, 3], &Limits::default()).err().unwrap().to_string();
        assert!(error.contains("x.bin") && error.contains("begins like no model"), "{error}");
    }
}
