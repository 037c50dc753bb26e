// How the scene is shown, and how it follows its cages.

import { actions, run, store } from "../core/store.js";
import { request } from "../core/connection.js";
import { objects } from "../view/objects.js";
import { button, check, choice, el, group, number, percent, perPicture, segments, setText, titleOf } from "../core/controls.js";

const VIEWS = [
  ["view.front", "Front"],
  ["view.right", "Right"],
  ["view.top", "Top"],
  ["view.all", "All"],
];

const change = (changes) => request({ do: "settings", ...changes });

/** What the schema of the settings says of one, as a title: its description, and hints of its choices. */
function titleOfSetting({ description, labels = [] }) {
  const sentences = [description, ...labels.filter(([, , hint]) => hint).map(([, label, hint]) => `${label}: ${hint}`)];
  return sentences.map((text) => text[0].toUpperCase() + text.slice(1)).join(". ");
}

/** The field of a setting by its schema: {root, set(value)}. */
function settingField(name, schema) {
  const given = { id: name, label: schema.title, title: titleOfSetting(schema) };
  const send = (value) => change({ [name]: value });
  if (schema.type === "boolean") return check({ ...given, onChange: send });
  const options = schema.labels ?? schema.enum?.map((value) => [value, value]);
  if (!options) return number({ ...given, min: schema.minimum, max: schema.maximum, step: schema.type === "integer" ? 1 : 0.1, onChange: send });
  const values = new Map(options.map(([value]) => [String(value), value]));
  const field = choice({ ...given, options: options.map(([value, label]) => [String(value), label]), onChange: (key) => send(values.get(key)) });
  const set = (value) => {
    if (!values.has(String(value))) {
      values.set(String(value), value); // one of a file, or of another program
      field.input.append(el("option", { value }, String(value)));
    }
    field.set(value);
  };
  return { root: field.root, set };
}

/** The fields of a group of settings, which the server's schema describes, but those in `without`: {root, start()}. */
export function settingFields(group, without = []) {
  const root = el("div", { class: "stack" });
  const fields = new Map();
  const show = () => {
    const { session, settings } = store.sections;
    if (!settings || !session) return;
    if (!fields.size) {
      for (const [name, schema] of Object.entries(session.settings)) {
        if (schema.group === group && !without.includes(name)) fields.set(name, settingField(name, schema));
      }
      root.append(...[...fields.values()].map((field) => field.root));
    }
    for (const [name, field] of fields) field.set(settings[name]);
  };
  return { root, start: () => store.follow(["settings", "session"], show) };
}

/** A background as "#rrggbb", for the colour field; null where it is the field's own. */
function hexOf(background) {
  const named = { white: "#ffffff", black: "#000000", grey: "#808080", gray: "#808080" };
  if (Array.isArray(background)) return `#${background.map((part) => Math.round(255 * part).toString(16).padStart(2, "0")).join("")}`;
  if (typeof background !== "string") return null;
  return named[background] ?? (/^#[0-9a-f]{6}$/i.test(background) ? background.toLowerCase() : null);
}

function backgroundField() {
  const color = el("input", { id: "background-color", type: "color", title: "Colour behind the scene", "aria-label": "Colour of the background" });
  const kind = choice({
    id: "background",
    label: "Background",
    title: "What is behind the scene. A plain captured background is dark here in the dark theme, but not in films",
    options: [
      ["", "As captured"],
      ["white", "White"],
      ["grey", "Grey"],
      ["black", "Black"],
      ["color", "Colour"],
    ],
    onChange: (value) => change({ background: value === "color" ? color.value : value || null }),
  });
  kind.input.after(color);
  color.addEventListener("change", () => change({ background: color.value }));
  const set = (background) => {
    const hex = hexOf(background);
    if (hex && document.activeElement !== color) color.value = hex;
    const isName = ["white", "grey", "black"].includes(background);
    kind.set(background === null || background === undefined ? "" : isName ? background : "color");
    color.hidden = kind.input.value !== "color";
  };
  return { root: kind.root, set };
}

/** What the colours of the masks mean, and how much of the picture they cover. */
function legend() {
  const kinds = [
    ["fold", "Turned inside out: moved too far"],
    ["reveal", "Uncovered: no camera saw it"],
    ["outside", "Empty: the cage holds nothing there"],
    ["filled", "Filled: made up, not seen"],
  ];
  const shares = new Map();
  const lines = new Map();
  const root = el("ul", { id: "mask-legend", class: "legend", "aria-label": "Colours of the masks" });
  for (const [name, text] of kinds) {
    const share = el("span", { class: "note" });
    shares.set(name, share);
    lines.set(name, el("li", {}, el("span", { class: `swatch ${name}`, "aria-hidden": "true" }), el("span", {}, text), share));
    root.append(lines.get(name));
  }
  const show = perPicture(() => {
    root.hidden = store.sections.settings?.show !== "masks";
    lines.get("filled").hidden = !store.sections.settings?.fill;
    const { masks } = store.status.frame ?? {};
    for (const [name, share] of shares) setText(share, masks && masks[name] !== undefined ? percent(masks[name]) : "");
  });
  return { root, show };
}

/** Fills an element with the choice of what is shown; returns what sets it. */
function fillShown(root) {
  const { title, labels } = store.sections.session.settings.show;
  const made = segments({ id: "show", label: title, options: labels, onChange: (value) => change({ show: value }) });
  root.append(made.root);
  return made.set;
}

export function viewGroup() {
  const others = settingFields("picture", ["show", "background", "fill"]);
  const shown = el("div"); // a choice of what is shown, once the server has said of what
  let setShown = null;
  const background = backgroundField();
  const masks = legend();
  const toolCheck = (id, tool, label, title) => check({ id, label, title: titleOf(title, tool), value: store.tools[tool], onChange: (on) => store.setTool(tool, on) });
  const overlay = toolCheck("overlay", "cage", "Draw the cage", "Draw the cage over the picture");
  const grid = toolCheck("grid", "grid", "Draw the ground as a grid", "A floor grid under the scene, with its axes and lengths in scene units");
  const fill = check({ id: "fill", label: "Fill uncovered background", title: "Continues the background where an edit uncovers what no photo showed, once nothing moves", onChange: (on) => change({ fill: on }) });
  const viewButton = ([name, label]) =>
    button({ id: name.replace(".", "-"), label, title: titleOf(actions.get(name).label, name), onClick: () => run(name) });
  const views = el("div", { class: "grid quarters", role: "group", "aria-label": "Look from" }, ...VIEWS.map(viewButton));
  const made = group("view", "Picture", false, shown, masks.root, overlay.root, grid.root, background.root, fill.root, others.root, views);
  const show = () => {
    const { session, settings } = store.sections;
    if (!settings || !session) return;
    background.set(settings.background);
    fill.set(settings.fill);
    fill.root.hidden = settings.background !== null || !session.field.layers || objects().length > 1;
    setShown ??= fillShown(shown);
    setShown(settings.show);
    masks.show();
  };
  const start = () => {
    others.start();
    store.on("status", masks.show);
    store.on("tools", (tools) => {
      overlay.set(tools.cage);
      grid.set(tools.grid);
    });
    store.follow(["settings", "objects", "session"], show); // session: of its field, whether there is something to fill
  };
  return { root: made.root, start };
}
