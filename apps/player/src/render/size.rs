//! The size of an image that a device can draw.

/// Pixels of an image in a page or a window at most. One has 12 bytes on the graphics card: 8 to blend in, and 4 to show.
const MOST_PIXELS: u64 = 64 << 20;
/// Pixels to which the rows of an image are filled up where it is copied from the graphics card: 256 bytes.
const ROW_PIXELS: u64 = 64;
/// An image of so many pixels does not get smaller.
#[cfg(any(target_arch = "wasm32", test))]
const LEAST_PIXELS: u64 = 64 * 64;

/// What an image may have at most.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct MostPixels {
    /// Columns, and rows.
    pub(crate) side: u32,
    /// Columns times rows.
    pub(crate) all: u64,
}

impl MostPixels {
    /// Of a device whose textures have at most `side` pixels each way, and whose buffers have at most `buffer_bytes`, to which images are copied.
    pub(crate) fn new(side: u32, buffer_bytes: u64) -> Self {
        let (side, copied) = (side.max(1), buffer_bytes / 4);
        Self { side, all: copied.saturating_sub(ROW_PIXELS * u64::from(side)).clamp(1, MOST_PIXELS) }
    }
    /// The largest size that fits, of the shape of `wanted` (columns and rows): both sides are scaled alike, and rounded down to whole pixels. What fits is
    /// returned as it is. No side is 0.
    pub(crate) fn fit(self, wanted: (u32, u32)) -> (u32, u32) {
        let (width, height) = (wanted.0.max(1), wanted.1.max(1));
        let (w, h) = (f64::from(width), f64::from(height));
        let share = (f64::from(self.side.max(1)) / w.max(h)).min((self.all.max(1) as f64 / (w * h)).sqrt());
        if share >= 1.0 {
            return (width, height);
        }
        // Rounding must not take a pixel from a side that is a whole number.
        let scaled = |side: f64| ((side * share + 1e-6).floor() as u32).max(1);
        let (width, height) = (scaled(w), scaled(h));
        // A side of one pixel was not scaled like the other one.
        let bounded = |side: u32, other: u32| u64::from(side).min(self.all / u64::from(other)).max(1) as u32;
        (bounded(width, height), bounded(height, width))
    }
    /// The bound of images with half the pixels of `size`, for which there was too little memory; `None` where `size` is as small as images get.
    #[cfg(any(target_arch = "wasm32", test))]
    pub(crate) fn fewer(self, (width, height): (u32, u32)) -> Option<Self> {
        let pixels = u64::from(width) * u64::from(height);
        (pixels > LEAST_PIXELS).then_some(Self { all: pixels / 2, ..self })
    }
}

/// What is said of an image that has `drawn` in place of the `wanted` pixels; `None` where these are equal.
#[cfg(any(target_arch = "wasm32", feature = "window", test))]
pub(crate) fn remark(wanted: (u32, u32), drawn: (u32, u32)) -> Option<String> {
    let ((w, h), (width, height)) = (wanted, drawn);
    (wanted != drawn).then(|| {
        format!("The image has {width}x{height} pixels instead of {w}x{h}, more than can be drawn here. Choose a lower resolution or a smaller window to change that.")
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Columns and rows that are wanted, the largest side, the most pixels, and the size that fits.
    type Case = ((u32, u32), u32, u64, (u32, u32));

    #[test]
    fn images_keep_their_shape_where_they_are_too_large() {
        let any = u64::MAX;
        let cases: [Case; 9] = [
            ((1280, 800), 8192, any, (1280, 800)),
            ((8192, 8192), 8192, 8192 * 8192, (8192, 8192)),
            // An 8K screen with four pixels per CSS pixel each way.
            ((30_720, 17_280), 16_384, any, (16_384, 9216)),
            ((30_720, 17_280), 16_384, 64 << 20, (10_922, 6144)),
            ((1280, 800), 512, any, (512, 320)),
            ((800, 1280), 512, any, (320, 512)),
            ((1000, 500), 4096, 125_000, (500, 250)),
            // Lines do not vanish.
            ((100_000, 1), 100, any, (100, 1)),
            ((1_000_000, 1), u32::MAX, 100, (100, 1)),
        ];
        for (wanted, side, all, fits) in cases {
            assert_eq!(MostPixels { side, all }.fit(wanted), fits, "{wanted:?} in {side} pixels each way, {all} altogether");
        }
        let limits = [(0, 0), (1, 1), (7, 40), (512, 512 * 512), (16_384, 64 << 20), (u32::MAX, u64::MAX)];
        let sides = [0, 1, 2, 3, 640, 8191, 16_385, 61_440, u32::MAX];
        for (side, all) in limits {
            let most = MostPixels { side, all };
            for wanted in sides.iter().flat_map(|w| sides.map(|h| (*w, h))) {
                let (width, height) = most.fit(wanted);
                let what = format!("{wanted:?} in {side} pixels each way, {all} altogether: {width}x{height}");
                assert!(width >= 1 && height >= 1 && width.max(height) <= side.max(1), "{what}");
                assert!(u64::from(width) * u64::from(height) <= all.max(1), "{what}");
                assert_eq!(most.fit((width, height)), (width, height), "what fits is made smaller: {what}");
                let shapes = [f64::from(width) / f64::from(height), f64::from(wanted.0.max(1)) / f64::from(wanted.1.max(1))];
                // Sides are rounded by less than a pixel.
                let rounding = 1.0 / f64::from(width.min(height));
                assert!(width.min(height) == 1 || (shapes[0] / shapes[1] - 1.0).abs() < 1.01 * rounding / (1.0 - rounding), "{what}");
            }
        }
    }

    #[test]
    fn images_that_fit_can_be_copied_into_one_buffer() {
        for (side, bytes) in [(8192, 256 << 20), (16_384, 256 << 20), (16_384, 4 << 30), (2048, 1 << 20)] {
            let most = MostPixels::new(side, bytes);
            for wanted in [(side, side), (side - 63, side), (side, 3), (3, side), (4 * side, side)] {
                let (width, height) = most.fit(wanted);
                let copied = u64::from((4 * width).next_multiple_of(256)) * u64::from(height);
                assert!(copied <= bytes, "{width}x{height} pixels take {copied} of {bytes} bytes");
            }
        }
        assert_eq!(MostPixels::new(8192, u64::MAX), MostPixels { side: 8192, all: MOST_PIXELS });
        assert_eq!(MostPixels::new(0, 0), MostPixels { side: 1, all: 1 });
    }

    #[test]
    fn images_without_memory_get_fewer_pixels_down_to_a_least_number() {
        let (mut most, mut size, mut tries) = (MostPixels::new(16_384, u64::MAX), (1280, 800), 0);
        while let Some(fewer) = most.fewer(size) {
            let smaller = fewer.fit((1280, 800));
            assert!(smaller.0 < size.0 && smaller.1 < size.1, "{size:?} becomes {smaller:?}");
            (most, size, tries) = (fewer, smaller, tries + 1);
        }
        assert!(u64::from(size.0) * u64::from(size.1) <= LEAST_PIXELS && tries < 20, "{size:?} after {tries} tries");
    }

    #[test]
    fn a_smaller_image_is_said() {
        assert_eq!(remark((640, 480), (640, 480)), None);
        let said = remark((1280, 800), (512, 320)).unwrap();
        assert!(said.contains("512x320 pixels instead of 1280x800") && said.contains("lower resolution"), "{said}");
    }
}
