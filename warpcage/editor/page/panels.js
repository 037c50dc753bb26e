// The side panel: its groups from top to bottom.

import * as toolbar from "./toolbar.js";
import { editsGroup } from "./panel_edits.js";
import { cageGroup } from "./panel_cage.js";
import { poseGroup } from "./panel_pose.js";
import { viewGroup } from "./panel_view.js";
import { filmGroup, jobsGroup, keysGroup } from "./panel_film.js";

/** Builds header and side panel. Call it once, when all actions are registered. */
export function start() {
  toolbar.start();
  const groups = [editsGroup(), cageGroup(), poseGroup(), viewGroup(), keysGroup(), filmGroup(), jobsGroup()];
  document.getElementById("panel").append(...groups.map(({ root }) => root));
  for (const { start } of groups) start();
}
