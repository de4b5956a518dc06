//! Several outputs in one flat array: head after head, each `[rows, width]`.

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
