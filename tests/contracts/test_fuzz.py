"""Damaged files of every kind that is read: only errors of the package come out, in one line that names a file, and
memory stays bounded. The damages are drawn, other ones in each run; those that were made by hand are in
test_broken_input, test_broken_fields, test_hostile_files and test_splat_hostile."""

import functools
import operator

import hostile
import numpy as np
import pytest
from hostile import FORMATS, LEFT_OUT, put, read_or_refuse, whole
from hypothesis import given
from hypothesis import strategies as st

pytestmark = pytest.mark.filterwarnings("ignore")


#: Damages that were drawn once, and that something was wrong with: files and what is in them.
KNOWN = [
    ("bundler", "list.txt", hostile.swap("images/view_00", "[" * 3000 + "images/view_00")),
    ("opensfm", "reconstruction.json", hostile.swap('"translation": [', '"translation": [1e300, 0, 0], "x": [')),
    ("transforms", "transforms.json", hostile.swap("images/view_00.png", f"images/{'b' * 300}/images/x.jpg")),
    ("stray", "odometry.csv", lambda data: data + b"nan\n"),
    ("bundler", "bundle/bundle.out", hostile.instead("# Bundle file v0.3\n3")),
    ("metashape", "cameras.xml", hostile.swap('<resolution width="24"', '<resolution width=""')),
]


@pytest.mark.parametrize("name, file, damage", KNOWN)
def test_damages_of_old(tmp_path, name, file, damage):
    put(tmp_path, whole(name))
    read_or_refuse(name, tmp_path, {file: damage(whole(name)[file])})


@pytest.mark.scaled
@pytest.mark.parametrize("name", FORMATS)
def test_drawn_damages(tmp_path, name):
    put(tmp_path, whole(name))

    @given(hostile.damaged(name), st.booleans())
    def try_damaged(changed, detect):
        file, data = changed
        options = {} if detect or name not in hostile.SCENES else {"format": name.split()[0]}
        read_or_refuse(name, tmp_path, {file: data}, **options)

    try_damaged()


#: What stands in place of each value of a file, and of each array, by day and at night.
VALUES = [LEFT_OUT, "x", -1, 10**400, float("nan"), None, [], True, {}, 1e300, "../x.png", [[1, 2], [3]]]
ARRAYS_BY_DAY = [1, 2, 3, 5, 7, 9, 13]
HAVING_PLACES = [
    "blender",
    "transforms",
    "transforms lens",
    "transforms matrix",
    "record3d",
    "opensfm",
    "dtu",
    *hostile.FIELDS,
    "sog",
]
HAVING_PLACES += ["replica", "nerfies", "3dgs", "splats glb", "cage.glb", "cage.gltf", *hostile.OTHERS]


@pytest.mark.scaled
@pytest.mark.parametrize("name", HAVING_PLACES)
def test_each_value_in_place_of_each(tmp_path, name, at_night):
    """Values of other kinds and sizes, one at a time, in all places of files that hold trees or arrays."""
    put(tmp_path, whole(name))
    for file, data in whole(name).items():
        ending = hostile.ending_of(file, data)
        content = hostile.OPENED[ending][0](data) if ending else None
        for path in hostile.places(content):
            old = functools.reduce(operator.getitem, path, content)
            if isinstance(old, np.ndarray):
                values = [LEFT_OUT, *(hostile.ARRAYS if at_night else [hostile.ARRAYS[k] for k in ARRAYS_BY_DAY])]
            elif isinstance(old, bytes):
                values = [LEFT_OUT, b"", b"x", bytes(100)]
            else:
                values = VALUES if at_night else VALUES[:5]
            for value in values:
                read_or_refuse(
                    name, tmp_path, {file: hostile.OPENED[ending][1](hostile.replaced(content, path, value))}
                )
