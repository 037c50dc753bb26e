"""Session files: a document as JSON, and the field that it belongs to."""

from __future__ import annotations

import json
import os
import pathlib
from typing import Any

from ..core.checks import listed
from ..core.files import DAMAGED, PathLike, atomic_path, damage, read_json, require_file
from ..splats.splat_field import AnyField
from .document import Document

FORMAT, VERSION = "warpcage session", 1

#: How the name of a field's session ends: `lego.npz` has `lego.session.json`.
ENDING = ".session.json"

#: What tells versions of a file apart: its time in nanoseconds, its bytes and its number.
Stamp = tuple[int, int, int]


def session_path(field: PathLike) -> pathlib.Path:
    """Where the session of a field's file is kept: beside it."""
    path = pathlib.Path(field)
    return path.with_name(path.stem + ENDING)


def free_session_path(path: pathlib.Path) -> pathlib.Path:
    """The first name of NAME.1.session.json, NAME.2.session.json, ... that no file beside a session's file has."""
    stem = path.name.removesuffix(ENDING) if path.name.endswith(ENDING) else path.stem
    number = 1
    while os.path.lexists(other := path.with_name(f"{stem}.{number}{ENDING}")):
        number += 1
    return other


def file_stamp(path: pathlib.Path) -> Stamp | None:
    """What tells versions of a file apart. None where there is no file."""
    try:
        status = os.stat(path)
    except FileNotFoundError:
        return None
    return status.st_mtime_ns, status.st_size, status.st_ino


def write_session(path: PathLike, document: Document, field: AnyField, field_name: str | None) -> None:
    """Write a session's file, whole or not at all; the name of a field without a file is None."""
    content = {
        "format": FORMAT,
        "version": VERSION,
        "field": {"name": field_name, "bounds": field.bounds.tolist()},
        "document": document.to_json(),
    }
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, allow_nan=False) + "\n", encoding="utf-8")


def read_session(path: PathLike, field: AnyField | None = None) -> Document:
    """Read a session's file, which should belong to the field; None takes any."""
    path = require_file(path, "session file")
    try:
        content: Any = read_json(path, "session file")
        if content.get("format") != FORMAT:
            raise ValueError(f"it is no {FORMAT}")
        version = content.get("version")
        if type(version) is not int or version < 1:
            raise ValueError(f"its version must be a whole number from 1, got {str(version)[:40]!r}")
        if version > VERSION:
            raise ValueError(f"its version is {version}, this warpcage reads up to {VERSION}: upgrade")
        if field is not None and content["field"]["bounds"] != field.bounds.tolist():
            name = listed([str(content["field"].get("name"))])
            raise ValueError(f"it belongs to another field, {name}, with other bounds")
        return Document.from_json(content["document"])
    except DAMAGED as error:
        raise ValueError(f"{path}: {damage('session file', error)}") from None
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
