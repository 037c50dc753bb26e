// The cages and the selection as the page has them now, which is ahead of the server during a drag.

import { store } from "../core/store.js";
import { ask, guard, when } from "../core/connection.js";
import { toast } from "../core/dialogs.js";
import { makeTopology, signedVolume, wholePolygons } from "../geometry/topology.js";
import { bounds, distance } from "../geometry/vectors.js";

/** id -> {id, name, kind, visible, faces, topology, rest, posed, size, sense}; faces and points are flat. */
export const cages = new Map();
const listeners = [];
let held = null; // {id, places}: this edit's places (name) are dragged, the server's are kept for later
let chosen = { of: null, vertices: new Set() };
let unanswered = 0; // selections that the server has not answered
let unsaid = null; // a selection made without a connection
let theirs = null; // the last selection of the server
let active = { edit: null, vertex: -1 }; // the vertex that was picked last

/** Calls listener() whenever cages or selection change. */
export const whenChanged = (listener) => listeners.push(listener);
const changed = () => listeners.forEach((listener) => listener());

/** Which places are edited and shown: "posed" or "rest". */
export const placesName = () => (store.sections.settings?.mode === "rest" ? "rest" : "posed");

/** The flat vertices of a cage that are edited and shown. */
export const places = (cage) => cage[placesName()];

export const visibleCages = () => [...cages.values()].filter((cage) => cage.visible);

/** The edit that is worked on, or null. */
export const activeCage = () => cages.get(store.sections.selection?.edit) ?? null;

/** The selected vertices of the active edit, as a set. */
export function selected() {
  const content = store.sections.selection;
  if (chosen.of !== content) chosen = { of: content, vertices: new Set(content?.vertices ?? []) };
  return chosen.vertices;
}

export const pickMode = () => store.sections.selection?.mode ?? "vertex";

/** The active vertex of the active edit; -1 where there is none. */
export const activeVertex = () => (active.edit === activeCage()?.id && selected().has(active.vertex) ? active.vertex : -1);

/** Selects vertices of an edit at once, and on the server. */
export function select(edit, vertices, { mode = pickMode(), active: vertex = active.vertex } = {}) {
  const numbers = [...vertices].sort((a, b) => a - b);
  active = { edit, vertex };
  const before = store.sections.selection;
  const isSame = before?.edit === edit && before.mode === mode && String(before.vertices) === String(numbers);
  if (isSame) return changed();
  store.set("selection", { ...before, edit, mode, vertices: numbers });
  unanswered += 1;
  ask({ do: "select", edit, mode, vertices: numbers })
    .catch((error) => {
      if (error.isLost) {
        unsaid = { edit, mode, vertices: numbers };
        return;
      }
      if (unanswered === 1) store.set("selection", theirs ?? before ?? null);
      toast(error.message, "error");
    })
    .finally(() => (unanswered -= 1));
}

when("hello", () => {
  const { edit, mode, vertices } = unsaid ?? {};
  unsaid = null;
  const cage = cages.get(edit);
  if (cage && vertices.every((i) => i < cage.topology.count)) select(edit, vertices, { mode });
});

// A selection that the server sends before it has answered the last one is old
guard("selection", (content) => {
  theirs = content;
  return unanswered > 0;
});

/** Gives a cage other places, as a drag does. */
export function setPlaces(cage, name, points) {
  cage[name] = points;
  changed();
}

/** Keeps the server from changing these places of an edit until `release`. */
export function hold(id, name) {
  held = { id, name, received: null };
}

/** Lets the server change them again; takes what it sent since `expectAnswer`, if anything. */
export function release() {
  const { id, name, received } = held ?? {};
  held = null;
  const cage = cages.get(id);
  if (cage && received?.length === cage[name].length) setPlaces(cage, name, received);
}

/** Lets the server change them again, and takes back the drag. */
export function giveUp() {
  held = null;
  take(store.sections.edits ?? []);
  changed();
}

/** Forgets what the server sent during the drag: what comes from now on answers it. */
export function expectAnswer() {
  if (held) held.received = null;
}

function sameFaces(cage, faces) {
  const { polygons } = cage.topology;
  return polygons.length === faces.length && faces.every((face, f) => face.every((v, k) => v === (polygons[f][k] ?? -1)));
}

function take(edits) {
  const gone = new Set(cages.keys());
  for (const edit of edits) {
    gone.delete(edit.id);
    const before = cages.get(edit.id);
    const cage = before ?? { id: edit.id };
    if (!before || before.rest.length !== 3 * edit.rest.length || !sameFaces(before, edit.faces)) {
      cage.topology = makeTopology(wholePolygons(edit.faces), edit.rest.length);
      cage.faces = cage.topology.faces;
    }
    Object.assign(cage, { name: edit.name, kind: edit.kind, visible: edit.visible });
    for (const name of ["rest", "posed"]) {
      const points = Float64Array.from(edit[name].flat());
      const isKept = held?.id === edit.id && held.name === name && cage[name]?.length === points.length;
      if (isKept) held.received = points;
      else cage[name] = points;
    }
    cage.size = distance(...bounds(cage.rest)) || 1;
    cage.sense = signedVolume(cage.faces, cage.rest) < 0 ? -1 : 1; // whether its faces look inwards
    cages.delete(edit.id); // the map's order is the edits' order
    cages.set(edit.id, cage);
  }
  for (const id of gone) cages.delete(id);
}

store.on("edits", (edits) => {
  take(edits);
  changed();
});
for (const name of ["selection", "settings", "check"]) store.on(name, changed);

const coming = new Map(); // edit -> posed vertices of the film's next picture

function takePlaces(id, name, points) {
  const cage = cages.get(id);
  if (cage?.[name].length !== points.length) return;
  if (held?.id === id && held.name === name) held.received = points;
  else setPlaces(cage, name, points);
}

when("vertices", (name, id, points) => {
  // While the film plays, cages go with its pictures; each comes after its vertices
  if (name === "posed" && store.sections.playback?.playing) coming.set(id, points);
  else takePlaces(id, name, points);
});

function takeComing() {
  for (const [id, points] of coming) takePlaces(id, "posed", points);
  coming.clear();
}
when("frame", takeComing);
store.on("playback", ({ playing }) => playing || takeComing());
