//! Which tiles of a footprint's box its ellipse meets: pairs with the others would draw nothing.
//!
//! The box is divided into up to 32 cells, eight along its longer side and four along the other, of whole tiles; a bit says whether the ellipse meets a cell.
//! Up to eight by four tiles, each is a cell of its own. The bits are stored, so that the kernels that count and that list pairs agree, however compilers
//! round.

use super::geometry::Projected;
use crate::ops::rasterize::TILE;
use cubecl::prelude::*;
use std::f32::consts::FRAC_1_SQRT_2;

/// Cells along the longer side, and along the other.
const LONG: u32 = 8;
const SHORT: u32 = 4;
/// What rounding may add to the distance of two points, as a share of their coordinates.
const ROUNDING: f32 = 4e-6;
const TILE_LENGTH: f32 = TILE as f32;

/// How the box of a footprint is divided.
#[derive(CubeType, Clone, Copy)]
pub struct Cells {
    /// First tile and number of tiles along x and y.
    pub column: u32,
    pub row: u32,
    pub columns: u32,
    pub rows: u32,
    /// Cells along x and y.
    pub across: u32,
    pub down: u32,
    /// Tiles per cell along x and y.
    pub wide: u32,
    pub high: u32,
}

/// The division of a box, packed as first and end tile in halves.
#[cube]
pub fn cells_of(columns: u32, rows: u32) -> Cells {
    let (column, row) = (columns & 0xffffu32, rows & 0xffffu32);
    let (width, height) = ((columns >> 16) - column, (rows >> 16) - row);
    let across = select(width >= height, LONG, SHORT);
    let down = LONG * SHORT / across;
    Cells { column, row, columns: width, rows: height, across, down, wide: width.div_ceil(across), high: height.div_ceil(down) }
}

/// The least of sigma = (own x)^2 + (other (y - slope x))^2 on the side x of a rectangle from y0 to y1, less what rounding may add; coordinates are from the
/// ellipse's centre.
#[cube]
fn least_on_side(own: f32, slope: f32, other: f32, x: f32, y0: f32, y1: f32) -> f32 {
    let best = slope * x;
    let above = select(best > y0, best, y0);
    let y = select(above < y1, above, y1);
    let distance = (y - best).abs() - ROUNDING * (y.abs() + best.abs());
    let (first, second) = (own * x, other * select(distance > 0.0, distance, 0.0f32));
    first * first + second * second
}

/// What an ellipse meets.
#[derive(CubeType, Clone, Copy)]
pub struct Met {
    /// A bit per cell.
    pub cells: u32,
    /// Tiles in those cells.
    pub tiles: u32,
}

/// The cells in which sigma is at most `cutoff` somewhere between their outermost pixel centres, and a few more where it is slightly larger.
#[cube]
pub fn cells_met(cells: Cells, p: Projected, cutoff: f32) -> Met {
    let (root_x, root_y, root) = (p.xx.sqrt(), p.yy.sqrt(), p.determinant.sqrt());
    let (own_x, slope_x, other_x) = (FRAC_1_SQRT_2 / root_x, p.xy / p.xx, FRAC_1_SQRT_2 * root_x / root);
    let (own_y, slope_y, other_y) = (FRAC_1_SQRT_2 / root_y, p.xy / p.yy, FRAC_1_SQRT_2 * root_y / root);
    let mut met = 0u32;
    let mut tiles = 0u32;
    for down in 0..cells.down {
        for across in 0..cells.across {
            let (left, top) = (across * cells.wide, down * cells.high);
            if left < cells.columns && top < cells.rows {
                let wide = select(left + cells.wide < cells.columns, cells.wide, cells.columns - left);
                let high = select(top + cells.high < cells.rows, cells.high, cells.rows - top);
                let x0 = (cells.column + left) as f32 * TILE_LENGTH + 0.5 - p.center_x;
                let y0 = (cells.row + top) as f32 * TILE_LENGTH + 0.5 - p.center_y;
                let (x1, y1) = (x0 + wide as f32 * TILE_LENGTH - 1.0, y0 + high as f32 * TILE_LENGTH - 1.0);
                let inside = x0 <= 0.0 && x1 >= 0.0 && y0 <= 0.0 && y1 >= 0.0;
                let left_side = least_on_side(own_x, slope_x, other_x, x0, y0, y1);
                let right_side = least_on_side(own_x, slope_x, other_x, x1, y0, y1);
                let top_side = least_on_side(own_y, slope_y, other_y, y0, x0, x1);
                let bottom_side = least_on_side(own_y, slope_y, other_y, y1, x0, x1);
                if inside || left_side <= cutoff || right_side <= cutoff || top_side <= cutoff || bottom_side <= cutoff {
                    met |= 1u32 << (down * cells.across + across);
                    tiles += wide * high;
                }
            }
        }
    }
    Met { cells: met, tiles }
}
