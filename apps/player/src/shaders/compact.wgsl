// Lists the visible Gaussians in their order: a scan over the counts of the workgroups, then each workgroup writes its own. The order does not depend on timing, so
// equal frames are equal bytes.

struct Work {
    // Workgroups of the sort.
    sort: vec3<u32>,
    visible: u32,
    // Vertices, instances, first vertex, first instance.
    draw: vec4<u32>,
}

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> keys: array<u32>;
@group(0) @binding(2) var<storage, read_write> visible_of_block: array<u32>;
@group(0) @binding(3) var<storage, read_write> work: Work;
@group(0) @binding(4) var<storage, read_write> pairs: array<vec2<u32>>;

const BLOCK: u32 = 256u;
const SORT_BLOCK: u32 = 2048u;

var<workgroup> sums: array<u32, 256>;

// Inclusive scan over the workgroup.
fn scan(thread: u32, value: u32) -> u32 {
    sums[thread] = value;
    workgroupBarrier();
    for (var step = 1u; step < 256u; step = step << 1u) {
        var add = 0u;
        if (thread >= step) { add = sums[thread - step]; }
        workgroupBarrier();
        sums[thread] += add;
        workgroupBarrier();
    }
    return sums[thread];
}

@compute @workgroup_size(256)
fn scan_blocks(@builtin(local_invocation_index) thread: u32) {
    let blocks = (frame.counts.x + BLOCK - 1u) / BLOCK;
    // Every thread has a run of neighbouring blocks.
    let run = (blocks + 255u) / 256u;
    let first = min(thread * run, blocks);
    let end = min(first + run, blocks);
    var sum = 0u;
    for (var i = first; i < end; i++) { sum += visible_of_block[i]; }
    let after = scan(thread, sum);
    var at = after - sum;
    for (var i = first; i < end; i++) {
        let count = visible_of_block[i];
        visible_of_block[i] = at;
        at += count;
    }
    if (thread == 255u) {
        work.visible = after;
        work.sort = vec3<u32>((after + SORT_BLOCK - 1u) / SORT_BLOCK, 1u, 1u);
        work.draw = vec4<u32>(4u, after, 0u, 0u);
    }
}

@compute @workgroup_size(256)
fn compact(@builtin(global_invocation_id) id: vec3<u32>, @builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    var key = HIDDEN;
    if (id.x < frame.counts.x) { key = keys[id.x]; }
    let shown = select(0u, 1u, key != HIDDEN);
    let after = scan(thread, shown);
    if (shown == 1u) { pairs[visible_of_block[group.x] + after - 1u] = vec2<u32>(key, id.x); }
}
