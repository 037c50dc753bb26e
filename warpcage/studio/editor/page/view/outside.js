// The notice that a new object stands outside of the view, or of the cameras of keys, and what brings it in.

import { run, store } from "../core/store.js";
import { ask, request } from "../core/connection.js";
import { button, el, perPicture, setText } from "../core/controls.js";
import { projectAll } from "../geometry/camera.js";
import { cornersIn, objects } from "./objects.js";
import { drawings, getSize, sceneCamera } from "./viewport.js";

let known = null; // the numbers of the objects that were there
let watched = null; // the number of the object that came last, until it is seen or the notice is closed
let outside = null; // count of keys whose cameras do not see all; null until the server has counted
let asked = null; // what was asked of the server last

/** Whether a corner of an object's box is beyond the edge of the view. */
function isOutside(object) {
  const places = projectAll(sceneCamera(), cornersIn(object));
  const [width, height] = getSize();
  for (let i = 0; i < places.length; i += 3) {
    const [x, y, far] = places.slice(i, i + 3);
    if (!(far > 0 && x >= 0 && y >= 0 && x <= width && y <= height)) return true;
  }
  return false;
}

const aspect = () => Math.min(20, Math.max(0.05, getSize()[0] / getSize()[1]));

/** Asks how many cameras of keys do not see all; the server knows where objects stand at the time of each. */
async function countKeys(then) {
  const { timeline, objects: all } = store.sections;
  if (asked?.timeline === timeline && asked?.all === all) return;
  const mine = (asked = { timeline, all });
  try {
    const { keys } = await ask({ do: "camera.outside", aspect: aspect() });
    if (asked !== mine) return;
    outside = keys;
    then();
  } catch (error) {
    if (asked === mine) asked = null; // asked again with the next change
    if (!error.isLost) throw error;
  }
}

/** Shows the notice in the corner of the view while there is a cause. */
export function start() {
  const text = el("span", { id: "outside-text" });
  const close = () => ((watched = null), show());
  const all = button({ id: "outside-all", label: "Frame all (Home)", title: "Move the view back until all objects are in it", onClick: () => run("view.all") });
  const keys = button({ id: "outside-keys", label: "Move camera keys", title: "Move the cameras of the keys back until they see all objects", onClick: () => request({ do: "camera.frame", aspect: aspect() }) });
  const off = button({ id: "outside-close", label: "Close this notice", icon: "close", kind: "flat", onClick: close });
  const root = el("div", { id: "outside", class: "hint", role: "status" }, el("div", { class: "stack" }, text, el("div", { class: "row tight" }, all, keys)), off);
  root.hidden = true;
  document.getElementById("notes").prepend(root);
  const show = perPicture(() => {
    const object = objects().find(({ id, visible }) => id === watched && visible);
    if (object) countKeys(show);
    const isBeyond = Boolean(object) && isOutside(object);
    if (object && !isBeyond && outside === 0) watched = null; // seen once: it may leave the view
    root.hidden = !object || store.sections.playback?.playing || !(isBeyond || outside);
    if (root.hidden) return;
    const where = [isBeyond ? "the view" : "", outside ? `${outside} camera ${outside === 1 ? "key" : "keys"}` : ""];
    setText(text, `"${object.name}" is not fully in ${where.filter(Boolean).join(" nor in ")}.`);
    all.hidden = !isBeyond;
    keys.hidden = !outside;
  });
  store.on("objects", (list) => {
    const added = known && list.find(({ id }) => !known.has(id));
    known = new Set(list.map(({ id }) => id));
    if (added) [watched, outside, asked] = [added.id, null, null];
    show();
  });
  for (const name of ["timeline", "playback"]) store.on(name, show);
  drawings.push(() => watched === null || show()); // the view has moved
}
