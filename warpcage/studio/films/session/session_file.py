"""The file of a session of the editor: read and written, and its edits as a deformation."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import json
import os
import pathlib
from collections.abc import Iterable
from typing import Any

from ....core.checks import listed
from ....core.files import DAMAGED, PathLike, atomic_path, errors_of, read_json, require_file, require_version
from ....core.names import named_errors, renamed_keys
from ....errors import InputError
from ....splats.splat_field import AnyField
from ..checks import MAX_LINE, MAX_NAME
from ..document import MAIN, OLD_KEYS, Document
from ..edits import Deformation, PosedEdit

#: Version 2 has several objects, 3 has them and fragments by these names; all are read.
FORMAT, VERSION = "warpcage session", 3

#: How the name of a field's session ends: `lego.npz` has `lego.session.json`.
ENDING = ".session.json"

#: Identifies a version of a file: its time in nanoseconds, its bytes and its number.
Stamp = tuple[int, int, int]


def session_path(field: PathLike) -> pathlib.Path:
    """Where the session of a field's file is kept: beside it."""
    path = pathlib.Path(field)
    return path.with_name(path.stem + ENDING)


def free_session_path(path: pathlib.Path) -> pathlib.Path:
    """The first name of NAME.1.session.json, NAME.2.session.json, ... that no file beside a session's file has."""
    stem = path.name.removesuffix(ENDING) if path.name.endswith(ENDING) else path.stem
    names = (path.with_name(f"{stem}.{number}{ENDING}") for number in itertools.count(1))
    return next(name for name in names if not os.path.lexists(name))


def file_stamp(path: pathlib.Path) -> Stamp | None:
    """What identifies the version of a file. None where there is no file."""
    try:
        status = os.stat(path)
    except FileNotFoundError:
        return None
    return status.st_mtime_ns, status.st_size, status.st_ino


@dataclasses.dataclass(frozen=True)
class Export:
    """A file, or a folder of pictures, that a session wrote into its folder."""

    name: str
    text: str  # what it is, in a line
    size: int | None  # bytes of a file
    time: int | None  # when it was changed last, nanoseconds, by which another file of its name is known

    @classmethod
    def of(cls, path: pathlib.Path, text: str) -> Export:
        """What is noted of a file that was just written."""
        stamp = None if path.is_dir() else file_stamp(path)
        return cls(path.name, text, *((None, None) if stamp is None else (stamp[1], stamp[0])))

    def is_there(self, path: pathlib.Path) -> bool:
        """Whether a path is still that file, or a folder where it was one."""
        return path.is_dir() if self.size is None else path.is_file() and Export.of(path, self.text) == self


#: Exports that a session's file keeps, the newest.
MAX_EXPORTS = 40


def read_exports(content: Any) -> tuple[Export, ...]:
    """The exports of a session's file, the oldest first; what is no export is left out."""
    exports = []
    for entry in content[-MAX_EXPORTS:] if isinstance(content, list) else ():
        with contextlib.suppress(*DAMAGED, ValueError):
            one = Export(**entry)
            if all(isinstance(text, str) for text in (one.name, one.text)):
                exports.append(dataclasses.replace(one, text=one.text[:MAX_LINE]))
    return tuple(exports)


def write_session(
    path: PathLike,
    document: Document,
    field: AnyField,
    field_name: str | None,
    history: dict[str, Any] | None = None,
    exports: Iterable[Export] = (),
) -> None:
    """Write a session's file, whole or not at all; the name of a field without a file is None.
    history: its steps, see `History.to_json`; exports: what it wrote into its folder."""
    content = {
        "format": FORMAT,
        "version": VERSION,
        "field": {"name": field_name, "bounds": field.bounds.tolist()},
        "document": document.to_json("scene" if field_name is None else object_name(field_name)),
    } | ({} if history is None else {"history": history})
    if exports:
        content["exports"] = [dataclasses.asdict(export) for export in exports]
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, allow_nan=False) + "\n", encoding="utf-8")


def read_session(path: PathLike, field: AnyField | None = None) -> Document:
    """Read a session's file, which should belong to the field; None takes any."""
    return read_kept(path, field)[0]


def read_kept(path: PathLike, field: AnyField | None = None) -> tuple[Document, Any, tuple[Export, ...]]:
    """As `read_session`, what the file holds of its steps, see `read_history`, None where it holds nothing, and its
    exports."""
    path = require_file(path, "session file")
    with errors_of(path, "session file"):
        content: Any = read_json(path, "session file")
        if content.get("format") != FORMAT:
            raise InputError(f"it is no {FORMAT}")
        require_version(content.get("version"), VERSION)
        if field is not None and content["field"]["bounds"] != field.bounds.tolist():
            name = listed([str(content["field"].get("name"))])
            raise InputError(f"it belongs to another field, {name}, with other bounds")
        document = _named(Document.from_json(content["document"]), content)
        return document, content.get("history"), read_exports(content.get("exports"))


def _named(document: Document, content: Any) -> Document:
    """The document of a file's content; one that says nothing of objects names its only one as its field."""
    name = content.get("field", {}).get("name")
    if "objects" in renamed_keys(content["document"], OLD_KEYS) or not isinstance(name, str):
        return document
    return document.with_object(dataclasses.replace(document.objects[0], name=object_name(name)))


def object_name(path: PathLike) -> str:
    """What an object is called by the file of its field: its name without endings."""
    name = pathlib.PurePath(path).name.split(".")[0][:MAX_NAME]
    return name if name.strip() and name.isprintable() else "scene"


def is_session(path: str) -> bool:
    """Whether a file of --edits is a session of the editor. Raises for a file that is not there or no JSON."""
    file = require_file(path, "edits file")
    with errors_of(file, "edits file"):
        return read_json(file, "edits file").get("format") == FORMAT


def session_edits(path: str, interpolation: str | None = None) -> tuple[Deformation, list[str]]:
    """The visible edits of a session's own field, in the poses that it was left in, and a line on each edit."""
    visible = [edit for edit in read_session(path).edits_of(MAIN) if edit.visible]
    if not visible:
        raise InputError(f"{path}: the session has no visible edit")
    parts = []
    for edit in visible:
        with named_errors(f"{path}: edit {edit.name!r}"):
            cage_edit, poses = edit.cage_edit, []
            if not cage_edit.remove:
                poses = [cage_edit.cage.with_vertices(edit.posed)]
                poses[0].require_usable("the posed cage")
            parts.append(PosedEdit(cage_edit, poses, interpolation or "smooth"))
    return Deformation(parts), [f"{edit.name}: {edit.kind}" for edit in visible]
