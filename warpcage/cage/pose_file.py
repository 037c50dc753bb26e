"""Named poses of one cage: blending, and a JSON file that outlives versions of the cage file and of this library."""

from __future__ import annotations

import hashlib
import json

import numpy as np

from ..core.files import atomic_path, require_file
from .cage import Cage

_FORMAT, _VERSION = "warpcage poses", 1


class PoseFile:
    """Named keyframes of a rest cage.

    rest: Cage. keyframes: name -> pose, a Cage in any order that `Cage.match` takes, or vertices (v, 3).
    Raises ValueError for a pose that does not fit or an empty name.

    The file is JSON: format, version, cage (sha256 over its faces and float64 vertices, and both in full) and
    keyframes (name and vertices, each number with all its digits). Readers ignore keys that they do not know, so later
    versions may add some; one that changes the meaning of these raises `version`.
    """

    def __init__(self, rest: Cage, keyframes=()):
        self.rest = rest
        self._poses: dict[str, Cage] = {}
        for name, pose in dict(keyframes).items():
            self[name] = pose

    def __setitem__(self, name: str, pose) -> None:
        if not isinstance(name, str) or not name.strip():
            raise ValueError(f"a keyframe needs a name, got {name!r}")
        try:
            self._poses[name] = self.rest.match(pose) if isinstance(pose, Cage) else self.rest.with_vertices(pose)
        except ValueError as error:
            raise ValueError(f"keyframe {name!r}: {error}") from None

    def __getitem__(self, name: str) -> Cage:
        if name not in self._poses:
            raise ValueError(f"there is no keyframe {name!r}: {', '.join(self._poses) or 'none at all'}")
        return self._poses[name]

    def __len__(self) -> int:
        return len(self._poses)

    @property
    def names(self) -> tuple[str, ...]:
        """Names in the order they were added."""
        return tuple(self._poses)

    def blend(self, weights) -> Cage:
        """The rest cage plus the weighted displacements of keyframes: v = rest + sum w (pose - rest).

        weights: name -> number of any size; {} is the rest cage. Raises ValueError for unknown names or NaN.
        """
        vertices = self.rest.vertices.copy()
        for name, weight in weights.items():
            if not np.isfinite(weight):
                raise ValueError(f"the weight of keyframe {name!r} must be finite, got {weight}")
            vertices += float(weight) * (self[name].vertices - self.rest.vertices)
        return self.rest.with_vertices(vertices)

    def at(self, time: float, names=None) -> Cage:
        """The cage `time` keyframes along a sequence of names (default: all, in order), 0 the first of them, on a
        Catmull-Rom spline through the keyframes. Raises ValueError for a time beyond the sequence."""
        names = list(self.names if names is None else names)
        if not names or not 0.0 <= time <= len(names) - 1:
            raise ValueError(f"time must be 0 to {len(names) - 1} for {len(names)} keyframes, got {time}")
        k = min(int(time), max(len(names) - 2, 0))
        t = time - k
        p0, p1, p2, p3 = (self[names[int(np.clip(j, 0, len(names) - 1))]].vertices for j in range(k - 1, k + 3))
        vertices = p1 + 0.5 * t * (
            p2 - p0 + t * (2.0 * p0 - 5.0 * p1 + 4.0 * p2 - p3 + t * (3.0 * (p1 - p2) + p3 - p0))
        )
        return self.rest.with_vertices(vertices)

    def save(self, path) -> None:
        """Write the file, whole or not at all."""
        document = {
            "format": _FORMAT, "version": _VERSION,
            "cage": {"sha256": cage_hash(self.rest), "faces": self.rest.faces.tolist(),
                     "vertices": self.rest.vertices.tolist()},
            "keyframes": [{"name": name, "vertices": pose.vertices.tolist()} for name, pose in self._poses.items()],
        }  # fmt: skip
        with atomic_path(path) as temporary:
            temporary.write_text(json.dumps(document) + "\n", encoding="utf-8")

    @classmethod
    def load(cls, path, rest: Cage | None = None) -> PoseFile:
        """Read a file. rest: the cage to pose, if need be in another order than the file's; None takes the file's own.

        Raises FileNotFoundError, or ValueError for what is no such file, a newer version, a damaged cage, or a rest
        cage that its poses do not fit.
        """
        path = require_file(path, "pose file")
        try:
            document = json.loads(path.read_text(encoding="utf-8"))
            if document["format"] != _FORMAT:
                raise ValueError(f"its format is {document['format']!r}, not {_FORMAT!r}")
            if document["version"] > _VERSION:
                raise ValueError(f"its version is {document['version']}, this warpcage reads up to {_VERSION}: upgrade")
            own = Cage(document["cage"]["vertices"], document["cage"]["faces"])
            if cage_hash(own) != document["cage"]["sha256"]:
                raise ValueError("its cage does not have the hash it names: the file was changed")
            poses = {frame["name"]: own.with_vertices(frame["vertices"]) for frame in document["keyframes"]}
            return cls(own if rest is None else rest, poses)
        except (KeyError, TypeError, OverflowError, RecursionError, UnicodeDecodeError, json.JSONDecodeError) as error:
            raise ValueError(f"{path}: no pose file: {type(error).__name__} {error}") from None
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None


def cage_hash(cage: Cage) -> str:
    """sha256 over the counts, the faces (little-endian int32) and the vertices (little-endian float64)."""
    digest = hashlib.sha256(f"{len(cage.vertices)} {len(cage.faces)}\n".encode())
    digest.update(np.ascontiguousarray(cage.faces, dtype="<i4").tobytes())
    digest.update(np.ascontiguousarray(cage.vertices + 0.0, dtype="<f8").tobytes())
    return digest.hexdigest()
