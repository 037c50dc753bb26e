// How the scene is computed and shown.

import { actions, run, store } from "../core/store.js";
import { request } from "../core/connection.js";
import { things } from "../view/things.js";
import { button, check, choice, el, group, percent, perPicture, segments, setText, titleOf } from "../core/controls.js";

const RESOLUTIONS = [16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512];
const VIEWS = [
  ["view.front", "Front"],
  ["view.right", "Right"],
  ["view.top", "Top"],
  ["view.all", "All"],
];

const change = (changes) => request({ do: "settings", ...changes });

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
    title: "What is behind the scene. The field's own, where it is one colour, gives way to the page's in the dark theme; not in films",
    options: [
      ["", "The field's own"],
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
    ["outside", "Empty: nothing to show there"],
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

/** The group of the picture: {root, start()}. */
export function viewGroup() {
  const coordinates = choice({
    id: "coordinates",
    label: "Coordinates",
    title: "How the inside follows the cage: harmonic follows limbs, mean value is smooth, green keeps shapes but may leave the cage",
    options: [
      ["harmonic", "Harmonic"],
      ["mean_value", "Mean value"],
      ["green", "Green"],
    ],
    onChange: (value) => change({ coordinates: value }),
  });
  const resolution = choice({
    id: "resolution",
    label: "Resolution",
    title: "Cells of the map along the cage's longest side: finer follows sharp poses more closely, coarser is faster",
    options: RESOLUTIONS.map((cells) => [String(cells), `${cells} cells`]),
    onChange: (value) => change({ resolution: Number(value) }),
  });
  const density = choice({
    id: "density",
    label: "Density",
    title: "How matter that is stretched keeps its opacity",
    options: [
      ["opacity", "Keeps its opacity"],
      ["paper", "As in the paper"],
    ],
    onChange: (value) => change({ density: value }),
  });
  const supersampling = choice({
    id: "supersampling",
    label: "Sharpness",
    title: "Rays for each pixel, in pictures that rest",
    options: [1, 2, 3, 4].map((side) => [String(side), side === 1 ? "1 ray a pixel" : `${side * side} rays a pixel`]),
    onChange: (value) => change({ supersampling: Number(value) }),
  });
  const shown = segments({
    id: "show",
    label: "What is shown",
    options: [
      ["rgb", "Colour", "The scene in colour"],
      ["disparity", "Disparity", "How near matter is"],
      ["alpha", "Alpha", "How much covers the background"],
      ["masks", "Masks", "What is turned inside out, uncovered or empty"],
    ],
    value: "rgb",
    onChange: (value) => change({ show: value }),
  });
  const background = backgroundField();
  const masks = legend();
  const overlay = check({
    id: "overlay",
    label: "Draw the cage",
    title: titleOf("Draw the cage over the picture", "cage"),
    value: store.tools.cage,
    onChange: (on) => store.setTool("cage", on),
  });
  const grid = check({
    id: "grid",
    label: "Draw the ground as a grid",
    title: titleOf("A grid beneath the field, with the axes through its middle and lengths in its units", "grid"),
    value: store.tools.grid,
    onChange: (on) => store.setTool("grid", on),
  });
  const fill = check({
    id: "fill",
    label: "Fill what nobody saw",
    title: "Background that the edits uncover and no picture showed goes on from what is around it, in pictures that rest",
    onChange: (on) => change({ fill: on }),
  });
  const viewButton = ([name, label]) =>
    button({ id: name.replace(".", "-"), label, title: titleOf(actions.get(name).label, name), onClick: () => run(name) });
  const views = el("div", { class: "grid quarters", role: "group", "aria-label": "Look from" }, ...VIEWS.map(viewButton));
  const made = group("view", "Picture", false, shown.root, masks.root, overlay.root, grid.root, coordinates.root, resolution.root, density.root, background.root, fill.root, supersampling.root, views);
  const show = () => {
    const { settings } = store.sections;
    if (!settings) return;
    const cells = String(settings.resolution);
    if (!RESOLUTIONS.includes(settings.resolution) && ![...resolution.input.options].some(({ value }) => value === cells)) {
      resolution.input.append(el("option", { value: cells }, `${cells} cells`));
    }
    coordinates.set(settings.coordinates);
    resolution.set(settings.resolution);
    density.set(settings.density);
    supersampling.set(settings.supersampling);
    background.set(settings.background);
    fill.set(settings.fill);
    fill.root.hidden = settings.background !== null || !store.sections.session?.field?.layers || things().length > 1;
    shown.set(settings.show);
    masks.show();
  };
  const start = () => {
    store.on("settings", show);
    store.on("things", show);
    store.on("session", show); // of its field: whether there is something to fill
    store.on("status", masks.show);
    store.on("tools", (tools) => {
      overlay.set(tools.cage);
      grid.set(tools.grid);
    });
    show();
  };
  return { root: made.root, start };
}
