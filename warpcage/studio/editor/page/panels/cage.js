// The cage of the active edit: where it comes from, its fineness, and what the live check finds.

import { activeEdit, selectedVertices, store, withActiveEdit } from "../core/store.js";
import { ask, attempt, request, send } from "../core/connection.js";
import { askFor, toast } from "../core/dialogs.js";
import { isBrush } from "../tools/brush.js";
import { counted, keysOf } from "./keys.js";
import { nextPlace } from "../view/pointer.js";
import { activeObject } from "../view/objects.js";
import { button, el, group, setText } from "../core/controls.js";
import { AXIS_NAMES } from "../geometry/vectors.js";

const METHODS = [
  ["auto", "Automatic"],
  ["shell", "Shell: follows the surface"],
  ["voxel", "Voxels: sturdy, also for haze and gaps"],
];

const AROUND = [
  ["all", "All that is visible"],
  ["ground", "The object that I click, on the ground or a table"],
  ["wall", "The object that I click, on a wall"],
  ["none", "The object that I click, in the air"],
];

const SYMMETRIES = [
  [null, "None"],
  ["auto", "Where the object nearly is"],
  ["x", "Left and right alike (x)"],
  ["y", "y"],
  ["z", "z"],
];

const DETAILS = [
  ["even", "Even"],
  ["parts", "Limbs and gaps"],
];

const FACES = [
  ["triangles", "Triangles"],
  ["quads", "Quads, where they hold"],
];

/** Where a new cage may be finer: a choice of a dialog. */
function focuses(edit) {
  const count = selectedVertices().length;
  return [
    ["none", "Nowhere"],
    ...(edit ? [["poses", `Where "${edit.name}" is bent, now or at keys`]] : []),
    ...(edit && count ? [["vertices", count === 1 ? "About the selected vertex" : `About the ${count} selected vertices`]] : []),
  ];
}

const clickHint = () => `${isBrush() ? "Paint over" : "Click"} the object in the picture; Escape leaves it.`;

/** For which edit a new cage is: a field of a dialog. One that keys hold poses of is not replaced unasked. */
function forEdit(edit, usual) {
  const keys = keysOf(edit);
  const carried = keys.length ? `its pose and those of ${counted(keys)} are` : "its pose is";
  return {
    name: "edit",
    label: "For",
    type: "choice",
    value: edit && !keys.length ? usual : "new",
    choices: [["new", "A new edit"], ...(edit ? [[edit.id, `"${edit.name}", in place of its cage`]] : [])],
    help: edit ? `In place of a cage: ${carried} carried over, exactly to the same mesh or a finer one, else roughly.` : undefined,
  };
}

/** Asks for the cage and has it made; the list of jobs shows how far it is. */
async function generate() {
  const edit = activeEdit();
  const given = await askFor({
    title: "Generate a cage",
    fields: [
      forEdit(edit, edit?.id),
      { name: "around", label: "Around", type: "choice", value: "all", choices: AROUND },
      { name: "count", label: "Vertices", type: "number", value: 100, min: 8, max: 2000, step: 1, help: "Approximate. Few are easy to pose, many follow details." },
      { name: "margin", label: "Margin", type: "number", value: null, min: 0, max: 100, step: 0.5, unit: "voxels", optional: true, help: "Gap between object and cage. Empty: automatic." },
      { name: "method", label: "Method", type: "choice", value: "auto", choices: METHODS },
      { name: "symmetry", label: "Symmetry", type: "choice", value: null, choices: SYMMETRIES },
      { name: "detail", label: "Detail", type: "choice", value: "even", choices: DETAILS, help: "Tubes for limbs, gaps and holes open where the vertices suffice." },
      { name: "faces", label: "Faces", type: "choice", value: "triangles", choices: FACES, help: "Quads are easier to read and to subdivide." },
      { name: "focus", label: "Finer", type: "choice", value: "none", choices: focuses(edit), help: "Shorter edges there, longer ones elsewhere, at the same number of vertices." },
      { name: "finer", label: "Times finer", type: "number", value: 2, min: 1, max: 8, step: 0.5, shown: ({ focus }) => focus !== "none" },
    ],
    confirm: "Generate",
  });
  if (!given) return;
  const { around, ...options } = given;
  options.focus = { none: null, poses: { edit: edit?.id }, vertices: { edit: edit?.id, vertices: selectedVertices() } }[given.focus];
  let click = null;
  if (around !== "all") {
    toast(clickHint());
    const place = await nextPlace();
    if (!place) return;
    click = { ...place, plane: around };
  }
  await request({ do: "cage.generate", ...options, click, edit: given.edit === "new" ? null : given.edit, count: Math.round(given.count) });
}

/** Makes a cage around the object that is clicked, as a new edit. */
async function generateAround() {
  toast(clickHint());
  const place = await nextPlace();
  if (place) await request({ do: "cage.generate", edit: null, count: 100, click: { ...place, plane: "any" } });
}

async function mirror(edit) {
  const { bounds } = activeObject();
  const axes = AXIS_NAMES.map((name) => [name, `Across ${name}`]);
  const given = await askFor({
    title: "Mirror the edit",
    text: `A new edit: the cage of "${edit.name}" on the other side of a plane, with its pose and the poses of its keys.`,
    fields: [
      { name: "axis", label: "Plane", type: "choice", value: "x", choices: axes },
      { name: "place", label: "At", type: "number", value: null, step: 0.05, unit: "units", optional: true, help: "Where the plane crosses that axis. Empty: the middle of the object." },
    ],
    confirm: "Mirror",
  });
  if (!given) return;
  const k = AXIS_NAMES.indexOf(given.axis);
  request({ do: "cage.mirror", edit: edit.id, axis: given.axis, place: given.place ?? (bounds[0][k] + bounds[1][k]) / 2 });
}

async function simplify(edit) {
  const has = edit.rest.length;
  const keys = keysOf(edit);
  const given = await askFor({
    title: "Simplify the cage",
    text: `"${edit.name}" has ${has} vertices. Its pose${keys.length ? ` and those of ${counted(keys)} are` : " is"} carried over, roughly.`,
    fields: [{ name: "count", label: "Vertices", type: "number", value: Math.max(8, Math.round(has / 2)), min: 8, max: Math.max(8, has - 1), step: 1 }],
    confirm: "Simplify",
  });
  if (given) request({ do: "cage.simplify", edit: edit.id, count: Math.round(given.count) });
}

async function box(edit) {
  const vertices = selectedVertices();
  if (!vertices.length) return toast("Nothing is selected: select the vertices to put a box around.", "warning");
  const given = await askFor({
    title: "Box around the selection",
    text: `A new edit: a box around ${vertices.length} vertices of "${edit.name}" as they are at rest.`,
    fields: [{ name: "margin", label: "Margin", type: "number", value: 2, min: 0, max: 100, step: 1, unit: "% of the cage" }],
    confirm: "Add",
  });
  if (given) request({ do: "cage.box", edit: edit.id, vertices, margin: given.margin / 100 });
}

/** For which edit a file is: nothing to ask where there is none. */
const editField = (edit) => (edit ? [forEdit(edit, "new")] : []);

const KINDS = { cage: "cages", poses: "pose files" };

/** Lets one of the files of a kind in the session's folder be chosen, and loads it. */
export async function loadFrom(kind, title, command, fields = [], text = null) {
  const result = await request({ do: "files" });
  if (!result) return;
  const names = result.files.filter((file) => file.kind === kind).map(({ name }) => name);
  if (!names.length) return toast(`The session's folder has no ${KINDS[kind]}; upload one.`, "warning");
  const file = { name: "file", label: "File", type: "choice", value: names[0], choices: names };
  const send = (given) => ask({ do: command, ...given, ...(given.edit === "new" ? { edit: null } : {}) });
  return askFor({ title, text, fields: [file, ...fields], confirm: "Load", send });
}

/** Loads a cage that was uploaded, for an edit or a new one. */
async function loadCage(file) {
  const edit = activeEdit();
  const send = (given) => ask({ do: "cage.load", file, edit: given.edit === "new" ? null : given.edit });
  if (!edit) return attempt(send({ edit: "new" }));
  return askFor({ title: `Load ${file}`, fields: editField(edit), confirm: "Load", send });
}

/** Sends a file, which gets into the session's folder once it was read and loaded; its name there, or throws Error(one line). */
async function uploaded(file) {
  const form = new FormData();
  form.append("file", file, file.name);
  const answer = await fetch(`upload?page=${store.status.client}`, { method: "POST", body: form, credentials: "same-origin" });
  const content = await answer.text();
  if (!answer.ok) throw new Error(content.split("\n")[0] || `the upload of ${file.name} failed (${answer.status})`);
  return JSON.parse(content).file;
}

/**
 * A hidden file field, which opens the browser's own dialog; load(name) is called when the file has arrived.
 * kind: what the file is loaded as, by which the server has its endings.
 */
export function uploadField(id, label, kind, load) {
  const input = el("input", { id, type: "file", class: "hidden-file", tabindex: "-1", "aria-label": label });
  input.addEventListener("click", () => (input.accept = store.sections.session.endings[kind].join()));
  input.addEventListener("change", async () => {
    const [file] = input.files;
    input.value = "";
    if (!file) return;
    store.setStatus({ doing: `Uploading ${file.name}` });
    const name = await attempt(uploaded(file));
    store.setStatus({ doing: null });
    if (!name) return;
    try {
      await load(name);
    } finally {
      send({ do: "upload.drop", file: name }); // nothing where it was loaded: refused or cancelled it is of no use
    }
  });
  return input;
}

/** How the check ended: "good", "warn" for what may be meant, "bad" for what tears the picture. */
function verdictOf({ problem, crossing_faces: crossing = [], folded_share: folded, leaking_faces: leaking = [], outside_share: outside }) {
  if (problem || crossing.length || folded > 0) return "bad";
  return leaking.length || outside > 0 ? "warn" : "good";
}

const VERDICTS = { pending: "Checking…", good: "Check: all well", warn: "Check: is this intended?", bad: "Check: fix this" };

export function cageGroup() {
  const upload = uploadField("cage-upload-file", "Cage file", "cage", loadCage);
  const size = el("p", { id: "cage-size", class: "note" });
  const refine = el(
    "div",
    { class: "grid thirds" },
    button({ id: "cage-subdivide", label: "Subdivide", title: "Cut each face of the cage into four; the shape and the pose stay", onClick: withActiveEdit((edit) => request({ do: "cage.subdivide", edit: edit.id })) }),
    button({ id: "cage-simplify", label: "Simplify…", title: "Fewer vertices, about the same shape", onClick: withActiveEdit(simplify) }),
    button({ id: "cage-box", label: "Box…", title: "A new edit: a box around the selected vertices", onClick: withActiveEdit(box) }),
  );
  const cut = button({ id: "cage-refine", label: "Refine", title: "Cut the faces at the selected vertices, and what is beside them; the shape and the pose stay", onClick: withActiveEdit((edit) => request({ do: "cage.subdivide", edit: edit.id, vertices: selectedVertices() })) });
  const copy = button({ id: "cage-mirror", label: "Mirror…", title: "A new edit: this one on the other side of a plane, such as a second arm", onClick: withActiveEdit(mirror) });
  const verdict = el("p", { id: "check-verdict", class: "verdict" });
  const found = el("ul", { id: "check-lines", class: "check-lines", "aria-label": "What the check found" });
  const check = el("div", { id: "check", "aria-live": "polite", "aria-atomic": "true" }, verdict, found);
  const made = group(
    "cage",
    "Cage",
    true,
    size,
    el(
      "div",
      { class: "grid thirds" },
      button({ id: "cage-generate", label: "Generate…", kind: "primary", title: "Make a cage around everything visible", onClick: generate }),
      button({ id: "cage-load", label: "Load…", title: "Load a cage file from the session's folder", onClick: () => loadFrom("cage", "Load a cage", "cage.load", editField(activeEdit())) }),
      button({ id: "cage-upload", label: "Upload…", title: "Upload a cage file (OBJ, PLY, GLB ...) from this computer", onClick: () => upload.click() }),
    ),
    upload,
    refine,
    el(
      "div",
      { class: "grid" },
      button({ id: "cage-click", label: "Around a click…", title: "A cage around the object that is clicked, on the ground, a table or a wall, as a new edit", onClick: generateAround }),
      copy,
      cut,
    ),
    check,
  );
  const showCage = () => {
    const edit = activeEdit();
    for (const element of refine.children) element.disabled = !edit;
    setText(size, edit ? `${edit.rest.length} vertices, ${edit.faces.length} faces` : "No cage selected.");
    copy.disabled = !edit;
    for (const name of ["cage-box", "cage-refine"]) document.getElementById(name).disabled = !edit || !selectedVertices().length;
  };
  const showCheck = () => {
    const { check: content } = store.sections;
    const isOfEdit = content && content.edit !== null && content.edit === store.sections.selection?.edit;
    check.hidden = !isOfEdit;
    if (!isOfEdit) return setText(made.note, "");
    const state = content.pending ? "pending" : verdictOf(content);
    check.dataset.state = state;
    made.note.dataset.state = state;
    setText(made.note, state === "bad" || state === "warn" ? "!" : "");
    setText(verdict, VERDICTS[state]);
    const lines = content.lines ?? [];
    const texts = [...found.children].map((line) => line.textContent);
    if (texts.join("\n") !== lines.join("\n")) found.replaceChildren(...lines.map((line) => el("li", {}, line)));
  };
  const start = () => (store.follow(["edits", "selection"], showCage), store.follow(["selection", "check"], showCheck));
  return { root: made.root, start };
}
