// The header, the tools at the left of the view and the options of those that are on.

import { actions, choices, keep, kept, register, run, STARTED_ANEW, store } from "../core/store.js";
import { request } from "../core/connection.js";
import { waitingFor } from "../view/objects.js";
import { sendSize } from "../view/viewport.js";
import { choice, el, icon, number, perPicture, segments, setText, titleOf } from "../core/controls.js";

const THEME = "warpcage.theme";
const PANEL = "warpcage.panel";
const THEMES = ["auto", "light", "dark"];

let theme = THEMES.includes(kept(THEME)) ? kept(THEME) : "auto";

function setTitle(element, title) {
  element.title = title;
  element.setAttribute("aria-label", title);
}

function showTheme() {
  if (theme === "auto") delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = theme;
  const name = { auto: "same as the system", light: "light", dark: "dark" }[theme];
  setTitle(document.getElementById("theme"), `Theme: ${name}. Click to change.`);
}

function nextTheme() {
  theme = THEMES[(THEMES.indexOf(theme) + 1) % THEMES.length];
  keep(THEME, theme);
  showTheme();
  sendSize();
}

function showPanel(isOpen) {
  document.body.classList.toggle("panel-closed", !isOpen);
  document.getElementById("panel").inert = !isOpen;
  document.getElementById("panel-toggle").setAttribute("aria-expanded", String(isOpen));
}

function togglePanel() {
  const isOpen = document.body.classList.contains("panel-closed");
  keep(PANEL, isOpen ? "open" : "closed");
  showPanel(isOpen);
}

/** What a key of the tool's button says: the first of its action's, in few signs. */
function badge(action) {
  const key = actions.get(action)?.keys[0] ?? "";
  return key.replace("Shift+", "⇧").replace("Ctrl+", "^").replace("Alt+", "⌥");
}

/** Gives the buttons of index.html their pictures, titles and keys. */
function dress() {
  for (const element of document.querySelectorAll("button[data-icon]")) {
    const { icon: name, label, action } = element.dataset;
    element.replaceChildren(icon(name));
    setTitle(element, titleOf(label, action));
    const text = element.closest("#tools") ? badge(action) : "";
    if (text) element.append(el("span", { class: "badge", "aria-hidden": "true" }, text));
  }
}

function onClick(event) {
  const element = event.target.closest("button[data-icon]");
  if (!element) return;
  if (element.id === "theme") nextTheme();
  else run(element.dataset.action, event);
}

function buildOptions() {
  const choose = (name, label, title, bare) => choice({ id: name, label, title: titleOf(title, name), options: choices[name], bare, onChange: (value) => store.setTool(name, value) });
  const percent = (id, name, label, title, range) => number({ id, label, title, ...range, unit: "%", onChange: (value) => store.setTool(name, value / 100) });
  const axes = choose("axes", "Axes", "Axes for Move, Rotate and Scale", true);
  const symmetry = choose("symmetry", "Symmetry", "Mirror what you do across the middle of the cage", true);
  document.getElementById("options-place").append(axes.root, symmetry.root);
  const radius = percent("radius", "radius", "Radius", "Radius of proportional editing in percent of the cage's size; the wheel changes it while you drag", { min: 1, max: 200, step: 5 });
  const falloff = choose("falloff", "Falloff", "How the effect falls off with distance");
  const step = percent("snap-step", "step", "Step", "Snap step in percent of the cage's size; a rotation snaps to as many degrees", { min: 0.1, max: 100, step: 1 });
  const near = el("div", { class: "chip", id: "proportional-options" }, radius.root, falloff.root);
  const steps = el("div", { class: "chip", id: "snap-options" }, step.root);
  document.getElementById("tool-options").append(near, steps);
  return () => {
    const { tools } = store;
    axes.set(tools.axes);
    symmetry.set(tools.symmetry);
    radius.set(100 * tools.radius);
    falloff.set(tools.falloff);
    step.set(100 * tools.step);
    near.hidden = !tools.proportional;
    steps.hidden = !tools.snap;
  };
}

function buildMode() {
  const mode = segments({
    id: "mode",
    label: "What is edited",
    options: [
      ["pose", "Pose", "Pose the cage: the scene follows (Q)"],
      ["rest", "Rest", "Fit the cage to the scene before it is posed (Q)"],
      ["place", "Place", "Move, rotate and scale whole objects (T)"],
    ],
    value: "pose",
    onChange: (value) => request({ do: "settings", mode: value }),
  });
  document.getElementById("mode-place").append(mode.root);
  return mode.set;
}

function showHistory() {
  const { undo = 0, redo = 0, undo_label, redo_label } = store.sections.history ?? {};
  for (const [id, label, count, what] of [
    ["undo", "Undo", undo, undo_label],
    ["redo", "Redo", redo, redo_label],
  ]) {
    const element = document.getElementById(id);
    element.disabled = !count;
    setTitle(element, titleOf(count && what ? `${label}: ${what}` : label, id));
  }
}

function showTools() {
  for (const element of document.querySelectorAll("button[data-tool]")) {
    const { tool, value } = element.dataset;
    const isOn = value ? store.tools[tool] === value : Boolean(store.tools[tool]);
    element.setAttribute("aria-pressed", String(isOn));
  }
}

function showPicks() {
  for (const element of document.querySelectorAll("button[data-mode]")) {
    element.setAttribute("aria-pressed", String(element.dataset.mode === store.sections.selection?.mode));
  }
}

const clock = (time) => {
  const moment = new Date(time);
  if (Number.isNaN(moment.getTime())) return "";
  return moment.toLocaleTimeString([], { hour: "2-digit", minute: "2-digit" });
};

/** Whether the page is connected and the session saved. */
function connectionText() {
  const { connected, attempts, refused } = store.status;
  const { saved, save_error: error, folder, name } = store.sections.session ?? {};
  if (refused) return ["lost", "Started anew", `${STARTED_ANEW}. What the one before had is saved.`];
  if (!connected) return attempts ? ["lost", "Reconnecting…", "Looking for the editor; your work is saved"] : ["wait", "Connecting…", ""];
  if (error) return ["lost", "Not saved", error];
  if (!saved) return ["wait", "Saving…", "This happens automatically"];
  return ["good", "Saved", `Saved at ${clock(saved)} as ${folder}/${name}; this happens automatically`];
}

let lastFrame = null;
let restTimer = 0;

const showStatus = perPicture(() => {
  const { connected, fps, latency, frame } = store.status;
  const speed = document.getElementById("speed");
  if (frame !== lastFrame) {
    lastFrame = frame;
    clearTimeout(restTimer);
    restTimer = setTimeout(() => ((restTimer = 0), showStatus()), 1200);
  }
  // pictures come when something changes: where nothing does, none a second is no fault
  const parts = connected && frame ? [waitingFor() ?? (restTimer && fps > 1 ? `${Math.round(fps)} fps` : frame.sharp ? "at rest" : "preview")] : [];
  if (connected && latency) parts.push(`${Math.round(latency)} ms`);
  setText(speed, parts.join(" · "));
  if (frame) {
    const { width, height, ms } = frame;
    const made = ms ? `, made in ${Math.round(ms.all)} ms (pose ${Math.round(ms.pose)}, picture ${Math.round(ms.render)})` : "";
    speed.title = `Frames per second, and delay from the pointer to the picture. This frame: ${width} x ${height}${made}`;
  }
  document.body.classList.toggle("lost", !connected);
  const [state, text, title] = connectionText();
  const place = document.getElementById("connection");
  place.dataset.state = state;
  setText(place, text);
  place.title = title;
});

function showSession() {
  const { name, field } = store.sections.session ?? {};
  const title = field?.name ?? name ?? "warpcage";
  const heading = document.getElementById("scene-name");
  setText(heading, title);
  heading.title = `Scene: ${title}`;
  document.title = `${title} · warpcage`;
}

/** Gives the keys back to the view after a press of the mouse, so that Space plays and does not press it once more. */
function keepKeys() {
  const view = document.getElementById("view");
  let isPointed = false;
  const giveBack = () => view.focus({ preventScroll: true });
  window.addEventListener("pointerdown", () => (isPointed = true), { capture: true });
  window.addEventListener("keydown", () => (isPointed = false), { capture: true });
  document.addEventListener("mousedown", (event) => {
    if (event.target.closest("dialog") || !event.target.closest("button, summary")) return;
    event.preventDefault();
    giveBack();
  });
  document.addEventListener("click", ({ target }) => {
    if (isPointed && target.matches("[type=radio], [type=checkbox]") && !target.closest("dialog")) giveBack();
  });
  document.addEventListener("change", ({ target }) => {
    if (isPointed && target.matches("select") && !target.closest("dialog")) giveBack();
  });
}

/** Fills header and tools, and keeps them as the store is. */
export function start() {
  register("panel", { label: "Side panel", keys: ["P"], group: "Page", run: togglePanel });
  register("theme", { label: "Next theme: system, light, dark", group: "Page", run: nextTheme });
  const turnTo = (mode, other) => () => request({ do: "settings", mode: store.sections.settings?.mode === mode ? other : mode });
  register("mode", { label: "Switch between Pose and Rest", keys: ["Q"], group: "Edit", run: turnTo("rest", "pose") });
  register("mode.place", { label: "Switch between Place and Pose", keys: ["T"], group: "Edit", run: turnTo("place", "pose") });
  dress();
  showTheme();
  showPanel(kept(PANEL) ? kept(PANEL) === "open" : window.innerWidth > 900);
  const showOptions = buildOptions();
  const showMode = buildMode();
  document.addEventListener("click", onClick);
  keepKeys();
  store.on("settings", ({ mode }) => showMode(mode));
  store.follow(["tools"], () => (showTools(), showOptions()));
  store.follow(["selection"], showPicks);
  store.follow(["history"], showHistory);
  store.on("session", showSession);
  store.follow(["session", "status", "objects"], showStatus);
}
