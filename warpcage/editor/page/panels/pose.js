// Posing with sliders and typed numbers: bend, twist, taper and stretch of all or of the selection. A slider poses live
// while it is dragged, makes one undo step when it is let go, and goes back to the middle for the next one.

import { activeEdit, run, selectedVertices, store } from "../core/store.js";
import { ask, request, sendVertices } from "../core/connection.js";
import { toast } from "../core/dialogs.js";
import { button, choice, el, group, number, perPicture, row, segments, setText, short, titleOf } from "../core/controls.js";
import { AXIS_NAMES, mean } from "../geometry/vectors.js";
import { activeCage, places, placesName, whenChanged } from "../view/cages.js";
import { loadFrom } from "./cage.js";

const degrees = { neutral: 0, read: (place) => Math.round(place), place: (amount) => amount, tell: (amount) => `${short(amount, 1)}°` };
const factor = { neutral: 1, read: (place) => 4 ** place, place: (amount) => Math.log(amount) / Math.log(4), tell: (amount) => `× ${short(amount, 2)}` };
const PRESETS = [
  { name: "bend", label: "Bend", ...degrees, min: -180, max: 180, step: 1, unit: "°", limit: [-720, 720] },
  { name: "twist", label: "Twist", ...degrees, min: -360, max: 360, step: 1, unit: "°", limit: [-1440, 1440] },
  { name: "taper", label: "Taper", ...factor, min: -1, max: 1, step: 0.01, unit: "×", limit: [0.01, 100] },
  { name: "stretch", label: "Stretch", ...factor, min: -1, max: 1, step: 0.01, unit: "×", limit: [0.01, 100] },
];

/** What all sliders share: which vertices, along which axis, between which limits. */
const ways = { on: "all", axis: "z", towards: "x", limits: [0, 1], isAxisChosen: false };
let opened = null; // the preset whose slider is out of the middle
let refused = false; // whether the slider that is held cannot pose: it says so once

const message = ({ name }, amount) => ({ do: "preset.set", preset: name, amount, axis: ways.axis, towards: ways.towards, limits: ways.limits });

/** Whether the vertices that sliders act on lie in one plane across the axis: no slider can tell them apart. */
function isFlat(vertices) {
  const cage = activeCage();
  const chosen = ways.on === "selection" ? vertices : [...Array(places(cage).length / 3).keys()];
  const along = chosen.map((vertex) => places(cage)[3 * vertex + AXIS_NAMES.indexOf(ways.axis)]);
  return Math.max(...along) - Math.min(...along) <= 1e-9 * cage.size;
}

/** Begins a preset; false, and a word about it, where it has nothing to act on. */
function begin(preset) {
  const edit = activeEdit();
  const vertices = selectedVertices();
  if (!edit) toast("There is no cage to pose: generate one first.", "warning");
  else if (store.sections.settings?.mode === "rest") toast("Sliders pose the cage: change to Pose first (Q).", "warning");
  else if (ways.on === "selection" && !vertices.length) toast("Nothing is selected: select vertices, or let the slider act on all.", "warning");
  else if (isFlat(vertices)) toast(`What is selected is flat along ${ways.axis}: select more vertices, or choose another axis.`, "warning");
  else {
    opened = preset;
    request({ do: "preset.begin", edit: edit.id, vertices: ways.on === "selection" ? vertices : null });
    return true;
  }
  return false;
}

/** Poses live; what the server refuses is told once, and the step is taken back. */
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
  if (!cancel) await request(message(preset, amount));
  await request({ do: "preset.end", cancel });
}

/** One preset: a slider to drag and a number to type. */
function presetRow(preset) {
  const { name, label, neutral, min, max, step, unit, limit } = preset;
  const id = `preset-${name}`;
  const slider = el("input", { id, type: "range", min, max, step, "aria-label": label, title: `${label}: drag; with the arrow keys, Enter keeps it; Escape takes it back` });
  const shown = el("output", { class: "amount", for: id, hidden: true });
  let isDragged = false;
  const amountNow = () => preset.read(slider.valueAsNumber);
  const rest = () => {
    slider.value = preset.place(neutral);
    slider.setAttribute("aria-valuetext", preset.tell(neutral));
    typed.input.hidden = false;
    shown.hidden = true;
  };
  const finish = (cancel) => {
    isDragged = refused = false;
    if (opened === preset) end(amountNow(), cancel || amountNow() === neutral);
    rest();
  };
  slider.addEventListener("pointerdown", () => (isDragged = true));
  slider.addEventListener("input", () => {
    if (opened !== preset && (refused || !begin(preset))) {
      refused = true;
      return rest();
    }
    const amount = amountNow();
    slider.setAttribute("aria-valuetext", preset.tell(amount));
    setText(shown, preset.tell(amount));
    shown.hidden = false;
    typed.input.hidden = true;
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
    value: neutral,
    bare: true,
    onChange: async (amount) => {
      if (amount !== neutral && begin(preset)) await end(amount, false);
      typed.set(neutral);
    },
  });
  rest();
  const name_ = el("label", { for: id }, label);
  return el("div", { class: "preset" }, name_, slider, el("span", { class: "value" }, typed.input, shown, el("span", { class: "unit" }, unit)));
}

/** Where the middle of the selection is: three numbers that can be typed. */
function placeFields() {
  const fields = AXIS_NAMES.map((axis, i) =>
    number({
      id: `place-${axis}`,
      label: `Middle of the selection, ${axis}`,
      title: `Middle of the selection, ${axis}: type a number and press Enter`,
      bare: true,
      onChange: (value) => {
        const edit = activeEdit();
        const vertices = selectedVertices();
        if (!edit || !vertices.length) return;
        const name = placesName();
        const moved = Float64Array.from(places(activeCage()));
        const by = value - mean(moved, vertices)[i];
        for (const vertex of vertices) moved[3 * vertex + i] += by;
        request({ do: "drag.begin", edit: edit.id, label: `move to ${axis} ${short(value)}`, rest: name === "rest" });
        sendVertices(name, edit.id, moved);
        request({ do: "drag.end", edit: edit.id, cancel: false });
      },
    }),
  );
  const count = el("span", { id: "selection-count", class: "note" });
  const root = el("div", { class: "place", role: "group", "aria-label": "Middle of the selection" });
  AXIS_NAMES.forEach((axis, i) => root.append(el("label", { for: `place-${axis}` }, axis), fields[i].input));
  const show = perPicture(() => {
    const edit = activeEdit();
    const vertices = selectedVertices();
    setText(count, vertices.length ? `${vertices.length} of ${edit?.rest.length ?? 0} selected; their middle:` : "Nothing is selected.");
    root.hidden = !edit || !vertices.length;
    if (root.hidden) return;
    const middle = mean(places(activeCage()), vertices);
    fields.forEach((field, i) => field.set(Number(short(middle[i], 4))));
  });
  return { nodes: [count, root], show };
}

/** The group of the pose: {root, start()}. */
export function poseGroup() {
  const on = segments({
    id: "preset-on",
    label: "What the sliders act on",
    options: [
      ["all", "All", "Sliders act on the whole cage"],
      ["selection", "Selection", "Sliders act on the selected vertices"],
    ],
    value: ways.on,
    onChange: (value) => (ways.on = value),
  });
  const others = () => AXIS_NAMES.filter((axis) => axis !== ways.axis).flatMap((axis) => [[axis, axis], [`-${axis}`, `−${axis}`]]);
  const towards = choice({
    id: "preset-towards",
    label: "Towards",
    title: "The direction that Bend bends to",
    options: others(),
    value: ways.towards,
    onChange: (value) => (ways.towards = value),
  });
  const setAxis = (value) => {
    ways.axis = value;
    towards.fill(others());
    if (ways.towards.endsWith(value)) ways.towards = AXIS_NAMES.find((axis) => axis !== value);
    towards.set(ways.towards);
  };
  const axis = choice({
    id: "preset-axis",
    label: "Axis",
    title: "The axis along which the sliders act",
    options: AXIS_NAMES.map((name) => [name, name]),
    value: ways.axis,
    onChange: (value) => {
      ways.isAxisChosen = true;
      setAxis(value);
    },
  });
  const limits = ["from", "to"].map((name, i) =>
    number({
      id: `preset-${name}`,
      label: `Limits: ${name}`,
      title: `Where along the axis it ${i ? "ends" : "begins"}, in percent of the cage's box`,
      min: 0,
      max: 100,
      step: 5,
      value: 100 * i,
      bare: true,
      onChange: (value) => {
        const kept = i ? Math.max(value, 100 * ways.limits[0] + 1) : Math.min(value, 100 * ways.limits[1] - 1);
        ways.limits[i] = kept / 100;
        limits[i].set(kept);
      },
    }),
  );
  const between = el("div", { class: "field", title: "Where along the axis the sliders act" }, el("label", { for: "preset-from" }, "Between"));
  between.append(el("div", { class: "value" }, limits[0].input, el("span", { class: "unit" }, "to"), limits[1].input, el("span", { class: "unit" }, "%")));
  const place = placeFields();
  const resets = row(
    button({ id: "reset-selection", label: "Reset selection", title: titleOf("Bring the selected vertices back to the rest cage", "pose.reset"), onClick: () => run("pose.reset") }),
    button({ id: "reset-all", label: "Reset all", title: titleOf("Bring the whole cage back to rest", "pose.reset.all"), onClick: () => run("pose.reset.all") }),
    button({ id: "pose-load", label: "Load…", title: "Load a posed cage, with the faces of this one, from the session's folder", onClick: () => loadFrom("cage", "Load a pose", "pose.load") }),
  );
  const made = group("pose", "Pose", true, el("div", { class: "field" }, el("span", { class: "label" }, "Acts on"), on.root), ...PRESETS.map(presetRow), axis.root, towards.root, between, ...place.nodes, resets);
  const show = () => {
    place.show();
    document.getElementById("reset-all").disabled = !activeEdit();
    document.getElementById("reset-selection").disabled = !selectedVertices().length;
  };
  const start = () => {
    whenChanged(show);
    store.on("session", ({ field }) => {
      if (ways.isAxisChosen || !field?.up) return;
      const sizes = field.up.map(Math.abs);
      axis.set(AXIS_NAMES[sizes.indexOf(Math.max(...sizes))]);
      setAxis(axis.input.value);
    });
    // a lost connection has ended the preset
    store.on("status", ({ connected }) => connected || (opened = null));
    show();
  };
  return { root: made.root, start };
}
