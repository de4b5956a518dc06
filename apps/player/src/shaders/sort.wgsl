// A pass of a stable radix sort by 8 bits of the key: count digits per block, scan, scatter. No subgroups, no float atomics.

struct Work {
    sort: vec3<u32>,
    visible: u32,
    draw: vec4<u32>,
}
struct Pass {
    shift: u32,
}

@group(0) @binding(0) var<uniform> digit_of: Pass;
@group(0) @binding(1) var<storage, read> work: Work;
@group(0) @binding(2) var<storage, read> source: array<vec2<u32>>;
@group(0) @binding(3) var<storage, read_write> target_pairs: array<vec2<u32>>;
// [256 digits, blocks].
@group(0) @binding(4) var<storage, read_write> counts: array<u32>;

const ROUNDS: u32 = 8u;
const BLOCK: u32 = 2048u;

var<workgroup> digit_counts: array<atomic<u32>, 256>;
var<workgroup> sums: array<u32, 256>;
// Per digit, a bit for each of the 256 threads.
var<workgroup> masks: array<atomic<u32>, 2048>;
var<workgroup> next: array<u32, 256>;

@compute @workgroup_size(256)
fn count(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    for (var round = 0u; round < ROUNDS; round++) {
        let i = group.x * BLOCK + round * 256u + thread;
        if (i < work.visible) { atomicAdd(&digit_counts[(source[i].x >> digit_of.shift) & 255u], 1u); }
    }
    workgroupBarrier();
    counts[thread * work.sort.x + group.x] = atomicLoad(&digit_counts[thread]);
}

@compute @workgroup_size(256)
fn scan(@builtin(local_invocation_index) thread: u32) {
    let blocks = work.sort.x;
    var sum = 0u;
    for (var b = 0u; b < blocks; b++) { sum += counts[thread * blocks + b]; }
    sums[thread] = sum;
    workgroupBarrier();
    for (var step = 1u; step < 256u; step = step << 1u) {
        var add = 0u;
        if (thread >= step) { add = sums[thread - step]; }
        workgroupBarrier();
        sums[thread] += add;
        workgroupBarrier();
    }
    var at = sums[thread] - sum;
    for (var b = 0u; b < blocks; b++) {
        let here = counts[thread * blocks + b];
        counts[thread * blocks + b] = at;
        at += here;
    }
}

@compute @workgroup_size(256)
fn scatter(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    next[thread] = counts[thread * work.sort.x + group.x];
    workgroupBarrier();
    let word = thread >> 5u;
    let bit = 1u << (thread & 31u);
    for (var round = 0u; round < ROUNDS; round++) {
        let i = group.x * BLOCK + round * 256u + thread;
        let there = i < work.visible;
        var pair = vec2<u32>(0u);
        var digit = 0u;
        if (there) {
            pair = source[i];
            digit = (pair.x >> digit_of.shift) & 255u;
            atomicOr(&masks[8u * digit + word], bit);
        }
        workgroupBarrier();
        if (there) {
            // The bits of lower threads with the same digit: the stable rank.
            var rank = countOneBits(atomicLoad(&masks[8u * digit + word]) & (bit - 1u));
            for (var w = 0u; w < word; w++) { rank += countOneBits(atomicLoad(&masks[8u * digit + w])); }
            target_pairs[next[digit] + rank] = pair;
        }
        workgroupBarrier();
        // Thread t has digit t.
        var here = 0u;
        for (var w = 0u; w < 8u; w++) {
            here += countOneBits(atomicLoad(&masks[8u * thread + w]));
            atomicStore(&masks[8u * thread + w], 0u);
        }
        next[thread] += here;
        workgroupBarrier();
    }
}
