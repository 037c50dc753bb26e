// What the page knows: the server's sections, this page's tools, the state of the connection; and what can be done: its
// actions, which panels run by name, keys by their key, and the help lists by group.

const KEPT = "warpcage.tools";

/** What is said where an editor answers that does not know this page's address. */
export const STARTED_ANEW = "The editor was started anew: open the address it printed";

const defaults = {
  tool: "select", // select | move | rotate | scale | landmark | box | ruler
  pick: "rectangle", // rectangle | lasso | brush
  brush: 24, // radius of the brush, pixels
  finger: "orbit", // orbit | select: what a drag of one finger does
  through: true, // select what is hidden too
  axes: "world",
  proportional: false,
  radius: 0.3, // share of the cage's size
  falloff: "smooth",
  symmetry: "", // plane through the middle of the rest cage
  snap: false,
  step: 0.05, // share of the cage's size; a rotation snaps to 100 times as many degrees (5)
  cage: true, // whether the cage is drawn
  grid: false, // whether the ground is drawn as a grid
};

/** What tools can be chosen to be: [value, label]. */
export const choices = {
  axes: [
    ["world", "World axes"],
    ["view", "View axes"],
    ["local", "Local axes"],
  ],
  falloff: [
    ["smooth", "Smooth"],
    ["sphere", "Sphere"],
    ["linear", "Linear"],
    ["sharp", "Sharp"],
    ["constant", "Constant"],
  ],
  symmetry: [
    ["", "No mirror"],
    ["x", "Mirror x"],
    ["y", "Mirror y"],
    ["z", "Mirror z"],
  ],
};

/** What this browser kept under a name, or null. */
export function kept(name) {
  try {
    return localStorage.getItem(name);
  } catch {
    return null; // a browser that keeps nothing
  }
}

export function keep(name, text) {
  try {
    localStorage.setItem(name, text);
  } catch {
    // a browser that keeps nothing: the choice lasts as long as the page
  }
}

/** The values that this browser kept by their names; empty where there is nothing, or something that is not ours. */
export function keptValues(name) {
  try {
    return JSON.parse(kept(name) ?? "{}") ?? {};
  } catch {
    return {};
  }
}

/** The tools as this browser kept them, with defaults for what is missing or of another type. */
function keptTools() {
  const tools = { ...defaults };
  const before = keptValues(KEPT);
  for (const name of Object.keys(defaults)) {
    if (typeof before[name] === typeof defaults[name]) tools[name] = before[name];
  }
  return tools;
}

const listeners = new Map(); // name -> Set of functions

function notify(name, content) {
  for (const listener of [...(listeners.get(name) ?? [])]) listener(content, name);
  for (const listener of [...(listeners.get("*") ?? [])]) listener(content, name);
}

export const store = {
  sections: {}, // as the server sent them: store.sections.settings.coordinates ...
  tools: keptTools(),
  status: { connected: false, client: null, attempts: 0, refused: false, fps: 0, latency: 0, frame: null, doing: null },

  /** Calls listener(content, name) when a section, "tools", "status" or anything ("*") changes; returns how to stop. */
  on(name, listener) {
    if (!listeners.has(name)) listeners.set(name, new Set());
    listeners.get(name).add(listener);
    return () => listeners.get(name).delete(listener);
  },

  /** Calls listener() now, and whenever one of these changes. */
  follow(names, listener) {
    for (const name of names) store.on(name, listener);
    listener();
  },

  set(name, content) {
    store.sections[name] = content;
    notify(name, content);
  },

  /** Changes one of this page's tools and keeps it in the browser. */
  setTool(name, value) {
    if (!(name in defaults)) throw new Error(`no tool option "${name}"`);
    if (store.tools[name] === value) return;
    store.tools[name] = value;
    keep(KEPT, JSON.stringify(store.tools));
    notify("tools", store.tools);
  },

  setStatus(changes) {
    Object.assign(store.status, changes);
    notify("status", store.status);
  },
};

export function activeEdit() {
  const { edits = [], selection } = store.sections;
  return edits.find(({ id }) => id === selection?.edit) ?? null;
}

/** A listener that calls work(edit, ...) with the active edit, where there is one. */
export const withActiveEdit = (work) => (...given) => {
  const edit = activeEdit();
  if (edit) work(edit, ...given);
};

export const selectedVertices = () => store.sections.selection?.vertices ?? [];

/** name -> {label, keys: ["Ctrl+Z"], group, run(event), enabled?(), repeat?: true where a held key runs it again} */
export const actions = new Map();
const byKey = new Map(); // key -> name

/** Adds an action, or replaces the one of that name. */
export function register(name, action) {
  for (const key of actions.get(name)?.keys ?? []) byKey.delete(key);
  actions.set(name, { keys: [], group: "Other", ...action });
  for (const key of action.keys ?? []) byKey.set(key, name);
}

/** Runs an action by its name unless it is not enabled now; returns whether it ran. */
export function run(name, event) {
  const action = actions.get(name);
  if (!action) throw new Error(`no action "${name}"`);
  if (action.enabled && !action.enabled()) return false;
  action.run(event);
  return true;
}

export const actionOf = (key) => byKey.get(key);
