// The pieces that panels are made of: elements, fields and foldable groups. A field in use keeps what is in it:
// `set` waits until the user leaves it.

import { actions, keep, keptValues } from "./store.js";
import { AXIS_NAMES } from "../geometry/vectors.js";

const SVG = "http://www.w3.org/2000/svg";
const FOLDED = "warpcage.folded";

/** An element: el("p", {id: "a", class: "note", on: {click}}, "text", child, ...). Texts are never read as HTML. */
export function el(tag, options = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(options)) {
    if (value === undefined || value === null || value === false) continue;
    if (name === "on") for (const [event, listener] of Object.entries(value)) element.addEventListener(event, listener);
    else if (name === "class") element.className = value;
    else element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

/** An element of a drawing. */
export function svg(tag, attributes, ...children) {
  const element = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

/** One of the pictures in icons.svg. */
export const icon = (name) => svg("svg", { class: "icon", "aria-hidden": "true" }, svg("use", { href: `icons.svg#${name}` }));

export function setIcon(picture, name) {
  picture.querySelector("use").setAttribute("href", `icons.svg#${name}`);
}

/** The text as it is, written only where it differs: what stays the same is not drawn again. */
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** A title with the keys of an action: "Undo (Ctrl+Z)". */
export function titleOf(label, action) {
  const keys = actions.get(action)?.keys ?? [];
  return keys.length ? `${label} (${keys.join(", ")})` : label;
}

/** A number in few characters: 0.25, 12, 1.5. */
export const short = (value, digits = 3) => String(Number(Number(value).toFixed(digits)));

/** A share in percent that does not call a small one nothing. */
export function percent(share) {
  if (share > 0 && share < 0.001) return "under 0.1 %";
  return `${short(100 * share, share < 0.1 ? 1 : 0)} %`;
}

/** A button. {id, label, icon?, title, keep? (the label is shown too), onClick} */
export function button({ id, label, icon: name, title, keep = !name, kind = "", onClick }) {
  const hint = title ?? label;
  const element = el("button", { id, type: "button", class: `button ${kind}`, title: hint, on: { click: onClick } });
  if (name) element.append(icon(name));
  if (keep) element.append(el("span", {}, label));
  else element.setAttribute("aria-label", label);
  return element;
}

export const row = (...children) => el("div", { class: "row" }, ...children);

/** A line with a label on its left. */
function labelled(label, id, title, ...controls) {
  return el("div", { class: "field", title }, el("label", { for: id }, label), el("div", { class: "value" }, ...controls));
}

/** Keeps a field from changes while it is in use, and from writing what it has; `isTyped`: Escape takes back. */
function guarded(input, read, write, isTyped) {
  let held = false;
  let waiting; // what came meanwhile
  /** Lets the field go; what came meanwhile, if anything. */
  const letGo = () => {
    const came = waiting;
    held = false;
    waiting = undefined;
    return came;
  };
  const release = () => {
    const came = letGo();
    if (came !== undefined) write(came);
  };
  input.addEventListener("input", () => (held = true));
  input.addEventListener("pointerdown", () => (held = input.type === "range"));
  // what was typed and is the same as before makes no "change"
  for (const event of ["blur", "pointercancel"]) input.addEventListener(event, release);
  const onKey = (event) => {
    if (event.key === "Escape") write(letGo() ?? read());
    if (event.key === "Enter" || event.key === "Escape") input.blur(); // what was typed counts, and keys are the page's again
  };
  if (isTyped) input.addEventListener("keydown", onKey);
  const set = (value) => {
    if (held) waiting = value;
    else if (read() !== value) write(value);
  };
  return { set, letGo };
}

/** A number to type. {id, label, title, min, max, step, unit, value, onChange(value)?} */
export function number({ id, label, title, min, max, step = 0.1, unit = "", value = "", bare = false, onChange }) {
  // any number may be typed; `step` is what the arrow keys add
  const input = el("input", { id, type: "number", min, max, step: "any", inputmode: "decimal", title, autocomplete: "off" });
  if (bare) input.setAttribute("aria-label", label);
  let last = value;
  const write = (content) => {
    last = content;
    input.value = content === null || content === "" ? "" : short(content, 4);
  };
  write(value);
  const { set, letGo } = guarded(input, () => last, write, Boolean(onChange));
  const take = (typed) => {
    letGo();
    if (!Number.isFinite(typed)) return write(last);
    const kept = Math.min(max ?? Infinity, Math.max(min ?? -Infinity, typed));
    write(kept);
    onChange?.(kept);
  };
  if (onChange) input.addEventListener("change", () => take(input.valueAsNumber));
  input.addEventListener("keydown", (event) => {
    const way = { ArrowUp: 1, ArrowDown: -1 }[event.key];
    if (!way) return;
    event.preventDefault();
    take((input.valueAsNumber || 0) + way * step * (event.shiftKey ? 10 : 1));
  });
  const unitText = unit ? el("span", { class: "unit" }, unit) : null;
  const root = bare ? input : labelled(label, id, title, input, unitText);
  return { root, input, set };
}

/** Three numbers to type, along x, y and z. {id, label, unit, step, onChange(value, axis)} */
export function triple({ id, label, unit = "", step, onChange }) {
  const title = (axis) => `${label}, ${axis}${unit}: type a number and press Enter`;
  const fields = AXIS_NAMES.map((axis, k) => number({ id: `${id}-${axis}`, label: `${label}, ${axis}`, title: title(axis), step, bare: true, onChange: (value) => onChange(value, k) }));
  const root = el("div", { class: "place", role: "group", "aria-label": label });
  AXIS_NAMES.forEach((axis, k) => root.append(el("label", { for: `${id}-${axis}` }, axis), fields[k].input));
  const set = (values) => fields.forEach((field, k) => field.set(Number(short(values[k], 4))));
  return { root, inputs: fields.map(({ input }) => input), set };
}

/** A line of text. {id, label, title, value, onChange(text)} */
export function text({ id, label, title, value = "", maxlength = 80, onChange }) {
  const input = el("input", { id, type: "text", title, maxlength, autocomplete: "off", spellcheck: "false" });
  input.value = value;
  let last = value;
  const write = (content) => (last = input.value = content);
  const { set, letGo } = guarded(input, () => last, write, Boolean(onChange));
  const take = () => {
    const typed = input.value.trim();
    letGo();
    if (!typed) return write(last);
    last = typed;
    return onChange(typed);
  };
  if (onChange) input.addEventListener("change", take);
  return { root: labelled(label, id, title, input), input, set };
}

/** A list to choose from. {id, label, title, options: [[value, text]], onChange(value)} */
export function choice({ id, label, title, options, value, bare = false, onChange }) {
  const input = el("select", { id, title });
  if (bare) input.setAttribute("aria-label", label);
  const fill = (pairs) => input.replaceChildren(...pairs.map(([key, name]) => el("option", { value: key }, name)));
  fill(options);
  if (value !== undefined) input.value = value;
  input.addEventListener("change", () => onChange?.(input.value));
  const set = (content) => {
    const wanted = String(content ?? "");
    if (input.value !== wanted) input.value = wanted;
  };
  return { root: bare ? input : labelled(label, id, title, input), input, set, fill };
}

/** A switch. {id, label, title, value, onChange(on)} */
export function check({ id, label, title, value = false, onChange }) {
  const input = el("input", { id, type: "checkbox" });
  input.checked = value;
  input.addEventListener("change", () => onChange?.(input.checked));
  const root = el("label", { class: "check", title }, input, el("span", {}, label));
  return { root, input, set: (on) => (input.checked = Boolean(on)) };
}

/** A few choices side by side, one of them on. {id, label, options: [[value, text, title]], onChange(value)} */
export function segments({ id, label, options, value, onChange }) {
  const root = el("div", { id, class: "segments", role: "radiogroup", "aria-label": label });
  const inputs = new Map();
  for (const [key, name, title] of options) {
    const input = el("input", { id: `${id}-${key}`, type: "radio", name: id, value: key, "aria-label": name });
    input.addEventListener("change", () => onChange(key));
    inputs.set(key, input);
    root.append(el("label", { title: title ?? name }, input, el("span", {}, name)));
  }
  const set = (key) => inputs.has(key) && (inputs.get(key).checked = true);
  set(value);
  return { root, set };
}

/** A foldable group of the panel; whether it is open is kept in the browser. */
export function group(id, label, open, ...children) {
  const root = el("details", { id: `group-${id}`, class: "group" });
  const folded = keptValues(FOLDED)[id];
  root.open = folded === undefined ? open : !folded;
  const note = el("span", { class: "group-note", id: `group-${id}-note` });
  root.append(el("summary", { id: `group-${id}-fold`, title: `${label}: fold or unfold (Enter)` }, el("span", {}, label), note));
  root.append(el("div", { class: "group-body" }, ...children));
  root.addEventListener("toggle", () => keep(FOLDED, JSON.stringify({ ...keptValues(FOLDED), [id]: !root.open })));
  return { root, note };
}

/** Rows of a list, kept by key: those that stay are not made again. make(item) gives {root, update(item)}. */
export function rows(list, make) {
  const made = new Map();
  return (items) => {
    const wanted = new Set(items.map(({ id }) => id));
    for (const [id, entry] of made) {
      if (wanted.has(id)) continue;
      entry.root.remove();
      made.delete(id);
    }
    items.forEach((item, index) => {
      if (!made.has(item.id)) made.set(item.id, make(item));
      const entry = made.get(item.id);
      entry.update(item);
      if (list.children[index] !== entry.root) list.insertBefore(entry.root, list.children[index] ?? null);
    });
  };
}

/** A list to choose a row from, and the text where there is none: {parts, show(items, id of the chosen row's element)}. */
export function listBox({ id, label, title, empty, onKey, make }) {
  const list = el("ul", { id, class: "list", role: "listbox", tabindex: "0", "aria-label": label, title, on: { keydown: onKey } });
  const none = el("p", { class: "note" }, empty);
  const showRows = rows(list, make);
  const show = (items, chosen) => {
    showRows(items);
    list.hidden = !items.length;
    none.hidden = items.length > 0;
    if (chosen) list.setAttribute("aria-activedescendant", chosen);
    else list.removeAttribute("aria-activedescendant");
  };
  return { parts: [list, none], show };
}

/** A row with an eye, a name and a note: choose() by a click, hide() by its eye, rename() by a double click. */
export function listRow(id, { choose, hide, rename }, ...parts) {
  const eye = el("span", { class: "eye", title: "Show or hide (Space)", "aria-hidden": "true", on: { click: (event) => (event.stopPropagation(), hide()) } }, icon("eye"));
  const [name, note] = ["row-name", "row-note"].map((kind) => el("span", { class: kind }));
  const root = el("li", { id, class: "list-row", role: "option", on: { click: choose, dblclick: rename } }, eye, name, note, ...parts);
  const update = (item, { text, title, isChosen, label }) => {
    setText(name, item.name);
    setText(note, text);
    note.title = title;
    setIcon(eye, item.visible ? "eye" : "eye-off");
    root.setAttribute("aria-selected", String(isChosen));
    root.setAttribute("aria-label", `${item.name}, ${label}`);
    root.classList.toggle("dim", !item.visible);
  };
  return { root, update };
}

/** Does what a table of ways has for a pressed key, and keeps that key from the page's actions. */
export function followKey(ways, event) {
  if (!ways[event.key]) return;
  event.preventDefault();
  event.stopPropagation();
  ways[event.key]();
}

/** Calls a function at most once per drawn picture, with the last arguments. */
export function perPicture(work) {
  let last = null;
  return (...content) => {
    const isWaiting = last !== null;
    last = content;
    if (isWaiting) return;
    requestAnimationFrame(() => {
      const content = last;
      last = null;
      work(...content);
    });
  };
}
