// The brush that paints a selection: its size, its circle under the pointer, and the line of its keys.

import { register, store } from "../core/store.js";
import { el, number } from "../core/controls.js";
import { drawCircle } from "../view/draw.js";
import { drawings, overlay } from "../view/viewport.js";

const [LEAST, LARGEST] = [4, 200]; // radius, pixels

export const isBrush = () => store.tools.pick === "brush";

export function resizeBrush(factor) {
  const { brush } = store.tools;
  const step = Math.max(1, Math.abs(brush * (factor - 1)));
  store.setTool("brush", Math.max(LEAST, Math.min(LARGEST, Math.round(brush + Math.sign(factor - 1) * step))));
}

register("pick.brush", { label: "Brush selection", keys: ["V"], group: "Select", run: () => store.setTool("pick", "brush") });

drawings.push((context) => {
  if (overlay.brush && isBrush()) drawCircle(context, ...overlay.brush, store.tools.brush);
});

export function start() {
  const size = number({
    id: "brush-size",
    label: "Brush",
    title: "Radius of the brush in pixels ([ and ]). Drags add to the selection, with Alt or Ctrl held they take away",
    min: LEAST,
    max: LARGEST,
    step: 4,
    unit: "px",
    onChange: (value) => store.setTool("brush", Math.max(LEAST, Math.min(LARGEST, Math.round(value)))),
  });
  const chip = el("div", { class: "chip", id: "brush-options" }, size.root);
  document.getElementById("tool-options").append(chip);
  const show = () => {
    chip.hidden = !isBrush() || ["box", "landmark", "ruler"].includes(store.tools.tool);
    size.set(store.tools.brush);
  };
  store.follow(["tools"], show);
}
