//! Finds the codecs and reads archives where there is neither C nor a file system. CI builds this for wasm32 and calls it from Node.

#[path = "wasm/decoded.rs"]
mod decoded;

use cc4dgs_format::{CodecPlugin, Entries, WeightCodecPlugin};
use std::cell::RefCell;

thread_local! {
    static FILE: RefCell<Vec<u8>> = const { RefCell::new(Vec::new()) };
}

/// The number of codecs and weight codecs that were found.
#[unsafe(no_mangle)]
pub extern "C" fn plugin_count() -> u32 {
    cc4dgs_codecs::link();
    let codecs = Entries::<CodecPlugin>::collect().map_or(0, |found| found.iter().count());
    let weight_codecs = Entries::<WeightCodecPlugin>::collect().map_or(0, |found| found.iter().count());
    (codecs + weight_codecs) as u32
}

/// Address of `bytes` bytes of memory, into which the caller copies a file.
#[unsafe(no_mangle)]
pub extern "C" fn reserve(bytes: u32) -> *mut u8 {
    FILE.with_borrow_mut(|file| {
        *file = vec![0; bytes as usize];
        file.as_mut_ptr()
    })
}

/// What that file decodes to, as a checksum; 0 on any error.
#[unsafe(no_mangle)]
pub extern "C" fn checksum() -> u64 {
    decoded::checksum(FILE.take()).unwrap_or(0)
}
