//! The visual hull: points that nearly all foreground masks contain. Most lie on its surface, next to points that some masks leave out.
//!
//! Masks of different times disagree where things move. The share of masks that may leave a point out grows until there is a hull.

use super::Candidate;
use super::choose::Arrangement;
use super::views::{Foreground, WorkSet, WorkView};
use crate::sample::spread_from_first;
use cc4dgs_core::Seed;
use glam::{Mat3, Vec3};
use rand::Rng;
use rayon::prelude::*;

/// Cells per axis of the first look.
const GRID: usize = 64;
/// The most random points per cell that may hold surface, and in all such cells.
const PER_CELL: usize = 200;
const IN_ALL: usize = 400_000;
/// The most masks that are asked.
const MAX_MASKS: usize = 60;
/// The fewest cameras that must see a point before their masks decide.
const MIN_SEEING: usize = 3;
/// Shares of the seeing cameras whose mask may leave a point out, at one time.
const MISSES_AT_ONE_TIME: [f32; 2] = [0.08, 0.2];
/// The same across times.
const MISSES_ACROSS_TIMES: [f32; 3] = [0.1, 0.25, 0.4];
/// The shares for the box around everything that is foreground at some time, at one time and across times: what moves is often somewhere else.
const MISSES_OF_BOX: [f32; 2] = [0.5, 0.92];
/// Points that make a hull.
const ENOUGH: usize = 500;
/// One in so many points inside the surface is kept.
const INSIDE: usize = 24;

/// Where the foreground can be: a box, in which the hull is sought.
pub(super) struct Hull<'a> {
    masked: Vec<Masked<'a>>,
    low: Vec3,
    high: Vec3,
    misses: &'static [f32],
    misses_of_box: f32,
    whole: bool,
}

/// A view with a mask, and its projection in single precision.
struct Masked<'a> {
    view: &'a WorkView,
    mask: &'a [bool],
    projection: Mat3,
    offset: Vec3,
    size: [f32; 2],
}

impl<'a> Masked<'a> {
    fn new(view: &'a WorkView) -> Option<Self> {
        let level = view.fine();
        let projection = (level.k * view.rotation).as_mat3();
        let offset = (level.k * view.translation).as_vec3();
        Some(Self { view, mask: view.mask.as_deref()?, projection, offset, size: [level.width as f32, level.height as f32] })
    }
    /// Index of the pixel that shows a world point.
    fn pixel(&self, p: Vec3) -> Option<usize> {
        let q = self.projection * p + self.offset;
        let (u, v) = (q.x / q.z, q.y / q.z);
        let inside = q.z > 1e-6 && u >= 0.0 && v >= 0.0 && u < self.size[0] && v < self.size[1];
        inside.then(|| v as usize * self.size[0] as usize + u as usize)
    }
}

impl<'a> Hull<'a> {
    /// `None` if fewer than three views have masks or the masks have nothing in common.
    pub fn find(set: &'a WorkSet) -> Option<Self> {
        let masked: Vec<&WorkView> = set.views.iter().filter(|v| v.mask.is_some()).collect();
        let masked: Vec<Masked> = spread_from_first(&masked, MAX_MASKS).into_iter().filter_map(Masked::new).collect();
        if masked.len() < MIN_SEEING {
            return None;
        }
        let (misses, misses_of_box): (&[f32], f32) = match set.arrangement {
            Arrangement::OneTime => (&MISSES_AT_ONE_TIME, MISSES_OF_BOX[0]),
            _ => (&MISSES_ACROSS_TIMES, MISSES_OF_BOX[1]),
        };
        let mut hull = Self { masked, low: set.box_low, high: set.box_high, misses, misses_of_box, whole: set.foreground == Foreground::Whole };
        // The box may be many times larger than what is in it.
        for _ in 0..3 {
            let (low, high) = hull.extent(hull.misses_of_box)?;
            let shrunk = (high - low) / (hull.high - hull.low);
            (hull.low, hull.high) = (low, high);
            if shrunk.min_element() > 0.7 {
                break;
            }
        }
        Some(hull)
    }
    /// Lower and upper corner of a box around the foreground of all times.
    pub fn bounds(&self) -> (Vec3, Vec3) {
        (self.low, self.high)
    }
    /// Whether `p` can be foreground at some time.
    pub fn may_hold(&self, p: Vec3) -> bool {
        self.inside(p, self.misses_of_box)
    }
    /// The box around the cells that at most the share `misses` of the masks leave out, with a cell to spare.
    fn extent(&self, misses: f32) -> Option<(Vec3, Vec3)> {
        let grid = Grid { low: self.low, size: (self.high - self.low) / GRID as f32 };
        let full = self.full(&grid, misses);
        let centers = || (0..full.len()).filter(|&c| full[c]).map(|c| grid.center(c));
        let low = centers().reduce(Vec3::min)? - 1.5 * grid.size;
        let high = centers().reduce(Vec3::max)? + 1.5 * grid.size;
        Some((low.max(self.low), high.min(self.high)))
    }
    /// The cells whose centres at most the share `misses` of the masks leave out.
    fn full(&self, grid: &Grid, misses: f32) -> Vec<bool> {
        (0..GRID * GRID * GRID).into_par_iter().map(|c| self.inside(grid.center(c), misses)).collect()
    }

    /// Points on the hull, and some in it if there is nothing but foreground, with the colours of the cameras that face them.
    pub fn points(&self, seed: Seed) -> Vec<Candidate> {
        let mut found = Vec::new();
        for &misses in self.misses {
            found = self.points_of(seed, misses);
            if found.len() >= ENOUGH {
                break;
            }
        }
        found
    }
    fn points_of(&self, seed: Seed, misses: f32) -> Vec<Candidate> {
        // A cell's centre may miss a limb that crosses the cell; being nearly inside is enough for the first look.
        let nearly = (misses + 0.2).max(0.3);
        // The cells are those of the box of all times: where much moves, the shell is thick.
        let grid = Grid { low: self.low, size: (self.high - self.low) / GRID as f32 };
        let full = self.full(&grid, nearly);
        let mut near = vec![false; full.len()];
        for (c, near) in near.iter_mut().enumerate() {
            let around = |v: usize| v.saturating_sub(1)..(v + 2).min(GRID);
            let [i, j, k] = Grid::split(c);
            *near = around(k).any(|c| around(j).any(|b| around(i).any(|a| full[(c * GRID + b) * GRID + a])));
        }
        let cells: Vec<usize> = (0..near.len()).filter(|&c| near[c]).collect();
        let per_cell = PER_CELL.min(IN_ALL / cells.len().max(1)).max(4);
        let shell = 0.5 * grid.size.max_element();
        let found: Vec<Vec<Candidate>> = cells
            .par_iter()
            .map(|&cell| {
                // One generator per cell: the result does not depend on which thread takes it.
                let mut rng = seed.index(cell as u64).rng();
                let mut points = Vec::new();
                for i in 0..per_cell {
                    let jitter = Vec3::new(rng.random::<f32>() - 0.5, rng.random::<f32>() - 0.5, rng.random::<f32>() - 0.5);
                    let position = grid.center(cell) + jitter * grid.size;
                    if !self.inside(position, misses) {
                        continue;
                    }
                    let normal = self.normal(position, shell, misses);
                    if normal.is_some() || (self.whole && i % INSIDE == 0) {
                        points.push(Candidate { position, color: self.color(position, normal), confidence: 0.0, depth: 0.0 });
                    }
                }
                points
            })
            .collect();
        found.into_iter().flatten().collect()
    }

    fn inside(&self, p: Vec3, misses: f32) -> bool {
        let (mut seeing, mut missing) = (0usize, 0usize);
        let most = misses * self.masked.len() as f32;
        for view in &self.masked {
            let Some(pixel) = view.pixel(p) else { continue };
            seeing += 1;
            missing += usize::from(!view.mask[pixel]);
            if missing as f32 > most {
                return false;
            }
        }
        // What only a corner of the rig sees is not carved, and so not known to be full.
        seeing >= MIN_SEEING.max(self.masked.len() / 3) && missing as f32 <= misses * seeing as f32
    }
    /// The outward direction if the hull ends within `reach`.
    fn normal(&self, p: Vec3, reach: f32, misses: f32) -> Option<Vec3> {
        let axes = [Vec3::X, -Vec3::X, Vec3::Y, -Vec3::Y, Vec3::Z, -Vec3::Z];
        let sum: Vec3 = axes.into_iter().filter(|a| !self.inside(p + *a * reach, misses)).sum();
        sum.try_normalize()
    }
    /// Mean colour of the three cameras that look at the surface most squarely; of all, inside. Only foreground counts.
    fn color(&self, p: Vec3, normal: Option<Vec3>) -> [f32; 3] {
        let seen = self.masked.iter().filter_map(|m| {
            let pixel = m.pixel(p).filter(|&pixel| m.mask[pixel])?;
            let facing = normal.map_or(0.0, |n| (m.view.center.as_vec3() - p).normalize_or_zero().dot(n));
            Some((facing, m.view.fine().rgb[pixel]))
        });
        let mut seen: Vec<(f32, [f32; 3])> = seen.collect();
        seen.sort_by(|a, b| b.0.total_cmp(&a.0));
        seen.truncate(if normal.is_some() { 3 } else { seen.len() });
        let n = seen.len().max(1) as f32;
        std::array::from_fn(|k| seen.iter().map(|s| s.1[k]).sum::<f32>() / n)
    }
}

/// [`GRID`]³ cells from `low` on.
struct Grid {
    low: Vec3,
    size: Vec3,
}

impl Grid {
    fn split(cell: usize) -> [usize; 3] {
        [cell % GRID, cell / GRID % GRID, cell / GRID / GRID]
    }
    fn center(&self, cell: usize) -> Vec3 {
        self.low + self.size * Vec3::from(Self::split(cell).map(|i| i as f32 + 0.5))
    }
}
