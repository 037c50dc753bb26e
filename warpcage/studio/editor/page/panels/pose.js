// Posing with sliders and typed numbers: bend, twist, taper and stretch of the selection, or of the whole cage where nothing
// is selected. A slider poses live while it is dragged, makes one undo step when it is let go, and keeps its value until
// something else changes the pose.

import { activeEdit, run, selectedVertices, store } from "../core/store.js";
import { ask, request, sendVertices } from "../core/connection.js";
import { toast } from "../core/dialogs.js";
import { button, choice, el, group, number, perPicture, row, setText, short, titleOf, triple } from "../core/controls.js";
import { AXIS_NAMES, dot, mean, point } from "../geometry/vectors.js";
import { activeCage, places, placesName, whenChanged } from "../view/cages.js";
import { loadFrom } from "./cage.js";

const degrees = { neutral: 0, read: (place) => Math.round(place), place: (amount) => amount, format: (amount) => `${short(amount, 1)}°` };
const factor = { neutral: 1, read: (place) => 4 ** place, place: (amount) => Math.log(amount) / Math.log(4), format: (amount) => `× ${short(amount, 2)}` };
const PRESETS = [
  { name: "bend", label: "Bend", ...degrees, min: -180, max: 180, step: 1, unit: "°", limit: [-720, 720] },
  { name: "twist", label: "Twist", ...degrees, min: -360, max: 360, step: 1, unit: "°", limit: [-1440, 1440] },
  { name: "taper", label: "Taper", ...factor, min: -1, max: 1, step: 0.01, unit: "×", limit: [0.01, 100] },
  { name: "stretch", label: "Stretch", ...factor, min: -1, max: 1, step: 0.01, unit: "×", limit: [0.01, 100] },
];

/** What all sliders share: along which axis, between which limits. */
const ways = { axis: "up", towards: "x", limits: [0, 1] };
let opened = null; // the preset whose slider is being moved
let isEnding = false; // whether what it reached is on its way to the server
let refused = false; // whether the slider that is held cannot pose: it says so once

const up = () => store.sections.session?.field?.up ?? [0, 0, 1];
const direction = () => (ways.axis === "up" ? up() : AXIS_NAMES.map((name) => Number(name === ways.axis)));

/** The axis of the world that sliders act along, or nearly so. */
function nearestAxis() {
  const sizes = direction().map(Math.abs);
  return AXIS_NAMES[sizes.indexOf(Math.max(...sizes))];
}

const wayNow = () => ({ axis: ways.axis === "up" ? up() : ways.axis, towards: ways.towards, limits: ways.limits });
const message = ({ name }, amount) => ({ do: "preset.set", preset: name, amount, ...wayNow() });

/** The vertices that sliders act on: those selected, or null for all. */
function chosenVertices() {
  const vertices = selectedVertices();
  return vertices.length && vertices.length < activeEdit()?.rest.length ? vertices : null;
}

/** How far a slider has posed what it acts on now. */
function amountOf({ name, neutral }) {
  const { vertices, axis, towards, limits, amounts } = activeEdit()?.sliders ?? {};
  const isSame = amounts && JSON.stringify([vertices, { axis, towards, limits }]) === JSON.stringify([chosenVertices(), wayNow()]);
  return (isSame && amounts[name]) || neutral;
}

/** Whether the vertices that sliders act on lie in one plane across the axis: sliders act alike on all of them. */
function isFlat() {
  const cage = activeCage();
  const chosen = chosenVertices() ?? [...Array(places(cage).length / 3).keys()];
  const along = chosen.map((vertex) => dot(point(places(cage), vertex), direction()));
  return Math.max(...along) - Math.min(...along) <= 1e-9 * cage.size;
}

/** Begins a preset; false, with a message, where it has nothing to act on. */
function begin(preset) {
  const edit = activeEdit();
  if (!edit) toast("There is no cage to pose: generate one first.", "warning");
  else if (store.sections.settings?.mode === "rest") toast("Sliders pose the cage: change to Pose first (Q).", "warning");
  else if (isFlat()) toast(`What is selected is flat along the axis ${ways.axis}: select more, deselect all (Alt+A) to bend everything, or choose another axis.`, "warning");
  else {
    opened = preset;
    request({ do: "preset.begin", edit: edit.id, vertices: chosenVertices() });
    return true;
  }
  return false;
}

/** Poses live; a refusal of the server is shown once, and the step is taken back. */
const sendAmount = perPicture(async (preset, amount) => {
  if (opened !== preset) return;
  try {
    await ask(message(preset, amount));
  } catch (error) {
    if (opened !== preset) return;
    refused = true;
    toast(error.message, "error");
    end(amount, true);
  }
});

/** Ends what is open as one undo step, or takes it back. */
async function end(amount, cancel) {
  const preset = opened;
  if (!preset) return;
  opened = null;
  isEnding = true;
  if (!cancel) await request(message(preset, amount));
  await request({ do: "preset.end", cancel });
  isEnding = false;
  showAmounts();
}

const shown = []; // what shows the amount of each preset
const showAmounts = perPicture(() => {
  if (!opened && !isEnding) for (const show of shown) show();
});

/** One preset: a slider to drag and a number to type. */
function presetRow(preset) {
  const { name, label, min, max, step, unit, limit } = preset;
  const id = `preset-${name}`;
  const slider = el("input", { id, type: "range", min, max, step, "aria-label": label, title: `${label}: drag; with the arrow keys, Enter keeps it; Escape takes it back` });
  let isDragged = false;
  const amountNow = () => preset.read(slider.valueAsNumber);
  const showAmount = (amount) => {
    slider.setAttribute("aria-valuetext", preset.format(amount));
    typed.set(amount);
  };
  const show = () => {
    slider.value = preset.place(amountOf(preset));
    showAmount(amountOf(preset));
  };
  const finish = (cancel) => {
    isDragged = refused = false;
    if (opened === preset) end(amountNow(), cancel);
  };
  slider.addEventListener("pointerdown", () => (isDragged = true));
  slider.addEventListener("input", () => {
    if (opened !== preset && (refused || !begin(preset))) {
      refused = true;
      return show();
    }
    const amount = amountNow();
    showAmount(amount);
    sendAmount(preset, amount);
  });
  // keys change step by step: what they reach is kept by Enter, or when the focus goes on
  slider.addEventListener("change", () => isDragged && finish(false));
  slider.addEventListener("blur", () => finish(false));
  slider.addEventListener("pointerup", () => isDragged && finish(false));
  slider.addEventListener("pointercancel", () => finish(true));
  slider.addEventListener("keydown", (event) => {
    if (event.key !== "Enter" && event.key !== "Escape") return;
    event.preventDefault();
    event.stopPropagation();
    const isHeld = isDragged;
    finish(event.key === "Escape");
    isDragged = refused = isHeld; // until it is let go
  });
  const typed = number({
    id: `${id}-amount`,
    label: `${label}, typed`,
    title: `${label}: type an amount (${unit}) and press Enter`,
    min: limit[0],
    max: limit[1],
    bare: true,
    onChange: async (amount) => {
      if (begin(preset)) await end(amount, false);
      else show();
    },
  });
  show();
  shown.push(show);
  const name_ = el("label", { for: id }, label);
  return el("div", { class: "preset" }, name_, slider, el("span", { class: "value" }, typed.input, el("span", { class: "unit" }, unit)));
}

/** Where the middle of the selection is: three numbers that can be typed. */
function placeFields() {
  const move = (value, k) => {
    const edit = activeEdit();
    const vertices = selectedVertices();
    if (!edit || !vertices.length) return;
    const name = placesName();
    const moved = Float64Array.from(places(activeCage()));
    const by = value - mean(moved, vertices)[k];
    for (const vertex of vertices) moved[3 * vertex + k] += by;
    request({ do: "drag.begin", edit: edit.id, label: `move to ${AXIS_NAMES[k]} ${short(value)}`, rest: name === "rest" });
    sendVertices(name, edit.id, moved);
    request({ do: "drag.end", edit: edit.id, cancel: false });
  };
  const { root, set } = triple({ id: "place", label: "Middle of the selection", onChange: move });
  const count = el("span", { id: "selection-count", class: "note" });
  const show = perPicture(() => {
    const edit = activeEdit();
    const vertices = selectedVertices();
    setText(count, vertices.length ? `${vertices.length} of ${edit?.rest.length ?? 0} selected; their middle:` : "Nothing is selected.");
    root.hidden = !edit || !vertices.length;
    if (!root.hidden) set(mean(places(activeCage()), vertices));
  });
  return { nodes: [count, root], show };
}

export function poseGroup() {
  const on = el("p", { id: "preset-on", class: "note", title: "Select vertices to pose these alone; nothing (Alt+A) or all (A) for the whole cage" });
  const others = () => AXIS_NAMES.filter((axis) => axis !== nearestAxis()).flatMap((axis) => [[axis, axis], [`-${axis}`, `−${axis}`]]);
  const towards = choice({
    id: "preset-towards",
    label: "Towards",
    title: "The direction that Bend bends to",
    options: others(),
    value: ways.towards,
    onChange: (value) => {
      ways.towards = value;
      showAmounts();
    },
  });
  const setAxis = (value) => {
    ways.axis = value;
    towards.fill(others());
    if (ways.towards.endsWith(nearestAxis())) ways.towards = AXIS_NAMES.find((axis) => axis !== nearestAxis());
    towards.set(ways.towards);
    showAmounts();
  };
  const axis = choice({
    id: "preset-axis",
    label: "Axis",
    title: "The axis along which the sliders act",
    options: [["up", "Up"], ...AXIS_NAMES.map((name) => [name, name])],
    value: ways.axis,
    onChange: setAxis,
  });
  const limits = ["from", "to"].map((name, i) =>
    number({
      id: `preset-${name}`,
      label: `Limits: ${name}`,
      title: `Where along the axis it ${i ? "ends" : "begins"}, in percent: 0 is the start of the axis, its lowest place for Up`,
      min: 0,
      max: 100,
      step: 5,
      value: 100 * i,
      bare: true,
      onChange: (value) => {
        const kept = i ? Math.max(value, 100 * ways.limits[0] + 1) : Math.min(value, 100 * ways.limits[1] - 1);
        ways.limits[i] = kept / 100;
        limits[i].set(kept);
        showAmounts();
      },
    }),
  );
  const between = el("div", { class: "field", title: "Where along the axis the sliders act" }, el("label", { for: "preset-from" }, "Between"));
  between.append(el("div", { class: "value" }, limits[0].input, el("span", { class: "unit" }, "to"), limits[1].input, el("span", { class: "unit" }, "%")));
  const place = placeFields();
  const resets = row(
    button({ id: "reset-selection", label: "Reset selection", title: titleOf("Bring the selected vertices back to the rest cage", "pose.reset"), onClick: () => run("pose.reset") }),
    button({ id: "reset-all", label: "Reset all", title: titleOf("Bring the whole cage back to rest", "pose.reset.all"), onClick: () => run("pose.reset.all") }),
    button({ id: "pose-load", label: "Load…", title: "Load a pose: this cage with moved vertices, from a file of the session's folder", onClick: () => loadFrom("cage", "Load a pose", "pose.load") }),
  );
  const made = group("pose", "Pose", true, on, ...PRESETS.map(presetRow), axis.root, towards.root, between, ...place.nodes, resets);
  const show = () => {
    place.show();
    showAmounts();
    setText(on, chosenVertices() ? `Sliders pose what is selected (${chosenVertices().length}).` : "Sliders pose the whole cage.");
    document.getElementById("reset-all").disabled = !activeEdit();
    document.getElementById("reset-selection").disabled = !selectedVertices().length;
  };
  const start = () => {
    whenChanged(show);
    let before = up();
    store.on("session", () => {
      if (before.join() !== up().join()) setAxis(ways.axis); // towards what is across it
      before = up();
    });
    store.on("edits", showAmounts);
    // a lost connection has ended the preset
    store.on("status", ({ connected }) => connected || (opened = null));
    show();
  };
  return { root: made.root, start };
}
