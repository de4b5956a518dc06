//! A few of many, evenly spread.

/// At most `most` of `items`, from the middles of equal parts.
pub(crate) fn spread<T: Copy>(items: &[T], most: usize) -> Vec<T> {
    let n = items.len();
    if n <= most { items.to_vec() } else { (0..most).map(|i| items[(2 * i + 1) * n / (2 * most)]).collect() }
}

/// At most `most` of `items`, the first of each of equal parts.
pub(crate) fn spread_from_first<T: Copy>(items: &[T], most: usize) -> Vec<T> {
    let n = items.len();
    if n <= most { items.to_vec() } else { (0..most).map(|i| items[i * n / most]).collect() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_are_spread() {
        let hundred: Vec<usize> = (0..100).collect();
        assert_eq!(spread(&hundred, 4), [12, 37, 62, 87]);
        assert_eq!(spread_from_first(&hundred, 4), [0, 25, 50, 75]);
        assert_eq!((spread(&[3, 4, 5], 5), spread_from_first(&[3, 4, 5], 5)), (vec![3, 4, 5], vec![3, 4, 5]));
        assert!(spread(&hundred, 0).is_empty() && spread_from_first::<usize>(&[], 3).is_empty());
    }
}
