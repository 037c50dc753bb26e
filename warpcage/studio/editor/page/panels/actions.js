// The page's own actions, and the keys that run them and all others. view/selecting.js has those of selection, view and
// transforms, toolbar.js those of its buttons.

import { actionOf, actions, choices, register, run, store } from "../core/store.js";
import { request } from "../core/connection.js";
import { showHelp } from "../core/dialogs.js";
import { add } from "./keys.js";

const NAMED = { " ": "Space", Esc: "Escape", Del: "Delete", Left: "ArrowLeft", Right: "ArrowRight" };

/** The name of the pressed key as actions write it: "Ctrl+Shift+Z", "Shift+1", "?", "Ctrl++". */
export function keyName(event) {
  let key = NAMED[event.key] ?? event.key;
  const digit = /^Digit(\d)$/.exec(event.code ?? "");
  if (digit) key = digit[1]; // Shift+1 is "!" on some keyboards, "+" on others
  // On some systems Alt makes other letters of the keys
  const letter = /^Key([A-Z])$/.exec(event.code ?? "");
  if (letter && event.altKey && !/^[a-z]$/i.test(key)) key = letter[1];
  const isSign = key.length === 1 && !/^[a-z0-9]$/i.test(key);
  if (key.length === 1) key = key.toUpperCase();
  let name = "";
  if (event.ctrlKey || event.metaKey) name += "Ctrl+";
  if (event.altKey) name += "Alt+";
  if (event.shiftKey && !isSign) name += "Shift+";
  return name + key;
}

/** Whether the focused element takes this key itself: a text field all of them, a button Space and Enter. */
function isTakenBy(element, event) {
  if (!(element instanceof HTMLElement)) return false;
  if (element.isContentEditable || element.closest("dialog[open]")) return true;
  const tag = element.tagName;
  const isField = tag === "INPUT" || tag === "TEXTAREA" || tag === "SELECT";
  const isChoice = tag === "INPUT" && ["checkbox", "radio", "range", "color", "button", "file"].includes(element.type);
  if (isField && !isChoice) return true;
  const works = [" ", "Enter"].includes(event.key) || event.key.startsWith("Arrow") || ["Home", "End"].includes(event.key);
  const isPlain = !(event.ctrlKey || event.metaKey || event.altKey);
  const isWidget = isChoice || ["BUTTON", "A", "SUMMARY"].includes(tag) || (element.tabIndex >= 0 && tag !== "CANVAS");
  return isWidget && works && isPlain;
}

/** Runs the action of a pressed key; listens once, from main.js. */
export function listenToKeys() {
  window.addEventListener("keydown", (event) => {
    if (event.defaultPrevented || event.isComposing || document.querySelector("dialog[open]")) return;
    if (isTakenBy(event.target, event)) return;
    const name = actionOf(keyName(event));
    if (!name) return;
    event.preventDefault();
    if (event.repeat && !actions.get(name).repeat) return;
    run(name, event);
  });
}

const next = (values, value) => values[(values.indexOf(value) + 1) % values.length];
const choose = (name, value) => () => store.setTool(name, value);
const toggle = (name) => () => store.setTool(name, !store.tools[name]);
const cycle = (name) => () => store.setTool(name, next(choices[name].map(([value]) => value), store.tools[name]));

for (const [name, label, keys] of [["undo", "Undo", ["Ctrl+Z"]], ["redo", "Redo", ["Ctrl+Shift+Z", "Ctrl+Y"]]]) {
  // sent even where the page knows of no step: that just made may not have arrived yet
  register(name, { label, keys, group: "Edit", repeat: true, run: () => request({ do: name }) });
}
register("key.insert", { label: "Add a key of pose and camera at the current time", keys: ["K"], group: "Timeline", run: () => add(true, true) });
register("play", {
  label: "Play or pause",
  keys: ["Space"],
  group: "Timeline",
  // with the next picture, as a time that the head was just put to: sent after this one it would stop the film
  run() {
    const on = !store.sections.playback?.playing;
    requestAnimationFrame(() => request({ do: "play", on }));
  },
});
register("help", { label: "Help: all keys", keys: ["?", "F1", "H"], group: "Page", run: () => showHelp() });

register("tool.select", { label: "Tool: select", keys: ["W"], group: "Tools", run: choose("tool", "select") });
register("tool.move", { label: "Tool: move (gizmo)", keys: ["Shift+G"], group: "Tools", run: choose("tool", "move") });
register("tool.rotate", { label: "Tool: rotate (gizmo)", keys: ["Shift+R"], group: "Tools", run: choose("tool", "rotate") });
register("tool.scale", { label: "Tool: scale (gizmo)", keys: ["Shift+S"], group: "Tools", run: choose("tool", "scale") });
register("pick.rectangle", { label: "Rectangle selection", keys: ["B"], group: "Select", run: choose("pick", "rectangle") });
register("pick.lasso", { label: "Lasso selection", keys: ["C"], group: "Select", run: choose("pick", "lasso") });
register("pick.through", { label: "X-ray: select hidden parts too", keys: ["Alt+Z"], group: "Select", run: toggle("through") });
register("proportional", { label: "Proportional editing", keys: ["O"], group: "Tools", run: toggle("proportional") });
register("falloff", { label: "Next falloff", keys: ["Shift+O"], group: "Tools", run: cycle("falloff") });
register("axes", { label: "Next axes: world, view, local", keys: [","], group: "Tools", run: cycle("axes") });
register("symmetry", { label: "Next mirror plane: none, x, y, z", keys: ["M"], group: "Tools", run: cycle("symmetry") });
register("snap", { label: "Snap to steps", keys: ["N"], group: "Tools", run: toggle("snap") });
register("grid", { label: "Draw the ground as a grid", keys: ["Shift+D"], group: "View", run: toggle("grid") });
register("cage", { label: "Show the cage", keys: ["Alt+Shift+Z"], group: "View", run: toggle("cage") });
