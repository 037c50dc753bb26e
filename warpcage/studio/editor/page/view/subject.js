// What tools act on now: the active cage and its selected vertices, or the box of an object that is moved as a whole.

import * as C from "./cages.js";
import * as drag from "./drag.js";
import * as objects from "./objects.js";

/** The cage, or the box of an object, or null. */
export const activeCage = () => (objects.isPlacing() ? objects.handledBox() : C.activeCage());

/** The numbers of its vertices that move, as a set. */
export const selected = () => (objects.isPlacing() ? (objects.handledBox()?.chosen ?? new Set()) : C.selected());

export const activeVertex = () => (objects.isPlacing() ? -1 : C.activeVertex());

/** The flat vertices that are edited and shown. */
export const places = (cage) => (cage.isObject ? cage.posed : C.places(cage));

const carrierOf = (cage) => (cage.isObject ? objects : drag);

let carrier = drag; // what takes the places of the operation under way to the server

export function begin(cage, label) {
  carrier = carrierOf(cage);
  carrier.begin(cage, label);
}

export const update = (points, time) => carrier.update(points, time);
export const flush = () => (drag.flush(), objects.flush());
export const end = (cancel) => carrier.end(cancel);
export const isWaiting = () => drag.isWaiting() || objects.isWaiting();
