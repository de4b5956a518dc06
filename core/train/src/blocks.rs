//! Blocks of an image in which something moves, and whether a model draws it. The PSNR of an image hardly notices that a ball is missing; the PSNR of the
//! block that shows the ball does.

use cc4dgs_core::{Image8, Result, Scene};
use rayon::prelude::*;
use serde::Serialize;

/// Blocks over the height of an image.
const ROWS: usize = 16;
/// Fewest frames of a camera from which the usual colour of a pixel is known, and the most that are used.
const FRAMES: [usize; 2] = [5, 31];
/// Mean absolute difference from the usual colour over the channels, of values in 0..255, from which a pixel shows something that moves.
const MOVING: f32 = 20.0;
/// Share of the pixels of a block that must move.
const SHARE: f64 = 0.2;

/// The scores of one image's moving blocks.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct BlockScore {
    /// Blocks in which something moves.
    pub moving: usize,
    /// Of which the render is nearer to the usual image than to the truth: what moves is not there, or elsewhere.
    pub lost: usize,
    /// PSNR of the worst moving block, its moving pixels only.
    pub worst_psnr_db: f64,
}

/// What a fixed camera usually sees: the median over time of every pixel and channel; of an even number of frames the upper one of the two in the middle.
/// Stored results depend on that: the mean of the two would change which blocks move.
pub struct UsualImage {
    width: usize,
    height: usize,
    /// `[H,W,3]`, 0..255.
    values: Vec<u8>,
}

impl UsualImage {
    /// The usual image of `views`, which are of one camera; `None` where they are too few.
    ///
    /// # Errors
    /// What decoding the images meets.
    pub fn of(scene: &Scene, views: &[usize], background: [f32; 3]) -> Result<Option<Self>> {
        if views.len() < FRAMES[0] {
            return Ok(None);
        }
        let used = crate::sample::spread(views, FRAMES[1]);
        let camera = scene.camera(views[0]);
        let frames: Vec<Image8> = used
            .par_iter()
            .map(|&view| Ok(Image8::from_planes(&scene.frame(view)?.to_planes(background), camera.width, camera.height)))
            .collect::<Result<_>>()?;
        let median = |index: usize| {
            let mut values: Vec<u8> = frames.iter().map(|frame| frame.data[index]).collect();
            values.sort_unstable();
            values[values.len() / 2]
        };
        let (width, height) = (camera.width as usize, camera.height as usize);
        Ok(Some(Self { width, height, values: (0..3 * width * height).into_par_iter().map(median).collect() }))
    }
    /// Scores `render` against `truth`, RGB images of the camera; `None` where nothing moves.
    pub fn score(&self, truth: &Image8, render: &Image8) -> Option<BlockScore> {
        let side = self.height.div_ceil(ROWS).max(1);
        let mut total = BlockScore { moving: 0, lost: 0, worst_psnr_db: f64::INFINITY };
        for top in (0..self.height).step_by(side) {
            for left in (0..self.width).step_by(side) {
                let Some((lost, psnr_db)) = self.score_block(truth, render, [left, top], side) else { continue };
                total.moving += 1;
                total.lost += usize::from(lost);
                total.worst_psnr_db = total.worst_psnr_db.min(psnr_db);
            }
        }
        (total.moving > 0).then_some(total)
    }
    /// Whether the block at `[left, top]` is lost, and the PSNR of its moving pixels; `None` where too few move.
    fn score_block(&self, truth: &Image8, render: &Image8, [left, top]: [usize; 2], side: usize) -> Option<(bool, f64)> {
        let (right, bottom) = ((left + side).min(self.width), (top + side).min(self.height));
        let (mut moving, mut to_truth, mut to_usual, mut squares) = (0usize, 0.0f64, 0.0f64, 0.0f64);
        for pixel in (top..bottom).flat_map(|y| (left..right).map(move |x| y * self.width + x)) {
            let channels = 3 * pixel..3 * pixel + 3;
            let difference = |a: &[u8], b: &[u8]| a.iter().zip(b).map(|(a, b)| f32::from(a.abs_diff(*b))).sum::<f32>() / 3.0;
            let (t, r, u) = (&truth.data[channels.clone()], &render.data[channels.clone()], &self.values[channels]);
            if difference(t, u) < MOVING {
                continue;
            }
            moving += 1;
            to_truth += f64::from(difference(r, t));
            to_usual += f64::from(difference(r, u));
            squares += t.iter().zip(r).map(|(a, b)| f64::from(a.abs_diff(*b)).powi(2)).sum::<f64>() / 3.0;
        }
        let enough = moving as f64 >= SHARE * ((right - left) * (bottom - top)) as f64 && moving > 0;
        // Half a level of rounding is the least error that 8-bit images can show.
        let mse = (squares / moving.max(1) as f64).max(0.25);
        enough.then(|| (to_truth > to_usual, 10.0 * (255.0f64.powi(2) / mse).log10()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(ball: Option<[usize; 2]>) -> Image8 {
        let (width, height) = (64usize, 32usize);
        let inside = |x: usize, y: usize| ball.is_some_and(|[left, top]| (left..left + 4).contains(&x) && (top..top + 4).contains(&y));
        let data = (0..width * height).flat_map(|p| [if inside(p % width, p / width) { 220u8 } else { 90 }; 3]).collect();
        Image8 { width: width as u32, height: height as u32, channels: 3, data }
    }

    #[test]
    fn a_missing_ball_is_lost_and_a_blurred_one_is_not() {
        let usual = UsualImage { width: 64, height: 32, values: image(None).data };
        let truth = image(Some([20, 8]));
        let drawn = usual.score(&truth, &truth).unwrap();
        assert_eq!((drawn.moving, drawn.lost), (4, 0));
        assert!(drawn.worst_psnr_db > 50.0);
        let missing = usual.score(&truth, &image(None)).unwrap();
        assert_eq!((missing.moving, missing.lost), (4, 4));
        assert!(missing.worst_psnr_db < 10.0, "{missing:?}");
        let mut blurred = truth.clone();
        blurred.data.iter_mut().zip(&image(None).data).for_each(|(v, u)| *v = ((3 * u16::from(*v) + u16::from(*u)) / 4) as u8);
        assert_eq!(usual.score(&truth, &blurred).unwrap().lost, 0);
        assert!(usual.score(&image(None), &truth).is_none(), "nothing moves in the true image");
    }
}
