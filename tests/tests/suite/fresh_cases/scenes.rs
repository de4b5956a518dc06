//! Fresh cases like the golden scenes of the rasterizer: their sizes, distributions and corner cases, from a seed.

use super::draw::{Case, Draw, Parts, STRAIGHT, View, apart, rigid};
use cc4dgs_core::{BLUR, Rules, Seed};
use std::array::from_fn;

/// Needles and discs per case.
const NEEDLES: usize = 60;
/// Relative distance of a decision from its threshold at which the golden files leave a pixel out.
const ROBUST: f64 = 1e-4;

const GSPLAT: &[Rules] = &[Rules::Gsplat099];
const TWO_RULES: &[Rules] = &[Rules::Gsplat099, Rules::Inria];
/// Where alphas reach their cap, caps differ.
const ALL_RULES: &[Rules] = &[Rules::Gsplat099, Rules::Gsplat0999, Rules::Inria];

/// A kind of cases.
pub struct Kind {
    /// The golden scene that the cases resemble: `raster_NAME`.
    pub name: &'static str,
    /// The rules by which they are drawn.
    pub rules: &'static [Rules],
    /// Cases per rules.
    pub seeds: u64,
    /// A pixel counts where every decision is farther than this from its threshold, relatively.
    pub robust: f64,
    make: fn(&Draw) -> Case,
}

pub const FEW: Kind = Kind { name: "a", rules: TWO_RULES, seeds: 4, robust: ROBUST, make: few };
pub const ORDINARY: Kind = Kind { name: "b", rules: TWO_RULES, seeds: 4, robust: ROBUST, make: ordinary };
pub const ANTIALIASED: Kind = Kind { name: "b2", rules: GSPLAT, seeds: 6, robust: ROBUST, make: antialiased };
pub const DEGREE_4: Kind = Kind { name: "b4", rules: GSPLAT, seeds: 6, robust: ROBUST, make: degree_4 };
pub const CROWDED: Kind = Kind { name: "c", rules: TWO_RULES, seeds: 2, robust: ROBUST, make: crowded };
/// Peaks are 1e-4 from 1/255, so the golden files leave out half as much, too.
pub const FAINT: Kind = Kind { name: "d_alpha_threshold", rules: TWO_RULES, seeds: 4, robust: 0.5 * ROBUST, make: faint };
pub const CAPPED: Kind = Kind { name: "d_clamp_tie", rules: ALL_RULES, seeds: 4, robust: ROBUST, make: capped };
pub const EQUAL_DEPTHS: Kind = Kind { name: "d_identical_depths", rules: TWO_RULES, seeds: 4, robust: ROBUST, make: equal_depths };
pub const INSIDE: Kind = Kind { name: "d_inside_cloud", rules: TWO_RULES, seeds: 6, robust: ROBUST, make: inside };
pub const NEEDLE: Kind = Kind { name: "d_needles", rules: TWO_RULES, seeds: 8, robust: ROBUST, make: needles };
pub const OPAQUE: Kind = Kind { name: "d_opaque_stack", rules: ALL_RULES, seeds: 4, robust: ROBUST, make: opaque };

impl Kind {
    /// How many cases there are.
    pub fn cases(&self) -> u64 {
        self.seeds * self.rules.len() as u64
    }
    /// Case `seed`.
    pub fn case(&self, seed: u64) -> Case {
        let node = Seed::root(41).child(self.name.trim_start_matches("d_")).index(seed);
        let mut case = (self.make)(&Draw { node, seed });
        case.settings.rules = self.rules[(seed / self.seeds) as usize];
        case
    }
}

/// Gaussians everywhere in view and a little beyond.
struct Cloud {
    count: usize,
    depths: [f64; 2],
    /// Median of the scales, and the deviation of their logarithms.
    scales: [f64; 2],
    degree: usize,
    background: [f64; 3],
}

impl Cloud {
    fn case(self, draw: &Draw, view: &View) -> Case {
        let n = self.count;
        let depths = apart(draw.between("depths", self.depths[0], self.depths[1], n));
        let positions = draw.between("places", -0.07, 1.07, 2 * n);
        let parts = Parts {
            means: positions.chunks(2).zip(depths).flat_map(|(shares, z)| view.behind(shares, z)).collect(),
            scales: draw.log_normal("scales", self.scales[0], self.scales[1], 3 * n),
            quaternions: draw.spread("quaternions", 0.6, 4 * n),
            opacities: draw.between("opacities", 0.03, 0.98, n),
            colors: draw.colors(3 * n),
            degree: self.degree,
            harmonics: 0.25,
            background: self.background,
        };
        parts.case(draw, view)
    }
}

fn few(draw: &Draw) -> Case {
    let view = View::centered([32, 24], 30.0, draw.turned([0.0, 0.0, 3.0]));
    let depths = apart(draw.between("depths", 2.7, 3.3, 3));
    let positions = draw.between("places", 0.35, 0.65, 6);
    let parts = Parts {
        means: positions.chunks(2).zip(depths).flat_map(|(shares, z)| view.behind(shares, z)).collect(),
        scales: draw.between("scales", 0.18, 0.56, 9),
        quaternions: draw.spread("quaternions", 0.85, 12),
        opacities: draw.between("opacities", 0.5, 0.9, 3),
        colors: draw.colors(9),
        degree: 1,
        harmonics: 0.25,
        background: [0.0; 3],
    };
    parts.case(draw, &view)
}

fn ordinary(draw: &Draw) -> Case {
    let view = View::centered([64, 48], 55.0, draw.turned([0.05, 0.0, 3.0]));
    Cloud { count: 200, depths: [1.5, 6.0], scales: [0.123, 0.57], degree: 3, background: [0.8, 0.7, 0.6] }.case(draw, &view)
}

fn antialiased(draw: &Draw) -> Case {
    let view = View { size: [64, 48], focal: [48.0, 61.0], principal: [37.25, 20.5], world_to_camera: draw.turned([-0.1, -0.1, 3.7]) };
    let mut case = Cloud { count: 200, depths: [1.5, 6.0], scales: [0.048, 0.55], degree: 2, background: [0.1, 0.2, 0.15] }.case(draw, &view);
    case.settings.antialiased = true;
    case
}

fn degree_4(draw: &Draw) -> Case {
    let view = View::centered([64, 48], 70.0, draw.turned([0.0, 0.0, 2.3]));
    Cloud { count: 200, depths: [1.0, 9.0], scales: [0.2, 0.56], degree: 4, background: [1.0; 3] }.case(draw, &view)
}

/// The golden scene has 2,000 Gaussians at 128x96; these are fewer and larger, so that as many are in front of a pixel, and many pixels stop.
fn crowded(draw: &Draw) -> Case {
    let view = View::centered([96, 72], 82.5, draw.turned([-0.05, -0.1, 3.2]));
    Cloud { count: 800, depths: [1.5, 8.0], scales: [0.155, 0.54], degree: 3, background: [1.0; 3] }.case(draw, &view)
}

/// Alphas whose peaks, exactly in centres of pixels, are 1/255 or a little more or less.
fn faint(draw: &Draw) -> Case {
    let view = View::centered([64, 48], 64.0, STRAIGHT);
    let factors: [f64; 12] = [0.9999, 0.9997, 0.999, 0.99, 0.9, 0.5, 1.0001, 1.0003, 1.001, 1.01, 1.1, 1.3];
    let least = f64::from(1.0f32 / 255.0);
    let mut opacities: Vec<f64> = factors.iter().chain(&factors).map(|f| f * least).collect();
    opacities.extend([0.004, 0.0039, 0.00395, 0.008, 0.02, 0.5]);
    let shift = draw.numbers("shift", 2);
    let corner = [4.5 + (9.0 * shift[0]).floor(), 5.5 + (3.0 * shift[1]).floor()];
    let pixel = |i: usize| [corner[0] + 10.0 * (i % 6) as f64, corner[1] + 10.0 * (i / 6) as f64];
    let parts = Parts {
        means: (0..30).map(pixel).flat_map(|[u, v]| [(u - 32.0) / 32.0, (v - 24.0) / 32.0, 2.0]).collect(),
        scales: draw.log_normal("scales", 0.057, 0.32, 90),
        quaternions: draw.spread("quaternions", 0.5, 120),
        opacities: draw.shuffled("opacities", &opacities),
        colors: draw.between("colors", -0.5, 3.0, 90),
        degree: 0,
        harmonics: 0.0,
        background: [0.0; 3],
    };
    parts.case(draw, &view)
}

/// Two alphas at their cap, one behind the other: a pixel stops by less than 2e-6 of its transmittance, or by far.
fn capped(draw: &Draw) -> Case {
    let view = View::centered([40, 40], 40.0, STRAIGHT);
    let positions = draw.between("places", -0.04, 0.04, 4);
    let sides = [[-0.25 + positions[0], positions[1]], [0.3 + positions[2], positions[3]]];
    let mut scales = draw.between("large", 1.3, 1.8, 12);
    scales.extend(draw.between("small", 0.18, 0.28, 12));
    let mut opacities = draw.shuffled("opacities", &[1.0, 1.0, 0.9999]);
    opacities.extend([0.7, 0.3, 1.0, 0.9998, 0.6]);
    let depths: [f64; 8] = [2.0, 2.2, 2.4, 2.6, 2.0, 2.1, 2.3, 2.5];
    let parts = Parts {
        means: depths.iter().enumerate().flat_map(|(i, z)| [sides[i / 4][0] * z, sides[i / 4][1] * z, *z]).collect(),
        scales,
        quaternions: draw.spread("quaternions", 0.5, 32),
        opacities,
        colors: draw.colors(24),
        degree: 0,
        harmonics: 0.0,
        background: [0.3, 0.1, 0.7],
    };
    parts.case(draw, &view)
}

/// Two depths for forty Gaussians: their order is that of their indices.
fn equal_depths(draw: &Draw) -> Case {
    let view = View::centered([48, 32], 44.0, STRAIGHT);
    let depths = draw.numbers("depths", 40).into_iter().map(|v| if v < 0.5 { 2.0 } else { 3.0 });
    let parts = Parts {
        means: draw.between("places", 0.05, 0.95, 80).chunks(2).zip(depths).flat_map(|(shares, z)| view.behind(shares, z)).collect(),
        scales: draw.log_normal("scales", 0.3, 0.44, 120),
        quaternions: draw.spread("quaternions", 0.5, 160),
        opacities: draw.between("opacities", 0.2, 0.9, 40),
        colors: draw.colors(120),
        degree: 1,
        harmonics: 0.25,
        background: [0.1, 0.2, 0.3],
    };
    parts.case(draw, &view)
}

/// All around the camera: behind it, at the near planes, huge on the screen.
fn inside(draw: &Draw) -> Case {
    let view = View::centered([64, 48], 50.0, draw.turned([0.08, 0.01, 0.03]));
    let across = draw.spread("across", 0.78, 600);
    let depths = apart(draw.spread("depths", 0.78, 300));
    let parts = Parts {
        means: across.chunks(2).zip(depths).flat_map(|(xy, z)| view.world([xy[0], xy[1], z])).collect(),
        scales: draw.log_normal("scales", 0.11, 0.48, 900),
        quaternions: draw.spread("quaternions", 1.5, 1200),
        opacities: draw.between("opacities", 0.1, 0.99, 300),
        colors: draw.colors(900),
        degree: 3,
        harmonics: 0.25,
        background: [0.8, 0.1, 0.7],
    };
    parts.case(draw, &view)
}

/// A ratio of scales of 1e4, under the blur of 3D Gaussian splatting and under the one that plans choose.
fn needles(draw: &Draw) -> Case {
    let kinds = draw.numbers("kinds", 2 * NEEDLES);
    let scales = (0..NEEDLES).flat_map(|i| {
        let (long, disc) = (0.3 + 1.2 * kinds[2 * i], i % 2 == 0);
        (0..3).map(move |axis| if (axis == i / 2 % 3) == disc { 1e-4 * long } else { long })
    });
    let turn = draw.normal("camera", 4);
    let norm = turn.iter().map(|v| v * v).sum::<f64>().sqrt();
    let tilt = from_fn(|k| (if k == 0 { 4.0 } else { 0.5 } * turn[k].abs().max(0.2)) / norm.max(1.0));
    let view = View::centered([64, 48], 60.0, rigid(tilt, [0.0, 0.0, 4.0]));
    let parts = Parts {
        means: draw.between("means", -1.0, 1.0, 3 * NEEDLES),
        scales: scales.collect(),
        quaternions: draw.between("quaternions", -1.0, 1.0, 4 * NEEDLES),
        opacities: draw.numbers("opacities", NEEDLES).into_iter().map(|v| 0.3 + 0.68 * v).collect(),
        colors: draw.normal("colors", 3 * NEEDLES),
        degree: 1,
        harmonics: 0.4,
        background: [0.0; 3],
    };
    let mut case = parts.case(draw, &view);
    case.settings.blur = if draw.seed.is_multiple_of(2) { BLUR } else { 0.1 };
    case
}

/// Three stacks of eight Gaussians that hide all behind them.
fn opaque(draw: &Draw) -> Case {
    let view = View::centered([48, 32], 40.0, STRAIGHT);
    let opacities = ["left", "middle", "right"].map(|name| draw.shuffled(name, &[0.9, 0.985, 0.9899, 0.9901, 0.995, 0.999, 0.9999, 1.0]));
    let jitter = draw.spread("places", 0.02, 48);
    let mean = |i: usize| {
        let side = (i % 3) as f64;
        let z = 2.0 + 0.25 * (i / 3) as f64 + 0.01 * side;
        [0.55 * (side - 1.0) * z + jitter[2 * i], jitter[2 * i + 1], z]
    };
    let parts = Parts {
        means: (0..24).flat_map(mean).collect(),
        scales: draw.log_normal("scales", 1.95, 0.61, 72),
        quaternions: draw.spread("quaternions", 0.5, 96),
        opacities: (0..24).map(|i| opacities[i % 3][i / 3]).collect(),
        colors: draw.colors(72),
        degree: 0,
        harmonics: 0.0,
        background: [0.3, 0.1, 0.7],
    };
    parts.case(draw, &view)
}
