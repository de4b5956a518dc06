//! Images that stay in the memory of a device: a training reads each of them many times, and sending it takes longer than unpacking it.

use cc4dgs_core::Image8;
use std::collections::HashMap;
use std::hash::Hash;
use std::sync::{Arc, Weak};

/// What a device made of an image.
struct Entry<T> {
    /// Keeps the address of the image from being used again.
    image: Weak<Image8>,
    bytes: usize,
    made: T,
}

/// What was made of images, by the place it is used in (`K`: a thread and a device) and the image's address. An entry lasts as long as somebody else has the image.
pub struct KeptImages<K, T> {
    most_bytes: usize,
    bytes: usize,
    entries: HashMap<(K, usize), Entry<T>>,
}

impl<K: Eq + Hash, T: Clone> KeptImages<K, T> {
    /// Keeps up to `most_bytes` of images.
    pub fn new(most_bytes: usize) -> Self {
        Self { most_bytes, bytes: 0, entries: HashMap::new() }
    }

    /// What `make` made of `image` for `place`. It is made again where there was no space for it. What was made of images that nobody has any more goes first.
    pub fn of(&mut self, place: K, image: &Arc<Image8>, make: impl FnOnce() -> T) -> T {
        let key = (place, Arc::as_ptr(image) as usize);
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
        assert_eq!(made, 4, "the third has no space and is made each time");
        let [one, two, three] = images;
        drop(one);
        assert_eq!((kept.of("device", &three, || 30), kept.of("device", &three, || 31)), (30, 30), "the space of the first");
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
