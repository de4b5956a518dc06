// Reads model.glb with Khronos' glTF validator and model.splatv with gsplat.js; see exports.sh. Ends with 1 where one of them finds an error.
import { readFileSync } from 'node:fs';
import { join } from 'node:path';

const folder = process.argv[2];
let failed = false;

const { default: validator } = await import('gltf-validator');
const glb = new Uint8Array(readFileSync(join(folder, 'model.glb')));
const report = await validator.validateBytes(glb, { uri: 'model.glb', maxIssues: 20 });
console.log(`== gltf-validator ${validator.version()} reads model.glb`);
const { numErrors, numWarnings, numInfos, messages } = report.issues;
console.log(`   ${numErrors} errors, ${numWarnings} warnings, ${numInfos} infos; ${report.info.totalVertexCount} vertices, extensions ${report.info.extensionsUsed}`);
for (const { severity, code, message, pointer } of messages) console.log(`   severity ${severity} ${code} ${pointer}: ${message}`);
failed ||= numErrors > 0;

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
