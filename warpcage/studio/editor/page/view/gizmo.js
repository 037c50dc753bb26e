// The handles of move, rotate and scale at the selection, of constant size on the screen; and the axes of the view.

import { pixelAt, project } from "../geometry/camera.js";
import { isInside, toSegment } from "../geometry/pick.js";
import { AXES, AXIS_NAMES, add, cross, dot, perpendicular, subtract, times, unit } from "../geometry/vectors.js";

const SIZE = 84; // CSS pixels from the pivot to the end of an axis
const STEPS = 64; // of a ring
/** Of the axes x, y and z. */
export const COLORS = ["#f2495c", "#6cc644", "#4a90f2"];
const BRIGHT = "#ffd84d";
const RIM = "rgba(0, 0, 0, 0.55)";

const only = (k) => [0, 1, 2].map((i) => i === k);
const except = (k) => [0, 1, 2].map((i) => i !== k);

/** A tool's handles: {kind, name, allowed, color, line | area | ring | disc (screen points), strength 0..1}. */
export function makeGizmo(tool, camera, pivot, basis) {
  const [x, y, z] = project(camera, pivot);
  if (z <= 0 || !["move", "rotate", "scale"].includes(tool)) return [];
  const scale = pixelAt(camera, pivot) * SIZE;
  const toEye = unit(subtract(camera.eye, pivot));
  const at = (offset) => project(camera, add(pivot, times(offset, scale))).slice(0, 2);
  const handles = [];
  if (tool === "rotate") {
    basis.forEach((axis, k) => handles.push(ring(axis, k, at, toEye)));
    const disc = { x, y, radius: SIZE * 1.12, open: true };
    handles.push({ kind: tool, name: "view", allowed: [true, true, true], color: "#e8e8e8", disc, strength: 0.8 });
    return handles;
  }
  basis.forEach((axis, k) => {
    const slant = 1 - Math.abs(dot(axis, toEye));
    const strength = Math.min(1, slant / 0.08); // an axis that points at the eye fades
    const line = [at(times(axis, 0.18)), at(axis)];
    handles.push({ kind: tool, name: AXIS_NAMES[k], allowed: only(k), color: COLORS[k], line, strength });
    const [u, v] = [basis[(k + 1) % 3], basis[(k + 2) % 3]];
    const corner = (a, b) => at(add(times(u, a), times(v, b)));
    const area = [corner(0.38, 0.38), corner(0.6, 0.38), corner(0.6, 0.6), corner(0.38, 0.6)];
    const facing = Math.min(1, Math.max(0, Math.abs(dot(axis, toEye)) - 0.12) / 0.1);
    const name = `plane-${AXIS_NAMES[k]}`;
    handles.push({ kind: tool, name, allowed: except(k), color: COLORS[k], area, strength: facing });
  });
  const disc = { x, y, radius: 10, open: false };
  handles.push({ kind: tool, name: "view", allowed: [true, true, true], color: "#f4f4f4", disc, strength: 1 });
  return handles;
}

function ring(axis, k, at, toEye) {
  const u = perpendicular(axis, Math.abs(axis[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0]);
  const v = cross(axis, u);
  const points = [];
  for (let i = 0; i <= STEPS; i += 1) {
    const angle = (2 * Math.PI * i) / STEPS;
    const p = add(times(u, Math.cos(angle)), times(v, Math.sin(angle)));
    points.push({ at: at(p), front: dot(p, toEye) > -0.05 });
  }
  return { kind: "rotate", name: AXIS_NAMES[k], allowed: only(k), color: COLORS[k], ring: points, strength: 1 };
}

/** How far a pixel is from a handle; Infinity where it is not meant. */
function away(handle, x, y) {
  if (handle.strength < 0.3) return Infinity;
  if (handle.disc) {
    const far = Math.hypot(x - handle.disc.x, y - handle.disc.y);
    return handle.disc.open ? Math.abs(far - handle.disc.radius) + 2 : Math.max(0, far - handle.disc.radius) - 4;
  }
  if (handle.area) return isInside(handle.area.flat(), x, y) ? 0 : Infinity;
  if (handle.line) return toSegment(x, y, ...handle.line[0], ...handle.line[1])[0];
  let least = Infinity;
  for (let i = 1; i < handle.ring.length; i += 1) {
    const [a, b] = [handle.ring[i - 1], handle.ring[i]];
    if (a.front || b.front) least = Math.min(least, toSegment(x, y, ...a.at, ...b.at)[0]);
  }
  return least;
}

/** The handle under a pixel within a reach (pixels), or null. */
export function handleAt(handles, x, y, reach) {
  let best = null;
  let least = reach;
  for (const handle of handles) {
    const far = away(handle, x, y);
    if (far < least) [best, least] = [handle, far];
  }
  return best;
}

function tracePath(context, points, close = false) {
  context.beginPath();
  points.forEach(([x, y], i) => (i ? context.lineTo(x, y) : context.moveTo(x, y)));
  if (close) context.closePath();
}

/** A line with a dark rim, so that it shows on any picture. */
function rimmed(context, color, width) {
  context.strokeStyle = RIM;
  context.lineWidth = width + 2;
  context.stroke();
  context.strokeStyle = color;
  context.lineWidth = width;
  context.stroke();
}

function drawRing(context, handle, color, width) {
  for (const front of [false, true]) {
    context.beginPath();
    for (let i = 1; i < handle.ring.length; i += 1) {
      const [a, b] = [handle.ring[i - 1], handle.ring[i]];
      if ((a.front && b.front) !== front) continue;
      context.moveTo(...a.at);
      context.lineTo(...b.at);
    }
    context.globalAlpha = front ? 1 : 0.25;
    if (front) rimmed(context, color, width);
    else {
      context.strokeStyle = color;
      context.lineWidth = 1;
      context.stroke();
    }
  }
}

function drawEnd(context, [[x0, y0], [x1, y1]], kind, color) {
  context.fillStyle = color;
  context.strokeStyle = RIM;
  context.lineWidth = 1;
  if (kind === "scale") {
    context.beginPath();
    context.rect(x1 - 5, y1 - 5, 10, 10);
  } else {
    const size = Math.hypot(x1 - x0, y1 - y0) || 1;
    const [dx, dy] = [(x1 - x0) / size, (y1 - y0) / size];
    const far = Math.min(15, size);
    const tip = [x1 + dx * 4, y1 + dy * 4];
    const left = [tip[0] - dx * far - dy * 6, tip[1] - dy * far + dx * 6];
    const right = [tip[0] - dx * far + dy * 6, tip[1] - dy * far - dx * 6];
    tracePath(context, [tip, left, right], true);
  }
  context.fill();
  context.stroke();
}

export function drawGizmo(context, handles, hovered) {
  context.save();
  context.lineCap = "round";
  for (const handle of handles) {
    const isHovered = hovered?.name === handle.name;
    const color = isHovered ? BRIGHT : handle.color;
    context.globalAlpha = handle.strength;
    if (handle.strength <= 0.02) continue;
    if (handle.ring) drawRing(context, handle, color, isHovered ? 4 : 3);
    else if (handle.disc) {
      context.beginPath();
      context.arc(handle.disc.x, handle.disc.y, handle.disc.radius, 0, 2 * Math.PI);
      rimmed(context, color, isHovered ? 2.5 : 1.5);
    } else if (handle.area) {
      tracePath(context, handle.area, true);
      context.fillStyle = color;
      context.globalAlpha = handle.strength * (isHovered ? 0.85 : 0.5);
      context.fill();
      context.strokeStyle = color;
      context.lineWidth = 1;
      context.stroke();
    } else {
      tracePath(context, handle.line);
      rimmed(context, color, isHovered ? 4 : 3);
      drawEnd(context, handle.line, handle.kind, color);
    }
  }
  context.restore();
}

/** Coloured lines through the pivot along the axes that an operation is held to. */
export function drawGuides(context, camera, pivot, basis, allowed) {
  context.save();
  context.globalAlpha = 0.8;
  basis.forEach((axis, k) => {
    if (!allowed[k]) return;
    const depth = project(camera, pivot)[2];
    const along = dot(axis, camera.forward);
    const far = 20 * depth;
    const limit = Math.abs(along) > 1e-6 ? (0.95 * depth) / Math.abs(along) : far; // up to the camera's plane
    const ends = [-1, 1].map((sense) => {
      const reach = sense * along < 0 ? Math.min(far, limit) : far;
      return project(camera, add(pivot, times(axis, sense * reach))).slice(0, 2);
    });
    tracePath(context, ends);
    context.strokeStyle = COLORS[k];
    context.lineWidth = 1.2;
    context.stroke();
  });
  context.restore();
}

/** The balls of the world's axes in the picture's corner: {direction, x, y, near, label}, from far to near. */
export function makeCompass(camera, width) {
  const [cx, cy, far] = [width - 46, 46, 30];
  const balls = [];
  for (const sense of [1, -1]) {
    AXIS_NAMES.forEach((name, k) => {
      const direction = times(AXES[name], sense);
      const x = cx + far * dot(direction, camera.right);
      const y = cy - far * dot(direction, camera.up);
      const label = sense > 0 ? name.toUpperCase() : "";
      balls.push({ direction, x, y, near: -dot(direction, camera.forward), label, color: COLORS[k] });
    });
  }
  return { cx, cy, balls: balls.sort((a, b) => a.near - b.near) };
}

/** The ball of the compass under a pixel, or null. */
export function ballAt(compass, x, y) {
  return compass.balls.findLast((ball) => Math.hypot(x - ball.x, y - ball.y) <= 10) ?? null;
}

export function drawCompass(context, compass, hovered) {
  context.save();
  context.font = "bold 11px system-ui, sans-serif";
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.fillStyle = "rgba(60, 70, 84, 0.18)";
  context.beginPath();
  context.arc(compass.cx, compass.cy, 42, 0, 2 * Math.PI);
  context.fill();
  for (const ball of compass.balls) {
    const isHovered = hovered && String(hovered.direction) === String(ball.direction);
    context.globalAlpha = 0.7 + 0.3 * ball.near;
    context.strokeStyle = isHovered ? BRIGHT : ball.color;
    context.fillStyle = context.strokeStyle;
    context.lineWidth = 2;
    if (ball.label) {
      tracePath(context, [[compass.cx, compass.cy], [ball.x, ball.y]]);
      context.stroke();
    }
    context.beginPath();
    context.arc(ball.x, ball.y, ball.label ? 9 : 7, 0, 2 * Math.PI);
    if (!ball.label) context.globalAlpha *= 0.45;
    context.fill();
    context.globalAlpha = 1;
    context.stroke();
    context.fillStyle = "#10141a";
    if (ball.label) context.fillText(ball.label, ball.x, ball.y + 0.5);
  }
  context.restore();
}
