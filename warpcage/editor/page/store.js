// What the page knows: the server's sections, this page's tools, and the state of the connection.

const KEPT = "warpcage.tools";

const defaults = {
  tool: "select", // select | move | rotate | scale
  pick: "rectangle", // rectangle | lasso
  through: true, // select what is hidden too
  axes: "world", // world | view | local
  proportional: false,
  radius: 0.3, // share of the cage's size
  falloff: "smooth", // smooth | sphere | linear | sharp | constant
  symmetry: "", // "" | "x" | "y" | "z": plane through the middle of the rest cage
  snap: false,
  step: 0.05, // share of the cage's size; a rotation snaps to 100 times as many degrees (5)
  cage: true, // whether the cage is drawn
};

/** The tools as this browser kept them, with defaults for what is missing or of another type. */
function keptTools() {
  const tools = { ...defaults };
  try {
    const kept = JSON.parse(localStorage.getItem(KEPT) ?? "{}");
    for (const name of Object.keys(defaults)) {
      if (typeof kept[name] === typeof defaults[name]) tools[name] = kept[name];
    }
  } catch {
    // a browser that keeps nothing, or something that is not ours: the defaults serve
  }
  return tools;
}

const listeners = new Map(); // name -> Set of functions

function tell(name, content) {
  for (const listener of [...(listeners.get(name) ?? [])]) listener(content, name);
  for (const listener of [...(listeners.get("*") ?? [])]) listener(content, name);
}

export const store = {
  sections: {}, // as the server sent them: store.sections.settings.coordinates ...
  tools: keptTools(),
  status: { connected: false, client: null, attempts: 0, fps: 0, latency: 0, frame: null },

  /** Calls listener(content, name) when a section, "tools", "status" or anything ("*") changes; returns how to stop. */
  on(name, listener) {
    if (!listeners.has(name)) listeners.set(name, new Set());
    listeners.get(name).add(listener);
    return () => listeners.get(name).delete(listener);
  },

  /** Takes a section's new content. */
  set(name, content) {
    store.sections[name] = content;
    tell(name, content);
  },

  /** Changes one of this page's tools and keeps it in the browser. */
  setTool(name, value) {
    if (!(name in defaults)) throw new Error(`no tool option "${name}"`);
    if (store.tools[name] === value) return;
    store.tools[name] = value;
    try {
      localStorage.setItem(KEPT, JSON.stringify(store.tools));
    } catch {
      // a browser that keeps nothing: the choice lasts as long as the page
    }
    tell("tools", store.tools);
  },

  /** Changes parts of the status: {connected: true}. */
  setStatus(changes) {
    Object.assign(store.status, changes);
    tell("status", store.status);
  },
};
