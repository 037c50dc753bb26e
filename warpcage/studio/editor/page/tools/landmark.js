// Landmarks: a press takes hold of a place of the object, a drag takes it along in the plane of the screen, and the cage
// follows. Those that are there already hold their places.

import { register, run, store } from "../core/store.js";
import { ask, emit, isCongested, nextSequence, request, send } from "../core/connection.js";
import { button, el, setText } from "../core/controls.js";
import { toast } from "../core/dialogs.js";
import { project } from "../geometry/camera.js";
import { AXES, add } from "../geometry/vectors.js";
import { offsetOf } from "../geometry/transform.js";
import * as C from "../view/cages.js";
import { drawDisc } from "../view/draw.js";
import { pointerTools, sharesOf } from "../view/pointer.js";
import { camera, drawings, requestDraw } from "../view/viewport.js";

let pull = null; // the drag: {edit, number, place, from, camera, at, time, target, begun, isUnsent}; place null until it is known
let chosen = -1; // the number of the landmark that Delete deletes, or -1

const isOn = () => store.tools.tool === "landmark";

/** The landmarks of the active edit: where they are, in the coordinates of its object. */
const landmarks = () => {
  const cage = store.sections.settings?.mode === "pose" ? C.activeCage() : null;
  return (cage?.visible && store.sections.edits?.find(({ id }) => id === cage.id)?.landmarks) || [];
};

/** The number of the landmark under a pixel, the nearest; -1 where there is none. */
function landmarkAt([x, y], reach) {
  const view = camera();
  const away = landmarks().map((place) => {
    const [px, py, z] = project(view, place);
    return z > 0 ? Math.hypot(px - x, py - y) : Infinity;
  });
  const least = Math.min(...away, Infinity);
  return least <= reach ? away.indexOf(least) : -1;
}

/** Asks the server to take hold of it; what it says is known later, and the pointer may have gone on. */
function grasp() {
  const mine = pull;
  const of = mine.number < 0 ? sharesOf(mine.from) : { landmark: mine.number };
  mine.begun = ask({ do: "landmark.begin", edit: mine.edit, ...of }).then(
    ({ landmark, place }) => {
      chosen = landmark;
      Object.assign(mine, { number: landmark, place });
      aim(mine);
      return true;
    },
    (error) => {
      if (!error.isLost) toast(error.message, "warning");
      if (pull === mine) pull = null;
      requestDraw();
      return false;
    },
  );
}

/** Works out where the pointer has taken it, and sends that with the next picture of the screen. */
function aim(mine) {
  if (!mine.place || !mine.at) return;
  const free = offsetOf(mine.camera, mine.place, mine.from, mine.at, Object.values(AXES), [true, true, true]);
  mine.target = add(mine.place, free);
  if (!mine.isUnsent) requestAnimationFrame(() => flush(mine));
  mine.isUnsent = true;
  requestDraw();
}

function flush(mine, force = false) {
  if (!mine.isUnsent || (mine.isOver && !force)) return;
  if (isCongested() && !force) {
    requestAnimationFrame(() => flush(mine));
    return;
  }
  const seq = nextSequence();
  mine.isUnsent = false;
  if (send({ do: "landmark.set", place: mine.target, seq })) emit("sent", seq, mine.time);
}

/** Lets go: a step of undo, or none where it is cancelled. */
async function letGo(isKept) {
  const mine = pull;
  if (!mine?.begun || !(await mine.begun)) {
    pull = pull === mine ? null : pull;
    return;
  }
  if (isKept) flush(mine, true);
  mine.isOver = true;
  try {
    await ask({ do: "landmark.end", cancel: !isKept });
  } catch (error) {
    if (!error.isLost) toast(error.message, "error");
  }
  pull = pull === mine ? null : pull;
  requestDraw();
}

pointerTools.set("landmark", {
  begin(at, reach) {
    const cage = C.activeCage();
    if (!cage) toast("There is no cage: generate or load one first.", "warning");
    pull = cage ? { edit: cage.id, number: landmarkAt(at, reach), place: null, from: at, camera: camera(), at: null } : null;
    if (pull && pull.number < 0) grasp();
  },
  drag(at, { time }) {
    if (!pull) return;
    Object.assign(pull, { at, time });
    if (!pull.begun) grasp();
    aim(pull);
  },
  end: letGo,
  click() {
    if (pull?.begun) return letGo(true);
    if (pull) chosen = pull.number;
    pull = null;
    showOptions();
    requestDraw();
    return undefined;
  },
  hover: (at, reach) => (landmarkAt(at, reach) < 0 ? null : "grab"),
});

drawings.push((context, view) => {
  if (!isOn()) return;
  landmarks().forEach((place, number) => {
    const isPulled = pull?.target && pull.number === number;
    const [x, y, z] = project(view, isPulled ? pull.target : place);
    if (z <= 0) return;
    drawDisc(context, x, y, 7, number === chosen ? "#ffd84d" : "#3ddc97", "rgba(0, 0, 0, 0.7)", 1.6);
    drawDisc(context, x, y, 2, "rgba(0, 0, 0, 0.75)", "rgba(0, 0, 0, 0.75)", 1);
  });
});

/** Deletes the chosen landmark, or all where none is chosen; the pose stays. */
function remove() {
  const one = chosen >= 0 && chosen < landmarks().length ? { landmark: chosen } : {};
  chosen = -1;
  request({ do: "landmark.delete", edit: C.activeCage().id, ...one });
}

register("tool.landmark", {
  label: "Tool: drag places of the object",
  keys: ["J"],
  group: "Tools",
  run() {
    store.setTool("tool", "landmark");
    if (store.sections.settings?.mode !== "pose") request({ do: "settings", mode: "pose" });
  },
});
register("landmark.delete", {
  label: "Delete the chosen landmark, or all",
  keys: ["Delete"],
  group: "Tools",
  enabled: () => isOn() && !pull && landmarks().length > 0,
  run: remove,
});

function describe(count) {
  if (!count) return "Click places of the object that shall stay, then drag another one: the cage follows.";
  if (count === 1) return "One landmark moves the whole cage. Click more places that shall stay.";
  return `${count} landmarks: drag one, or another place. Delete deletes the yellow one.`;
}

let showOptions = () => undefined;

export function start() {
  const text = el("span", { class: "note", id: "landmark-text", role: "status" });
  const gone = button({ id: "landmark-delete", label: "Delete", icon: "delete", title: "Delete the chosen landmark, or all (Delete); the pose stays", onClick: () => run("landmark.delete") });
  const chip = el("div", { class: "chip", id: "landmark-options" }, text, gone);
  document.getElementById("tool-options").append(chip);
  showOptions = () => {
    const count = landmarks().length;
    if (chosen >= count && !pull) chosen = -1;
    chip.hidden = !isOn();
    gone.hidden = !count;
    setText(text, describe(count));
  };
  C.whenChanged(showOptions);
  store.follow(["tools"], () => (showOptions(), requestDraw()));
}
