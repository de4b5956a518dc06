//! A model in the form that the GPU reads.

use cc4dgs_format::gaussians::{sh_rest_len, unit_quaternion};
use cc4dgs_format::playback::{Head, PlaybackLayer, Track};
use cc4dgs_format::{BLUR, Error, HostGaussians, Result, Rules};

/// Floats of a Gaussian in [`Scene::gaussians`].
pub(crate) const GAUSSIAN_FLOATS: usize = 16;

/// Gaussians in the layout of the shaders, moving ones first.
pub struct Scene {
    /// Gaussians N.
    pub count: usize,
    /// Moving Gaussians M, the first ones.
    pub moving: usize,
    /// Spherical-harmonics degree, 0 to 4.
    pub sh_degree: usize,
    /// Largest degree that `harmonics` holds: `sh_degree`, unless that was too much for the device.
    pub(crate) drawn_degree: usize,
    /// Lower and upper corner of the box that holds most canonical centres, and a Gaussian of middle size; cameras without a presentation look at it.
    pub bounds: [[f32; 3]; 2],
    /// Lower and upper corner of a box that holds all centres at all times.
    pub(crate) reach: [[f32; 3]; 2],
    /// Background, RGB in 0..1.
    pub background: [f32; 3],
    /// Smallest depth drawn.
    pub near: f32,
    /// Cap of alpha.
    pub alpha_max: f32,
    /// What a pixel adds to both diagonal entries of the projected covariance, square pixels.
    pub blur: f32,
    /// Longest focal length in pixels of the training images: longer ones blur more ([`blur_at`](cc4dgs_format::blur_at)).
    pub focal: Option<f64>,
    /// Whether opacity is scaled by the share of the footprint that the pixel blur added.
    pub antialiased: bool,
    /// Whether a square of 3 sigma in whole tiles limits footprints (Inria's rules).
    pub square: bool,
    /// Per Gaussian: centre, opacity in 0..1; log-scales, 0; unit quaternion; degree 0, 0.
    pub(crate) gaussians: Vec<f32>,
    /// Coefficients of degree 1 and up as pairs of half floats, [`Scene::harmonics_words`] per Gaussian.
    pub(crate) harmonics: Vec<u32>,
    /// Sums of ranks of all tracks, M + 1 each.
    pub(crate) starts: Vec<u32>,
    /// Coefficients of all tracks.
    pub(crate) coefficients: Vec<f32>,
    /// The functions of the layer; its coefficients are in `coefficients`.
    pub(crate) layer: Option<PlaybackLayer>,
    /// Per segment and head, where its starts and coefficients begin.
    pub(crate) tracks: Vec<[Option<(u32, u32)>; 5]>,
}

impl Scene {
    /// Arranges `gaussians` and the layer that moves them. Rendering settings are the defaults of 3D Gaussian splatting files.
    ///
    /// # Errors
    /// [`Error::Limit`] for more coefficients than a 32-bit index reaches.
    pub fn new(gaussians: &HostGaussians, layer: Option<PlaybackLayer>) -> Result<Self> {
        let n = gaussians.len();
        let order = order(n, layer.as_ref());
        let mut out = Self {
            count: n,
            moving: layer.as_ref().map_or(0, |l| l.rows.len()),
            sh_degree: gaussians.sh_degree,
            drawn_degree: gaussians.sh_degree,
            bounds: gaussians.shown_box(),
            reach: gaussians.central_box(1.0),
            background: [0.0; 3],
            near: Rules::default().near(),
            alpha_max: 0.99,
            blur: BLUR as f32,
            focal: None,
            antialiased: false,
            square: false,
            gaussians: Vec::with_capacity(GAUSSIAN_FLOATS * n),
            harmonics: harmonics(gaussians, &order, gaussians.sh_degree),
            starts: Vec::new(),
            coefficients: Vec::new(),
            layer: None,
            tracks: Vec::new(),
        };
        for &i in &order {
            // Without a direction there is no rotation: the Gaussian is culled.
            let q = [0, 1, 2, 3].map(|k| gaussians.quaternions[4 * i + k]);
            let [w, x, y, z] = unit_quaternion(&q).unwrap_or([0.0; 4]);
            let opacity = 1.0 / (1.0 + (-gaussians.opacity_logits[i]).exp());
            let (m, s, d) = (&gaussians.means[3 * i..3 * i + 3], &gaussians.log_scales[3 * i..3 * i + 3], &gaussians.sh_dc[3 * i..3 * i + 3]);
            out.gaussians.extend([m[0], m[1], m[2], opacity, s[0], s[1], s[2], 0.0]);
            out.gaussians.extend([w, x, y, z, d[0], d[1], d[2], 0.0]);
        }
        if let Some(layer) = layer {
            out.reach = reach(&gaussians.means, out.reach, &layer);
            out.set_layer(layer)?;
        }
        Ok(out)
    }
    /// The coefficients of degree 1 and up of `gaussians`, which the scene was made of before these had arrived, as `harmonics` holds them.
    ///
    /// # Errors
    /// [`Error::Data`] for other Gaussians.
    pub(crate) fn harmonics_of(&self, gaussians: &HostGaussians) -> Result<Vec<u32>> {
        if (gaussians.len(), gaussians.sh_degree) != (self.count, self.sh_degree) {
            return Err(Error::data("colour coefficients", "they are those of another model", "Load it again"));
        }
        Ok(harmonics(gaussians, &order(self.count, self.layer.as_ref()), self.drawn_degree))
    }
    /// Leaves out the highest degrees of the harmonics until they take at most `most_words` words.
    pub fn fit_harmonics(&mut self, most_words: u64) {
        let stored = self.harmonics_words();
        while self.drawn_degree > 0 && (self.count * self.harmonics_words()) as u64 > most_words {
            self.drawn_degree -= 1;
        }
        let kept = self.harmonics_words();
        if kept < stored {
            self.harmonics = self.harmonics.chunks_exact(stored).flat_map(|words| &words[..kept]).copied().collect();
        }
    }
    /// Words of harmonics per Gaussian.
    pub(crate) fn harmonics_words(&self) -> usize {
        (3 * sh_rest_len(self.drawn_degree)).div_ceil(2)
    }
    fn set_layer(&mut self, mut layer: PlaybackLayer) -> Result<()> {
        let total = |of: fn(&Track) -> usize| layer.segments.iter().flat_map(|segment| &segment.tracks).map(of).sum::<usize>();
        let (starts, coefficients) = (total(|track| track.starts.len()), total(|track| track.coefficients.len()));
        let (largest, most) = (starts.max(coefficients) as u64, u64::from(u32::MAX));
        if largest > most {
            return Err(Error::limit("playback layer", largest, most, "Bake with a larger --max-error"));
        }
        self.starts.reserve_exact(starts);
        self.coefficients.reserve_exact(coefficients);
        for segment in &mut layer.segments {
            let mut tracks = [None; 5];
            for track in &mut segment.tracks {
                let at = Head::ALL.iter().position(|h| *h == track.head).unwrap_or(0);
                tracks[at] = Some((self.starts.len() as u32, self.coefficients.len() as u32));
                // Taken, because an emptied array would keep its memory for as long as the scene is shown.
                self.starts.append(&mut std::mem::take(&mut track.starts));
                self.coefficients.append(&mut std::mem::take(&mut track.coefficients));
                track.ranks = Vec::new();
            }
            self.tracks.push(tracks);
        }
        self.layer = Some(layer);
        Ok(())
    }
    /// Bytes on the GPU that describe the model.
    pub fn gpu_bytes(&self) -> u64 {
        4 * (self.gaussians.len() + self.harmonics.len() + self.starts.len() + self.coefficients.len()) as u64
    }
}

/// The rows of `n` Gaussians, those first that `layer` moves.
fn order(n: usize, layer: Option<&PlaybackLayer>) -> Vec<usize> {
    let mut still = vec![true; n];
    let rows: Vec<usize> = layer.into_iter().flat_map(|l| &l.rows).map(|&r| r as usize).collect();
    rows.iter().for_each(|&row| still[row] = false);
    rows.into_iter().chain((0..n).filter(|&i| still[i])).collect()
}

/// The coefficients of degree 1 to `degree`.
fn harmonics(gaussians: &HostGaussians, order: &[usize], degree: usize) -> Vec<u32> {
    let (rest, kept) = (3 * sh_rest_len(gaussians.sh_degree), 3 * sh_rest_len(degree));
    let mut out = Vec::with_capacity(order.len() * kept.div_ceil(2));
    order.iter().for_each(|&i| out.extend(gaussians.sh_rest[rest * i..rest * i + kept].chunks(2).map(pair_of_halves)));
    out
}

fn pair_of_halves(pair: &[f32]) -> u32 {
    let half = |k: usize| u32::from(half::f16::from_f32(pair.get(k).copied().unwrap_or(0.0).clamp(-65504.0, 65504.0)).to_bits());
    half(0) | half(1) << 16
}

/// `still` widened to where `layer` can move the centres `means`: the sum of what each function can add, which no time exceeds.
fn reach(means: &[f32], still: [[f32; 3]; 2], layer: &PlaybackLayer) -> [[f32; 3]; 2] {
    let [mut lower, mut upper] = still;
    for segment in &layer.segments {
        let samples = segment.last - segment.first + 1;
        for track in segment.tracks.iter().filter(|t| t.head == Head::Means) {
            let range = |f: &[f32]| f.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(a, b), v| (a.min(*v), b.max(*v)));
            let ranges: Vec<(f32, f32)> = track.functions.chunks_exact(samples).map(range).collect();
            for (row, &gaussian) in layer.rows.iter().enumerate() {
                let coefficients = &track.coefficients[3 * track.starts[row] as usize..3 * track.starts[row + 1] as usize];
                for k in 0..3 {
                    let terms = coefficients.iter().skip(k).step_by(3).zip(&ranges);
                    let (low, high) = terms.fold((0.0, 0.0), |(a, b), (c, r)| (a + (c * r.0).min(c * r.1), b + (c * r.0).max(c * r.1)));
                    let mean = means[3 * gaussian as usize + k];
                    (lower[k], upper[k]) = (lower[k].min(mean + low), upper[k].max(mean + high));
                }
            }
        }
    }
    [lower, upper]
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use cc4dgs_format::playback::Segment;

    /// Three Gaussians whose harmonics count from 0.
    pub(crate) fn three(sh_degree: usize) -> HostGaussians {
        HostGaussians {
            sh_degree,
            means: vec![0.0; 9],
            log_scales: vec![0.0; 9],
            quaternions: [1.0, 0.0, 0.0, 0.0].repeat(3),
            opacity_logits: vec![0.0; 3],
            sh_dc: vec![0.0; 9],
            sh_rest: (0..9 * sh_rest_len(sh_degree)).map(|v| v as f32).collect(),
            dynamic_scores: vec![0.0; 3],
            ..Default::default()
        }
    }

    #[test]
    fn moving_gaussians_come_first_and_keep_their_coefficients() {
        let gaussians = HostGaussians {
            means: (0..12).map(|v| v as f32).collect(),
            log_scales: vec![-3.0; 12],
            quaternions: [2.0, 0.0, 0.0, 0.0].repeat(4),
            opacity_logits: vec![0.0; 4],
            sh_dc: vec![0.1; 12],
            dynamic_scores: vec![0.0; 4],
            ..Default::default()
        };
        let ranks = vec![1, 2];
        let track = Track { head: Head::Means, functions: vec![0.0, 1.0, 1.0, 0.0], starts: Track::starts_of(&ranks), ranks, coefficients: vec![1.0; 9] };
        let layer = PlaybackLayer { rows: vec![1, 3], samples: 2, sh_degree: 0, segments: vec![Segment { first: 0, last: 1, tracks: vec![track] }] };
        let scene = Scene::new(&gaussians, Some(layer)).unwrap();
        let xs: Vec<f32> = scene.gaussians.chunks(GAUSSIAN_FLOATS).map(|g| g[0]).collect();
        assert_eq!((scene.moving, xs), (2, vec![3.0, 9.0, 0.0, 6.0]));
        assert_eq!((scene.gaussians[3], scene.gaussians[8], &scene.starts), (0.5, 1.0, &vec![0, 1, 3]));
        assert_eq!(scene.tracks[0][0], Some((0, 0)));
        // The layer keeps the functions; the memory of its other arrays is given back.
        let kept = &scene.layer.as_ref().unwrap().segments[0].tracks[0];
        assert_eq!((kept.functions.len(), kept.ranks.capacity(), kept.starts.capacity(), kept.coefficients.capacity()), (4, 0, 0, 0));
        assert_eq!(scene.bounds, [[0.0, 1.0, 2.0], [9.0, 10.0, 11.0]]);
        // Two functions of 0 to 1 with coefficients of 1.
        assert_eq!(scene.reach, [[0.0, 1.0, 2.0], [11.0, 12.0, 13.0]]);
    }

    #[test]
    fn harmonics_that_do_not_fit_lose_their_highest_degrees() {
        let whole = three(3);
        let mut scene = Scene::new(&whole, None).unwrap();
        let complete = scene.harmonics.clone();
        scene.fit_harmonics(69);
        assert!(scene.drawn_degree == 3 && scene.harmonics == complete);
        scene.fit_harmonics(68);
        assert_eq!((scene.sh_degree, scene.drawn_degree, scene.harmonics_words(), scene.harmonics.len()), (3, 2, 12, 36));
        assert_eq!((scene.harmonics[11], scene.harmonics[12]), (complete[11], complete[23]));
        // Those that arrive later are as many.
        assert_eq!(scene.harmonics_of(&whole).unwrap(), scene.harmonics);
        scene.fit_harmonics(1);
        assert!(scene.drawn_degree == 0 && scene.harmonics.is_empty() && scene.harmonics_of(&whole).unwrap().is_empty());
    }

    #[test]
    fn harmonics_that_arrive_later_are_those_of_the_whole() {
        let whole = three(1);
        let layer = || Some(PlaybackLayer { rows: vec![2], samples: 1, sh_degree: 1, segments: vec![Segment { first: 0, last: 0, tracks: Vec::new() }] });
        let base = Scene::new(&HostGaussians { sh_rest: vec![0.0; 27], ..whole.clone() }, layer()).unwrap();
        let complete = Scene::new(&whole, layer()).unwrap();
        assert!(base.harmonics.iter().all(|v| *v == 0) && complete.harmonics[0] == pair_of_halves(&[18.0, 19.0]));
        assert_eq!(base.harmonics_of(&whole).unwrap(), complete.harmonics);
        assert!(base.harmonics_of(&whole.select(&[0, 1])).is_err());
    }
}
