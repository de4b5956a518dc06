//! How much of a column storage loses.

/// Root-mean-square error over the standard deviation of the values; 0 if they are equal, NaN if a value is not finite.
pub fn relative_rms(values: &[f32], decoded: &[f32]) -> f64 {
    if values.len() == decoded.len() { ratio(squares(values, decoded), values.len()) } else { f64::NAN }
}

/// [`relative_rms`] of values that are decoded part after part, for encoders that hold no decoded copy of them.
#[derive(Clone, Copy, Debug)]
pub struct PartialLoss {
    error: f64,
    deviation: f64,
    count: usize,
    added: usize,
}

impl PartialLoss {
    /// Of `values`, of which nothing is decoded yet.
    pub fn new(values: &[f32]) -> Self {
        let mean = values.iter().map(|&v| f64::from(v)).sum::<f64>() / values.len().max(1) as f64;
        let deviation = values.iter().map(|&v| (f64::from(v) - mean).powi(2)).sum::<f64>();
        Self { error: 0.0, deviation, count: values.len(), added: 0 }
    }
    /// Adds the `values` that follow those added before, and what they are decoded to.
    pub fn add(&mut self, values: &[f32], decoded: &[f32]) {
        // One sum over all parts, so that the result does not depend on where they end.
        self.error = values.iter().zip(decoded).fold(self.error, |sum, (a, b)| sum + (f64::from(*a) - f64::from(*b)).powi(2));
        self.added += values.len();
        if values.len() != decoded.len() {
            self.error = f64::NAN;
        }
    }
    /// The loss, once all values were added; NaN before, and where a part had another length than what it is decoded to.
    pub fn loss(&self) -> f64 {
        if self.added == self.count { ratio([self.error, self.deviation], self.count) } else { f64::NAN }
    }
}

/// [`relative_rms`] of the values between the 5th and the 95th percentile of each component of `rows` `[N,width]`, in deviations from the mean of that
/// component. Outliers, and components around different means, enlarge the standard deviation of a column and would hide the errors of the other values.
pub fn central_loss(rows: &[f32], decoded: &[f32], width: usize) -> f64 {
    CentralLoss::new(rows, width).of(rows, decoded)
}

/// What [`central_loss`] knows of a column before it is decoded: of each component the 5th and the 95th percentile, and the values between them.
#[derive(Clone, Debug)]
struct CentralLoss {
    width: usize,
    components: Vec<(f32, f32, PartialLoss)>,
}

impl CentralLoss {
    fn new(rows: &[f32], width: usize) -> Self {
        let component = |component: usize| {
            let values = || rows.iter().skip(component).step_by(width).copied();
            let mut ordered: Vec<f32> = values().collect();
            let (last, cut) = (ordered.len().checked_sub(1)?, ordered.len() / 20);
            let low = *ordered.select_nth_unstable_by(cut, f32::total_cmp).1;
            let high = *ordered.select_nth_unstable_by(last - cut, f32::total_cmp).1;
            let inner: Vec<f32> = values().filter(|v| (low..=high).contains(v)).collect();
            Some((low, high, PartialLoss::new(&inner)))
        };
        Self { width, components: (0..width).filter_map(component).collect() }
    }
    fn of(&self, rows: &[f32], decoded: &[f32]) -> f64 {
        if rows.len() != decoded.len() {
            return f64::NAN;
        }
        let (mut sums, mut count) = ([0.0f64; 2], 0usize);
        for (component, (low, high, inner)) in self.components.iter().enumerate() {
            let pairs = rows.iter().zip(decoded).skip(component).step_by(self.width).filter(|(v, _)| (low..=high).contains(v));
            sums[0] += pairs.fold(0.0, |sum, (a, b)| sum + (f64::from(*a) - f64::from(*b)).powi(2));
            sums[1] += inner.deviation;
            count += inner.count;
        }
        ratio(sums, count)
    }
}

/// What the column `name` of Gaussians lost: [`relative_rms`], and for centres [`central_loss`] where it is larger. A few Gaussians far away must not hide the
/// errors of all others.
pub fn column_loss(name: &str, rows: &[f32], decoded: &[f32], width: usize) -> f64 {
    ColumnLoss::new(name, rows, width).of(rows, decoded)
}

/// [`column_loss`] of a column that is decoded again and again: what its values alone decide is computed once.
#[derive(Clone, Debug)]
pub struct ColumnLoss {
    whole: PartialLoss,
    central: Option<CentralLoss>,
}

impl ColumnLoss {
    /// Of the column `name` of Gaussians, with the values `rows` `[N,width]`.
    pub fn new(name: &str, rows: &[f32], width: usize) -> Self {
        Self { whole: PartialLoss::new(rows), central: (name == "means").then(|| CentralLoss::new(rows, width)) }
    }
    /// What the same `rows` lose where they become `decoded`.
    pub fn of(&self, rows: &[f32], decoded: &[f32]) -> f64 {
        let (mut whole, central) = (self.whole, self.central.as_ref().map_or(0.0, |central| central.of(rows, decoded)));
        whole.add(rows, decoded);
        let whole = whole.loss();
        // NaN stays.
        if central > whole { central } else { whole }
    }
}

/// The sums of squared errors and of squared deviations from the mean.
fn squares(values: &[f32], decoded: &[f32]) -> [f64; 2] {
    let mut sums = PartialLoss::new(values);
    sums.add(values, decoded);
    [sums.error, sums.deviation]
}

/// The root-mean-square error over the standard deviation, of the sums of `count` values.
fn ratio([error, deviation]: [f64; 2], count: usize) -> f64 {
    let n = count.max(1) as f64;
    if error == 0.0 { 0.0 } else { ((error / n) / (deviation / n)).sqrt() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_of_centres_do_not_hide_behind_a_few_far_away() {
        let near = |i: usize, k: usize| (i as f32 * 0.37 + k as f32).sin();
        let spoiled = |rows: &[f32]| rows.iter().map(|v| if v.abs() < 1e4 { v + 0.05 } else { *v }).collect::<Vec<f32>>();
        let mut rows: Vec<f32> = (0..1000).flat_map(|i| [near(i, 0), near(i, 1), near(i, 2)]).collect();
        let usual = column_loss("means", &rows, &spoiled(&rows), 3);
        assert!((0.05..0.1).contains(&usual), "{usual}");
        (0..10).for_each(|i| rows[3 * i] = if i % 2 == 0 { 1e5 } else { -1e5 });
        let decoded = spoiled(&rows);
        assert!(relative_rms(&rows, &decoded) < 1e-4 && column_loss("log_scales", &rows, &decoded, 3) < 1e-4);
        assert!(column_loss("means", &rows, &decoded, 3) > 0.05);
        // Nor far from the origin.
        let moved: Vec<f32> = (0..1000).flat_map(|i| [near(i, 0) + 1000.0, near(i, 1), near(i, 2)]).collect();
        assert!(relative_rms(&moved, &spoiled(&moved)) < 1e-3 && column_loss("means", &moved, &spoiled(&moved), 3) > 0.05);
        // What cannot be compared is within no bound.
        assert!(column_loss("means", &rows, &rows[3..], 3).is_nan() && column_loss("means", &[1.0; 3], &[f32::NAN; 3], 3).is_nan());
        assert_eq!(column_loss("means", &[], &[], 3), 0.0);
    }

    #[test]
    fn parts_lose_what_the_whole_loses() {
        let values: Vec<f32> = (0..999).map(|i| (i as f32 * 0.37).sin()).collect();
        let decoded: Vec<f32> = values.iter().map(|v| (v * 7.0).round() / 7.0).collect();
        let whole = relative_rms(&values, &decoded);
        for part in [1, 10, 333, 2000] {
            let mut sums = PartialLoss::new(&values);
            values.chunks(part).zip(decoded.chunks(part)).for_each(|(values, decoded)| sums.add(values, decoded));
            assert!(whole > 0.05 && sums.loss().to_bits() == whole.to_bits(), "parts of {part}: {} and {whole}", sums.loss());
        }
        assert_eq!(PartialLoss::new(&[]).loss(), 0.0);
        // What was not compared is within no bound.
        let mut sums = PartialLoss::new(&values);
        sums.add(&values[..10], &decoded[..10]);
        assert!(sums.loss().is_nan());
        sums.add(&values[10..], &decoded[11..]);
        assert!(sums.loss().is_nan());
    }
}
