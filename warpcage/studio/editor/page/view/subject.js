// What tools act on now: the active cage and its selected vertices, or the box of a thing that is moved as a whole.

import * as C from "./cages.js";
import * as drag from "./drag.js";
import * as things from "./things.js";

/** The cage, or the box of a thing, or null. */
export const activeCage = () => (things.isPlacing() ? things.handledBox() : C.activeCage());

/** The numbers of its vertices that move, as a set. */
export const selected = () => (things.isPlacing() ? (things.handledBox()?.chosen ?? new Set()) : C.selected());

export const activeVertex = () => (things.isPlacing() ? -1 : C.activeVertex());

/** The flat vertices that are edited and shown. */
export const places = (cage) => (cage.isThing ? cage.posed : C.places(cage));

const carrierOf = (cage) => (cage.isThing ? things : drag);

let carrier = drag; // what takes the places of the operation under way to the server

/** Begins a move of a cage's vertices, or of a thing. */
export function begin(cage, label) {
  carrier = carrierOf(cage);
  carrier.begin(cage, label);
}

export const update = (points, time) => carrier.update(points, time);
export const flush = () => (drag.flush(), things.flush());
export const end = (cancel) => carrier.end(cancel);
export const isWaiting = () => drag.isWaiting() || things.isWaiting();

/** Calls listener(seq, time) with each message of the hand that was sent. */
export function whenSent(listener) {
  drag.whenSent(listener);
  things.whenSent(listener);
}
