#!/bin/sh
# Finding: splat-transform gives nearly opaque splats of a .compressed.ply infinite opacities
# Software: splat-transform 3.7.0 (npm, @playcanvas/splat-transform; needs Node.js 20)
# Expected: a splat of logit 7 (opacity 0.9991) comes back from .compressed.ply, which has 8 bits for it, as a large
#   finite logit
# Seen: 0.9991 is nearest to 255 of 255, whose logit is written as inf, and -10 as -inf; .spz in the same release is
#   held at 13.8 (release 2.7.1 has inf there too)
# Meets: who unpacks a compressed capture to train or edit it on: one infinite value makes losses NaN, and exporters
#   drop splats
# Here: infinite logits are read as opacity 1 and 0, and bytes of 0 and 255 as a quarter of a step from them
#   (`warpcage/splats/io/contents.py`).
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

const logits = [-10, 0, 5, 6, 7, 10];
writeSplats("splats.ply", logits.map((logit, k) => [k, 0, 0, 0.5, -0.5, 0.2, logit, -3, -4, -5, 1, 0, 0, 0]));
const found = {};
for (const ending of ["compressed.ply", "spz"]) {
  convert("splats.ply", `packed.${ending}`);
  convert(`packed.${ending}`, "back.ply");
  found[ending] = readSplats("back.ply").opacity;
  const shown = found[ending].map((logit) => +logit.toFixed(3)).join(" ");
  console.log(`logits ${logits.join(" ")} by way of .${ending}: ${shown}`);
}
const infinite = (values) => values.filter((value) => !Number.isFinite(value)).length;
if (infinite(found["compressed.ply"]) !== 3 || infinite(found.spz) !== 0) throw new Error("the behaviour has changed");
END
node program.mjs
