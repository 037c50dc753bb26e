// Starts the page.

import { actions, listenToKeys, run } from "./actions.js";
import { connect } from "./connection.js";
import * as pointer from "./pointer.js";
import "./selecting.js";
import { store } from "./store.js";
import { start, viewport } from "./viewport.js";
import * as panels from "./panels.js";
import * as timeline from "./timeline.js";

const canvas = document.getElementById("view");
start(canvas);
pointer.start(canvas);
listenToKeys();
panels.start();
timeline.start();
window.warpcage = { store, actions, viewport, run };
connect();
