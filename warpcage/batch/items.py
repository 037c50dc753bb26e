"""Items of a job, of all kinds: frames, fits and evaluations, as lines of a job file describe them."""

from __future__ import annotations

from .edit_words import EditWords
from .frame_item import PART_ENDINGS, FrameItem
from .item import ID, Defaults, Item, canonical, digest
from .scene_items import EvaluateItem, FitItem
from .words import TRANSPARENT

__all__ = [
    "ID",
    "KINDS",
    "PART_ENDINGS",
    "TRANSPARENT",
    "Defaults",
    "EditWords",
    "EvaluateItem",
    "FitItem",
    "FrameItem",
    "Item",
    "canonical",
    "digest",
]

#: Items by the word of their kind.
KINDS: dict[str, type[Item]] = Item.kinds
