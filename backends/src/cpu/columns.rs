//! Matrices side by side on the CPU: one pass over the rows.

use crate::ops::columns::PARTS;
use rayon::prelude::*;

/// Rows per task.
const ROWS: usize = 4096;

/// The matrices `parts` `[rows,width]` side by side, row-major.
pub fn beside(parts: [&[f32]; PARTS], widths: [usize; PARTS], rows: usize) -> Vec<f32> {
    let total: usize = widths.iter().sum();
    let mut out = vec![0.0f32; rows * total];
    if total == 0 {
        return out;
    }
    out.par_chunks_mut(ROWS * total).enumerate().for_each(|(block, out)| {
        let mut start = 0;
        for (part, width) in parts.into_iter().zip(widths).filter(|(_, width)| *width > 0) {
            let own = part.chunks_exact(width).skip(block * ROWS);
            for (out, own) in out.chunks_exact_mut(total).zip(own) {
                out[start..start + width].copy_from_slice(own);
            }
            start += width;
        }
    });
    out
}

/// The matrices `[rows,width]` of which `joined` consists.
pub fn apart(joined: &[f32], widths: [usize; PARTS], rows: usize) -> [Vec<f32>; PARTS] {
    let total: usize = widths.iter().sum();
    let mut start = 0;
    widths.map(|width| {
        let from = start;
        start += width;
        let mut out = vec![0.0f32; rows * width];
        if width > 0 {
            for (out, row) in out.chunks_exact_mut(width).zip(joined.chunks_exact(total)) {
                out.copy_from_slice(&row[from..from + width]);
            }
        }
        out
    })
}
