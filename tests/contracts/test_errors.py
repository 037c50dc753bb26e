"""Every refusal is a warpcage.Error, and what Python calls such a mistake too."""

import errno
import importlib
import os
import pickle

import numpy as np
import pytest
from refusals import refused

import warpcage
from warpcage import errors
from warpcage.core import atomic_path
from warpcage.core.memory import MemoryShortage

CLASSES = [each for each in vars(errors).values() if isinstance(each, type) and issubclass(each, errors.Error)]


@pytest.mark.parametrize("kind", CLASSES, ids=lambda kind: kind.__name__)
def test_errors_are_pickled_as_their_class(kind):
    error = errors.file_error(OSError("what is wrong")) if kind is errors.FileError else kind("what is wrong")
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is type(error) and isinstance(again, kind) and isinstance(again, warpcage.Error)
    assert str(again) == "what is wrong"


CAGE = warpcage.Cage.box([-1, -1, -1], [1, 1, 1])
OPEN = warpcage.Cage(CAGE.vertices, CAGE.faces[1:])


def field():
    return warpcage.VoxelField.from_dense(np.full((4, 4, 4), 5.0), np.zeros((4, 4, 4, 9, 3)), [[-1] * 3, [1] * 3])


#: Refusals of all rooms, and what Python calls them.
REFUSED = {
    "core": (lambda folder: warpcage.mean_value_coordinates([[0, 0, 0]], CAGE, device="cuda:99"), ValueError),
    "mesh": (lambda folder: warpcage.Cage([[0, 0]], [[0, 1, 2]]), ValueError),
    "file": (lambda folder: warpcage.Cage.load(folder / "none.obj"), FileNotFoundError),
    "damaged": (lambda folder: warpcage.VoxelField.load(folder / "text.npz"), ValueError),
    "view": (lambda folder: warpcage.Camera.look_at([0, 0, 0], [0, 0, 0], width=4, height=4), ValueError),
    "coordinates": (lambda folder: warpcage.green_coordinates([[0, 0, 0]], OPEN), ValueError),
    "scene": (lambda folder: warpcage.load_scene(folder / "none"), FileNotFoundError),
    "splats": (lambda folder: warpcage.SplatField.load(folder / "none.ply"), FileNotFoundError),
    "cage": (lambda folder: CAGE.bend(40, axis="w"), ValueError),
    "poses": (lambda folder: warpcage.PoseFile.load(folder / "text.json"), ValueError),
    "deform": (lambda folder: warpcage.Deformer(field(), CAGE, coordinates="linear"), ValueError),
    "pickled": (lambda folder: pickle.dumps(field()), TypeError),
    "fit": (lambda folder: warpcage.fit(5), ValueError),
    "jobs": (lambda folder: warpcage.run_jobs(folder / "text.json", folder / "out"), ValueError),
    "editor": (lambda folder: warpcage.edit(5, CAGE), ValueError),
    "progress": (lambda folder: warpcage.Cage.from_field(field(), progress=lambda *told: False), warpcage.Cancelled),
    "parent": (lambda folder: CAGE.save(folder / "text.json" / "cage.obj"), OSError),
}


@pytest.mark.parametrize("room", REFUSED)
def test_refusals_of_all_rooms(room, tmp_path):
    for name in ("text.json", "text.npz"):
        (tmp_path / name).write_text("text")
    call, kind = REFUSED[room]
    refused(lambda: call(tmp_path), error=kind)


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EACCES, errno.ENOENT])
def test_what_the_system_refuses_keeps_its_class(number, tmp_path, monkeypatch):
    def full(*names):
        raise OSError(number, os.strerror(number), str(names[0]))

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(warpcage.Error) as caught, atomic_path(tmp_path / "a.txt") as temporary:
        temporary.write_text("a")
    assert isinstance(caught.value, type(OSError(number, ""))) and caught.value.errno == number
    again = pickle.loads(pickle.dumps(caught.value))
    assert (type(again), again.errno, again.filename) == (type(caught.value), number, caught.value.filename)
    assert list(tmp_path.iterdir()) == []


def test_too_little_memory_is_a_refusal():
    assert issubclass(MemoryShortage, warpcage.Error) and issubclass(MemoryShortage, ValueError)
    assert importlib.import_module("warpcage").Error is errors.Error
