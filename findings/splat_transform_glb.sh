#!/bin/sh
# Finding: splat-transform's .glb holds quaternions of any length
# Software: splat-transform 3.7.0 (npm, @playcanvas/splat-transform; needs Node.js 20)
# Expected: KHR_gaussian_splatting asks for unit quaternions, so those of a 3DGS .ply, which have any length, are made
#   unit ones
# Seen: a quaternion of length 2.01 is written at that length; the scene is turned by half a turn about z too, as its
#   .ply is taken to have y down
# Meets: who hands splats to a glTF viewer that trusts the extension: splats are four times too large, or skewed
# Here: quaternions of any length are read, and written as unit ones; the turn is undone
#   (`warpcage/splats/io/gltf.py`, docs/splats.md).
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
npm install --silent --no-audit --no-fund @playcanvas/splat-transform@3.7.0
cat > program.mjs <<'END'
import { execFileSync } from "node:child_process";
import { readFileSync, writeFileSync } from "node:fs";

const names = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split(" ");

function writeSplats(path, rows) {
  const head = `ply\nformat binary_little_endian 1.0\nelement vertex ${rows.length}\n`;
  const properties = names.map((name) => `property float ${name}\n`).join("");
  const body = Buffer.from(Float32Array.from(rows.flat()).buffer);
  writeFileSync(path, Buffer.concat([Buffer.from(`${head}${properties}end_header\n`), body]));
}

function readSplats(path) {
  const data = readFileSync(path);
  const end = data.indexOf("end_header\n") + 11;
  const found = [...data.subarray(0, end).toString().matchAll(/property float (\S+)/g)].map((match) => match[1]);
  const values = new Float32Array(data.buffer.slice(data.byteOffset + end, data.byteOffset + data.length));
  return Object.fromEntries(found.map((name, k) => [name, [...values].filter((_, n) => n % found.length === k)]));
}

const convert = (...words) => execFileSync("node_modules/.bin/splat-transform", ["-q", "-w", ...words]);

writeSplats("splats.ply", [[1, 2, 3, 0.5, -0.5, 0.2, 1, -3, -4, -5, 2, 0.2, 0, 0]]);
convert("splats.ply", "splats.glb");
const data = readFileSync("splats.glb");
const length = data.readUInt32LE(12);
const glb = JSON.parse(data.subarray(20, 20 + length).toString());
function values(number, count) {
  const accessor = glb.accessors[number];
  const start = 28 + length + (glb.bufferViews[accessor.bufferView].byteOffset ?? 0) + (accessor.byteOffset ?? 0);
  return Array.from({ length: count }, (_, k) => data.readFloatLE(start + 4 * k));
}
const attributes = glb.meshes[0].primitives[0].attributes;
const place = values(attributes.POSITION, 3);
const turn = values(attributes["KHR_gaussian_splatting:ROTATION"], 4);
console.log("place (1, 2, 3) in the .ply, in the .glb:", place, "nodes:", JSON.stringify(glb.nodes));
console.log("length of the quaternion:", Math.hypot(...turn).toFixed(3));
const same = Math.abs(Math.hypot(...turn) - 2.01) < 0.01 && place.join() === "-1,-2,3";
if (!same) throw new Error("the behaviour has changed");
END
node program.mjs
