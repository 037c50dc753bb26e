// What is written to files: the film in its formats, with what it will take, and what else a session has.

import { store } from "../core/store.js";
import { ask, when } from "../core/connection.js";
import { askFor, showText } from "../core/dialogs.js";
import { objects } from "../view/objects.js";
import { film } from "./keys.js";

/** The formats of films: [value, label, ending, whether it has alpha, bytes for one of a sharp picture of the page], the
 *  last as measured with films of 25 frames of a fitted excavator. */
const FORMATS = [
  ["mp4", "MP4: plays everywhere", ".mp4", false, 0.05],
  ["gif", "GIF: for short loops", ".gif", false, 0.8],
  ["mov", "ProRes 4444, alpha: for editing", ".mov", true, 5.5],
  ["webm", "WebM, alpha: for web pages", ".webm", true, 0.25],
  ["png", "PNG sequence, alpha: a folder", "", true, 3],
];
const formatOf = (what) => FORMATS.find(([value]) => value === what);

const samples = []; // of the last sharp pictures: {pixels, bytes, pose, render}, times in milliseconds
const KEPT_SAMPLES = 9;

when("frame", ({ header, bytes }) => {
  if (!header.sharp || !bytes) return;
  samples.unshift({ pixels: header.width * header.height, bytes, ...header.ms });
  samples.length = Math.min(samples.length, KEPT_SAMPLES);
});

let made = ""; // what the pictures of the samples were made with
store.on("settings", ({ supersampling, resolution, coordinates }) => {
  const now = [supersampling, resolution, coordinates].join();
  if (now !== made) samples.length = 0;
  made = now;
});

/** The middle one of some numbers: a picture that waited for its kernels counts no more than others. */
const middle = (numbers) => numbers.sort((one, other) => one - other)[(numbers.length - 1) >> 1];

/** A number that is known roughly. */
const about = (value, unit) => (value < 1 ? `under 1 ${unit}` : `about ${Number(value.toPrecision(1))} ${unit}`);

const timeOf = (time) => (time < 90 ? about(time, "s") : time < 5400 ? about(time / 60, "min") : about(time / 3600, "h"));

/** The name of a film's file, or of its folder of pictures. */
const nameOf = ({ file, what }) => file.replace(/\.(mp4|gif|mov|webm)$/i, "") + formatOf(what)[2];

const SIDES = { min: 16, max: 4096 }; // pixels of a film's width and height

/** What a film will take, from the pictures that this page was sent. */
function estimate(given) {
  const { what, width, height } = given;
  const isSize = (side) => Number.isInteger(side) && side >= SIDES.min && side <= SIDES.max;
  if (!isSize(width) || !isSize(height)) return `Width and height are whole numbers from ${SIDES.min} to ${SIDES.max}.`;
  const { frames, loop } = film();
  const ends = loop === "once" && frames > 1 ? " (the first and the last moment are both shown)" : "";
  const { folder = "the session's folder" } = store.sections.session ?? {};
  const size = `${frames} ${frames === 1 ? "frame" : "frames"}${ends} of ${width} x ${height} pixels, into ${folder}/${nameOf(given)}.`;
  if (!samples.length) return `${size} Time and file size: unknown until a first frame was rendered.`;
  const poses = samples.map(({ pose }) => pose).filter((time) => time > 1); // others had the pose of the one before
  const pixels = frames * width * height;
  const time = frames * (poses.length ? middle(poses) : 0) + pixels * middle(samples.map((one) => one.render / one.pixels));
  const bytes = pixels * middle(samples.map((one) => one.bytes / one.pixels)) * formatOf(what).at(-1);
  return `${size} Takes ${timeOf(time / 1000)} and ${about(bytes / 1e6, "MB")}.`;
}

const sizes = () => {
  const { width = 800, height = 600, scale = 1 } = store.status.frame ?? {};
  const even = (value) => 2 * Math.round(value / 2);
  const isSlow = store.sections.session?.device === "cpu"; // half a second a picture and more, at full size
  const full = isSlow ? 640 : Math.max(640, width / scale); // pictures are smaller while something moves
  return [
    { name: "width", label: "Width", type: "number", value: even(full), ...SIDES, step: 2, unit: "pixels" },
    { name: "height", label: "Height", type: "number", value: even((full * height) / width), ...SIDES, step: 2, unit: "pixels" },
  ];
};
const overlay = { name: "overlay", label: "Draw the cage", type: "check", value: false };
const hasAlpha = ({ what }) => formatOf(what)[3];

/** Asks how the film is written, says what that takes, and writes it. */
export const exportFilm = () =>
  askFor({
    title: "Export film",
    fields: [
      { name: "file", label: "Name", type: "text", value: "film" },
      { name: "what", label: "Format", type: "choice", value: "mp4", choices: FORMATS.map(([value, label]) => [value, label]) },
      ...sizes(),
      { name: "transparent", label: "Transparent background", type: "check", value: true, shown: hasAlpha },
      overlay,
    ],
    note: estimate,
    confirm: "Export",
    send: (given) => ask({ do: "export", ...given, file: nameOf(given), transparent: given.transparent && hasAlpha(given) }),
  });

const shape = {
  name: "ending",
  label: "Format",
  type: "choice",
  value: ".obj",
  choices: [
    [".obj", "OBJ"],
    [".ply", "PLY"],
    [".glb", "glTF (GLB)"],
  ],
};

/** Asks for the name of a file other than a film, and writes it. */
function exportAs(what, label, usual, ...fields) {
  const { folder = "the session's folder" } = store.sections.session ?? {};
  const help = `Is written into ${folder}; it can be downloaded when it is done.`;
  return askFor({
    title: `Export: ${label}`,
    fields: [{ name: "file", label: "File", type: "text", value: usual, help }, ...fields],
    confirm: "Export",
    send: ({ file, ending = "" }) => ask({ do: "export", what, file: file.endsWith(ending) ? file : file + ending }),
  });
}

function exportScene() {
  const hasSplats = objects().some(({ visible, size }) => visible && size.endsWith("splats"));
  return exportAs("bake", "Posed scene", hasSplats ? "bent.ply" : "bent.npz");
}

async function showCommand() {
  let result = null;
  await askFor({
    title: "Command line of the film",
    fields: [{ name: "file", label: "File", type: "text", value: "film.mp4", help: "What the command writes." }, ...sizes(), overlay],
    confirm: "Show",
    send: async (given) => (result = await ask({ do: "export.command", ...given })),
  });
  if (result) showText("Command line", "This makes the same film without the editor:", result.command);
}

/** What else can be exported: [what, label, title, what begins it]. */
export const EXPORTS = [
  ["cage", "Posed cage", "The posed cage as a mesh", () => exportAs("cage", "Posed cage", "posed", shape)],
  ["poses", "Poses", "The poses of the active edit at all keys, in one file", () => exportAs("poses", "Poses", "poses.json")],
  ["bake", "Posed scene", "The scene as it is posed now, as a new scene file", exportScene],
  ["command", "Command line", "The warpcage command that makes the same film without the editor", showCommand],
];
