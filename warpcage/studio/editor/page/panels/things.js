// The things of the scene: which fields are in it, where they stand, and what is done with them as wholes.

import { store } from "../core/store.js";
import { ask, request } from "../core/connection.js";
import { askFor, confirmThat, toast } from "../core/dialogs.js";
import { button, el, followKey, group, icon, listBox, number, perPicture, setIcon, setText, short, text } from "../core/controls.js";
import { AXIS_NAMES } from "../geometry/vectors.js";
import { activeThing, choose, things } from "../view/things.js";
import { uploadField } from "./cage.js";
import { counted, film } from "./keys.js";

const FIELDS = ".npz,.ply,.spz,.sog,.splat,.glb";
const OWN = 0; // the number of the field that the session is of

const change = (id, changes) => request({ do: "thing.change", id, ...changes });

/** A listener that calls work(thing, ...) with the active thing, where there is one. */
const withThing = (work) => (...given) => {
  const thing = activeThing();
  if (thing) work(thing, ...given);
};

/** Adds a field or a mesh of the session's folder. */
async function addFile(file, isBeside = true) {
  store.setStatus({ doing: `Reading ${file}` });
  await request({ do: "thing.add", file, beside: isBeside });
  store.setStatus({ doing: null });
}

async function add() {
  const { files } = (await request({ do: "thing.files" })) ?? {};
  if (!files) return;
  if (!files.length) {
    toast("The session's folder has no scene file and no mesh: Upload one, or Duplicate the object.", "warning");
    return;
  }
  const given = await askFor({
    title: "Add object",
    text: "A scene file (voxels or splats) or a mesh from the session's folder.",
    fields: [
      { name: "file", label: "File", type: "choice", value: files[0], choices: files },
      { name: "beside", label: "Stand it beside the others", type: "check", value: true, help: "Off: where its own file puts it." },
    ],
    confirm: "Add",
  });
  if (given) await addFile(given.file, given.beside);
}

/** A second one, a little to the side. */
function copy({ id, bounds: [lower, upper], place }) {
  const wide = place.scale * Math.max(...upper.map((value, k) => value - lower[k]));
  return request({ do: "thing.copy", id, offset: [1.1 * wide, 0, 0] });
}

async function remove({ id, name }) {
  const own = store.sections.edits.map((edit) => edit.id); // it is the active one
  const keys = film().keys.filter((key) => key.things.includes(id) || key.edits.some((edit) => own.includes(edit)));
  const lost = keys.length ? `, its cages and its part of ${counted(keys)} go` : " and its cages go";
  const isSure = await confirmThat("Remove the object?", `"${name}"${lost}; undo brings them back.`, "Remove");
  if (isSure) request({ do: "thing.remove", id });
}

async function saveStage() {
  const nameOf = (file) => (file.endsWith(".stage.json") ? file : `${file.replace(/\.json$/, "")}.stage.json`);
  const given = await askFor({
    title: "Save scene",
    text: "All objects with their positions, cages and poses in one file, which warpcage render, animate, bake and edit open.",
    fields: [{ name: "file", label: "File", type: "text", value: "scene.stage.json", help: `Is written into ${store.sections.session.folder}; must end in .stage.json.` }],
    confirm: "Save",
    send: ({ file }) => ask({ do: "stage.save", file: nameOf(file) }),
  });
  if (given) toast(`${nameOf(given.file)} is written.`);
}

function makeRow({ id }) {
  const eye = el("span", { class: "eye", title: "Show or hide (Space)", "aria-hidden": "true" });
  eye.append(icon("eye"));
  const name = el("span", { class: "row-name" });
  const note = el("span", { class: "row-note" });
  const lock = el("span", { class: "eye lock", title: "Lock or unlock its position", "aria-hidden": "true" });
  lock.append(icon("unlock"));
  const root = el("li", { id: `thing-${id}`, class: "list-row", role: "option" }, eye, name, note, lock);
  const now = () => things().find((thing) => thing.id === id);
  const toggle = (flag) => (event) => {
    event.stopPropagation();
    change(id, { [flag]: !now()[flag] });
  };
  eye.addEventListener("click", toggle("visible"));
  lock.addEventListener("click", toggle("locked"));
  root.addEventListener("click", () => choose(id));
  root.addEventListener("dblclick", () => document.getElementById("thing-name").select());
  const update = (thing) => {
    setText(name, thing.name);
    setText(note, thing.size.split(" ").at(-1)); // voxels or splats
    note.title = thing.size;
    setIcon(eye, thing.visible ? "eye" : "eye-off");
    setIcon(lock, thing.locked ? "lock" : "unlock");
    lock.classList.toggle("off", !thing.locked);
    root.setAttribute("aria-selected", String(store.sections.selection?.thing === id));
    root.setAttribute("aria-label", `${thing.name}, ${thing.size}, ${thing.visible ? "shown" : "hidden"}${thing.locked ? ", locked" : ""}`);
    root.classList.toggle("dim", !thing.visible);
  };
  return { root, update };
}

function onListKey(event) {
  const thing = activeThing();
  if (!thing || event.ctrlKey || event.metaKey || event.altKey) return;
  const at = things().indexOf(thing);
  const go = (by) => things()[at + by] && choose(things()[at + by].id);
  const ways = {
    ArrowUp: () => go(-1),
    ArrowDown: () => go(1),
    " ": () => change(thing.id, { visible: !thing.visible }),
    Enter: () => document.getElementById("thing-name").select(),
    F2: () => document.getElementById("thing-name").select(),
    Delete: () => thing.id !== OWN && remove(thing),
  };
  followKey(ways, event);
}

/** The numbers of the active thing's place: {nodes, show}. */
function placeFields() {
  const put = (changes) => withThing((thing) => change(thing.id, { place: { ...thing.place, ...changes(thing.place) } }))();
  const triple = (word, label, unit, step) => {
    const fields = AXIS_NAMES.map((axis, i) =>
      number({
        id: `thing-${word}-${axis}`,
        step,
        label: `${label}, ${axis}`,
        title: `${label}, ${axis}${unit}: type a number and press Enter`,
        bare: true,
        onChange: (value) => put((place) => ({ [word]: place[word].map((old, k) => (k === i ? value : old)) })),
      }),
    );
    const root = el("div", { class: "place", role: "group", "aria-label": label });
    AXIS_NAMES.forEach((axis, i) => root.append(el("label", { for: `thing-${word}-${axis}` }, axis), fields[i].input));
    return { root, show: (values) => fields.forEach((field, i) => field.set(Number(short(values[i], 4)))), inputs: fields.map(({ input }) => input) };
  };
  const position = triple("position", "Position", "", 0.1);
  const turn = triple("turn", "Rotation", ", degrees about the scene's axes, x first", 5);
  const scale = number({ id: "thing-scale", label: "Scale", title: "Size compared with its own file", min: 1e-6, max: 1e6, step: 0.1, unit: "times", onChange: (value) => put(() => ({ scale: value })) });
  const reset = button({ id: "thing-reset", label: "Back to the file's position", title: "Reset position, rotation and scale", onClick: () => put(() => ({ position: [0, 0, 0], turn: [0, 0, 0], scale: 1 })) });
  const inputs = [...position.inputs, ...turn.inputs, scale.input, reset];
  const show = ({ place, locked }) => {
    position.show(place.position);
    turn.show(place.turn);
    scale.set(place.scale);
    for (const input of inputs) input.disabled = locked;
  };
  const heading = (words) => el("span", { class: "note" }, words);
  return { nodes: [heading("Position"), position.root, heading("Rotation, degrees"), turn.root, scale.root, reset], show };
}

/** The group of the things: {root, start()}. */
export function thingsGroup() {
  const list = listBox({
    id: "thing-list",
    label: "Objects",
    title: "Up and Down choose, Space shows or hides, Enter renames, Delete removes",
    empty: "No objects yet.",
    onKey: onListKey,
    make: makeRow,
  });
  const upload = uploadField("thing-upload-file", "Scene or mesh file", FIELDS, (file) => addFile(file));
  const tools = el(
    "div",
    { class: "row tight" },
    button({ id: "thing-add", label: "Add object…", icon: "plus", keep: true, title: "Add a scene file or mesh from the session's folder", onClick: add }),
    button({ id: "thing-upload", label: "Upload…", title: "Upload a scene file or mesh from this computer, and add it", onClick: () => upload.click() }),
    el("span", { class: "spring" }),
    button({ id: "thing-copy", label: "Duplicate", icon: "copy", title: "Duplicate the active object with its cages and keys", onClick: withThing(copy) }),
    button({ id: "thing-remove", label: "Remove", icon: "delete", title: "Remove the active object from the scene (Delete in the list)", onClick: withThing(remove) }),
  );
  const name = text({ id: "thing-name", label: "Name", title: "Name of the active object (Enter keeps it)", maxlength: 100, onChange: withThing((thing, to) => thing.name !== to && change(thing.id, { name: to })) });
  const place = placeFields();
  const save = button({ id: "stage-save", label: "Save scene…", title: "All objects with cages and poses in one file, which warpcage render and edit open", onClick: saveStage });
  const details = el("div", { class: "stack" }, name.root, ...place.nodes, save);
  const made = group("things", "Objects", false, ...list.parts, tools, upload, details);
  const show = perPicture(() => {
    const thing = activeThing();
    list.show(things(), thing && `thing-${thing.id}`);
    setText(made.note, things().length > 1 ? `${thing?.name ?? ""} · ${things().length}` : "");
    details.hidden = !thing;
    document.getElementById("thing-copy").disabled = !thing;
    document.getElementById("thing-remove").disabled = !thing || thing.id === OWN || thing.locked;
    if (!thing) return;
    name.set(thing.name);
    place.show(thing);
  });
  const start = () => {
    store.on("things", show);
    store.on("selection", show);
    show();
  };
  return { root: made.root, start };
}
