//! Pareto fronts.

/// Indices of the points that no other point beats in one coordinate without losing in the other, from left to right. Low x is better; so is high y, or
/// low y where `low_y`. Of equal points the first stays.
pub fn front(points: &[(f64, f64)], low_y: bool) -> Vec<usize> {
    let y = |i: usize| if low_y { -points[i].1 } else { points[i].1 };
    let mut order: Vec<usize> = (0..points.len()).collect();
    order.sort_by(|a, b| points[*a].0.total_cmp(&points[*b].0).then(y(*b).total_cmp(&y(*a))).then(a.cmp(b)));
    let mut best = f64::NEG_INFINITY;
    order.retain(|i| {
        let better = y(*i) > best;
        best = best.max(y(*i));
        better
    });
    order
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_point_of_the_front_is_dominated_and_every_other_is() {
        let points: Vec<(f64, f64)> = (0..60u64).map(|i| ((i * 7919 % 23) as f64, (i * 104_729 % 19) as f64)).collect();
        for low in [false, true] {
            let found = front(&points, low);
            let better = |a: f64, b: f64| if low { a < b } else { a > b };
            for (i, p) in points.iter().enumerate() {
                let dominated = points.iter().any(|q| (q.0 <= p.0 && better(q.1, p.1)) || (q.0 < p.0 && q.1 == p.1));
                let first = points.iter().position(|q| q == p) == Some(i);
                assert_eq!(found.contains(&i), !dominated && first, "point {i} {p:?}, low {low}");
            }
            assert!(found.windows(2).all(|w| points[w[0]].0 < points[w[1]].0));
        }
        assert!(front(&[], false).is_empty());
    }
}
