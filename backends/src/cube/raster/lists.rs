//! Tile lists: which Gaussians meet a tile, in depth order.

use super::cells::cells_of;
use super::project::{KEY_CELLS, KEY_COLUMNS, KEY_DEPTH, KEY_ROWS, KEY_TILES, KEYS};
use cubecl::prelude::*;

/// Words behind the starts of the tiles: the bits of the background's colour, so that blending needs no array of its own for it.
pub const BACKGROUND: usize = 3;

/// Depth keys and indices of all Gaussians, to be sorted.
#[cube(launch)]
pub fn depth_keys(keys: &[u32], depth: &mut [u32], index: &mut [u32]) {
    if ABSOLUTE_POS < depth.len() {
        depth[ABSOLUTE_POS] = keys[KEYS * ABSOLUTE_POS + KEY_DEPTH];
        index[ABSOLUTE_POS] = ABSOLUTE_POS as u32;
    }
}

/// Tiles met by the Gaussian of every depth rank.
#[cube(launch)]
pub fn counts_by_rank(keys: &[u32], order: &[u32], counts: &mut [u32]) {
    if ABSOLUTE_POS < order.len() {
        counts[ABSOLUTE_POS] = keys[KEYS * order[ABSOLUTE_POS] as usize + KEY_TILES];
    }
}

/// (Gaussian, tile) pairs in depth order: tile and Gaussian of each pair, its index (which sorting carries along), and where the pairs of each Gaussian
/// start.
#[cube(launch)]
pub fn emit_pairs(
    keys: &[u32],
    order: &[u32],
    starts: &[u32],
    tile_of_pair: &mut [u32],
    pair: &mut [u32],
    gaussian_of_pair: &mut [u32],
    start_of_gaussian: &mut [u32],
    tiles_x: u32,
) {
    if ABSOLUTE_POS < order.len() {
        let gaussian = order[ABSOLUTE_POS];
        let at = KEYS * gaussian as usize;
        let mut index = starts[ABSOLUTE_POS];
        start_of_gaussian[gaussian as usize] = index;
        if keys[at + KEY_TILES] > 0 {
            let (columns, rows, met) = (keys[at + KEY_COLUMNS], keys[at + KEY_ROWS], keys[at + KEY_CELLS]);
            let cells = cells_of(columns, rows);
            let (first_row, first_column, high, wide, across) = (cells.row, cells.column, cells.high, cells.wide, cells.across);
            for row in (rows & 0xffffu32)..(rows >> 16) {
                for column in (columns & 0xffffu32)..(columns >> 16) {
                    let cell = (row - first_row) / high * across + (column - first_column) / wide;
                    if (met >> cell) & 1u32 == 1u32 {
                        if (index as usize) < tile_of_pair.len() {
                            tile_of_pair[index as usize] = row * tiles_x + column;
                            pair[index as usize] = index;
                            gaussian_of_pair[index as usize] = gaussian;
                        }
                        index += 1;
                    }
                }
            }
        }
    }
}

/// Pairs behind the last one belong to no tile.
#[cube(launch)]
pub fn fill_unused(tile_of_pair: &mut [u32], pair: &mut [u32], total: &[u32], tiles: u32) {
    if ABSOLUTE_POS < tile_of_pair.len() && ABSOLUTE_POS >= total[0] as usize {
        tile_of_pair[ABSOLUTE_POS] = tiles;
        pair[ABSOLUTE_POS] = ABSOLUTE_POS as u32;
    }
}

/// A channel of the background's colour, from behind the starts of the tiles.
#[cube]
pub fn background_of(starts: &[u32], channel: usize) -> f32 {
    f32::reinterpret(starts[starts.len() - BACKGROUND + channel])
}

/// starts`[tile]` is the first of the sorted pairs of a tile; starts`[tiles]` their number. The background's colour is behind them ([`background_of`]).
#[cube(launch)]
pub fn tile_starts(tile_of_pair: &[u32], background: &[f32], starts: &mut [u32], pairs: u32) {
    let tiles = (starts.len() - 1 - BACKGROUND) as u32;
    let at = ABSOLUTE_POS as u32;
    if at == 0 {
        for channel in 0..BACKGROUND {
            starts[tiles as usize + 1 + channel] = u32::reinterpret(background[channel]);
        }
    }
    if at <= pairs {
        // Pair `at` starts its own tile and all empty ones since the pair before it.
        let mut from = 0u32;
        if at > 0 {
            from = tile_of_pair[at as usize - 1] + 1;
        }
        let mut to = tiles;
        if at < pairs {
            to = tile_of_pair[at as usize];
        }
        let mut tile = from;
        while tile <= to {
            starts[tile as usize] = at;
            tile += 1;
        }
    }
}
