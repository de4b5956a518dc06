//! Compact regions of an image, such as a ball that a render does not show.

/// Fewest pixels of a region, and the largest share of the image.
const LEAST_AREA: usize = 12;
const LARGEST_SHARE: f64 = 0.04;
/// Area of a region over that of a disk as long as it: 1 for a disk, 0.5 for an ellipse of 2 to 1.
const LEAST_COMPACTNESS: f64 = 0.5;

/// A compact region.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Blob {
    /// Its centre in pixels; the centre of the first pixel is at 0.5.
    pub center_px: [f64; 2],
    /// The radius of a disk of its area, in pixels.
    pub radius_px: f64,
}

/// The compact regions of `mask` `[H,W]`: pixels that touch by a side, the largest regions first, at most `most`.
pub(super) fn blobs(mask: &[bool], width: usize, most: usize) -> Vec<Blob> {
    let mut seen = vec![false; mask.len()];
    let mut found = Vec::new();
    let mut stack = Vec::new();
    for start in 0..mask.len() {
        if !mask[start] || seen[start] {
            continue;
        }
        seen[start] = true;
        stack.push(start);
        // Count, sums of x and y, of x², y² and xy.
        let mut sums = [0.0f64; 6];
        while let Some(pixel) = stack.pop() {
            let (column, row) = (pixel % width, pixel / width);
            let (x, y) = (column as f64 + 0.5, row as f64 + 0.5);
            sums.iter_mut().zip([1.0, x, y, x * x, y * y, x * y]).for_each(|(sum, value)| *sum += value);
            let neighbours = [
                (column > 0).then(|| pixel - 1),
                (column + 1 < width).then_some(pixel + 1),
                (row > 0).then(|| pixel - width),
                (pixel + width < mask.len()).then_some(pixel + width),
            ];
            for next in neighbours.into_iter().flatten() {
                if mask[next] && !seen[next] {
                    seen[next] = true;
                    stack.push(next);
                }
            }
        }
        found.extend(compact(sums, mask.len()));
    }
    found.sort_by(|a, b| b.radius_px.total_cmp(&a.radius_px));
    found.truncate(most);
    found
}

/// The region with these sums, if it is compact and neither tiny nor large.
fn compact(sums: [f64; 6], pixels: usize) -> Option<Blob> {
    let [area, x, y, xx, yy, xy] = sums;
    if area < LEAST_AREA as f64 || area > LARGEST_SHARE * pixels as f64 {
        return None;
    }
    let (x, y) = (x / area, y / area);
    // A twelfth is the variance within a pixel.
    let (a, b, c) = (xx / area - x * x + 1.0 / 12.0, yy / area - y * y + 1.0 / 12.0, xy / area - x * y);
    let longest = 0.5 * (a + b) + (0.25 * (a - b).powi(2) + c * c).sqrt();
    // The variance along a diameter of a disk of radius r is r² / 4.
    let disk = std::f64::consts::PI * 4.0 * longest;
    (area >= LEAST_COMPACTNESS * disk).then(|| Blob { center_px: [x, y], radius_px: (area / std::f64::consts::PI).sqrt() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn disks_are_found_and_bars_and_specks_are_not() {
        let (w, h) = (80usize, 60usize);
        let mut mask = vec![false; w * h];
        for y in 0..h {
            for x in 0..w {
                let disk = (x as f64 + 0.5 - 20.0).powi(2) + (y as f64 + 0.5 - 30.0).powi(2) < 36.0;
                let bar = (50..54).contains(&x) && (10..50).contains(&y);
                let speck = x == 70 && y == 5;
                mask[y * w + x] = disk || bar || speck;
            }
        }
        let found = blobs(&mask, w, 8);
        assert_eq!(found.len(), 1, "{found:?}");
        let Blob { center_px: [x, y], radius_px } = found[0];
        assert!((x - 20.0).abs() < 0.1 && (y - 30.0).abs() < 0.1 && (radius_px - 6.0).abs() < 0.2, "{found:?}");
        assert!(blobs(&vec![true; w * h], w, 8).is_empty() && blobs(&[], 1, 8).is_empty());
    }
}
