// Toasts, questions and help. Dialogs are the browser's own: they keep the focus inside, Escape closes them.

import { actions, store } from "./store.js";
import { button, check, choice, el, number, setText, text } from "./controls.js";

const STAYS = { info: 4000, warning: 7000, error: 10000 }; // milliseconds
const MAX_TOASTS = 4; // at once

export function toast(message, level = "info") {
  const list = document.getElementById("toasts");
  const same = [...list.children].find(({ dataset }) => dataset.text === message);
  same?.remove();
  const times = Number(same?.dataset.times ?? 0) + 1;
  const content = el("span", { class: "toast-text" }, times > 1 ? `${message} (${times} times)` : message);
  const item = el("div", { class: `toast ${level}`, role: level === "error" ? "alert" : "status" }, content);
  Object.assign(item.dataset, { text: message, times });
  item.append(button({ label: "Close this message", icon: "close", kind: "flat", onClick: () => item.remove() }));
  let timer = 0;
  const leave = () => (timer = setTimeout(() => item.remove(), STAYS[level] ?? STAYS.info));
  item.addEventListener("pointerenter", () => clearTimeout(timer));
  item.addEventListener("pointerleave", leave);
  list.append(item);
  while (list.children.length > MAX_TOASTS) list.firstChild.remove();
  list.hidePopover();
  list.showPopover(); // above a dialog that is open
  leave();
}

/** Opens a dialog with content and a row of buttons; returns what closes it. The focus goes back where it was. */
function open(title, content, buttons, { wide = false, onClosed } = {}) {
  const before = document.activeElement;
  const heading = el("h2", { id: "dialog-title" }, title);
  const form = el("form", { method: "dialog" }, heading, content, el("div", { class: "dialog-buttons" }, ...buttons));
  const dialog = el("dialog", { class: wide ? "dialog wide" : "dialog", "aria-labelledby": "dialog-title" }, form);
  const close = () => dialog.close();
  dialog.addEventListener("close", () => {
    dialog.remove();
    if (before instanceof HTMLElement && before.isConnected) before.focus();
    onClosed?.();
  });
  // a press on what is behind closes it, a drag that only ends there does not
  dialog.addEventListener("pointerdown", (event) => event.target === dialog && close());
  document.body.append(dialog);
  dialog.showModal();
  return { dialog, form, close };
}

/** Choices as [value, label]; a value may be a number or null, and comes back as such. */
const pairsOf = (choices) => choices.map((one) => (Array.isArray(one) ? one : [one, one]));

function fieldOf({ type, name, choices, ...given }) {
  const options = { ...given, id: `ask-${name}`, title: given.help ?? given.label };
  if (type === "number") return number(options);
  if (type === "choice") {
    const pairs = pairsOf(choices);
    const at = Math.max(0, pairs.findIndex(([value]) => value === given.value));
    return choice({ ...options, value: String(at), options: pairs.map(([, label], i) => [String(i), label]) });
  }
  if (type === "check") return check(options);
  return text({ ...options, maxlength: 200 });
}

function contentOf({ input }, { type, choices }) {
  if (type === "check") return input.checked;
  if (type === "number") return input.value === "" ? null : input.valueAsNumber;
  return type === "choice" ? pairsOf(choices)[input.selectedIndex][0] : input.value.trim();
}

/**
 * Asks for some values: {title, text?, fields: [{name, label, type: "number"|"text"|"choice"|"check", value, choices?,
 * min?, max?, step?, unit?, help?, optional?, shown?(values)}], note?(values), confirm, send?}. A promise of {name: value},
 * or null where it was left. note: what is said of the values as they are now.
 * send(values): what is done with them, a promise; while it fails the dialog stays with what was typed and says why.
 */
export function askFor({ title, text: intro, fields, note: describe = null, confirm = "OK", send = null }) {
  return new Promise((resolve) => {
    let result = null;
    const controls = fields.map((field) => fieldOf(field));
    const body = el("div", { class: "dialog-body" }, intro ? el("p", {}, intro) : null);
    fields.forEach((field, index) => {
      const { root, input } = controls[index];
      if (!field.optional && field.type !== "check") input.required = true;
      body.append(root);
      if (!field.help) return;
      const note = el("p", { class: "note", id: `ask-${field.name}-help` }, field.help);
      input.setAttribute("aria-describedby", note.id);
      body.append(note);
    });
    const yes = el("button", { id: "dialog-confirm", type: "submit", class: "button primary", title: `${confirm} (Enter)` }, confirm);
    const no = button({ id: "dialog-cancel", label: "Cancel", title: "Cancel (Escape)", onClick: () => close() });
    const failed = el("p", { id: "dialog-error", class: "dialog-error", role: "alert" });
    failed.hidden = true;
    const noteLine = el("p", { id: "dialog-note", "aria-live": "polite" });
    body.append(...(describe ? [noteLine] : []), failed);
    const valuesNow = () => Object.fromEntries(fields.map((field, index) => [field.name, contentOf(controls[index], field)]));
    const show = () => {
      const values = valuesNow();
      fields.forEach(({ shown }, index) => shown && (controls[index].root.hidden = !shown(values)));
      if (describe) setText(noteLine, describe(values));
    };
    show();
    const stop = store.on("status", show); // which pictures have come
    const { form, close } = open(title, body, [no, yes], { onClosed: () => (stop(), resolve(result)) });
    for (const event of ["input", "change", "keyup"]) form.addEventListener(event, show);
    form.addEventListener("submit", async (event) => {
      const values = valuesNow();
      if (!send) return (result = values);
      event.preventDefault();
      yes.disabled = true;
      try {
        await send(values);
        result = values;
        close();
      } catch (error) {
        failed.hidden = false;
        setText(failed, error.message);
        failed.scrollIntoView({ block: "nearest" });
      }
      yes.disabled = false;
      return undefined;
    });
    form.addEventListener("keydown", (event) => {
      // fields of text do so by themselves
      if (event.key !== "Enter" || !event.target.matches("select, [type=checkbox]")) return;
      event.preventDefault();
      form.requestSubmit(yes);
    });
    (controls[0]?.input ?? yes).focus();
    controls[0]?.input.select?.();
  });
}

export async function confirmThat(title, question, confirm) {
  return (await askFor({ title, text: question, fields: [], confirm })) !== null;
}

/** Copies a text; pages of plain http have no clipboard of their own. */
export async function copyText(content) {
  try {
    await navigator.clipboard.writeText(content);
  } catch {
    const area = el("textarea");
    area.style.position = "fixed"; // nothing moves for it
    area.value = content;
    (document.querySelector("dialog") ?? document.body).append(area);
    area.select();
    document.execCommand("copy");
    area.remove();
  }
  toast("Copied.");
}

export function showText(title, intro, content) {
  const area = el("textarea", { id: "dialog-text", readonly: true, rows: 4, "aria-label": title, spellcheck: "false" });
  area.value = content;
  const copy = button({ id: "dialog-copy", label: "Copy", icon: "copy", keep: true, kind: "primary", onClick: () => copyText(content) });
  const body = el("div", { class: "dialog-body" }, el("p", {}, intro), area);
  const done = button({ label: "Close", title: "Close (Escape)", onClick: () => opened.close() });
  const opened = open(title, body, [done, copy], { wide: true });
  copy.focus();
}

const MOUSE = [
  ["Click", "Select; with Shift add or take away"],
  ["Drag elsewhere", "Rectangle or lasso; Shift adds, Ctrl takes away"],
  ["Drag, with the brush", "Paint the selection; with Alt or Ctrl take away; [ and ] change the brush"],
  ["Drag, with the box", "A box cage around a part; a drag of a dot moves that side"],
  ["Drag, with landmarks", "Take a place of the object along: the cage follows. A click pins a place, Delete deletes it"],
  ["Click, with the ruler", "The distance between two points"],
  ["Drag a vertex", "Move it, or the selection that it belongs to"],
  ["Right drag", "Orbit; with Shift pan, with Ctrl zoom. So do the middle button and Alt+drag"],
  ["Wheel", "Zoom; while moving: the radius of proportional editing"],
  ["One finger, two", "Orbit or select, by the switch that touch screens show; pan and zoom"],
];
const MOVING = [
  [["X", "Y", "Z"], "Along one axis; again: other axes, none"],
  [["Shift+X"], "Along the two other axes"],
  [["0–9"], "Exact amount; Tab: the next number"],
  [["Shift"], "Slower, for precision"],
  [["Ctrl"], "Snap to steps; no snapping where Snap is on"],
  [["Enter", "Escape"], "Keep, take back"],
];
const TIMELINE = [
  [["←", "→"], "A frame back or on; with Shift ten"],
  [["↑", "↓"], "Previous key, next key"],
  [["Alt+←", "Alt+→"], "Move the selected key in time"],
  [["Home", "End"], "Start and end of the film"],
  [["Enter"], "Add a key of pose and camera"],
  [["Delete"], "Delete the selected key"],
  [["Drag a ring"], "Shape the custom curve from the selected key to the next"],
];
const SIGNS = { ArrowLeft: "←", ArrowRight: "→", ArrowUp: "↑", ArrowDown: "↓" };

function keyRow(keys, label) {
  const named = keys.map((key) => key.replace(/Arrow(Left|Right|Up|Down)/, (sign) => SIGNS[sign]));
  const shown = named.flatMap((key, index) => (index ? [" ", el("kbd", {}, key)] : [el("kbd", {}, key)]));
  return el("div", { class: "key-row" }, el("dt", {}, ...shown), el("dd", {}, label));
}

export function showHelp() {
  const groups = new Map();
  for (const { label, keys, group } of actions.values()) {
    if (!keys.length) continue;
    if (!groups.has(group)) groups.set(group, []);
    groups.get(group).push(keyRow(keys, label));
  }
  const body = el("div", { class: "dialog-body help-groups", tabindex: "0", "aria-label": "Keys by group" });
  const mouse = MOUSE.map(([what, label]) => keyRow([what], label));
  const moving = MOVING.map(([keys, label]) => keyRow(keys, label));
  const timeline = TIMELINE.map(([keys, label]) => keyRow(keys, label));
  for (const [name, list] of [["Mouse and touch", mouse], ["While moving", moving], ...groups, ["Timeline, when it has the focus", timeline]]) {
    body.append(el("section", {}, el("h3", {}, name), el("dl", {}, ...list)));
  }
  const done = button({ id: "dialog-close", label: "Close", title: "Close (Escape)", onClick: () => opened.close() });
  const opened = open("Keys", body, [done], { wide: true });
  done.focus();
}
