//! Whether two images show common content where their cameras say so.
//!
//! A corner of one image must reappear on its epipolar line in the other. How well any line matches depends on the texture, so the true line competes with
//! parallel lines of the same length: with wrong poses, the true line holds the best match no more often than the others.

use super::super::small_gray;
use cc4dgs_core::{Camera, Image8};
use glam::{DMat3, DVec2, DVec3};

/// Pixels of the small images that are compared.
const PIXELS: f64 = 5_000.0;
/// Half-width of the comparison window, pixels.
const RADIUS: usize = 3;
const SIDE: usize = 2 * RADIUS + 1;
const WINDOW: usize = SIDE * SIDE;
/// Offsets of the compared lines from the true one, as shares of the square root of the number of pixels.
const OFFSETS: [f64; LINES] = [0.0, 0.07, -0.07, 0.14, -0.14];
/// Number of compared lines, the true one first.
pub(super) const LINES: usize = 5;
/// Corners are the best pixels of the cells of this grid.
const GRID: (usize, usize) = (10, 8);
/// Smallest eigenvalue of the structure tensor of a corner: mean squared slope per pixel, grey in 0..1.
const CORNER: f32 = 4e-5;
/// Correlation from which a match counts.
const MATCH: f32 = 0.75;
/// The most steps along a line.
const STEPS: usize = 160;

/// A small grey image with its camera.
pub(super) struct Look {
    width: usize,
    height: usize,
    gray: Vec<f32>,
    focal: DVec2,
    principal: DVec2,
    rotation: DMat3,
    translation: DVec3,
    /// Corners: the middle of the window.
    corners: Vec<(usize, usize)>,
}

/// How often the lines of a pair of images won.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Tally {
    /// Corners whose line can be seen in the other image.
    pub seen: u32,
    /// Corners of the first image.
    pub corners: u32,
    /// Corners by the line that holds the best match; corners without a match are not counted.
    pub wins: [u32; LINES],
}

impl Tally {
    /// Adds the counts of `other`.
    pub fn add(&mut self, other: &Tally) {
        self.seen += other.seen;
        self.corners += other.corners;
        self.wins.iter_mut().zip(other.wins).for_each(|(a, b)| *a += b);
    }
    /// Corners with a match.
    pub fn matches(&self) -> u32 {
        self.wins.iter().sum()
    }
    /// Share of the matches that lie on the true line, pulled towards chance (0.2) by two matches; 1 where poses are exact and texture is unique.
    pub fn share(&self) -> f64 {
        let chance = 1.0 / LINES as f64;
        (f64::from(self.wins[0]) + 2.0 * chance) / (f64::from(self.matches()) + 2.0)
    }
}

impl Look {
    /// The small version of `image`, seen by `camera`; alpha is composited over `background`.
    pub fn new(image: &Image8, camera: &Camera, background: [f32; 3]) -> Self {
        let (width, height, gray) = small_gray(image, PIXELS, background);
        let camera = camera.resized(width, height);
        let (rotation, translation) = camera.rotation_translation();
        let mut look = Self {
            width: width as usize,
            height: height as usize,
            gray,
            focal: DVec2::new(camera.fx, camera.fy),
            principal: DVec2::new(camera.cx, camera.cy),
            rotation,
            translation,
            corners: Vec::new(),
        };
        look.corners = look.find_corners();
        look
    }
    fn find_corners(&self) -> Vec<(usize, usize)> {
        let margin = RADIUS + 1;
        if self.width <= 2 * margin || self.height <= 2 * margin {
            return Vec::new();
        }
        let (columns, rows) = GRID;
        let mut best = vec![(CORNER, None); columns * rows];
        for y in margin..self.height - margin {
            for x in margin..self.width - margin {
                let cell = &mut best[y * rows / self.height * columns + x * columns / self.width];
                let strength = self.corner_strength(x, y);
                if strength > cell.0 {
                    *cell = (strength, Some((x, y)));
                }
            }
        }
        best.into_iter().filter_map(|cell| cell.1).collect()
    }
    /// Smaller eigenvalue of the mean structure tensor of the window around (x, y).
    fn corner_strength(&self, x: usize, y: usize) -> f32 {
        let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
        for j in y - RADIUS..=y + RADIUS {
            for i in x - RADIUS..=x + RADIUS {
                let p = j * self.width + i;
                let (dx, dy) = (0.5 * (self.gray[p + 1] - self.gray[p - 1]), 0.5 * (self.gray[p + self.width] - self.gray[p - self.width]));
                (xx, xy, yy) = (xx + dx * dx, xy + dx * dy, yy + dy * dy);
            }
        }
        let (half, difference) = (0.5 * (xx + yy), 0.5 * (xx - yy));
        (half - (difference * difference + xy * xy).sqrt()) / WINDOW as f32
    }
    /// The grey value at pixel coordinates, bilinear; the caller keeps inside.
    fn sample(&self, u: f32, v: f32) -> f32 {
        let (x, y) = (u - 0.5, v - 0.5);
        let (i, j) = ((x as usize).min(self.width - 2), (y as usize).min(self.height - 2));
        let (s, t) = (x - i as f32, y - j as f32);
        let p = j * self.width + i;
        let top = self.gray[p] * (1.0 - s) + self.gray[p + 1] * s;
        let bottom = self.gray[p + self.width] * (1.0 - s) + self.gray[p + self.width + 1] * s;
        top * (1.0 - t) + bottom * t
    }
    fn matrix(&self, focal_factor: f64) -> DMat3 {
        let f = self.focal * focal_factor;
        DMat3::from_cols(DVec3::new(f.x, 0.0, 0.0), DVec3::new(0.0, f.y, 0.0), DVec3::new(self.principal.x, self.principal.y, 1.0))
    }
    /// Looks for the corners of this image in `other`, at all depths from `near` (units of the cameras) to infinity, all focal lengths times `focal_factor`.
    pub fn compare(&self, other: &Look, near: f64, focal_factor: f64) -> Tally {
        let mut tally = Tally { corners: self.corners.len() as u32, ..Tally::default() };
        if other.width < 2 || other.height < 2 {
            return tally;
        }
        let r = other.rotation * self.rotation.transpose();
        let t = other.translation - r * self.translation;
        let k = other.matrix(focal_factor);
        let search = Search { from: self, to: other, turn: k * r * self.matrix(focal_factor).inverse(), shift: k * t, nearest: 1.0 / near };
        for &(x, y) in &self.corners {
            let Some(scores) = search.best_on_lines(x, y) else { continue };
            tally.seen += 1;
            let best = (0..LINES).fold(0, |b, line| if scores[line] > scores[b] { line } else { b });
            tally.wins[best] += u32::from(scores[best] > MATCH);
        }
        tally
    }
}

/// A pixel (u, v) of `from` at inverse depth d is at `turn * (u, v, 1) + d * shift` in `to`, homogeneous.
struct Search<'a> {
    from: &'a Look,
    to: &'a Look,
    turn: DMat3,
    shift: DVec3,
    nearest: f64,
}

impl Search<'_> {
    /// The best correlation on each line over all depths; `None` if the lines are outside the other image.
    fn best_on_lines(&self, x: usize, y: usize) -> Option<[f32; LINES]> {
        let window = self.window(x, y);
        let far = self.turn * DVec3::new(x as f64 + 0.5, y as f64 + 0.5, 1.0);
        let unit = ((self.to.width * self.to.height) as f64).sqrt();
        let mut scores = [f32::NEG_INFINITY; LINES];
        let mut inverse = 0.0;
        for _ in 0..STEPS {
            let h = far + inverse * self.shift;
            let mut step = self.nearest / 64.0;
            if h.z > 1e-9 {
                let p = h.truncate() / h.z;
                // Pixels per unit of inverse depth.
                let speed = (self.shift.truncate() - p * self.shift.z) / h.z;
                step = (1.0 / speed.length()).clamp(self.nearest / STEPS as f64, self.nearest / 4.0);
                let along = speed.try_normalize().unwrap_or(DVec2::X);
                let column = |m: DVec3| (m.truncate() - p * m.z) / h.z;
                let warp = [column(self.turn.x_axis), column(self.turn.y_axis)];
                self.score_lines(&window, p, along.perp() * unit, warp, &mut scores);
            }
            inverse += step;
            if inverse > self.nearest {
                break;
            }
        }
        scores[0].is_finite().then_some(scores)
    }
    /// The window around a corner, zero mean and unit length.
    fn window(&self, x: usize, y: usize) -> [f32; WINDOW] {
        let mut values = [0.0; WINDOW];
        for (row, line) in values.chunks_exact_mut(SIDE).enumerate() {
            let start = (y + row - RADIUS) * self.from.width + x - RADIUS;
            line.copy_from_slice(&self.from.gray[start..start + SIDE]);
        }
        normalise(&mut values);
        values
    }
    /// Compares the window with the images of it around `p` on all lines. `normal` is the direction across the lines for an offset of 1, `warp` the change
    /// of the position in the other image per pixel.
    fn score_lines(&self, window: &[f32; WINDOW], p: DVec2, normal: DVec2, warp: [DVec2; 2], scores: &mut [f32; LINES]) {
        let size = warp[0].perp_dot(warp[1]).abs();
        if !(0.1..10.0).contains(&size) {
            return;
        }
        let reach = (warp[0].abs() + warp[1].abs()) * RADIUS as f64 + DVec2::splat(0.5);
        let limit = DVec2::new(self.to.width as f64, self.to.height as f64) - reach;
        // All lines or none: a line that is longer in the image would win more often.
        let inside = |q: DVec2| q.cmpge(reach).all() && q.cmple(limit).all();
        if !OFFSETS.iter().all(|offset| inside(p + normal * *offset)) {
            return;
        }
        let [across, down] = warp.map(|step| step.as_vec2());
        for (score, offset) in scores.iter_mut().zip(OFFSETS) {
            let middle = (p + normal * offset).as_vec2();
            let mut values = [0.0; WINDOW];
            for (row, line) in values.chunks_exact_mut(SIDE).enumerate() {
                let mut q = (middle - across * RADIUS as f32) + down * (row as f32 - RADIUS as f32);
                for value in line {
                    *value = self.to.sample(q.x, q.y);
                    q += across;
                }
            }
            normalise(&mut values);
            *score = score.max(window.iter().zip(&values).map(|(a, b)| a * b).sum());
        }
    }
}

/// Zero mean and unit length; windows without texture stay near zero.
fn normalise(values: &mut [f32; WINDOW]) {
    let mean = values.iter().sum::<f32>() / WINDOW as f32;
    values.iter_mut().for_each(|v| *v -= mean);
    // A standard deviation of one 8-bit level does not count as texture.
    let length = (values.iter().map(|v| v * v).sum::<f32>() + WINDOW as f32 * 1.5e-5).sqrt();
    values.iter_mut().for_each(|v| *v /= length);
}
