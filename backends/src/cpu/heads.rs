//! Several outputs in one flat array: head after head, each `[rows, width]`.

use crate::ops::split::PieceLayout;
use rayon::prelude::*;

/// Rows per task.
const ROWS: usize = 4096;

/// Splits `flat` into blocks of `block` rows: per block, its part of every head.
pub fn row_blocks<'a>(flat: &'a mut [f32], widths: &[usize], rows: usize, block: usize) -> Vec<Vec<&'a mut [f32]>> {
    let mut parts: Vec<Vec<&mut [f32]>> = (0..rows.div_ceil(block)).map(|_| Vec::with_capacity(widths.len())).collect();
    let mut rest = flat;
    for &width in widths {
        let (head, tail) = rest.split_at_mut(rows * width);
        rest = tail;
        for (part, rows) in parts.iter_mut().zip(head.chunks_mut(block * width)) {
            part.push(rows);
        }
    }
    parts
}

/// The outputs `[rows, width]` at `time` of a `head` `[rows, times x width]`.
pub fn piece(head: &[f32], width: usize, times: usize, time: usize) -> Vec<f32> {
    let mut out = vec![0.0f32; head.len() / times];
    out.par_chunks_mut(ROWS * width).zip(head.par_chunks(ROWS * times * width)).for_each(|(out, head)| {
        for (out, row) in out.chunks_exact_mut(width).zip(head.chunks_exact(times * width)) {
            out.copy_from_slice(&row[time * width..][..width]);
        }
    });
    out
}

/// The array of which these are the pieces, time after time and head after head; zeros for pieces that are `None`.
pub fn join(pieces: &[Option<&[f32]>], layout: &PieceLayout) -> Vec<f32> {
    let mut out = vec![0.0f32; layout.len()];
    let whole: Vec<usize> = layout.widths.iter().map(|width| layout.times * width).collect();
    row_blocks(&mut out, &whole, layout.rows, ROWS).into_par_iter().enumerate().for_each(|(block, mut heads)| {
        for (index, piece) in pieces.iter().enumerate() {
            let (head, time) = layout.head_and_time(index);
            let (Some(piece), width) = (piece, layout.widths[head]) else { continue };
            if width == 0 {
                continue;
            }
            let own = piece.chunks_exact(width).skip(block * ROWS);
            for (out, row) in heads[head].chunks_exact_mut(layout.times * width).zip(own) {
                out[time * width..][..width].copy_from_slice(row);
            }
        }
    });
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pieces_make_up_the_whole() {
        let layout = PieceLayout { rows: 2 * ROWS + 3, widths: vec![3, 1, 4], times: 2 };
        let whole: Vec<f32> = (0..layout.len()).map(|k| k as f32).collect();
        let pieces: Vec<Vec<f32>> = (0..layout.pieces())
            .map(|index| {
                let (head, time) = layout.head_and_time(index);
                let of_head = layout.rows * layout.times * layout.widths[head];
                piece(&whole[layout.start(head)..][..of_head], layout.widths[head], layout.times, time)
            })
            .collect();
        assert_eq!(pieces[4][..2], [(layout.start(1) + 1) as f32, (layout.start(1) + 3) as f32], "the second head at the second time");
        let mut slices: Vec<Option<&[f32]>> = pieces.iter().map(|piece| Some(piece.as_slice())).collect();
        assert_eq!(join(&slices, &layout), whole);
        slices[4] = None;
        let without = join(&slices, &layout);
        let of_head = &without[layout.start(1)..layout.start(2)];
        assert!(of_head.iter().skip(1).step_by(2).all(|v| *v == 0.0) && of_head[2] == whole[layout.start(1) + 2]);
    }
}
