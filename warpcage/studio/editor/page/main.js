// Starts the page: the view, keys, header, side panel and timeline, and then the connection.

import { actions, run, store } from "./core/store.js";
import { connect } from "./core/connection.js";
import { listenToKeys } from "./panels/actions.js";
import * as outside from "./view/outside.js";
import * as pointer from "./view/pointer.js";
import "./view/selecting.js";
import * as box from "./tools/box.js";
import * as brush from "./tools/brush.js";
import * as landmark from "./tools/landmark.js";
import * as ruler from "./tools/ruler.js";
import { start, viewport } from "./view/viewport.js";
import { cageGroup } from "./panels/cage.js";
import { editsGroup } from "./panels/edits.js";
import { filmGroup, jobsGroup, keysGroup } from "./panels/film.js";
import { viewGroup } from "./panels/picture.js";
import { poseGroup } from "./panels/pose.js";
import { objectsGroup } from "./panels/objects.js";
import * as timeline from "./panels/timeline.js";
import * as toolbar from "./panels/toolbar.js";

/** Builds the side panel: its groups from top to bottom. */
function startPanel() {
  const groups = [objectsGroup(), editsGroup(), cageGroup(), poseGroup(), keysGroup(), filmGroup(), jobsGroup(), viewGroup()];
  document.getElementById("panel").append(...groups.map(({ root }) => root));
  for (const group of groups) group.start();
}

const canvas = document.getElementById("view");
start(canvas);
pointer.start(canvas);
outside.start();
listenToKeys();
toolbar.start();
for (const tool of [brush, landmark, box, ruler]) tool.start();
startPanel();
timeline.start();
window.warpcage = { store, actions, viewport, run };
connect();
