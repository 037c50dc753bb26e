"""What items name and is not there: found before a run begins, not after hours of it."""

from __future__ import annotations

import os

from ..cage.presets import is_preset
from ..core.files import NpyFile, PathLike, require_file
from ..core.memory import Recent
from .fingerprints import references_of
from .items import Item
from .words import split_reference

#: Files that are remembered: each is looked at once, however many items name it.
MOST_FILES = 100_000


class Missing:
    """Looks for files and rows that items name; base: folder that their paths are relative to."""

    def __init__(self, base: PathLike):
        self.base = base
        self._files: Recent[NpyFile | str | None] = Recent(MOST_FILES)

    def of(self, item: Item) -> str | None:
        """One line on the first that an item names and is not there; None where all is there."""
        # Whether it can be used shows when the item is made.
        found = (self._wrong(reference) for reference in references_of(item))
        return next((line for line in found if line), None)

    def _wrong(self, reference: str) -> str | None:
        name, place = split_reference(reference)
        file = self._files.get(name, lambda: self._looked_at(name))
        if isinstance(file, str) or file is None or not place:
            return file if isinstance(file, str) else None
        rows = file.shape[0] if file.shape else 0
        if place.isdigit() and int(place) >= rows:
            return f"{file.path} has rows 0 to {rows - 1}, got {place}" if rows else f"{file.path} has no rows"
        return None

    def _looked_at(self, name: str) -> NpyFile | str | None:
        """The array in a .npy file, None for another that is there, or a line on what is wrong."""
        path = os.path.join(self.base, name)
        try:
            if os.path.isdir(path) or is_preset(name, self.base):
                return None
            return NpyFile(path) if name.lower().endswith(".npy") else require_file(path, "file") and None
        except (OSError, ValueError) as error:
            return str(error)
