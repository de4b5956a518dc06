//! Which grid vertices surround each point, and which of them are the same (CC-4DGS, Sections IV-B and IV-C).

use crate::cpu::raster::parallel::SharedMut;
use crate::cpu::sort::stable_order;
use rayon::prelude::*;

pub use cc4dgs_fields::voxels::MAX_RESOLUTION;

/// The corners of all points on one level.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Corners {
    /// The vertices to decode `[U]`, each (x, y, z) in 0..=resolution; sorted and distinct with reuse, one per corner without.
    pub vertices: Vec<[u32; 3]>,
    /// Per point and corner, the index of its vertex `[8 M]`.
    pub corners: Vec<u32>,
    /// Per point and corner, its trilinear weight `[8 M]`.
    pub weights: Vec<f32>,
    /// All (point, corner) slots grouped by vertex, ascending within each `[8 M]`.
    pub slots: Vec<u32>,
    /// Where the slots of each vertex start `[U + 1]`.
    pub starts: Vec<u32>,
}

/// Locates `points` `[M, 3]` on a grid of `resolution` cells per axis over the box. Points outside are moved to its nearest face, NaN to its
/// lower face. Corner c of a cell has offsets (c & 1, c >> 1 & 1, c >> 2).
pub fn corners(points: &[f32], box_min: [f32; 3], box_max: [f32; 3], resolution: u32, reuse: bool) -> Corners {
    let resolution = resolution.clamp(1, MAX_RESOLUTION);
    let m = points.len() / 3;
    let side = u64::from(resolution) + 1;
    let mut keys = vec![0u32; 8 * m];
    let mut weights = vec![0.0f32; 8 * m];
    let scale: [f32; 3] = std::array::from_fn(|d| if box_max[d] > box_min[d] { resolution as f32 / (box_max[d] - box_min[d]) } else { 0.0 });
    keys.par_chunks_mut(8 << 10).zip(weights.par_chunks_mut(8 << 10)).zip(points.par_chunks(3 << 10)).for_each(|((keys, weights), points)| {
        for ((keys, weights), point) in keys.chunks_exact_mut(8).zip(weights.chunks_exact_mut(8)).zip(points.chunks_exact(3)) {
            let mut cell = [0u32; 3];
            let mut part = [0.0f32; 3];
            for d in 0..3 {
                // `max` turns NaN into 0.
                let at = ((point[d] - box_min[d]) * scale[d]).max(0.0).min(resolution as f32);
                cell[d] = (at as u32).min(resolution - 1);
                part[d] = at - cell[d] as f32;
            }
            for c in 0..8usize {
                let offset = [c & 1, c >> 1 & 1, c >> 2];
                let vertex: [u64; 3] = std::array::from_fn(|d| u64::from(cell[d]) + offset[d] as u64);
                keys[c] = ((vertex[2] * side + vertex[1]) * side + vertex[0]) as u32;
                weights[c] = (0..3).map(|d| if offset[d] == 1 { part[d] } else { 1.0 - part[d] }).product();
            }
        }
    });
    let vertex = |key: u32| {
        let (key, side) = (u64::from(key), side);
        [(key % side) as u32, (key / side % side) as u32, (key / (side * side)) as u32]
    };
    if !reuse {
        let identity: Vec<u32> = (0..8 * m as u32).collect();
        let starts = (0..=8 * m as u32).collect();
        return Corners { vertices: keys.into_par_iter().map(vertex).collect(), corners: identity.clone(), weights, slots: identity, starts };
    }
    let slots = stable_order(&keys, side * side * side);
    let key = |i: usize| keys[slots[i] as usize];
    let mut starts: Vec<u32> = (0..slots.len()).into_par_iter().filter(|&i| i == 0 || key(i) != key(i - 1)).map(|i| i as u32).collect();
    let vertices = starts.par_iter().map(|&start| vertex(key(start as usize))).collect();
    starts.push(slots.len() as u32);
    let mut corners = vec![0u32; 8 * m];
    let of_slots = SharedMut::new(&mut corners);
    starts.par_windows(2).enumerate().for_each(|(index, ends)| {
        for &slot in &slots[ends[0] as usize..ends[1] as usize] {
            // SAFETY: a slot occurs once in the order.
            unsafe { of_slots.slice(slot as usize, 1)[0] = index as u32 };
        }
    });
    Corners { vertices, corners, weights, slots, starts }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn points(n: usize) -> Vec<f32> {
        (0..3 * n).map(|i| ((i * 7919 % 1009) as f32 / 1009.0 - 0.1) * 1.3).collect()
    }

    #[test]
    fn corners_surround_the_point_and_weights_reproduce_it() {
        for (resolution, reuse) in [(1, true), (16, true), (256, true), (1600, true), (16, false)] {
            let p = points(300);
            let c = corners(&p, [0.0; 3], [1.0; 3], resolution, reuse);
            for i in 0..300 {
                for d in 0..3 {
                    let sum: f32 = (0..8).map(|k| c.weights[8 * i + k] * c.vertices[c.corners[8 * i + k] as usize][d] as f32).sum();
                    let want = p[3 * i + d].clamp(0.0, 1.0) * resolution as f32;
                    assert!((sum - want).abs() <= 1e-5 * resolution as f32, "point {i} axis {d}: {sum} instead of {want}");
                }
            }
        }
    }

    #[test]
    fn reuse_keeps_each_vertex_once_and_lists_its_slots() {
        // In one part, and in several.
        for (count, resolution) in [(500, 16), (9_000, 200)] {
            let found = |threads: usize| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                pool.install(|| corners(&points(count), [0.0; 3], [1.0; 3], resolution, true))
            };
            let c = found(3);
            assert!(c == found(1), "threads change the corners");
            let mut seen = c.vertices.clone();
            seen.sort_unstable_by_key(|v| (v[2], v[1], v[0]));
            seen.dedup();
            assert_eq!(seen, c.vertices);
            assert_eq!((c.starts[0], c.starts[c.vertices.len()] as usize), (0, 8 * count));
            for u in 0..c.vertices.len() {
                let slots = &c.slots[c.starts[u] as usize..c.starts[u + 1] as usize];
                assert!(!slots.is_empty() && slots.is_sorted() && slots.iter().all(|&s| c.corners[s as usize] == u as u32));
            }
        }
    }

    #[test]
    fn degenerate_input_is_defined() {
        let c = corners(&[f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 0.5, 2.0, -3.0], [0.0; 3], [1.0, 1.0, 0.0], 8, true);
        assert!(c.weights.iter().all(|w| (0.0..=1.0).contains(w)));
        assert!(c.vertices.iter().flatten().all(|&v| v <= 8));
        assert_eq!(corners(&[], [0.0; 3], [1.0; 3], 8, true).vertices.len(), 0);
    }
}
