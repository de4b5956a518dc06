//! A cache of images in device memory: training reads each image many times, and uploading it takes longer than unpacking it.

use cc4dgs_core::Image8;
use std::collections::HashMap;
use std::hash::Hash;
use std::sync::{Arc, Weak};

/// A cached value of an image.
struct Entry<T> {
    /// Keeps the allocation, so that no other image gets the same address.
    image: Weak<Image8>,
    bytes: usize,
    made: T,
}

/// Values made of images, by owner (`K`: a thread and a device) and address of the image. Entries whose image was dropped are removed at the next miss.
pub struct KeptImages<K, T> {
    most_bytes: usize,
    bytes: usize,
    entries: HashMap<(K, usize), Entry<T>>,
}

impl<K: Eq + Hash, T: Clone> KeptImages<K, T> {
    /// A cache for images of up to `most_bytes` together.
    pub fn new(most_bytes: usize) -> Self {
        Self { most_bytes, bytes: 0, entries: HashMap::new() }
    }

    /// The cached value of `image` for `owner`, or else the result of `make`, which is cached if its image fits within the bound.
    pub fn of(&mut self, owner: K, image: &Arc<Image8>, make: impl FnOnce() -> T) -> T {
        let key = (owner, Arc::as_ptr(image) as usize);
        if let Some(entry) = self.entries.get(&key) {
            return entry.made.clone();
        }
        self.entries.retain(|_, entry| entry.image.strong_count() > 0);
        self.bytes = self.entries.values().map(|entry| entry.bytes).sum();
        let (made, bytes) = (make(), image.data.len());
        if self.bytes + bytes <= self.most_bytes {
            self.bytes += bytes;
            self.entries.insert(key, Entry { image: Arc::downgrade(image), bytes, made: made.clone() });
        }
        made
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(value: u8) -> Arc<Image8> {
        Arc::new(Image8 { width: 2, height: 2, channels: 3, data: vec![value; 12] })
    }

    #[test]
    fn images_are_made_once_while_there_is_space() {
        let mut kept = KeptImages::new(30);
        let images = [image(1), image(2), image(3)];
        let mut made = 0;
        let mut ask = |kept: &mut KeptImages<&str, u8>, image: &Arc<Image8>| {
            kept.of("device", image, || {
                made += 1;
                image.data[0]
            })
        };
        for _ in 0..2 {
            assert_eq!(images.each_ref().map(|image| ask(&mut kept, image)), [1, 2, 3]);
        }
        assert_eq!(made, 4, "the third is over the bound and is made each time");
        let [one, two, three] = images;
        drop(one);
        assert_eq!((kept.of("device", &three, || 30), kept.of("device", &three, || 31)), (30, 30), "the bytes of the first are free again");
        assert_eq!((kept.of("device", &two, || 20), kept.of("other device", &two, || 21)), (2, 21));
        assert_eq!(kept.bytes, 24);
    }

    #[test]
    fn another_image_at_the_address_of_one_that_is_gone_is_another_image() {
        let mut kept = KeptImages::new(1 << 20);
        for value in 0..200 {
            let image = image(value);
            assert_eq!(kept.of((), &image, || image.data[0]), value);
        }
    }
}
