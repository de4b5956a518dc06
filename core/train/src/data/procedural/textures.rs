//! Colours over surfaces: functions of the local position, in world units.

use glam::DVec3;
use std::f64::consts::TAU;

/// Cells begin this share of a cell off the origin.
const OFF_FACES: f64 = 0.0137;

/// A colour, RGB in 0..1.
pub type Rgb = [f64; 3];

/// Colour over the surface, a function of the local position. Those with a seed are random, equal seeds look the same.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Texture {
    /// One colour.
    Plain(Rgb),
    /// Two colours in cubes of the given edge.
    Checker(Rgb, Rgb, f64),
    /// Two colours in bands around the local z axis' meridians (first) and heights (second): number of bands per turn and per unit.
    Bands(Rgb, Rgb, f64, f64),
    /// Fractal value noise between two colours.
    Noise {
        /// Where the noise is low and where it is high.
        colors: [Rgb; 2],
        /// Size of the coarsest of three octaves.
        cell: DVec3,
        /// Which noise.
        seed: u32,
    },
    /// Floor boards along the local x axis, with joints and grain.
    Planks {
        /// The darkest and the lightest board.
        colors: [Rgb; 2],
        /// Length and width of a board.
        board: [f64; 2],
        /// Which boards.
        seed: u32,
    },
    /// Vertical stripes on upright faces, as on wallpaper.
    Stripes {
        /// The two colours.
        colors: [Rgb; 2],
        /// Width of a stripe.
        width: f64,
        /// Which shades.
        seed: u32,
    },
    /// Bricks on upright faces.
    Bricks {
        /// The darkest and the lightest brick, and the mortar.
        colors: [Rgb; 3],
        /// Length and height of a brick.
        brick: [f64; 2],
        /// Which shades.
        seed: u32,
    },
    /// Lines of words on a face in the plane of x and z.
    Print {
        /// Paper, ink and the colour of headings.
        colors: [Rgb; 3],
        /// Height of a line.
        line: f64,
        /// Which words.
        seed: u32,
    },
    /// Cells of three colours in many shades: spines of books, a quilt.
    Patches {
        /// The three colours.
        colors: [Rgb; 3],
        /// Size of a cell.
        cell: DVec3,
        /// Which cells.
        seed: u32,
    },
}

impl Texture {
    /// The colour at a local point.
    pub fn color(&self, p: DVec3) -> Rgb {
        match *self {
            Self::Plain(c) => c,
            Self::Checker(a, b, edge) => {
                // Half an edge off, so that faces through the origin do not flicker between two cubes.
                let cell = (p / edge + DVec3::splat(0.25)).floor();
                if (cell.x + cell.y + cell.z).rem_euclid(2.0) < 0.5 { a } else { b }
            }
            Self::Bands(a, b, per_turn, per_unit) => {
                let phase = p.y.atan2(p.x) / TAU * per_turn + p.z * per_unit;
                if phase.rem_euclid(1.0) < 0.5 { a } else { b }
            }
            Self::Noise { colors, cell, seed } => mix(colors[0], colors[1], contrast(fractal(p / cell, seed))),
            Self::Planks { colors, board: [length, width], seed } => {
                let row = (p.y / width).floor();
                let along = p.x / length + random(row, 0.0, 0.0, seed);
                let tone = random(row, along.floor(), 1.0, seed);
                let grain = fractal(DVec3::new(p.x / 0.9, p.y / 0.12, row), seed) - 0.5;
                let joint = (p.y / width).rem_euclid(1.0) < 0.1 || along.rem_euclid(1.0) < 0.03;
                scale(mix(colors[0], colors[1], (tone + 1.1 * grain).clamp(0.0, 1.0)), if joint { 0.55 } else { 1.0 })
            }
            Self::Stripes { colors, width, seed } => {
                let (column, within) = cell_of((p.x + p.y) / width);
                let color = mix(colors[0], colors[1], if column.rem_euclid(2.0) < 0.5 { 0.15 } else { 0.85 });
                let ornament = within > 0.3 && within < 0.7 && (p.z / width + 0.5 * column).rem_euclid(1.0) < 0.4;
                mottled(scale(color, if ornament { 0.72 } else { 1.0 }), p, seed)
            }
            Self::Bricks { colors, brick: [length, height], seed } => {
                let (row, up) = cell_of(p.z / height);
                let (column, along) = cell_of((p.x + p.y) / length + 0.5 * row.rem_euclid(2.0));
                let color = if up < 0.16 || along < 0.08 { colors[2] } else { mix(colors[0], colors[1], random(column, row, 0.0, seed)) };
                mottled(color, p, seed)
            }
            Self::Print { colors, line, seed } => {
                // Off the faces of boxes whose sizes are multiples of a line, where rounding would choose the cell.
                let (x, z) = (p.x / (0.8 * line) + OFF_FACES, p.z / line + OFF_FACES);
                let (row, up) = cell_of(z);
                // A block of a few lines is a heading, an image or text.
                let kind = random((row / 3.0).floor(), 0.0, 3.0, seed);
                let (column, _) = cell_of(x);
                let ink = (0.2..0.8).contains(&up) && random(column, row, 1.0, seed) > 0.35;
                let color = match kind {
                    k if k < 0.3 => mix(colors[2], colors[0], contrast(fractal(DVec3::new(p.x / 0.2, 0.0, p.z / 0.2), seed))),
                    k if k < 0.5 => colors[if random(column, (row / 2.0).floor(), 2.0, seed) > 0.4 { 2 } else { 0 }],
                    _ => colors[usize::from(ink)],
                };
                mottled(color, p, seed)
            }
            Self::Patches { colors, cell, seed } => {
                let q = (p / cell + DVec3::splat(OFF_FACES)).floor();
                let pick = random(q.x, q.y, q.z, seed);
                let shade = 0.55 + 0.6 * random(q.z, q.x, q.y, seed ^ 1);
                mottled(scale(colors[((pick * 3.0) as usize).min(2)], shade), p, seed)
            }
        }
    }
}

/// Linear from `a` (0) to `b` (1).
fn mix(a: Rgb, b: Rgb, share: f64) -> Rgb {
    std::array::from_fn(|k| a[k] + (b[k] - a[k]) * share)
}

fn scale(c: Rgb, by: f64) -> Rgb {
    c.map(|v| v * by)
}

/// Index of the unit cell, and the position in it, 0..1.
fn cell_of(x: f64) -> (f64, f64) {
    (x.floor(), x - x.floor())
}

/// Lighter and darker by a fifth, so that no surface is flat.
fn mottled(c: Rgb, p: DVec3, seed: u32) -> Rgb {
    scale(c, 0.8 + 0.4 * contrast(fractal(p / 0.3, seed ^ 2)))
}

/// Fractal noise seldom comes near 0 and 1; this spreads it.
fn contrast(v: f64) -> f64 {
    ((v - 0.5) * 2.2 + 0.5).clamp(0.0, 1.0)
}

/// 0..1 for a lattice point: SplitMix64's finaliser of a sum that differs for all points nearby.
fn random(x: f64, y: f64, z: f64, seed: u32) -> f64 {
    let [x, y, z] = [x, y, z].map(|c| c as i64 as u64);
    let sum = x.wrapping_mul(0x9E37_79B9_7F4A_7C15).wrapping_add(y.wrapping_mul(0xC2B2_AE3D_27D4_EB4F)).wrapping_add(z.wrapping_mul(0x1656_67B1_9E37_79F9));
    let mut h = sum.wrapping_add(u64::from(seed).wrapping_mul(0xD6E8_FEB8_6659_FD93));
    h = (h ^ (h >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    h = (h ^ (h >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    ((h ^ (h >> 31)) >> 11) as f64 / (1u64 << 53) as f64
}

/// Value noise: random numbers at lattice points, smoothly interpolated. 0..1.
fn noise(p: DVec3, seed: u32) -> f64 {
    let cell = p.floor();
    let f = p - cell;
    let s = f * f * (DVec3::splat(3.0) - 2.0 * f);
    let at = |x: f64, y: f64, z: f64| random(cell.x + x, cell.y + y, cell.z + z, seed);
    let along = |y: f64, z: f64| at(0.0, y, z) + (at(1.0, y, z) - at(0.0, y, z)) * s.x;
    let sheet = |z: f64| along(0.0, z) + (along(1.0, z) - along(0.0, z)) * s.y;
    sheet(0.0) + (sheet(1.0) - sheet(0.0)) * s.z
}

/// Three octaves of value noise, 0..1.
fn fractal(p: DVec3, seed: u32) -> f64 {
    0.5 * noise(p, seed) + 0.3 * noise(p * 2.0, seed ^ 0x55) + 0.2 * noise(p * 4.0, seed ^ 0xAA)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_smooth_bounded_and_follows_its_seed() {
        let (mut low, mut high, mut steps, mut differ) = (1.0f64, 0.0f64, 0.0f64, 0);
        for i in 0..4000 {
            let p = DVec3::new(0.173 * f64::from(i), -0.091 * f64::from(i), 0.057 * f64::from(i));
            let v = fractal(p, 7);
            (low, high) = (low.min(v), high.max(v));
            steps = steps.max((fractal(p + DVec3::X * 1e-4, 7) - v).abs());
            differ += usize::from((fractal(p, 8) - v).abs() > 0.02);
        }
        assert!(low > 0.0 && low < 0.25 && high < 1.0 && high > 0.75, "{low}..{high}");
        assert!(steps < 1e-3 && differ > 3000, "{steps} {differ}");
    }

    #[test]
    fn colours_are_colours() {
        let (a, b, c, seed) = ([0.2, 0.3, 0.4], [0.8, 0.7, 0.6], [0.5, 0.1, 0.1], 3);
        let textures = [
            Texture::Noise { colors: [a, b], cell: DVec3::splat(0.3), seed },
            Texture::Planks { colors: [a, b], board: [1.0, 0.2], seed },
            Texture::Stripes { colors: [a, b], width: 0.3, seed },
            Texture::Bricks { colors: [a, b, c], brick: [0.4, 0.2], seed },
            Texture::Print { colors: [a, b, c], line: 0.1, seed },
            Texture::Patches { colors: [a, b, c], cell: DVec3::splat(0.2), seed },
        ];
        for texture in textures {
            let mut spread = [1.0f64, 0.0f64];
            for i in 0..500 {
                let p = DVec3::new(0.031 * f64::from(i), 0.0, 0.017 * f64::from(i));
                let color = texture.color(p);
                assert!(color.iter().all(|v| (0.0..=1.2).contains(v)), "{texture:?}: {color:?}");
                spread = [spread[0].min(color[1]), spread[1].max(color[1])];
            }
            assert!(spread[1] - spread[0] > 0.15, "{texture:?}: {spread:?}");
        }
    }
}
