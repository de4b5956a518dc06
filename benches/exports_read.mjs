// Reads model.glb with Khronos' glTF validator and model.splatv with gsplat.js; see exports.sh. Ends with 1 where one of them finds an error.
import { readFileSync, writeFileSync } from 'node:fs';
import { join } from 'node:path';

const folder = process.argv[2];
if (folder.endsWith('.ply')) {
    // splat-transform writes an opacity of 1 as an infinite logit, which readers here refuse.
    const bytes = readFileSync(folder);
    const body = bytes.indexOf('end_header\n') + 11;
    const names = [...bytes.toString('latin1', 0, body).matchAll(/^property float (\S+)$/gm)].map((m) => m[1]);
    for (let at = body + 4 * names.indexOf('opacity'); at < bytes.length; at += 4 * names.length) {
        bytes.writeFloatLE(Math.max(-12, Math.min(12, bytes.readFloatLE(at))), at);
    }
    writeFileSync(folder, bytes);
    process.exit(0);
}
let failed = false;

const { default: validator } = await import('gltf-validator');
const glb = new Uint8Array(readFileSync(join(folder, 'model.glb')));
const report = await validator.validateBytes(glb, { uri: 'model.glb', maxIssues: 20 });
console.log(`== gltf-validator ${validator.version()} reads model.glb`);
const { numErrors, numWarnings, numInfos, messages } = report.issues;
console.log(`   ${numErrors} errors, ${numWarnings} warnings, ${numInfos} infos; ${report.info.totalVertexCount} vertices, extensions ${report.info.extensionsUsed}`);
// This version of the validator does not know the extension, so it takes the extension's own attribute names for mistakes.
const ofExtension = ({ code, pointer }) => code === 'MESH_PRIMITIVE_INVALID_ATTRIBUTE' && pointer.includes('/KHR_gaussian_splatting:');
const others = messages.filter((message) => !ofExtension(message));
console.log(`   of the errors, ${messages.length - others.length} are the names of the extension's attributes`);
for (const { severity, code, message, pointer } of others) console.log(`   severity ${severity} ${code} ${pointer}: ${message}`);
failed ||= others.some(({ severity }) => severity === 0);

// The same model as splat-transform writes it, by attribute. It turns the values by 180 degrees about z, where the file here turns the node.
const arrays = (file) => {
    const bytes = readFileSync(join(folder, file));
    const length = bytes.readUInt32LE(12);
    const json = JSON.parse(bytes.toString('utf8', 20, 20 + length));
    const found = {};
    for (const [name, index] of Object.entries(json.meshes[0].primitives[0].attributes)) {
        const { bufferView, componentType, count, type } = json.accessors[index];
        const { byteOffset = 0, byteLength } = json.bufferViews[bufferView];
        const start = 20 + length + 8 + byteOffset;
        const part = bytes.buffer.slice(bytes.byteOffset + start, bytes.byteOffset + start + byteLength);
        found[name] = { count, type, componentType, values: componentType === 5126 ? new Float32Array(part) : new Uint8Array(part) };
    }
    return found;
};
const [ours, theirs] = [arrays('model.glb'), arrays('splat-transform.glb')];
console.log('== splat-transform writes the same model as glTF');
// Its colours of plain points, COLOR_0, are sRGB; glTF's are linear.
const linear = (byte) => 255 * (byte <= 10 ? byte / 255 / 12.92 : ((byte / 255 + 0.055) / 1.055) ** 2.4);
const odd = /SH_DEGREE_1_COEF_[02]|SH_DEGREE_2_COEF_[13]|SH_DEGREE_3_COEF_[0246]/;
for (const [name, { count, type, componentType, values }] of Object.entries(theirs)) {
    const own = ours[name];
    const alike = own && own.count === count && own.type === type && own.componentType === componentType;
    let most = 0;
    if (alike && name.endsWith('ROTATION')) {
        for (let i = 0; i < values.length; i += 4) {
            const [x, y, z, w] = own.values.subarray(i, i + 4);
            const turned = [-y, x, w, -z];
            const norm = Math.hypot(...values.subarray(i, i + 4));
            // q and -q are one rotation; theirs are not normalised, as in PLY files.
            const along = turned.reduce((sum, v, k) => sum + (v * values[i + k]) / norm, 0);
            most = Math.max(most, 1 - Math.abs(along));
        }
    } else if (alike) {
        values.forEach((stored, i) => {
            const v = name === 'COLOR_0' && i % 4 < 3 ? linear(stored) : stored;
            const sign = odd.test(name) || (name === 'POSITION' && i % 3 < 2) ? -1 : 1;
            most = Math.max(most, Math.abs(sign * own.values[i] - v) / Math.max(1, Math.abs(v)));
        });
    }
    console.log(`   ${name}: ${alike ? `largest difference ${most.toExponential(1)}` : 'absent here, or of another type'}`);
    failed ||= !alike || most > (componentType === 5126 ? 1e-5 : 1);
}

// gsplat.js expects a browser; its reader of files needs only these.
globalThis.self = globalThis.window = globalThis;
globalThis.document = { createElement: () => ({ style: {}, addEventListener() {} }), addEventListener() {}, body: { appendChild() {} } };
globalThis.FileReader = class {
    readAsArrayBuffer(blob) {
        blob.arrayBuffer().then((buffer) => {
            this.result = buffer;
            this.onload?.({ target: this });
            this.onloadend?.();
        });
    }
};
const gsplat = await import('gsplat');
const scene = new gsplat.Scene();
const camera = new gsplat.Camera();
const bytes = readFileSync(join(folder, 'model.splatv'));
const splatv = await gsplat.SplatvLoader.LoadFromFileAsync(new Blob([bytes]), scene, camera, () => {});
const { vertexCount, positions } = splatv.data;
const box = [Infinity, -Infinity];
for (let i = 0; i < vertexCount; i++) for (const k of [1, 2]) {
    const v = positions[3 * i + k];
    box[0] = Math.min(box[0], v);
    box[1] = Math.max(box[1], v);
}
console.log(`== gsplat.js reads model.splatv`);
console.log(`   ${vertexCount} records (rows of 1024), y and z from ${box[0].toFixed(3)} to ${box[1].toFixed(3)}, camera at ${camera.position.flat().map((v) => v.toFixed(3))}`);
failed ||= !(vertexCount % 1024 === 0 && vertexCount > 0 && Number.isFinite(box[0]) && Number.isFinite(box[1]));
process.exit(failed ? 1 : 0);
