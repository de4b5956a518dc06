//! How much memory `compact` takes while it encodes, and k-means with many centres. A program of its own, because it counts every allocation.
#![allow(clippy::unwrap_used, reason = "a test that meets an error should stop there, in helpers too")]

use cc4dgs_codecs::kmeans::{self, Assignment};
use cc4dgs_format::gaussians::sh_rest_len;
use cc4dgs_format::{CodecContext, CodecPlugin, Entries, HostGaussians, Limits, Seed, Silent, toml};
use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

/// Counts the bytes that are allocated, and the most that were.
struct Counting;

static NOW: AtomicUsize = AtomicUsize::new(0);
static MOST: AtomicUsize = AtomicUsize::new(0);
/// Held by each test, because allocations of a test that runs at the same time would be counted, too.
static ALONE: Mutex<()> = Mutex::new(());

fn add(bytes: usize) {
    MOST.fetch_max(NOW.fetch_add(bytes, Ordering::Relaxed) + bytes, Ordering::Relaxed);
}

// SAFETY: every call is passed on to the system allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        add(layout.size());
        // SAFETY: the caller's promises are the system allocator's.
        unsafe { System.alloc(layout) }
    }
    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        add(layout.size());
        // SAFETY: the caller's promises are the system allocator's.
        unsafe { System.alloc_zeroed(layout) }
    }
    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        NOW.fetch_sub(layout.size(), Ordering::Relaxed);
        // SAFETY: the caller's promises are the system allocator's.
        unsafe { System.dealloc(pointer, layout) }
    }
    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        add(size);
        NOW.fetch_sub(layout.size(), Ordering::Relaxed);
        // SAFETY: the caller's promises are the system allocator's.
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Gaussians of degree 3 whose coefficients all have codes.
fn scene(count: usize) -> HostGaussians {
    let draw = |k: usize, column: usize| (Seed::root(column as u64).index(k as u64).value() >> 40) as f32 / (1u64 << 23) as f32 - 1.0;
    let mut g = HostGaussians { sh_degree: 3, opacity_logits: vec![0.0; count], ..Default::default() };
    for (column, (name, width, values)) in g.columns_mut().into_iter().enumerate() {
        let shift = if name == "log_scales" { -5.0 } else { 0.0 };
        *values = (0..count * width).map(|k| shift + draw(k, column)).collect();
    }
    g
}

#[test]
fn encoding_takes_at_most_twice_the_memory_of_the_model_beside_it() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    cc4dgs_codecs::link();
    let codec = (Entries::<CodecPlugin>::collect().unwrap().get("compact").unwrap().build)("", &toml::Table::new()).unwrap();
    // Over the number from which there are layers; buffers of blocks are small beside it.
    let count = 140_000;
    let g = scene(count);
    let model = 4 * count * (15 + 3 * sh_rest_len(3));
    let encode = || {
        let context = CodecContext { dynamic_threshold: Some(f32::INFINITY), ..CodecContext::new(Seed::root(3), Limits::default(), &Silent) };
        let before = NOW.load(Ordering::Relaxed);
        MOST.store(before, Ordering::Relaxed);
        let streams = codec.encode(&g, &context).unwrap();
        (streams, MOST.load(Ordering::Relaxed) - before)
    };
    // More threads hold more columns and blocks at a time.
    let (streams, most) = rayon::ThreadPoolBuilder::new().num_threads(2).build().unwrap().install(encode);
    assert!(streams.iter().map(|s| s.bytes.len()).sum::<usize>() > 20 * count, "the test has nothing to show");
    assert!(most <= 2 * model, "{most} bytes beside a model of {model}");
}

#[test]
fn an_update_of_many_centres_does_not_hold_the_sums_of_all_tasks() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    // 64 tasks of 2,048 points, each with 9 MB of sums. Every centre has a point of zeros and one of ones, 32 tasks apart.
    let (k, width, count) = (1usize << 16, 16, 1usize << 17);
    let points: Vec<f32> = (0..count * width).map(|i| (i / (k * width)) as f32).collect();
    let centers = vec![0.0f32; k * width];
    let assignment = Assignment { labels: (0..count).map(|i| (i % k) as u32).collect(), distances: vec![1.0; count], inertia: 0.0 };
    let update = || {
        let before = NOW.load(Ordering::Relaxed);
        MOST.store(before, Ordering::Relaxed);
        let moved = kmeans::update(&points, width, &assignment, &centers);
        (moved, MOST.load(Ordering::Relaxed) - before)
    };
    let (moved, most) = rayon::ThreadPoolBuilder::new().num_threads(2).build().unwrap().install(update);
    assert!(moved.iter().all(|v| *v == 0.5));
    let of_task = 8 * k * (width + 1);
    assert!(most < 24 * of_task, "{most} bytes, {of_task} of a task");
}
