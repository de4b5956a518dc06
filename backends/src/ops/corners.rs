//! The grid vertices around points, found once per step and level.
//!
//! The number of distinct vertices is known to the device alone, but buffers need a size. So the search has two halves. Between them, one read-back gets the
//! numbers of all levels; or the worst case is allocated, and nothing is read back.

use super::limits::{check_binding, check_sorted, unread};
use crate::cpu::tensor::CpuBackend;
use crate::cpu::vertex::index::{self, MAX_RESOLUTION};
use burn::backend::tensor::{FloatTensor, IntTensor};
use burn::backend::{Backend, Dispatch, ExtensionType, backend_extension};
use burn::tensor::{Int, Tensor};
use cc4dgs_core::{Error, Result};
use rayon::prelude::*;

/// The box and resolution of a level's grid.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GridBox {
    /// Lower corner, world units.
    pub min: [f32; 3],
    /// Upper corner, world units.
    pub max: [f32; 3],
    /// Cells per axis.
    pub resolution: u32,
}

/// The result of the first half, for the second.
#[derive(Clone, Debug, ExtensionType)]
pub struct CornersBegun<B: Backend> {
    /// Trilinear weights `[8M]`.
    pub weights: FloatTensor<B>,
    /// The (point, corner) slots grouped by vertex `[8M]`.
    pub slots: IntTensor<B>,
    /// Vertices `[U,3]` where they are listed already; keys of the slots' vertices in order `[8M]` elsewhere.
    pub vertices: IntTensor<B>,
    /// Where each vertex's slots start `[U+1]`; elsewhere how many vertices come before each slot `[8M]`.
    pub starts: IntTensor<B>,
    /// The vertex of each corner `[8M]`; elsewhere nothing of use.
    pub corners: IntTensor<B>,
    /// The number of vertices U `[1]`.
    pub count: IntTensor<B>,
}

/// Finding corners has no gradient: the field of CC-4DGS is not differentiated with respect to the canonical centres.
#[backend_extension(Flex, NdArray: cfg(feature = "ndarray"), Cube: cfg(feature = "cube"))]
pub trait CornerOps: Backend {
    /// Finds and groups the corners of points `[M,3]`.
    fn begin_corners(points: FloatTensor<Self>, grid: GridBox, reuse: bool) -> CornersBegun<Self>;
    /// `(vertices [U,3], starts [U+1], corners [8M])`, see [`VoxelCorners`], with a capacity of `capacity` vertices where their number is not known.
    fn list_corners(
        slots: IntTensor<Self>,
        vertices: IntTensor<Self>,
        starts: IntTensor<Self>,
        corners: IntTensor<Self>,
        grid: GridBox,
        reuse: bool,
        capacity: usize,
    ) -> (IntTensor<Self>, IntTensor<Self>, IntTensor<Self>);
}

fn signed(values: &[u32]) -> Vec<i64> {
    values.par_iter().map(|&v| i64::from(v)).collect()
}

/// A CPU needs no second half: the first does everything.
impl<B: CpuBackend> CornerOps for B {
    fn begin_corners(points: FloatTensor<Self>, grid: GridBox, reuse: bool) -> CornersBegun<Self> {
        let found = index::corners(&Self::floats(&points), grid.min, grid.max, grid.resolution, reuse);
        let (count, slots) = (found.vertices.len(), found.corners.len());
        CornersBegun {
            weights: Self::from_floats(found.weights, [slots]),
            slots: Self::from_ints(signed(&found.slots), [slots]),
            vertices: Self::from_ints(signed(found.vertices.as_flattened()), [count, 3]),
            starts: Self::from_ints(signed(&found.starts), [count + 1]),
            corners: Self::from_ints(signed(&found.corners), [slots]),
            count: Self::from_ints(vec![count as i64], [1]),
        }
    }
    fn list_corners(
        _slots: IntTensor<Self>,
        vertices: IntTensor<Self>,
        starts: IntTensor<Self>,
        corners: IntTensor<Self>,
        _grid: GridBox,
        _reuse: bool,
        _capacity: usize,
    ) -> (IntTensor<Self>, IntTensor<Self>, IntTensor<Self>) {
        (vertices, starts, corners)
    }
}

/// Upper bound on the vertices of a level that are allocated without counting them: with 32 features each, they fit the bindings of every adapter. For more
/// vertices, the time of reading the count back is small beside that of decoding.
const MOST_UNCOUNTED: usize = 1 << 20;

/// The grid corners of M points on one level.
#[derive(Clone, Debug)]
pub struct VoxelCorners {
    /// Vertices to decode `[U,3]`, integer coordinates in 0..=resolution; -1 in rows past the last vertex, where they were not counted.
    pub vertices: Tensor<2, Int>,
    /// Per point and corner, the row of its vertex `[8M]`.
    pub corners: Tensor<1, Int>,
    /// Per point and corner, its trilinear weight `[8M]`.
    pub weights: Tensor<1>,
    /// The (point, corner) slots grouped by vertex `[8M]`.
    pub slots: Tensor<1, Int>,
    /// Where each vertex's slots start `[U+1]`.
    pub starts: Tensor<1, Int>,
}

impl VoxelCorners {
    /// Finds the corners of `points` `[M,3]`, world units, on every one of `grids`. Points outside a box are moved to its nearest face. With `reuse`, corners
    /// at the same position share a vertex (CC-4DGS, Section IV-C); without, every corner has its own. No gradient flows to the points. With `counted`, the
    /// counts are read back once and U is the number of vertices; without, U may be larger on devices with memory of their own, up to a million.
    pub fn find(points: Tensor<2>, grids: &[GridBox], reuse: bool, counted: bool) -> Result<Vec<Self>> {
        let [m, width] = points.dims();
        if width != 3 || m == 0 {
            return Err(Error::parameter("voxel corners", format!("points have shape [{m},{width}]"), "Give at least one point with three coordinates"));
        }
        if let Some(grid) = grids.iter().find(|g| !(1..=MAX_RESOLUTION).contains(&g.resolution)) {
            return Err(Error::parameter("grid resolution", format!("{} cells per axis", grid.resolution), format!("Choose 1 to {MAX_RESOLUTION}")));
        }
        if grids.is_empty() {
            return Ok(Vec::new());
        }
        let points = points.inner();
        check_binding(&points.device(), "voxel corners", "points", m, size_of::<[u32; 8]>())?;
        check_sorted(&points.device(), "voxel corners", "points", m, 8)?;
        let begun: Vec<CornersBegun<Dispatch>> =
            grids.iter().map(|&grid| <Dispatch as CornerOps>::begin_corners(points.clone().into_dispatch(), grid, reuse)).collect();
        let vertices = |grid: &GridBox| if reuse { (grid.resolution as usize + 1).saturating_pow(3).min(8 * m) } else { 8 * m };
        let capacity: Vec<usize> = grids.iter().map(vertices).collect();
        let capacity = if counted || capacity.iter().any(|&vertices| vertices > MOST_UNCOUNTED) {
            let counts = Tensor::cat(begun.iter().map(|b| Tensor::<1, Int>::from_dispatch(b.count.clone())).collect(), 0);
            let counts = counts.try_into_data().map_err(|error| unread("voxel corners, numbers of vertices", error))?;
            counts.iter::<i64>().map(|count| count.max(0) as usize).collect()
        } else {
            capacity
        };
        for &vertices in &capacity {
            check_binding(&points.device(), "voxel corners", "vertices", vertices, 3 * size_of::<u32>())?;
        }
        let listed = begun.into_iter().zip(grids).zip(capacity).map(|((b, &grid), capacity)| {
            let (vertices, starts, corners) = <Dispatch as CornerOps>::list_corners(b.slots.clone(), b.vertices, b.starts, b.corners, grid, reuse, capacity);
            Self {
                vertices: Tensor::from_dispatch(vertices),
                corners: Tensor::from_dispatch(corners),
                weights: Tensor::from_dispatch(b.weights),
                slots: Tensor::from_dispatch(b.slots),
                starts: Tensor::from_dispatch(starts),
            }
        });
        Ok(listed.collect())
    }
}
