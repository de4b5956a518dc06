// Decodes archives in WebAssembly and compares with what another machine found in them.
//   cargo run --release -p cc4dgs-codecs --example archives -- FOLDER > NATIVE.txt        (or FILE... instead of FOLDER)
//   node benches/wasm_decode.mjs plugins_on_wasm.wasm NUMBER_OF_PLUGINS NATIVE.txt
// Every line of NATIVE.txt is a checksum and a file.
import { readFileSync } from "node:fs";

const [program, plugins, native] = process.argv.slice(2);
const { instance } = await WebAssembly.instantiate(readFileSync(program), {});
const { memory, plugin_count, reserve, checksum } = instance.exports;
let failed = plugin_count() !== Number(plugins);
console.log(`${plugin_count()} plug-ins found`);
const lines = readFileSync(native, "utf8").trim().split("\n");
for (const line of lines) {
    const [expected, ...name] = line.split(" ");
    const bytes = readFileSync(name.join(" "));
    // Memory may grow in `reserve`, which replaces its buffer.
    const address = reserve(bytes.length);
    new Uint8Array(memory.buffer, address, bytes.length).set(bytes);
    const before = performance.now();
    const found = BigInt.asUintN(64, checksum()).toString(16).padStart(16, "0");
    const same = found === expected && found !== "0".repeat(16);
    failed ||= !same;
    const name_only = name.join(" ").split("/").pop();
    console.log(`${name_only}: ${bytes.length} bytes, ${(performance.now() - before).toFixed(0)} ms, ${same ? "the same bits" : `${found} instead of ${expected}`}`);
}
process.exit(failed || lines.length === 0 ? 1 : 0);
