// The objects of the scene: which fields are in it, where they stand, and what is done with them as wholes.

import { store } from "../core/store.js";
import { ask, request } from "../core/connection.js";
import { askFor, confirmThat, toast } from "../core/dialogs.js";
import { button, el, followKey, group, icon, listBox, listRow, number, perPicture, setIcon, setText, text, triple } from "../core/controls.js";
import { activeObject, choose, objects } from "../view/objects.js";
import { uploadField } from "./cage.js";
import { counted, film } from "./keys.js";

const OWN = 0; // the number of the field that the session is of

const change = (id, changes) => request({ do: "object.change", id, ...changes });

/** A listener that calls work(object, ...) with the active object, where there is one. */
const withObject = (work) => (...given) => {
  const object = activeObject();
  if (object) work(object, ...given);
};

/** Adds a field or a mesh of the session's folder. */
async function addFile(file, isBeside = true) {
  store.setStatus({ doing: `Reading ${file}` });
  await request({ do: "object.add", file, beside: isBeside });
  store.setStatus({ doing: null });
}

async function add() {
  const { files } = (await request({ do: "object.files" })) ?? {};
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
  return request({ do: "object.copy", id, offset: [1.1 * wide, 0, 0] });
}

async function remove({ id, name }) {
  const own = store.sections.edits.map((edit) => edit.id); // it is the active one
  const keys = film().keys.filter((key) => key.objects.includes(id) || key.edits.some((edit) => own.includes(edit)));
  const lost = keys.length ? `, its cages and its part of ${counted(keys)} go` : " and its cages go";
  const isSure = await confirmThat("Remove the object?", `"${name}"${lost}; undo brings them back.`, "Remove");
  if (isSure) request({ do: "object.remove", id });
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

const rename = () => document.getElementById("object-name").select();

function makeRow({ id }) {
  const toggle = (flag) => change(id, { [flag]: !objects().find((object) => object.id === id)[flag] });
  const onLock = (event) => (event.stopPropagation(), toggle("locked"));
  const lock = el("span", { class: "eye lock", title: "Lock or unlock its position", "aria-hidden": "true", on: { click: onLock } }, icon("unlock"));
  const { root, update: show } = listRow(`object-${id}`, { choose: () => choose(id), hide: () => toggle("visible"), rename }, lock);
  const update = (object) => {
    const label = `${object.size}, ${object.visible ? "shown" : "hidden"}${object.locked ? ", locked" : ""}`;
    const text = object.size.split(" ").at(-1); // voxels or splats
    show(object, { text, title: object.size, label, isChosen: store.sections.selection?.object === id });
    setIcon(lock, object.locked ? "lock" : "unlock");
    lock.classList.toggle("off", !object.locked);
  };
  return { root, update };
}

function onListKey(event) {
  const object = activeObject();
  if (!object || event.ctrlKey || event.metaKey || event.altKey) return;
  const at = objects().indexOf(object);
  const go = (by) => objects()[at + by] && choose(objects()[at + by].id);
  const ways = {
    ArrowUp: () => go(-1),
    ArrowDown: () => go(1),
    " ": () => change(object.id, { visible: !object.visible }),
    Enter: rename,
    F2: rename,
    Delete: () => object.id !== OWN && remove(object),
  };
  followKey(ways, event);
}

/** The numbers of the active object's place: {nodes, show}. */
function placeFields() {
  const put = (changes) => withObject((object) => change(object.id, { place: { ...object.place, ...changes(object.place) } }))();
  const part = (name, label, unit, step) => triple({ id: `object-${name}`, label, unit, step, onChange: (value, k) => put((place) => ({ [name]: place[name].with(k, value) })) });
  const position = part("position", "Position", "", 0.1);
  const turn = part("turn", "Rotation", ", degrees about the scene's axes, x first", 5);
  const scale = number({ id: "object-scale", label: "Scale", title: "Size compared with its own file", min: 1e-6, max: 1e6, step: 0.1, unit: "times", onChange: (value) => put(() => ({ scale: value })) });
  const reset = button({ id: "object-reset", label: "Back to the file's position", title: "Reset position, rotation and scale", onClick: () => put(() => ({ position: [0, 0, 0], turn: [0, 0, 0], scale: 1 })) });
  const inputs = [...position.inputs, ...turn.inputs, scale.input, reset];
  const show = ({ place, locked }) => {
    position.set(place.position);
    turn.set(place.turn);
    scale.set(place.scale);
    for (const input of inputs) input.disabled = locked;
  };
  const heading = (text) => el("span", { class: "note" }, text);
  return { nodes: [heading("Position"), position.root, heading("Rotation, degrees"), turn.root, scale.root, reset], show };
}

export function objectsGroup() {
  const list = listBox({
    id: "object-list",
    label: "Objects",
    title: "Up and Down choose, Space shows or hides, Enter renames, Delete removes",
    empty: "No objects yet.",
    onKey: onListKey,
    make: makeRow,
  });
  const upload = uploadField("object-upload-file", "Scene or mesh file", "object", (file) => addFile(file));
  const tools = el(
    "div",
    { class: "grid" },
    button({ id: "object-add", label: "Add object…", icon: "plus", keep: true, title: "Add a scene file or mesh from the session's folder", onClick: add }),
    button({ id: "object-upload", label: "Upload…", title: "Upload a scene file or mesh from this computer, and add it", onClick: () => upload.click() }),
    button({ id: "object-copy", label: "Duplicate", icon: "copy", keep: true, title: "Duplicate the active object with its cages and keys", onClick: withObject(copy) }),
    button({ id: "object-remove", label: "Remove", icon: "delete", keep: true, title: "Remove the active object from the scene (Delete in the list)", onClick: withObject(remove) }),
  );
  const name = text({ id: "object-name", label: "Name", title: "Name of the active object (Enter keeps it)", maxlength: 100, onChange: withObject((object, to) => object.name !== to && change(object.id, { name: to })) });
  const place = placeFields();
  const save = button({ id: "stage-save", label: "Save scene…", title: "All objects with cages and poses in one file, which warpcage render and edit open", onClick: saveStage });
  const details = el("div", { class: "stack" }, name.root, ...place.nodes, save);
  const made = group("objects", "Objects", false, ...list.parts, tools, upload, details);
  const show = perPicture(() => {
    const object = activeObject();
    list.show(objects(), object && `object-${object.id}`);
    setText(made.note, objects().length > 1 ? `${object?.name ?? ""} · ${objects().length}` : "");
    details.hidden = !object;
    document.getElementById("object-copy").disabled = !object;
    document.getElementById("object-remove").disabled = !object || object.id === OWN || object.locked;
    if (!object) return;
    name.set(object.name);
    place.show(object);
  });
  return { root: made.root, start: () => store.follow(["objects", "selection"], show) };
}
