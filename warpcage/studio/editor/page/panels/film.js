// Keys, the film and its exports, and the work that takes a while.

import { activeEdit, store } from "../core/store.js";
import { ask, request } from "../core/connection.js";
import { askFor, copyText, toast } from "../core/dialogs.js";
import { button, choice, el, followKey, group, icon, listBox, number, row, rows, setText, short, text, titleOf } from "../core/controls.js";
import { loadFrom, uploadField } from "./cage.js";
import { EXPORTS, exportFilm } from "./exports.js";
import { LOOPS, add, change, choose, chosenKey, counted, easingChoice, easingLabel, easingName, film, goTo, holds, jump, keysOf, onChosen, remove, seconds } from "./keys.js";

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
    setText(easing, easingLabel(key));
    marks.children[0].classList.toggle("off", !key.pose);
    marks.children[1].classList.toggle("off", !key.camera);
    const isChosen = chosenKey()?.id === id;
    root.setAttribute("aria-selected", String(isChosen));
    root.setAttribute("aria-label", `${key.name} at ${seconds(key.time)}, ${holds(key)}, ${easingName(key)}`);
  };
  return { root, update };
}

/** Moves of a camera, as `warpcage animate --cameras` names them. */
const MOVES = [
  ["turn", "Turn, within what the photos show"],
  ["turn:360", "Full turn, 360°"],
  ["turn:90", "Quarter turn, 90°"],
  ["dolly", "Dolly in"],
  ["dolly:1.6", "Dolly out"],
  ["crane", "Crane up"],
  ["crane:-25", "Crane down"],
  ["hand-held", "Hand-held"],
  ["follow", "Follow the active cage"],
];

async function moveCamera() {
  const { length, keys } = film();
  const cameras = keys.filter(({ camera }) => camera);
  let result = null;
  await askFor({
    title: "Camera move",
    text: `Starts from the current view, moves about its center and lasts the whole film, ${seconds(length)}.${cameras.length ? ` It replaces the cameras of ${counted(cameras)}; undo brings them back.` : ""}`,
    fields: [
      { name: "move", label: "Move", type: "choice", value: "turn", choices: MOVES },
      { name: "typed", label: "Or typed", type: "text", value: "", optional: true, help: "turn:DEGREES, dolly:SHARE, crane:DEGREES, hand-held:SEED or follow, several joined by +: dolly:0.7+hand-held." },
    ],
    confirm: "Make keys",
    send: async ({ typed, move }) => (result = await ask({ do: "camera.move", move: typed || move })),
  });
  if (result?.note) toast(result.note);
}

export function keysGroup() {
  const onKey = (event) => {
    const ways = { ArrowUp: () => jump(-1), ArrowDown: () => jump(1), Delete: remove, Enter: () => document.getElementById("key-name").select() };
    if (!(event.ctrlKey || event.metaKey || event.altKey)) followKey(ways, event);
  };
  const list = listBox({
    id: "key-list",
    label: "Keys",
    title: "Up and Down go from key to key, Enter renames, Delete deletes",
    empty: "No keys yet. Click a time on the timeline, pose the cage, and add a key.",
    onKey,
    make: makeKeyRow,
  });
  const name = text({ id: "key-name", label: "Name", title: "Name of the selected key (Enter keeps it)", maxlength: 100, onChange: (to) => change({ name: to }) });
  const time = number({ id: "key-time", label: "Time", title: "Time of the selected key", min: 0, max: 3600, unit: "s", onChange: (to) => change({ time: to }) });
  const easing = easingChoice({ id: "key-easing", label: "Easing", title: "How the movement to the next key goes" });
  const takeCurve = (to) => change({ easing: { bezier: to.split(/[\s,]+/).map(Number) } });
  const curve = text({ id: "key-curve", label: "Curve", title: "Bezier handles x1, y1, x2, y2 as in CSS cubic-bezier: x is time from 0 to 1, y is progress and may go beyond", onChange: takeCurve });
  const details = el(
    "div",
    { id: "key-details", class: "stack" },
    name.root,
    time.root,
    easing.root,
    curve.root,
    row(
      button({ id: "key-take-pose", label: "Update pose", title: "Replace the pose of the selected key with the current one", onClick: () => change({ pose: true }) }),
      button({ id: "key-take-camera", label: "Update camera", title: "Replace the camera of the selected key with the current one", onClick: () => change({ camera: true }) }),
      button({ id: "key-delete", label: "Delete the key", icon: "delete", title: "Delete the selected key (Delete in the list or on the timeline)", onClick: remove }),
    ),
  );
  const adds = row(
    button({ id: "key-add", label: "Add key", icon: "plus", keep: true, title: titleOf("Add a key of pose and camera at the current time", "key.insert"), onClick: () => add(true, true) }),
    button({ id: "key-add-pose", label: "Pose key", title: "Add a key of the pose alone at the current time", onClick: () => add(true, false) }),
    button({ id: "key-add-camera", label: "Camera key", title: "Add a key of the camera alone at the current time", onClick: () => add(false, true) }),
    button({ id: "camera-move", label: "Camera move…", title: "Add keys of a camera move over the whole film: turn, dolly, crane, hand-held, follow", onClick: moveCamera }),
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
    easing.set(key);
    curve.root.hidden = !key.easing.bezier;
    curve.set(key.easing.bezier?.map((number) => short(number)).join(", ") ?? "");
  };
  return { root: made.root, start: () => (onChosen(show), store.follow(["timeline"], show)) };
}

/** A line on what loading poses replaces, or null. */
function replaced() {
  const keys = keysOf(activeEdit());
  return keys.length ? `Poses of the file replace those that ${counted(keys)} ${keys.length === 1 ? "holds" : "hold"}, as do cameras, where it has some; undo brings them back.` : null;
}

export function filmGroup() {
  const length = number({ id: "film-length", label: "Length", title: "Length of the film: its last key's time until you set another, and no shorter", min: 0.1, max: 3600, step: 0.5, unit: "s", onChange: (value) => request({ do: "timeline", length: value }) });
  const fps = number({ id: "film-fps", label: "Frame rate", title: "Frames per second", min: 1, max: 240, step: 1, unit: "fps", onChange: (value) => request({ do: "timeline", fps: value }) });
  const loop = choice({ id: "film-loop", label: "At the end", title: "What the film does at its end", options: LOOPS, onChange: (value) => request({ do: "timeline", loop: value }) });
  const films = button({ id: "export-film", label: "Export film…", kind: "primary", title: "Write the film as MP4, GIF, ProRes, WebM or PNG pictures", onClick: exportFilm });
  const others = el("div", { class: "grid" });
  for (const [what, label, title, start] of EXPORTS) others.append(button({ id: `export-${what}`, label: `${label}…`, title, onClick: start }));
  const upload = uploadField("poses-upload-file", "Pose file", "poses", (file) => request({ do: "poses.load", file }));
  const poses = row(
    button({ id: "poses-load", label: "Load…", title: "Load a pose file from the session's folder into the timeline", onClick: () => loadFrom("poses", "Load poses", "poses.load", [], replaced()) }),
    button({ id: "poses-upload", label: "Upload…", title: "Upload a pose file from this computer", onClick: () => upload.click() }),
  );
  const made = group("film", "Film", false, length.root, fps.root, loop.root, films, el("h3", {}, "Other exports"), others, el("h3", {}, "Pose files"), poses, upload);
  const show = () => {
    const { length: long, fps: rate, loop: way } = film();
    length.set(long);
    fps.set(rate);
    loop.set(way);
  };
  return { root: made.root, start: () => store.follow(["timeline"], show) };
}

/** Makes rows of jobs: `place` begins their ids, `clear` takes one off. */
const jobRows = (place, clearing, clear) => ({ id }) => {
  const name = el("span", { class: "row-name" });
  const note = el("span", { class: "job-text", role: "status" });
  const bar = el("progress", { max: 1, "aria-label": "Progress" });
  const cancel = button({ label: "Cancel", title: "Cancel this job", kind: "flat", onClick: () => request({ do: "job.cancel", id }) });
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
    const ends = { done: "Done", failed: "Failed", cancelled: "Cancelled" };
    const texts = isRunning ? [job.text] : [job.state === "failed" ? null : ends[job.state], job.result ?? job.text];
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
  const empty = el("p", { class: "note" }, "No jobs. Cages that take a while and exports are listed here.");
  const folder = button({ id: "session-folder", label: "", icon: "copy", keep: true, kind: "flat", onClick: () => copyText(store.sections.session.folder) });
  const made = group("jobs", "Jobs", false, folder, list, empty);
  const showFolder = ({ folder: path }) => {
    setText(folder.querySelector("span"), `Folder: ${path.split(/[\\/]/).at(-1) || path}`);
    folder.title = `Exports and uploads go into ${path}: press to copy that`;
  };
  const showRows = rows(list, jobRows("job", "Remove from the list", (id) => request({ do: "job.clear", id })));
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
  return { root: made.root, start: () => (store.on("session", showFolder), store.follow(["jobs"], show)) };
}
