// A view {eye, target, up, fov} as a camera: points to pixels, pixels to rays; and views that drags move.

import { add, bounds, cross, dot, length, perpendicular, rotate, subtract, times, unit } from "./vectors.js";

const MARGIN = 1.15; // room around what is framed

/** The camera of a view in a picture of this size (pixels; fov is vertical, in degrees). */
export function makeCamera(view, width, height) {
  const forward = unit(subtract(view.target, view.eye));
  const up = perpendicular(forward, view.up);
  const focal = height / 2 / Math.tan((view.fov * Math.PI) / 360);
  return { eye: view.eye, forward, up, right: cross(forward, up), focal, width, height };
}

/** Pixel (x right, y down) and distance along the camera's axis; the pixel means nothing where that is not positive. */
export function project(camera, p) {
  const a = subtract(p, camera.eye);
  const z = dot(a, camera.forward);
  const s = camera.focal / Math.max(z, 1e-9);
  return [camera.width / 2 + s * dot(a, camera.right), camera.height / 2 - s * dot(a, camera.up), z];
}

/** Pixels and distances of flat points, flat too. */
export function projectAll(camera, points) {
  const { eye, right, up, forward, focal } = camera;
  const out = new Float64Array(points.length);
  for (let i = 0; i < points.length; i += 3) {
    const x = points[i] - eye[0];
    const y = points[i + 1] - eye[1];
    const z = points[i + 2] - eye[2];
    const along = x * forward[0] + y * forward[1] + z * forward[2];
    const s = focal / Math.max(along, 1e-9);
    out[i] = camera.width / 2 + s * (x * right[0] + y * right[1] + z * right[2]);
    out[i + 1] = camera.height / 2 - s * (x * up[0] + y * up[1] + z * up[2]);
    out[i + 2] = along;
  }
  return out;
}

export function rayThrough(camera, x, y) {
  const across = times(camera.right, (x - camera.width / 2) / camera.focal);
  const upward = times(camera.up, (camera.height / 2 - y) / camera.focal);
  return unit(add(camera.forward, add(across, upward)));
}

/** World units that one pixel covers at a point. */
export const pixelAt = (camera, p) => Math.max(project(camera, p)[2], 1e-9) / camera.focal;

/** The view turned about its target: `across` about the world's up, `upward` about its own right (radians). */
export function orbit(view, across, upward, worldUp) {
  const vertical = unit(worldUp);
  let back = subtract(view.eye, view.target);
  let up = perpendicular(unit(times(back, -1)), view.up);
  const sense = dot(up, vertical) < -1e-9 ? 1 : -1; // upside down, a drag still pushes what is in front
  back = rotate(back, vertical, sense * across);
  up = rotate(up, vertical, sense * across);
  const right = cross(unit(times(back, -1)), up);
  const elevation = Math.asin(Math.max(-1, Math.min(1, dot(unit(back), vertical))));
  const limit = Math.PI / 2;
  const wanted = sense < 0 ? Math.max(-limit, Math.min(limit, elevation + upward)) - elevation : upward;
  back = rotate(back, right, -wanted);
  up = rotate(up, right, -wanted);
  return { ...view, eye: add(view.target, back), up: perpendicular(unit(times(back, -1)), up) };
}

/** The view moved sideways so that what is at the target's distance moves by these pixels. */
export function pan(view, dx, dy, height) {
  const camera = makeCamera(view, height, height);
  const size = length(subtract(view.target, view.eye)) / camera.focal;
  const step = add(times(camera.right, -dx * size), times(camera.up, dy * size));
  return { ...view, eye: add(view.eye, step), target: add(view.target, step) };
}

/** The view with its distance from the target times a factor. */
export function zoom(view, factor, shortest = 1e-6) {
  const back = subtract(view.eye, view.target);
  const distance = Math.max(length(back) * factor, shortest);
  return { ...view, eye: add(view.target, times(unit(back), distance)) };
}

/** The view turned so that the eye stands in a direction from the target. */
export function lookFrom(view, direction, up) {
  const distance = length(subtract(view.eye, view.target));
  const back = unit(direction);
  return { ...view, eye: add(view.target, times(back, distance)), up: perpendicular(times(back, -1), up) };
}

/** Directions towards the eye, by name, in a world with this up; each with the up of the picture. */
export function namedDirections(worldUp) {
  const up = unit(worldUp);
  const right = Math.abs(up[0]) < 0.9 ? perpendicular(up, [1, 0, 0]) : perpendicular(up, [0, 1, 0]);
  const front = cross(right, up);
  return {
    front: [front, up],
    back: [times(front, -1), up],
    right: [right, up],
    left: [times(right, -1), up],
    top: [up, times(front, -1)],
    bottom: [times(up, -1), front],
  };
}

/** The view moved along its direction so that flat points fill the picture. */
export function frameAll(view, points, aspect) {
  if (!points.length) return view;
  const [lower, upper] = bounds(points);
  const target = times(add(lower, upper), 0.5);
  const { right, up, forward, eye } = makeCamera(view, 1, 1);
  const tall = Math.tan((view.fov * Math.PI) / 360);
  let far = 1e-6;
  for (let i = 0; i < points.length; i += 3) {
    const p = subtract([points[i], points[i + 1], points[i + 2]], target);
    const half = Math.max(Math.abs(dot(p, right)) / (tall * aspect), Math.abs(dot(p, up)) / tall);
    far = Math.max(far, half * MARGIN - dot(p, forward));
  }
  return { ...view, target, eye: add(target, times(unit(subtract(eye, view.target)), far)) };
}
