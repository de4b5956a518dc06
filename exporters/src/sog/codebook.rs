//! 256 values that stand for many: k-means in one dimension, on sorted values.

/// Values of a codebook.
const SIZE: usize = 256;
/// Lloyd iterations; each costs a binary search per value of the codebook.
const ITERATIONS: usize = 40;

/// The values, ascending.
pub struct Codebook {
    values: Vec<f32>,
}

impl Codebook {
    /// The codebook of `values`, which must be finite. No values give zeros.
    pub fn of(values: &[f32]) -> Self {
        let mut sorted = values.to_vec();
        sorted.sort_unstable_by(f32::total_cmp);
        let (Some(&first), Some(&last)) = (sorted.first(), sorted.last()) else { return Self { values: vec![0.0; SIZE] } };
        // Half of the start follows the density of the values, half their range, so that outliers are near a value too.
        let by_rank = (0..SIZE / 2).map(|i| sorted[(2 * i + 1) * sorted.len() / SIZE]);
        let by_range = (0..SIZE / 2).map(|i| first + (last - first) * (i as f32 / (SIZE / 2 - 1) as f32));
        let mut centers: Vec<f32> = by_rank.chain(by_range).collect();
        let mut sums = vec![0.0f64; sorted.len() + 1];
        for (i, v) in sorted.iter().enumerate() {
            sums[i + 1] = sums[i] + f64::from(*v);
        }
        for _ in 0..ITERATIONS {
            centers.sort_unstable_by(f32::total_cmp);
            let mut bounds = vec![0; SIZE + 1];
            bounds[SIZE] = sorted.len();
            for k in 1..SIZE {
                let middle = middle(centers[k - 1], centers[k]);
                bounds[k] = sorted.partition_point(|v| *v < middle);
            }
            let moved: Vec<f32> = (0..SIZE)
                .map(|k| {
                    let (from, to) = (bounds[k], bounds[k + 1]);
                    if to > from { ((sums[to] - sums[from]) / (to - from) as f64) as f32 } else { centers[k] }
                })
                .collect();
            if moved == centers {
                break;
            }
            centers = moved;
        }
        centers.sort_unstable_by(f32::total_cmp);
        Self { values: centers }
    }
    /// The values, ascending.
    pub fn values(&self) -> &[f32] {
        &self.values
    }
    /// Index of the nearest value.
    pub fn index(&self, value: f32) -> u8 {
        let above = self.values.partition_point(|v| *v < value);
        let nearer_below = above > 0 && (above == SIZE || value < middle(self.values[above - 1], self.values[above]));
        (if nearer_below { above - 1 } else { above }) as u8
    }
}

/// Between two values, without overflow.
fn middle(a: f32, b: f32) -> f32 {
    0.5 * a + 0.5 * b
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn few_values_are_exact_and_many_are_near() {
        let few = [3.5f32, -1.0, 1e9, -1.0, 0.25];
        let book = Codebook::of(&few);
        assert!(few.iter().all(|v| book.values()[usize::from(book.index(*v))] == *v), "{:?}", book.values());
        // 5,000 values along a bell-shaped curve: the error is far below a uniform grid's of the same range, width / 256 / sqrt(12).
        let many: Vec<f32> = (0..5000).map(|i| (i as f32 * 0.7).sin() * (i as f32 * 0.31).sin() * (i as f32 * 0.011).sin()).collect();
        let book = Codebook::of(&many);
        assert!(book.values().is_sorted());
        let square: f32 = many.iter().map(|v| (book.values()[usize::from(book.index(*v))] - v).powi(2)).sum();
        let rms = (square / 5000.0).sqrt();
        assert!(rms < 0.9 * 2.0 / 256.0 / 12f32.sqrt(), "{rms}");
        assert_eq!(Codebook::of(&[]).index(4.0), 255);
    }
}
