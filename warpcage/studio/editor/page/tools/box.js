// Boxes drawn on the picture: a rectangle becomes a cage of 8 corners around what is seen in it, whose faces are dragged.

import { register, run, store } from "../core/store.js";
import { request } from "../core/connection.js";
import { button, el } from "../core/controls.js";
import { toast } from "../core/dialogs.js";
import { pixelAt, project, rayThrough } from "../geometry/camera.js";
import { BOX_EDGES } from "../geometry/place.js";
import { offsetOf, snapped } from "../geometry/transform.js";
import { add, cross, dot, mean, meetPlane, point, subtract, times, unit } from "../geometry/vectors.js";
import * as C from "../view/cages.js";
import * as drag from "../view/drag.js";
import { drawDisc, drawRegion, linePath, stroke } from "../view/draw.js";
import { COLORS } from "../view/gizmo.js";
import { extentOf, groundPlane } from "../view/grid.js";
import { pointerTools } from "../view/pointer.js";
import { clicked, elementAt } from "../view/selecting.js";
import { camera, drawings, requestDraw, surfaceAt } from "../view/viewport.js";

const SAMPLES = 40; // along each side of the rectangle, of what is seen in it
const SEEN = 0.02; // share of these that must show matter, else the box stands on the ground
const STRAY = 0.01; // share of them at either end that the box leaves out: rims of pixels
const MARGIN = 0.02; // room around matter, share of the box's largest side
const THIN = 0.02; // least thickness that a face may be dragged to, share of the cage's size
const ARM = 30; // pixels from a face's middle to the end of its handle
const CORNERS = [0, 1, 2, 3, 4, 5, 6, 7];

let drawn = null; // {from, to, box}: the box that is drawn
let pulled = null; // {cage, face, start, from, camera}: the face that is dragged
let hovered = null; // number of the face under the pointer

const fieldNow = () => store.sections.session?.field ?? { bounds: [[-1, -1, -1], [1, 1, 1]], up: [0, 0, 1] };
const isOn = () => store.tools.tool === "box";
const isRest = () => C.placesName() === "rest";

const rank = (sorted, share) => sorted[Math.round(share * (sorted.length - 1))];
const ascending = (values) => values.sort((a, b) => a - b);

/**
 * The box around places that are seen in a rectangle of so many pixels, in axes of its own: {axes, lower, upper}. Of
 * matter behind matter it takes the nearer, as deep as the rectangle is wide there. What is flat along the view has a
 * far side that is out of sight: there the box is as deep as it is wide, where the field has room (`bounds`).
 */
export function boxAround(places, axes, { eye, forward, focal }, pixels, bounds) {
  const depthOf = (place) => dot(subtract(place, eye), forward);
  const near = rank(ascending(places.map(depthOf)), STRAY);
  const kept = places.filter((place) => depthOf(place) <= near * (1 + pixels / focal));
  const along = axes.map((axis) => ascending(kept.map((place) => dot(place, axis))));
  const lower = along.map((values) => rank(values, STRAY));
  const upper = along.map((values) => rank(values, 1 - STRAY));
  const slants = axes.map((axis) => dot(axis, forward));
  const k = slants.map(Math.abs).indexOf(Math.max(...slants.map(Math.abs)));
  const sides = upper.map((value, i) => value - lower[i]);
  const wide = Math.min(...sides.filter((_, i) => i !== k));
  if (sides[k] < 0.5 * wide) {
    const [least, most] = extentOf(bounds, axes[k]);
    if (slants[k] > 0) upper[k] = Math.max(upper[k], Math.min(most, lower[k] + wide));
    else lower[k] = Math.min(lower[k], Math.max(least, upper[k] - wide));
  }
  const room = MARGIN * Math.max(...sides, 1e-9);
  return { axes, lower: lower.map((value) => value - room), upper: upper.map((value) => value + room) };
}

/** The box that stands on the ground where a rectangle of the picture lies on it, as high as it is narrow; or null. */
export function boxOnGround(view, [x0, y0], [x1, y1], { axes, level }) {
  const corners = [[x0, y0], [x1, y0], [x1, y1], [x0, y1]].map(([x, y]) => meetPlane(view.eye, rayThrough(view, x, y), times(axes[2], level), axes[2]));
  if (corners.some((corner) => corner === null)) return null;
  const along = axes.map((axis) => ascending(corners.map((corner) => dot(corner, axis))));
  const [lower, upper] = [along.map((values) => values[0]), along.map((values) => values[3])];
  lower[2] = level;
  upper[2] = level + Math.min(upper[0] - lower[0], upper[1] - lower[1]);
  return { axes, lower, upper };
}

/** The box of a rectangle on the picture: around what is seen there, else on the ground; null above the horizon. */
function boxOf(from, to) {
  const { bounds, up } = fieldNow();
  const plane = groundPlane(bounds, up);
  const places = [];
  for (let i = 0; i < SAMPLES; i += 1) {
    for (let j = 0; j < SAMPLES; j += 1) {
      const [s, t] = [(i + 0.5) / SAMPLES, (j + 0.5) / SAMPLES];
      const place = surfaceAt([from[0] + s * (to[0] - from[0]), from[1] + t * (to[1] - from[1])]);
      if (place) places.push(place);
    }
  }
  const pixels = Math.max(Math.abs(to[0] - from[0]), Math.abs(to[1] - from[1]));
  if (places.length >= SEEN * SAMPLES ** 2) return boxAround(places, plane.axes, camera(), pixels, bounds);
  return boxOnGround(camera(), from, to, plane);
}

/** The eight corners of a box, world units. */
const cornersOf = ({ axes, lower, upper }) =>
  CORNERS.map((i) => axes.reduce((sum, axis, k) => add(sum, times(axis, ((i >> k) & 1 ? upper : lower)[k])), [0, 0, 0]));

/** The six faces of a cage that is a box: [{normal, corners, middle}], outwards; none where it is no box. */
export function boxFaces({ faces, topology, rest, sense }) {
  if (topology.count !== 8 || faces.length !== 36) return [];
  const found = [];
  for (let f = 0; f < faces.length; f += 3) {
    const [a, b, c] = [0, 1, 2].map((k) => point(rest, faces[f + k]));
    const normal = times(unit(cross(subtract(b, a), subtract(c, a))), sense);
    let face = found.find((one) => dot(one.normal, normal) > 1 - 1e-4);
    if (!face) found.push((face = { normal, corners: new Set() }));
    for (let k = 0; k < 3; k += 1) face.corners.add(faces[f + k]);
  }
  if (found.length !== 6 || found.some(({ corners }) => corners.size !== 4)) return [];
  return found.map(({ normal, corners }) => ({ normal, corners: [...corners], middle: mean(rest, [...corners]) }));
}

/** A cage's places with a face moved along its normal, at most up to the face across from it. */
export function pulledFace(places, face, amount, size) {
  const others = CORNERS.filter((i) => !face.corners.includes(i));
  const thick = dot(subtract(face.middle, mean(places, others)), face.normal);
  const far = Math.max(amount, Math.min(0, THIN * size - thick));
  const out = Float64Array.from(places);
  for (const i of face.corners) out.set(add(point(places, i), times(face.normal, far)), 3 * i);
  return out;
}

/** The handles of the active box's faces: [{face, cage, at, end, isFront}], those in front last. */
function handles() {
  const cage = C.activeCage();
  if (!isOn() || !isRest() || !cage?.visible || !store.tools.cage) return [];
  const view = camera();
  const made = boxFaces(cage).map((face) => {
    const [x, y, z] = project(view, face.middle);
    const end = project(view, add(face.middle, times(face.normal, ARM * pixelAt(view, face.middle))));
    return { cage, face, at: [x, y], end: end.slice(0, 2), isFront: dot(face.normal, subtract(view.eye, face.middle)) > 0, isSeen: z > 0 };
  });
  return made.filter(({ isSeen }) => isSeen).sort((a, b) => a.isFront - b.isFront);
}

function handleAt([x, y], reach) {
  const away = ({ at, end }) => Math.min(Math.hypot(at[0] - x, at[1] - y), Math.hypot(end[0] - x, end[1] - y));
  const near = handles().filter((handle) => away(handle) <= reach);
  return near.sort((a, b) => b.isFront - a.isFront || away(a) - away(b))[0] ?? null;
}

/** Says what there is to do where boxes cannot be drawn now: they are cages at rest. */
function turnToRest() {
  request({ do: "settings", mode: "rest" });
  toast("Boxes are drawn in the mode Rest, which is on now.");
}

async function keepBox({ axes, lower, upper }) {
  await request({ do: "edit.add", kind: "move", shape: "box", segments: 1, axes, lower, upper });
  requestDraw();
}

pointerTools.set("box", {
  begin(at, reach) {
    const handle = handleAt(at, reach);
    pulled = null;
    drawn = { from: at, to: at, box: null };
    if (!handle) return;
    drawn = null;
    pulled = { cage: handle.cage, face: handle.face, start: C.places(handle.cage), from: at, camera: camera(), isMoving: false };
  },
  drag(at, { flip, time }) {
    if (pulled) {
      const { cage, face, start, from, camera: view } = pulled;
      if (!pulled.isMoving) drag.begin(cage, "Move a face");
      pulled.isMoving = true;
      const free = dot(offsetOf(view, face.middle, from, at, [face.normal], [true]), face.normal);
      const amount = snapped(free, store.tools.snap !== Boolean(flip) ? store.tools.step * cage.size : 0);
      drag.update(pulledFace(start, face, amount, cage.size), time);
    } else if (isRest() && drawn) {
      Object.assign(drawn, { to: at, box: boxOf(drawn.from, at) });
    }
    requestDraw();
  },
  end(isKept) {
    if (pulled?.isMoving) drag.end(!isKept);
    else if (drawn && isKept && !isRest()) turnToRest();
    else if (drawn && isKept && drawn.box) keepBox(drawn.box);
    else if (drawn && isKept) toast("Nothing is seen there: draw on the object or on the ground.", "warning");
    drawn = pulled = null;
    requestDraw();
  },
  click(at, way) {
    drawn = pulled = null;
    clicked(elementAt(...at, 11), way);
  },
  hover(at, reach) {
    const handle = handleAt(at, reach);
    const number = handle ? handle.face.corners.join() : null;
    if (number !== hovered) requestDraw();
    hovered = number;
    return handle ? "grab" : null;
  },
});

function drawHandles(context) {
  for (const { face, at, end, isFront } of handles()) {
    const isHovered = face.corners.join() === (pulled?.face.corners.join() ?? hovered);
    const k = face.normal.map(Math.abs).indexOf(Math.max(...face.normal.map(Math.abs)));
    const color = isHovered ? "#ffd84d" : COLORS[k];
    const path = new Path2D();
    path.moveTo(...at);
    path.lineTo(...end);
    context.save();
    context.globalAlpha = isFront ? 1 : 0.45;
    stroke(context, path, "rgba(0, 0, 0, 0.5)", 4);
    stroke(context, path, color, 2);
    for (const [place, radius] of [[at, 6], [end, 4]]) drawDisc(context, ...place, radius, color, "rgba(0, 0, 0, 0.6)", 1.2);
    context.restore();
  }
}

drawings.push((context, view) => {
  drawHandles(context);
  if (!drawn || drawn.to === drawn.from) return;
  drawRegion(context, "rectangle", [...drawn.from, ...drawn.to]);
  if (!drawn.box) return;
  const path = linePath(cornersOf(drawn.box).flatMap((corner) => project(view, corner)), BOX_EDGES);
  stroke(context, path, "rgba(0, 0, 0, 0.5)", 3);
  stroke(context, path, "#ff9a1f", 1.6);
});

register("tool.box", {
  label: "Tool: draw a box cage around a part, and drag its sides",
  keys: ["D"],
  group: "Tools",
  run() {
    store.setTool("tool", "box");
    if (!isRest()) request({ do: "settings", mode: "rest" });
  },
});
register("tool.leave", {
  label: "Leave the box, the landmarks or the ruler",
  keys: ["Escape"],
  group: "Tools",
  enabled: () => pointerTools.has(store.tools.tool),
  run: () => store.setTool("tool", "select"),
});

/** Makes a cage to pose of the active box: finer, in the pose, with the tool that selects. */
async function makeCage() {
  const cage = C.activeCage();
  if (!cage || !boxFaces(cage).length) return;
  await request({ do: "cage.subdivide", edit: cage.id });
  await request({ do: "settings", mode: "pose" });
  run("tool.select");
}

/** Adds the tool's line and button to the options of the tools that are on. */
export function start() {
  const text = el("span", { class: "note" });
  const cage = button({ id: "box-cage", label: "Cage", icon: "cage", keep: true, title: "Make the box a cage to pose: each side cut in four, in the mode Pose", onClick: makeCage });
  const chip = el("div", { class: "chip", id: "box-options" }, text, cage);
  document.getElementById("tool-options").append(chip);
  const show = () => {
    chip.hidden = !isOn();
    const active = C.activeCage();
    const isBox = Boolean(active && boxFaces(active).length);
    cage.hidden = !isBox;
    text.textContent = isBox && isRest() ? "Drag a dot to move that side. Drag elsewhere to draw another box." : "Drag across a part to draw a box around it.";
  };
  C.whenChanged(show);
  store.follow(["tools"], () => (show(), requestDraw()));
}
