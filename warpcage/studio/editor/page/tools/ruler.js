// The ruler: the way from one place of what is seen to another one, in the scene's units, and its parts along the axes.

import { register, store } from "../core/store.js";
import { el, setText } from "../core/controls.js";
import { toast } from "../core/dialogs.js";
import { project, rayThrough } from "../geometry/camera.js";
import { AXIS_NAMES, distance, meetPlane, subtract, times } from "../geometry/vectors.js";
import { drawDisc, linePath, stroke } from "../view/draw.js";
import { COLORS } from "../view/gizmo.js";
import { groundPlane } from "../view/grid.js";
import { shown } from "../view/operation.js";
import { pointerTools } from "../view/pointer.js";
import { camera, drawings, getSize, requestDraw, surfaceAt } from "../view/viewport.js";

let ends = []; // the places that were clicked, world units; two at most
let pointed = null; // the place under the pointer after the first click

const isOn = () => store.tools.tool === "ruler";

/** The place at a pixel: of matter, or of the ground where it is drawn; null where there is neither. */
function placeAt(at) {
  const place = surfaceAt(at);
  const { field } = store.sections.session ?? {};
  if (place || !store.tools.grid || !field) return place;
  const { axes, level } = groundPlane(field.bounds, field.up);
  const view = camera();
  return meetPlane(view.eye, rayThrough(view, ...at), times(axes[2], level), axes[2]);
}

/** The way from one place to another as text: [its length, its parts along x, y and z]. */
export function measured(from, to) {
  const parts = subtract(to, from).map((value, k) => `${AXIS_NAMES[k]} ${shown(value)}`);
  return [`${shown(distance(from, to))} units`, parts];
}

/** The two places that are measured now, the second one under the pointer until it is clicked; or null. */
const spanNow = () => (ends.length === 2 ? ends : ends.length && pointed ? [ends[0], pointed] : null);

function describe() {
  if (!ends.length) return "Click two points to measure between them. Esc leaves the ruler.";
  const span = spanNow();
  if (!span) return "Click the second point.";
  const [long, parts] = measured(...span);
  return `${long}: ${parts.join(", ")}`;
}

let show = () => undefined; // the text beside the tools

pointerTools.set("ruler", {
  click(at) {
    const place = placeAt(at);
    if (!place) {
      toast("Nothing is seen there: click the object, or draw the ground as a grid (Shift+D) to measure on it.", "warning");
      return;
    }
    ends = ends.length === 1 ? [ends[0], place] : [place];
    pointed = null;
    show();
    requestDraw();
  },
  hover(at) {
    if (ends.length !== 1) return null;
    pointed = placeAt(at);
    show();
    requestDraw();
    return null;
  },
});

function line(context, view, from, to, color, width, dash) {
  const [a, b] = [project(view, from), project(view, to)];
  const path = linePath([...a, ...b], [0, 1]);
  stroke(context, path, "rgba(0, 0, 0, 0.55)", width + 2.4, dash);
  stroke(context, path, color, width, dash);
}

/** The measure in a plate beside the middle of its line, inside the picture. */
function drawPlate(context, view, from, to) {
  const [a, b] = [project(view, from), project(view, to)];
  const [long, parts] = measured(from, to);
  context.save();
  const [large, small] = ["600 14px system-ui, sans-serif", "12px system-ui, sans-serif"];
  context.font = small;
  const widths = parts.map((part) => context.measureText(part).width + 12);
  context.font = large;
  const wide = Math.max(context.measureText(long).width, widths.reduce((sum, each) => sum + each, -12)) + 20;
  const [width, height] = getSize();
  const x = Math.max(6, Math.min(width - wide - 6, (a[0] + b[0]) / 2 + 14));
  const y = Math.max(6, Math.min(height - 52, (a[1] + b[1]) / 2 - 54));
  context.fillStyle = "rgba(16, 20, 26, 0.84)";
  context.beginPath();
  context.roundRect(x, y, wide, 46, 8);
  context.fill();
  context.textBaseline = "middle";
  context.fillStyle = "#ffffff";
  context.fillText(long, x + 10, y + 15);
  context.font = small;
  parts.reduce((left, part, k) => {
    context.fillStyle = COLORS[k];
    context.fillText(part, left, y + 33);
    return left + widths[k];
  }, x + 10);
  context.restore();
}

drawings.push((context, view) => {
  const span = isOn() ? spanNow() : null;
  for (const end of isOn() ? (span ?? ends) : []) {
    const [x, y, z] = project(view, end);
    if (z > 0) drawDisc(context, x, y, 4.5, "#ffd84d", "rgba(0, 0, 0, 0.7)", 1.4);
  }
  if (!span) return;
  const [from, to] = span;
  const corners = [from, [to[0], from[1], from[2]], [to[0], to[1], from[2]], to];
  for (let k = 0; k < 3; k += 1) line(context, view, corners[k], corners[k + 1], COLORS[k], 1.6, [4, 3]);
  line(context, view, from, to, "#ffd84d", 2);
  if (project(view, from)[2] > 0 && project(view, to)[2] > 0) drawPlate(context, view, from, to);
});

register("tool.ruler", { label: "Tool: measure a distance", keys: ["U"], group: "Tools", run: () => store.setTool("tool", "ruler") });

export function start() {
  const text = el("output", { id: "ruler-value", class: "note", "aria-live": "polite" });
  const chip = el("div", { class: "chip", id: "ruler-options" }, text);
  document.getElementById("tool-options").append(chip);
  show = () => setText(text, describe());
  const change = () => {
    chip.hidden = !isOn();
    if (!isOn()) [ends, pointed] = [[], null];
    show();
    requestDraw();
  };
  store.follow(["tools"], change);
}
