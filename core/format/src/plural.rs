//! Words of messages that depend on a count.

/// The words that agree with `count`: `one` where it is 1, else `many`. The number itself is not part of them.
///
/// ```
/// use cc4dgs_format::plural;
/// let told = |count: usize| format!("{count} {} skipped", plural(count, "image was", "images were"));
/// assert_eq!((told(1), told(3)), ("1 image was skipped".to_string(), "3 images were skipped".to_string()));
/// ```
pub fn plural<'a, N: PartialEq + From<u8>>(count: N, one: &'a str, many: &'a str) -> &'a str {
    if count == N::from(1) { one } else { many }
}

#[cfg(test)]
mod tests {
    use super::plural;

    #[test]
    fn only_one_is_singular() {
        assert_eq!([0usize, 1, 2].map(|count| plural(count, "image has", "images have")), ["images have", "image has", "images have"]);
        assert_eq!((plural(1u64, "is", "are"), plural(1.0f64, "is", "are"), plural(1.5f64, "is", "are")), ("is", "is", "are"));
    }
}
