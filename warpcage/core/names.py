"""Names that options take, each in one place."""

from __future__ import annotations

#: Kinds of coordinates, as `coordinates=` takes them.
KINDS = ("mean_value", "green", "harmonic")
DENSITIES = ("opacity", "paper")
COORDINATES = ("harmonic", "mean_value", "green")
STORES = ("map", "weights")
