// How the scene is shown, and how it follows its cages.

import { actions, run, store } from "../core/store.js";
import { request } from "../core/connection.js";
import { objects } from "../view/objects.js";
import { button, check, choice, el, group, percent, perPicture, segments, setText, titleOf } from "../core/controls.js";

const RESOLUTIONS = [16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512];
const VIEWS = [
  ["view.front", "Front"],
  ["view.right", "Right"],
  ["view.top", "Top"],
  ["view.all", "All"],
];

const DENSITIES = [
  ["opacity", "Keep opacity"],
  ["paper", "More opaque as they grow"],
];

const change = (changes) => request({ do: "settings", ...changes });

/** A choice of a setting, by its name in the settings; `read`: what is sent for a chosen value. */
const settingChoice = (name, label, title, options, read = String) =>
  choice({ id: name, label, title, options, onChange: (value) => change({ [name]: read(value) }) });

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

/** How the scene follows its cages, for all edits alike: {roots, start()}. */
export function deformationFields() {
  const coordinates = settingChoice("coordinates", "Deformation", "", []); // the server's, once it is there
  const resolution = settingChoice("resolution", "Resolution", "Grid cells along the cage's longest side: more follow sharp poses better, fewer are faster", RESOLUTIONS.map((cells) => [String(cells), `${cells} cells`]), Number);
  const density = settingChoice("density", "Density", "What happens to the opacity of parts that grow or shrink", DENSITIES);
  const show = () => {
    const { session, settings } = store.sections;
    if (!settings) return;
    if (!coordinates.input.options.length) {
      coordinates.fill(session.coordinates);
      const title = ["How the inside follows the cage", ...session.coordinates.map(([, label, help]) => `${label}: ${help}`)].join(". ");
      coordinates.input.title = coordinates.root.title = title;
    }
    const cells = String(settings.resolution);
    if (!RESOLUTIONS.includes(settings.resolution) && ![...resolution.input.options].some(({ value }) => value === cells)) {
      resolution.input.append(el("option", { value: cells }, `${cells} cells`));
    }
    coordinates.set(settings.coordinates);
    resolution.set(settings.resolution);
    density.set(settings.density);
  };
  return { roots: [coordinates.root, resolution.root, density.root], start: () => store.follow(["settings"], show) };
}

export function viewGroup() {
  const samples = [1, 2, 3, 4].map((side) => [String(side), `${side * side} per pixel`]);
  const supersampling = settingChoice("supersampling", "Samples", "Samples per pixel: more are smoother and slower. For films, and here once nothing moves", samples, Number);
  const shown = segments({
    id: "show",
    label: "What is shown",
    options: [
      ["rgb", "Colour", "The scene in colour"],
      ["disparity", "Depth", "How near objects are: near is bright"],
      ["alpha", "Alpha", "How opaque the scene is: white hides the background"],
      ["masks", "Masks", "What is turned inside out, uncovered or empty"],
    ],
    value: "rgb",
    onChange: (value) => change({ show: value }),
  });
  const background = backgroundField();
  const masks = legend();
  const toolCheck = (id, tool, label, title) => check({ id, label, title: titleOf(title, tool), value: store.tools[tool], onChange: (on) => store.setTool(tool, on) });
  const overlay = toolCheck("overlay", "cage", "Draw the cage", "Draw the cage over the picture");
  const grid = toolCheck("grid", "grid", "Draw the ground as a grid", "A floor grid under the scene, with its axes and lengths in scene units");
  const fill = check({ id: "fill", label: "Fill uncovered background", title: "Continues the background where an edit uncovers what no photo showed, once nothing moves", onChange: (on) => change({ fill: on }) });
  const viewButton = ([name, label]) =>
    button({ id: name.replace(".", "-"), label, title: titleOf(actions.get(name).label, name), onClick: () => run(name) });
  const views = el("div", { class: "grid quarters", role: "group", "aria-label": "Look from" }, ...VIEWS.map(viewButton));
  const made = group("view", "Picture", false, shown.root, masks.root, overlay.root, grid.root, background.root, fill.root, supersampling.root, views);
  const show = () => {
    const { settings } = store.sections;
    if (!settings) return;
    supersampling.set(settings.supersampling);
    background.set(settings.background);
    fill.set(settings.fill);
    fill.root.hidden = settings.background !== null || !store.sections.session?.field?.layers || objects().length > 1;
    shown.set(settings.show);
    masks.show();
  };
  const start = () => {
    store.on("status", masks.show);
    store.on("tools", (tools) => {
      overlay.set(tools.cage);
      grid.set(tools.grid);
    });
    store.follow(["settings", "objects", "session"], show); // session: of its field, whether there is something to fill
  };
  return { root: made.root, start };
}
