// The list of edits: what each cage does to the scene, whether it does so now, and in which order.

import { activeEdit, store, withActiveEdit } from "../core/store.js";
import { request } from "../core/connection.js";
import { askFor, confirmThat } from "../core/dialogs.js";
import { activeObject } from "../view/objects.js";
import { counted, keysOf } from "./keys.js";
import { settingFields } from "./picture.js";
import { button, choice, el, followKey, group, listBox, listRow, number, setIcon, setText, text } from "../core/controls.js";

const KINDS = [
  ["move", "Move"],
  ["copy", "Copy"],
  ["remove", "Remove"],
];
const MEANINGS = {
  move: "What is in the cage moves with it.",
  copy: "A copy moves with the cage; the original stays.",
  remove: "What is in the cage before it is posed is removed from the scene.",
};

const HELD = [
  ["cut", "That cut through the object"],
  ["still", "That are not moved"],
];
const SHAPES = [
  ["box", "Box"],
  ["cylinder", "Cylinder"],
  ["icosphere", "Ball"],
];

const change = (id, changes) => request({ do: "edit.change", id, ...changes });

/** A listener for a field of the active edit: what was typed or chosen becomes that part of it. */
const changeTo = (part) => withActiveEdit((edit, to) => edit[part] !== to && change(edit.id, { [part]: to }));

function activate(id) {
  const { selection } = store.sections;
  if (selection?.edit === id) return;
  request({ do: "select", edit: id, mode: selection?.mode ?? "vertex", vertices: [] });
}

/** Moves an edit up (-1) or down (1) in the list. */
function shift(id, by) {
  const ids = store.sections.edits.map((edit) => edit.id);
  const at = ids.indexOf(id);
  if (at < 0 || at + by < 0 || at + by >= ids.length) return;
  ids.splice(at + by, 0, ...ids.splice(at, 1));
  request({ do: "edit.order", ids });
}

async function remove(edit) {
  const keys = keysOf(edit);
  const lost = keys.length ? `"${edit.name}" goes, and ${counted(keys)} ${keys.length === 1 ? "loses its pose" : "lose their poses"} of it; undo brings them back.` : `"${edit.name}" goes; undo brings it back.`;
  const isSure = await confirmThat("Delete the edit?", lost, "Delete");
  if (isSure) request({ do: "edit.delete", id: edit.id });
}

/** Asks for the first cage of a new edit: a shape around the middle of the field. */
async function add() {
  const { bounds } = activeObject() ?? {};
  if (!bounds) return;
  const given = await askFor({
    title: "Add edit",
    text: "A simple cage in the middle of the object; fit it in the mode Rest. For one that fits by itself: Cage, Generate.",
    fields: [
      { name: "kind", label: "What it does", type: "choice", value: "move", choices: KINDS },
      { name: "shape", label: "Shape", type: "choice", value: "box", choices: SHAPES },
      { name: "share", label: "Size", type: "number", value: 50, min: 1, max: 120, step: 5, unit: "% of the object" },
    ],
    confirm: "Add",
  });
  if (!given) return;
  const [low, high] = bounds;
  const corner = (sign) => low.map((value, i) => (value + high[i]) / 2 + (sign * (high[i] - value) * given.share) / 200);
  request({ do: "edit.add", kind: given.kind, shape: given.shape, lower: corner(-1), upper: corner(1) });
}

const rename = () => document.getElementById("edit-name").select();
const toggle = (edit) => change(edit.id, { visible: !edit.visible });

function makeRow({ id }) {
  const hide = () => toggle(store.sections.edits.find((one) => one.id === id));
  const { root, update: show } = listRow(`edit-${id}`, { choose: () => activate(id), hide, rename });
  root.dataset.edit = id;
  const update = (edit) => {
    const title = `${edit.kind}, ${edit.rest.length} vertices`;
    const label = `${title}, ${edit.visible ? "shown" : "hidden"}`;
    show(edit, { text: `${edit.kind} · ${edit.rest.length}`, title, label, isChosen: store.sections.selection?.edit === id });
  };
  return { root, update };
}

function onListKey(event) {
  const { edits = [] } = store.sections;
  const edit = activeEdit();
  if (!edit || event.ctrlKey || event.metaKey) return;
  const at = edits.indexOf(edit);
  const go = (to) => edits[to] && activate(edits[to].id);
  const ways = {
    ArrowUp: () => (event.altKey ? shift(edit.id, -1) : go(at - 1)),
    ArrowDown: () => (event.altKey ? shift(edit.id, 1) : go(at + 1)),
    Home: () => go(0),
    End: () => go(edits.length - 1),
    " ": () => toggle(edit),
    Enter: rename,
    F2: rename,
    Delete: () => remove(edit),
  };
  followKey(ways, event);
}

export function editsGroup() {
  const list = listBox({
    id: "edit-list",
    label: "Edits",
    title: "Up and Down choose, Alt+Up and Alt+Down change the order, Space shows or hides, Enter renames, Delete deletes",
    empty: "No edits yet. Generate a cage in the group Cage, or add an edit with a simple one.",
    onKey: onListKey,
    make: makeRow,
  });
  const name = text({ id: "edit-name", label: "Name", title: "Name of the active edit (Enter keeps it)", maxlength: 100, onChange: changeTo("name") });
  const kind = choice({ id: "edit-kind", label: "What this cage does", title: "What the active edit does", options: KINDS, onChange: changeTo("kind") });
  const meaning = el("p", { class: "note", id: "edit-meaning" });
  const length = (options) => number({ min: 0, step: 0.05, unit: "units", ...options });
  const falloff = length({ id: "edit-falloff", label: "Fade", title: "Width over which the movement fades out at sides of the cage, so that the part does not tear off. 0: no fading", onChange: changeTo("falloff") });
  const held = choice({ id: "edit-held", label: "Fade at sides", title: "At which sides of the cage the movement fades out", options: HELD, onChange: changeTo("held") });
  const fragments = length({ id: "edit-fragments", label: "Take loose pieces along, up to", title: "Pieces outside the cage that touch only this part and are smaller than this move with it. 0: they stay", onChange: changeTo("fragments") });
  const shown = button({ id: "edit-visible", label: "Shown", icon: "eye", title: "Turn the active edit on or off", onClick: withActiveEdit(toggle) });
  const tools = el(
    "div",
    { class: "row tight" },
    button({ id: "edit-add", label: "Add edit", icon: "plus", keep: true, title: "Add an edit with a simple cage", onClick: add }),
    el("span", { class: "spring" }),
    shown,
    button({ id: "edit-up", label: "Earlier", icon: "up", title: "Move the active edit up (Alt+Up in the list)", onClick: withActiveEdit((edit) => shift(edit.id, -1)) }),
    button({ id: "edit-down", label: "Later", icon: "down", title: "Move the active edit down (Alt+Down in the list)", onClick: withActiveEdit((edit) => shift(edit.id, 1)) }),
    button({ id: "edit-delete", label: "Delete", icon: "delete", title: "Delete the active edit (Delete in the list)", onClick: withActiveEdit(remove) }),
  );
  const details = el("div", { class: "stack" }, name.root, kind.root, meaning);
  const walls = el("div", { class: "stack" }, falloff.root, held.root, fragments.root);
  const deformation = settingFields("deformation");
  const advanced = group("advanced", "Advanced", false, walls, el("p", { class: "note" }, "For all edits:"), deformation.root);
  const made = group("edits", "Edits", true, ...list.parts, tools, details, advanced.root);
  const show = () => {
    const { edits = [] } = store.sections;
    const edit = activeEdit();
    list.show(edits, edit && `edit-${edit.id}`);
    setText(made.note, edits.length ? String(edits.length) : "");
    details.hidden = walls.hidden = !edit;
    for (const element of tools.querySelectorAll("button:not(#edit-add)")) element.disabled = !edit;
    if (!edit) return;
    document.getElementById("edit-up").disabled = edits.indexOf(edit) === 0;
    document.getElementById("edit-down").disabled = edits.indexOf(edit) === edits.length - 1;
    name.set(edit.name);
    kind.set(edit.kind);
    setText(meaning, MEANINGS[edit.kind]);
    falloff.set(edit.falloff);
    held.set(edit.held);
    fragments.set(edit.fragments);
    falloff.root.hidden = edit.kind === "remove";
    held.root.hidden = edit.kind === "remove" || !edit.falloff;
    setIcon(shown, edit.visible ? "eye" : "eye-off");
    shown.setAttribute("aria-pressed", String(edit.visible));
  };
  return { root: made.root, start: () => (deformation.start(), store.follow(["edits", "selection"], show)) };
}
