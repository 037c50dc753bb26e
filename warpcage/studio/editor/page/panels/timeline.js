// The timeline: a ruler in seconds, the keys of poses and cameras, the head that shows and sets the time, and playing.

import { run, store } from "../core/store.js";
import { request } from "../core/connection.js";
import { button, choice, el, followKey, number, rows, setIcon, setText, short, titleOf } from "../core/controls.js";
import { exportFilm } from "./exports.js";
import { graphs } from "./graph.js";
import { LOOPS, add, change, choose, chosenKey, easingChoice, film, goTo, holds, jump, keyAt, now, onChosen, onFrame, remove, room, seconds, step } from "./keys.js";

const NEAR = 4; // pixels that a press may slip before it is a drag
const STEPS = [0.05, 0.1, 0.25, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600];
const PAGE = 10; // frames of Page Up and Page Down

const shareOf = (time) => `${(100 * time) / Math.max(room(), 1e-6)}%`;

let dragged = null; // {id, time} of the key that is dragged
let area = null; // the element whose width is that of `room()`

/** A mark of a key in the lane of poses or of cameras. */
function makeMark(kind) {
  return ({ id }) => {
    const root = el("span", { class: `mark ${kind}`, "aria-hidden": "true" });
    root.dataset.key = id;
    const update = (key) => {
      const time = dragged?.id === id ? dragged.time : key.time;
      root.style.left = shareOf(time);
      root.classList.toggle("chosen", chosenKey()?.id === id);
      root.title = `${key.name}, ${holds(key)}, ${seconds(time)}: drag to move in time`;
    };
    return { root, update };
  };
}

function timeAt(event) {
  const { left, width } = area.getBoundingClientRect();
  return onFrame(((event.clientX - left) / width) * room());
}

/** Ticks of the ruler: as many as there is room for. */
function ticks(width) {
  const length = room();
  const wanted = (length * 64) / Math.max(width, 64);
  const by = STEPS.find((one) => one >= wanted) ?? STEPS.at(-1);
  const made = [];
  for (let i = 0; i * by <= length + 1e-9; i += 1) {
    const tick = el("span", { class: "tick" }, short(i * by, 2));
    tick.style.left = shareOf(i * by);
    made.push(tick);
  }
  return made;
}

/** Presses on the track: a key is chosen or dragged, anything else moves the head. */
function listen(track, show) {
  let way = null; // {pointer, mark, x}: what the press is about
  track.addEventListener("pointerdown", (event) => {
    if (event.button !== 0 || way) return;
    const mark = event.target.closest(".mark");
    if (mark?.classList.contains("left")) return run("undo");
    way = { pointer: event.pointerId, id: mark ? Number(mark.dataset.key) : null, x: event.clientX };
    track.setPointerCapture(event.pointerId);
    track.focus();
    if (way.id === null) goTo(timeAt(event));
    else choose(way.id);
    return undefined;
  });
  track.addEventListener("pointermove", (event) => {
    if (event.pointerId !== way?.pointer) return;
    if (way.id === null) return goTo(timeAt(event));
    if (!dragged && Math.abs(event.clientX - way.x) < NEAR) return;
    dragged = { id: way.id, time: timeAt(event) };
    show();
  });
  const stop = (event, isKept) => {
    if (event.pointerId !== way?.pointer) return;
    const { id } = way;
    const moved = dragged;
    way = dragged = null;
    const key = film().keys.find((one) => one.id === id);
    if (key && !moved && isKept) {
      goTo(key.time);
      choose(id);
    }
    if (key && moved && isKept && moved.time !== key.time) request({ do: "key.change", id, time: moved.time }).then(show);
    else show();
  };
  track.addEventListener("pointerup", (event) => stop(event, true));
  track.addEventListener("pointercancel", (event) => stop(event, false));
  track.addEventListener("keydown", (event) => {
    if (event.key === "Escape" && dragged) {
      way = dragged = null;
      return show();
    }
    onTrackKey(event);
    return undefined;
  });
  track.addEventListener("dblclick", (event) => event.target.closest(".mark") || add(true, true));
}

function onTrackKey(event) {
  if (event.ctrlKey || event.metaKey) return;
  const shift = (frames) => {
    const key = chosenKey();
    if (!key) return;
    const time = onFrame(key.time + frames / film().fps);
    change({ time });
    goTo(time);
    choose(key.id);
  };
  const by = event.shiftKey ? PAGE : 1;
  const ways = {
    ArrowLeft: () => (event.altKey ? shift(-by) : step(-by)),
    ArrowRight: () => (event.altKey ? shift(by) : step(by)),
    ArrowUp: () => jump(-1),
    ArrowDown: () => jump(1),
    PageUp: () => step(-PAGE),
    PageDown: () => step(PAGE),
    Home: () => goTo(0),
    End: () => goTo(film().length),
    Delete: remove,
    Backspace: remove,
    Enter: () => add(true, true),
    " ": () => run("play"),
  };
  followKey(ways, event);
}

function bar() {
  const play = button({ id: "play", label: "Play", icon: "play", title: titleOf("Play", "play"), onClick: () => run("play") });
  const time = number({ id: "time", label: "Current time in seconds", title: "Current time: type seconds and press Enter", min: 0, max: 3600, bare: true, onChange: goTo });
  const length = el("span", { class: "unit", id: "time-length" });
  const loop = choice({ id: "time-loop", label: "At the end", title: "What the film does at its end", options: LOOPS, bare: true, onChange: (value) => request({ do: "timeline", loop: value }) });
  const easing = easingChoice({ id: "time-easing", label: "Easing of the selected key", title: "How the movement from the selected key to the next goes", bare: true });
  const gone = button({ id: "time-delete", label: "Delete key", icon: "delete", title: "Delete the selected key (Delete on the timeline)", onClick: remove });
  const name = el("span", { id: "time-key", class: "note" });
  const unkeyed = el("span", { id: "time-unkeyed", title: "This pose is in no key: add one (K) to keep it when the time changes" }, "Pose not kept");
  const root = el(
    "div",
    { class: "time-bar" },
    button({ id: "time-first", label: "To the start", icon: "first", title: "To the start (Home on the timeline)", onClick: () => goTo(0) }),
    button({ id: "time-before", label: "Previous key", icon: "before", title: "To the previous key (Up on the timeline)", onClick: () => jump(-1) }),
    play,
    button({ id: "time-after", label: "Next key", icon: "after", title: "To the next key (Down on the timeline)", onClick: () => jump(1) }),
    el("span", { class: "time-now" }, time.input, length),
    loop.input,
    el("span", { class: "spring" }, unkeyed),
    name,
    easing.input,
    button({ id: "time-add", label: "Key", icon: "plus", keep: true, title: titleOf("Add a key of pose and camera at the current time", "key.insert"), onClick: () => add(true, true) }),
    gone,
    button({ id: "time-export", label: "Export film", icon: "download", keep: true, title: "Write the film to a file; says first how long that takes", onClick: exportFilm }),
  );
  const show = () => {
    const { length: long, fps, loop: way } = film();
    const { playing = false, unkeyed: isUnkeyed = false } = store.sections.playback ?? {};
    const key = chosenKey();
    setIcon(play, playing ? "pause" : "play");
    play.title = titleOf(playing ? "Pause" : "Play", "play");
    play.setAttribute("aria-label", playing ? "Pause" : "Play");
    time.set(Math.round(now() * 100) / 100);
    setText(length, `/ ${seconds(long)}, frame ${Math.round(now() * fps)}`);
    loop.set(way);
    easing.input.disabled = gone.disabled = !key;
    easing.set(key);
    setText(name, key ? key.name : "");
    unkeyed.hidden = !isUnkeyed;
  };
  return { root, show };
}

export function start() {
  const { root: top, show: showBar } = bar();
  const ruler = el("div", { class: "ruler" });
  const marks = el("div");
  const poses = el("div", { class: "lane tall" });
  const ways = graphs(poses);
  const left = el("span", { class: "mark left", title: "A pose was left here without a key: press to go back to it (undo)" });
  poses.append(...ways.roots, marks, left, ...ways.handles);
  const cameras = el("div", { class: "lane" });
  const head = el("div", { class: "head" });
  const beyond = el("div", { class: "beyond", title: "After the end of the film; the next key may go here" });
  area = el("div", { class: "track-area" }, beyond, ruler, poses, cameras, head);
  const track = el(
    "div",
    {
      id: "track",
      class: "track",
      role: "slider",
      tabindex: "0",
      "aria-label": "Time of the film",
      "aria-valuemin": 0,
      title: "Left and Right step by a frame, Up and Down go from key to key, Alt+Left and Alt+Right move the selected key, Enter adds a key, Delete deletes it, Space plays",
    },
    area,
  );
  const labels = el("div", { class: "lane-labels", "aria-hidden": "true" }, el("span", {}, "s"), el("span", { class: "tall" }, "Pose"), el("span", {}, "Camera"));
  document.getElementById("timeline").append(top, el("div", { class: "time-body" }, labels, track));

  const showPoses = rows(marks, makeMark("pose"));
  const showCameras = rows(cameras, makeMark("camera"));
  let drawn = "";
  const showKeys = () => {
    const { keys } = film();
    const length = room();
    beyond.style.left = shareOf(film().length);
    const width = area.clientWidth;
    if (drawn !== `${length} ${width}`) ruler.replaceChildren(...ticks(width));
    drawn = `${length} ${width}`;
    showPoses(keys.filter(({ pose }) => pose));
    ways.show();
    showCameras(keys.filter(({ camera }) => camera));
    track.setAttribute("aria-valuemax", length);
  };
  const showTime = () => {
    const time = now();
    head.style.left = shareOf(Math.min(time, room()));
    const { left: leftAt = null } = store.sections.playback ?? {};
    left.hidden = leftAt === null;
    left.style.left = shareOf(Math.min(leftAt ?? 0, room()));
    track.setAttribute("aria-valuenow", short(time));
    const key = keyAt(time);
    track.setAttribute("aria-valuetext", `${seconds(time)}${key ? `, ${key.name}` : ""}`);
    showBar();
  };
  const show = () => (showKeys(), showTime());
  listen(track, show);
  new ResizeObserver(showKeys).observe(area);
  store.on("playback", showTime);
  onChosen(show);
  store.follow(["timeline"], show);
}
