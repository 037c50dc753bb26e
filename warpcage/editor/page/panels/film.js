// Keys, the film and its exports, and the work that takes a while.

import { store } from "../core/store.js";
import { ask, request } from "../core/connection.js";
import { askFor, showText, toast } from "../core/dialogs.js";
import { button, choice, el, followKey, group, icon, listBox, number, row, rows, setText, short, text, titleOf } from "../core/controls.js";
import { loadFrom, uploadField } from "./cage.js";
import { things } from "../view/things.js";
import { EASINGS, LOOPS, add, change, choose, chosenKey, ease, easingWord, film, goTo, holds, jump, onChosen, remove, seconds } from "./keys.js";

function makeKeyRow({ id }) {
  const time = el("span", { class: "row-note time" });
  const name = el("span", { class: "row-name" });
  const easing = el("span", { class: "row-note" });
  const marks = el("span", { class: "marks", "aria-hidden": "true" }, icon("key"), icon("camera"));
  const root = el("li", { id: `key-${id}`, class: "list-row", role: "option" }, time, name, easing, marks);
  root.dataset.key = id;
  root.addEventListener("click", () => {
    const key = film().keys.find((one) => one.id === id);
    goTo(key.time);
    choose(id);
  });
  const update = (key) => {
    setText(time, seconds(key.time));
    setText(name, key.name);
    setText(easing, EASINGS.find(([value]) => value === easingWord(key.easing))?.[1] ?? key.easing);
    marks.children[0].classList.toggle("off", !key.pose);
    marks.children[1].classList.toggle("off", !key.camera);
    const isChosen = chosenKey()?.id === id;
    root.setAttribute("aria-selected", String(isChosen));
    root.setAttribute("aria-label", `${key.name} at ${seconds(key.time)}, ${holds(key)}, ${easingWord(key.easing)}`);
  };
  return { root, update };
}

/** Moves of a camera, by their words: as `warpcage animate --cameras` has them. */
const MOVES = [
  ["turn", "Turn, through what pictures saw"],
  ["turn:360", "All the way round"],
  ["turn:90", "A quarter to the side"],
  ["dolly", "Dolly in"],
  ["dolly:1.6", "Dolly out"],
  ["crane", "Crane up"],
  ["crane:-25", "Crane down"],
  ["hand-held", "Hand-held"],
  ["follow", "Follow the active cage"],
];

async function moveCamera() {
  const { length, keys } = film();
  let result = null;
  await askFor({
    title: "Camera move",
    text: `From the view as it is, about its middle, over the ${seconds(length)} of the film.${keys.some(({ camera }) => camera) ? " It replaces the cameras of the keys." : ""}`,
    fields: [
      { name: "move", label: "Move", type: "choice", value: "turn", choices: MOVES },
      { name: "words", label: "Or in words", type: "text", value: "", optional: true, help: "turn:DEGREES, dolly:SHARE, crane:DEGREES, hand-held:SEED or follow, several joined by +: dolly:0.7+hand-held." },
    ],
    confirm: "Make keys",
    send: async ({ words, move }) => (result = await ask({ do: "camera.move", move: words || move })),
  });
  if (result?.note) toast(result.note);
}

/** The group of the keys: {root, start()}. */
export function keysGroup() {
  const onKey = (event) => {
    const ways = { ArrowUp: () => jump(-1), ArrowDown: () => jump(1), Delete: remove, Enter: () => document.getElementById("key-name").select() };
    if (!(event.ctrlKey || event.metaKey || event.altKey)) followKey(ways, event);
  };
  const list = listBox({
    id: "key-list",
    label: "Keys",
    title: "Up and Down go from key to key, Enter renames, Delete deletes",
    empty: "No keys yet. Pose the cage, choose a time on the timeline, and add a key.",
    onKey,
    make: makeKeyRow,
  });
  const name = text({ id: "key-name", label: "Name", title: "Name of the chosen key (Enter keeps it)", maxlength: 100, onChange: (to) => change({ name: to }) });
  const time = number({ id: "key-time", label: "Time", title: "Time of the chosen key", min: 0, max: 3600, unit: "s", onChange: (to) => change({ time: to }) });
  const easing = choice({ id: "key-easing", label: "Easing", title: "How the way to the next key goes", options: EASINGS, onChange: ease });
  const takeCurve = (to) => change({ easing: { bezier: to.split(/[\s,]+/).map(Number) } });
  const curve = text({ id: "key-curve", label: "Curve", title: "The curve's handles, as CSS has them: time and way of the first, then of the second, each from 0 to 1; the way may go beyond", onChange: takeCurve });
  const details = el(
    "div",
    { id: "key-details", class: "stack" },
    name.root,
    time.root,
    easing.root,
    curve.root,
    row(
      button({ id: "key-take-pose", label: "Take pose", title: "The chosen key takes the pose as it is now", onClick: () => change({ pose: true }) }),
      button({ id: "key-take-camera", label: "Take camera", title: "The chosen key takes the camera as it is now", onClick: () => change({ camera: true }) }),
      button({ id: "key-delete", label: "Delete the key", icon: "delete", title: "Delete the chosen key (Delete in the list or on the timeline)", onClick: remove }),
    ),
  );
  const adds = row(
    button({ id: "key-add", label: "Add key", icon: "plus", keep: true, title: titleOf("Key of pose and camera at the present time", "key.insert"), onClick: () => add(true, true) }),
    button({ id: "key-add-pose", label: "Pose", title: "Key of the pose alone at the present time", onClick: () => add(true, false) }),
    button({ id: "key-add-camera", label: "Camera", title: "Key of the camera alone at the present time", onClick: () => add(false, true) }),
    button({ id: "camera-move", label: "Move…", title: "Keys of a camera that moves over the whole film: turn, dolly, crane, hand-held, follow", onClick: moveCamera }),
  );
  const made = group("keys", "Keys", false, ...list.parts, adds, details);
  const show = () => {
    const { keys } = film();
    const key = chosenKey();
    list.show(keys, key && `key-${key.id}`);
    setText(made.note, keys.length ? String(keys.length) : "");
    details.hidden = !key;
    if (!key) return;
    document.getElementById(`key-${key.id}`)?.scrollIntoView({ block: "nearest" });
    name.set(key.name);
    time.set(key.time);
    easing.set(easingWord(key.easing));
    curve.root.hidden = !key.easing.bezier;
    curve.set(key.easing.bezier?.map((number) => short(number)).join(", ") ?? "");
  };
  const start = () => {
    store.on("timeline", show);
    onChosen(show);
    show();
  };
  return { root: made.root, start };
}

const sizes = () => {
  const { width = 800, height = 600, scale = 1 } = store.status.frame ?? {};
  const even = (value) => 2 * Math.round(value / 2);
  const isSlow = store.sections.session?.device === "cpu"; // half a second a picture and more, at full size
  const full = isSlow ? 640 : Math.max(640, width / scale); // pictures are smaller while something moves
  return [
    { name: "width", label: "Width", type: "number", value: even(full), min: 16, max: 4096, step: 2, unit: "pixels" },
    { name: "height", label: "Height", type: "number", value: even((full * height) / width), min: 16, max: 4096, step: 2, unit: "pixels" },
  ];
};
const overlay = { name: "overlay", label: "Draw the cage", type: "check", value: false };
const transparent = { name: "transparent", label: "Transparent background", type: "check", value: true };
const shape = {
  name: "ending",
  label: "Format",
  type: "choice",
  value: ".obj",
  choices: [
    [".obj", "OBJ"],
    [".ply", "PLY"],
    [".glb", "glTF (GLB)"],
  ],
};

/** What can be exported: [what, label, title, name of the file, fields]. */
const EXPORTS = [
  ["mp4", "MP4 film", "The film as MP4", "film.mp4", () => [...sizes(), overlay]],
  ["gif", "GIF", "The film as GIF", "film.gif", () => [...sizes(), overlay]],
  ["mov", "ProRes film", "The film as ProRes 4444 with alpha, for editing programs", "film.mov", () => [...sizes(), transparent, overlay]],
  ["webm", "WebM film", "The film as WebM with alpha, for web pages", "film.webm", () => [...sizes(), transparent, overlay]],
  ["png", "PNG pictures", "The film as numbered PNG pictures with alpha, in a folder", "film", () => [...sizes(), transparent, overlay]],
  ["cage", "Posed cage", "The posed cage as a mesh", "posed", () => [shape]],
  ["poses", "Poses", "The keys' poses of the active edit in one file", "poses.json", () => []],
  ["bake", "Baked field", "The deformed scene as a field of its own", "bent.npz", () => []],
];

function helpOf(what) {
  const { folder = "the session's folder" } = store.sections.session ?? {};
  return what === "png" ? `A new folder for the pictures, in ${folder}.` : `Is written into ${folder}; it can be downloaded when it is done.`;
}

async function exportAs([what, label, , usual, fields]) {
  const hasSplats = things().some(({ visible, size }) => visible && size.endsWith("splats"));
  const file = what === "bake" && hasSplats ? "bent.ply" : usual;
  await askFor({
    title: `Export: ${label}`,
    fields: [{ name: "file", label: what === "png" ? "Folder" : "File", type: "text", value: file, help: helpOf(what) }, ...fields()],
    confirm: "Export",
    send: ({ file: name, ...given }) => {
      const { ending = "" } = given;
      return ask({ do: "export", what, file: name.endsWith(ending) ? name : name + ending, ...given });
    },
  });
}

async function showCommand() {
  let result = null;
  await askFor({
    title: "Command line of the film",
    fields: [{ name: "file", label: "File", type: "text", value: "film.mp4", help: "What the command writes." }, ...sizes(), overlay],
    confirm: "Show",
    send: async (given) => (result = await ask({ do: "export.command", ...given })),
  });
  if (result) showText("Command line", "This makes the same film without the editor:", result.command);
}

/** The group of the film: {root, start()}. */
export function filmGroup() {
  const length = number({ id: "film-length", label: "Length", title: "Length of the film, not before its last key", min: 0.1, max: 3600, step: 0.5, unit: "s", onChange: (value) => request({ do: "timeline", length: value }) });
  const fps = number({ id: "film-fps", label: "Rate", title: "Pictures a second", min: 1, max: 240, step: 1, unit: "fps", onChange: (value) => request({ do: "timeline", fps: value }) });
  const loop = choice({ id: "film-loop", label: "At the end", title: "What the film does at its end", options: LOOPS, onChange: (value) => request({ do: "timeline", loop: value }) });
  const grid = el("div", { class: "grid" });
  for (const one of EXPORTS) grid.append(button({ id: `export-${one[0]}`, label: `${one[1]}…`, title: one[2], onClick: () => exportAs(one) }));
  const command = button({ id: "export-command", label: "Command line…", title: "The warpcage command that makes the same film without the editor", onClick: showCommand });
  const upload = uploadField("poses-upload-file", "Pose file", ".json", (file) => request({ do: "poses.load", file }));
  const poses = row(
    button({ id: "poses-load", label: "Load…", title: "Load a pose file of the session's folder into the timeline", onClick: () => loadFrom("poses", "Load poses", "poses.load") }),
    button({ id: "poses-upload", label: "Upload…", title: "Send a pose file from this computer", onClick: () => upload.click() }),
  );
  const made = group("film", "Film", false, length.root, fps.root, loop.root, el("h3", {}, "Export"), grid, command, el("h3", {}, "Pose files"), poses, upload);
  const show = () => {
    const { length: long, fps: rate, loop: way } = film();
    length.set(long);
    fps.set(rate);
    loop.set(way);
  };
  const start = () => {
    store.on("timeline", show);
    show();
  };
  return { root: made.root, start };
}

/** Makes rows of jobs: `place` begins their ids, `clear` takes one off. */
const jobRows = (place, clearing, clear) => ({ id }) => {
  const name = el("span", { class: "row-name" });
  const note = el("span", { class: "job-text", role: "status" });
  const bar = el("progress", { max: 1, "aria-label": "Progress" });
  const cancel = button({ label: "Cancel", title: "Stop this work", kind: "flat", onClick: () => request({ do: "job.cancel", id }) });
  const close = button({ label: clearing, icon: "close", kind: "flat", onClick: () => clear(id) });
  const download = el("a", { class: "button primary", download: true }, icon("download"), el("span", {}, "Download"));
  const root = el("li", { id: `${place}-${id}`, class: "job" }, el("div", { class: "row" }, name, cancel, close), bar, note, download);
  const update = (job) => {
    root.dataset.state = job.state;
    setText(name, job.name);
    name.title = job.name;
    const isRunning = job.state === "running";
    bar.hidden = cancel.hidden = !isRunning;
    close.hidden = isRunning;
    if (job.share === null || job.share === undefined) bar.removeAttribute("value");
    else bar.value = job.share;
    bar.setAttribute("aria-label", `Progress of ${job.name}`);
    const words = { done: "Done", failed: "Failed", cancelled: "Cancelled" };
    const texts = isRunning ? [job.text] : [job.state === "failed" ? null : words[job.state], job.result ?? job.text];
    setText(note, texts.filter(Boolean).join(": "));
    download.hidden = !job.download;
    if (job.download) {
      download.href = job.download;
      download.title = `Download ${job.result ?? job.name}`;
    }
  };
  return { root, update };
};

/** The group of the work that runs or ran: {root, start()}. What runs is shown over the view too, and what came of it. */
export function jobsGroup() {
  const list = el("ul", { id: "job-list", class: "jobs", "aria-label": "Jobs" });
  const empty = el("p", { class: "note" }, "Nothing runs. Cages and exports that take a while are shown here.");
  const made = group("jobs", "Jobs", false, list, empty);
  const showRows = rows(list, jobRows("job", "Take off the list", (id) => request({ do: "job.clear", id })));
  const leave = (id) => {
    watched.delete(id);
    show();
  };
  const showWork = rows(document.getElementById("work"), jobRows("work", "Hide; the group Jobs keeps it", leave));
  const watched = new Set(); // what has run since this page was opened, however short
  let known = null; // the numbers of all jobs so far
  let before = 0;
  const show = () => {
    const jobs = (store.sections.jobs ?? []).toReversed(); // the newest first
    showRows(jobs);
    for (const { id, state } of jobs) if (state === "running" || (known && !known.has(id))) watched.add(id);
    if (store.sections.jobs) known = new Set(jobs.map(({ id }) => id));
    showWork(jobs.filter(({ id, state, download }) => watched.has(id) && (state === "running" || state === "failed" || download)));
    empty.hidden = jobs.length > 0;
    const running = jobs.filter(({ state }) => state === "running").length;
    setText(made.note, running ? `${running} running` : jobs.length ? String(jobs.length) : "");
    if (running > before) made.root.open = true;
    before = running;
  };
  const start = () => {
    store.on("jobs", show);
    show();
  };
  return { root: made.root, start };
}
