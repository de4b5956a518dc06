//! Whether images that a reader loads itself depend on the order in which they are asked for.

use crate::FrameSource;
use crate::reader::{ImageSource, RawScene, RawView};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

/// Training asks for views at random. What is wrong if a source of the reader's own gives another image where it is asked for one again, as a decoder that only
/// goes forwards does.
pub(super) fn matters(scene: &RawScene) -> Option<String> {
    let own = |view: &RawView| match &view.image {
        ImageSource::Frames { source, index } => Some((source.clone(), *index)),
        _ => None,
    };
    let (first, last) = (scene.views.iter().find_map(own)?, scene.views.iter().rev().find_map(own)?);
    let again = || {
        let load = |(source, index): &(Arc<dyn FrameSource>, usize)| source.load(*index).ok();
        let (one, other) = (load(&first), load(&last));
        let (other_again, one_again) = (load(&last), load(&first));
        (one != one_again || other != other_again).then(|| format!("image {} or {} is another one where it is loaded again", first.1, last.1))
    };
    // A panic was found where the images were read.
    catch_unwind(AssertUnwindSafe(again)).unwrap_or(None)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Image8, Result, Split};
    use std::sync::atomic::{AtomicUsize, Ordering};

    /// Images as a decoder gives them that only goes forwards: the next one, or with `seeks` the one that is asked for.
    struct Film {
        seeks: bool,
        at: AtomicUsize,
    }

    impl FrameSource for Film {
        fn load(&self, view: usize) -> Result<Image8> {
            let next = self.at.fetch_add(1, Ordering::Relaxed);
            let frame = if self.seeks { view } else { next };
            Ok(Image8 { width: 1, height: 1, channels: 3, data: vec![frame as u8; 3] })
        }
    }

    #[test]
    fn images_that_depend_on_their_order_are_found() {
        for seeks in [true, false] {
            let source: Arc<dyn FrameSource> = Arc::new(Film { seeks, at: AtomicUsize::new(0) });
            let view = |index: usize| {
                let image = ImageSource::Frames { source: source.clone(), index };
                RawView { camera: 0, frame: index, time: None, split: Split::Train, image }
            };
            let scene = RawScene { views: (0..5).map(view).collect(), ..Default::default() };
            assert_eq!(matters(&scene).is_none(), seeks);
        }
        let scene = RawScene { views: Vec::new(), ..Default::default() };
        assert_eq!(matters(&scene), None);
    }
}
