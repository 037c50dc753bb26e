"""Objects by numbers: operators of other libraries take arrays, numbers and texts alone."""

from __future__ import annotations

import itertools
import threading
import weakref
from typing import Any, TypeVar

from ..coordinate_kinds import COORDINATE_KINDS
from ..core.checks import require_type
from ..errors import InputError, StateError
from ..mesh.mesh import ClosedMesh, require_mesh

_Kind = TypeVar("_Kind")

#: Objects are held by their owners alone, as a compiled function may outlive them.
_objects: weakref.WeakValueDictionary[int, Any] = weakref.WeakValueDictionary()

_numbers: weakref.WeakKeyDictionary[Any, int] = weakref.WeakKeyDictionary()

_next = itertools.count()

_change = threading.Lock()


def number_of(item: Any, kind: type, what: str) -> int:
    """The number of an object of a kind, the same as long as it lives; `what` begins the message where it is none."""
    if kind is ClosedMesh:
        require_mesh(item, what)
    require_type(item, kind, what)
    with _change:
        if item not in _numbers:
            _numbers[item] = next(_next)
            _objects[_numbers[item]] = item
        return _numbers[item]


def object_of(number: int, kind: type[_Kind]) -> _Kind:
    """The object of a number."""
    found = _objects.get(number)
    if not isinstance(found, kind):
        raise StateError(f"a {kind.__name__} of this call is no longer there: hold it as long as what was made with it")
    return found


def weight_counts(cage: ClosedMesh, coordinates: str) -> tuple[int, int]:
    """Columns of a cage's weights of a kind: of vertices, and of faces, 0 for kinds that have none."""
    kind = COORDINATE_KINDS[coordinates]
    if coordinates not in WEIGHT_KINDS:
        raise InputError(f"weights with gradients are of {' and '.join(WEIGHT_KINDS)}, not of {coordinates}")
    return cage.own_count, len(cage.refined(kind.face_cells).faces) if kind.has_face_weights else 0


#: Kinds of coordinates whose weights have a backward pass.
WEIGHT_KINDS = ("mean_value", "green")
