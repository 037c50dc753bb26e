"""Damaged files of every kind that is read: only errors of the package come out, in one line that names a file, and
memory stays bounded. The damages are drawn, other ones in each run; those that were made by hand are in
test_broken_input, test_broken_fields, test_hostile_files and test_splat_"""

import copy
import functools
import operator
import pathlib

import numpy as np
import pytest
from hostile import FIELDS, FORMATS, OPENED, OTHERS, SCENES, instead, put, read_or_refuse, swap, whole
from hypothesis import given
from hypothesis import strategies as st

pytestmark = pytest.mark.filterwarnings("ignore")


def ending_of(name, data):
    """The key of OPENED for a file, or None."""
    ending = ".gzip" if data.startswith(b"\x1f\x8b") else pathlib.PurePath(name).suffix
    return ending if ending in OPENED else None


def places(content, path=()):
    """Where values of a tree are, the keys that lead there: of lists, and of dicts of one kind, in the first."""
    if isinstance(content, dict | list) and content:
        inner = content if isinstance(content, dict) else dict(enumerate(content))
        kinds = {frozenset(each) if isinstance(each, dict) else None for each in inner.values()}
        alike = isinstance(content, list) or (len(kinds) == 1 and None not in kinds)
        for key in list(inner)[:1] if alike else inner:
            yield (*path, key)
            yield from places(inner[key], (*path, key))


LEFT_OUT = "left out"


def replaced(content, path, value):
    """A tree with another value in a place."""
    if not path:
        return value
    content = copy.deepcopy(content)
    inner = functools.reduce(operator.getitem, path[:-1], content)
    if value is not LEFT_OUT:
        inner[path[-1]] = value
    elif isinstance(inner, list) or path[-1] in inner:
        del inner[path[-1]]
    return content


# Damages that are drawn

WORDS = [
    b"nan", b"-inf", b"1e400", b"-1", b"0", b"99999999999999999999", b"1" * 5000, b"4294967295", b"x", b"\x00", b"null",
    b"true", b'"text"', b"[]", b"{}", b"[" * 3000, b"../../x", b"/etc/passwd", b"\xff\xfe", b"\n", b"#",
]  # fmt: skip


@st.composite
def bytes_damaged(draw, data):
    """Other bytes: cut off, flipped, put in, taken out, repeated, exchanged, or another word in place of one."""
    kind = draw(st.sampled_from(["cut", "flip", "insert", "remove", "word", "repeat", "swap"]))
    at, size = int(draw(st.floats(0, 1)) * len(data)), draw(st.integers(1, 40))
    content = draw(st.sampled_from(WORDS) | st.binary(max_size=16))
    if kind == "cut":
        return data[:at]
    if kind == "flip":
        return data[:at] + bytes(byte ^ (size * 7 & 255) for byte in data[at : at + 1]) + data[at + 1 :]
    if kind == "insert":
        return data[:at] + content + data[at:]
    if kind == "remove":
        return data[:at] + data[at + size :]
    if kind == "repeat":
        return data[:at] + data[at : at + size] * 3 + data[at + size :]
    if kind == "swap":
        return data[:at] + data[at + size : at + 2 * size] + data[at : at + size] + data[at + 2 * size :]
    words = data.replace(b",", b" , ").split(b" ")
    words[min(at * len(words) // max(1, len(data)), len(words) - 1)] = content
    return b" ".join(words)


NAMES = (
    "../x.png /etc/passwd images .. . images/view_00.png \0 train train/view_01 masks/view_01.png PINHOLE "
    "OPENCV_FISHEYE EQUIRECTANGULAR ../x.bin cage.gltf " + "a" * 5000
).split(" ")

NUMBERS = st.integers(-(10**320), 10**320) | st.integers(-9, 10**10) | st.floats()

VALUES = st.recursive(
    st.none() | st.booleans() | NUMBERS | st.text(max_size=8) | st.sampled_from(NAMES),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=8,
)

#: Keys that some files have, put in where they are none.
KEYS = ["k4", "mask_path", "train_filenames", "applied_transform", "w"]

ARRAYS = [
    np.zeros(0), np.zeros((0, 9, 3)), np.full((2, 3), np.nan), np.array("text"), np.array([1, 2, 3]),
    np.array([10**6, 10**6, 10**6]), np.array([-1, 2, 3]), np.float64(1e300), np.array(2**63, np.uint64), np.int8(1),
    np.zeros((3, 3, 3), np.int64), np.full((6, 6, 6), 2**40), np.array([True]), np.array([1j]),
    np.array([[1e300] * 3, [2e300] * 3]), np.array([[0, 0, 0], [1e-300, 1, 1]]),
    np.full((6, 6, 6), -7, np.int32), np.full(27, 255, np.uint8), np.array([1e38], np.float32),
    np.ones((4, 4)), np.zeros((2, 3), "M8[s]"), np.zeros(3, [("x", "f4"), ("y", "i4")]),
]  # fmt: skip


@st.composite
def tree_damaged(draw, content, root):
    """A tree with another value, or none, in one place. root: whether that may be all of it."""
    path, inner = [], content
    while isinstance(inner, dict | list) and inner and (draw(st.integers(0, 4)) or not (path or root)):
        keys = [*inner, *(KEYS if "frames" in inner or "file_path" in inner else [])]
        path.append(draw(st.sampled_from(keys if isinstance(inner, dict) else range(len(inner)))))
        inner = inner[path[-1]] if isinstance(inner, list) or path[-1] in inner else None
    if isinstance(inner, bytes):
        return replaced(content, path, draw(bytes_damaged(inner)))
    if isinstance(inner, np.ndarray):
        return replaced(content, path, draw(st.just(LEFT_OUT) | st.sampled_from(ARRAYS)))
    return replaced(content, path, draw(st.just(LEFT_OUT) | VALUES if path else VALUES)) if path or root else content


@st.composite
def damaged(draw, name):
    """The name of a file of a format, and other bytes for it."""
    files = whole(name)
    cameras = [file for file in files if not file.endswith(".png")]
    file = draw(st.sampled_from([*files, *cameras * 3]))
    data, ending = files[file], ending_of(file, files[file])
    inside = ending is not None and draw(st.booleans())
    if inside:
        content = OPENED[ending][0](data)
        for _ in range(draw(st.integers(1, 2))):
            content = draw(tree_damaged(content, ending in (".json", ".gltf")))
        data = OPENED[ending][1](content)
    for _ in range(draw(st.integers(0 if inside else 1, 2 if inside else 3))):
        data = draw(bytes_damaged(data))
    return file, data


#: Damages that were drawn once, and that something was wrong with: files and what is in them.
KNOWN = [
    ("bundler", "list.txt", swap("images/view_00", "[" * 3000 + "images/view_00")),
    ("opensfm", "reconstruction.json", swap('"translation": [', '"translation": [1e300, 0, 0], "x": [')),
    ("transforms", "transforms.json", swap("images/view_00.png", f"images/{'b' * 300}/images/x.jpg")),
    ("stray", "odometry.csv", lambda data: data + b"nan\n"),
    ("bundler", "bundle/bundle.out", instead("# Bundle file v0.3\n3")),
    ("metashape", "cameras.xml", swap('<resolution width="24"', '<resolution width=""')),
]


@pytest.mark.parametrize("name, file, damage", KNOWN)
def test_damages_of_old(tmp_path, name, file, damage):
    put(tmp_path, whole(name))
    read_or_refuse(name, tmp_path, {file: damage(whole(name)[file])})


@pytest.mark.scaled
@pytest.mark.parametrize("name", FORMATS)
def test_drawn_damages(tmp_path, name):
    put(tmp_path, whole(name))

    @given(damaged(name), st.booleans())
    def try_damaged(changed, detect):
        file, data = changed
        options = {} if detect or name not in SCENES else {"format": name.split()[0]}
        read_or_refuse(name, tmp_path, {file: data}, **options)

    try_damaged()


#: What stands in place of each value of a file, and of each array, by day and at night.
VALUES_OF_EACH = [LEFT_OUT, "x", -1, 10**400, float("nan"), None, [], True, {}, 1e300, "../x.png", [[1, 2], [3]]]
ARRAYS_BY_DAY = [1, 2, 3, 5, 7, 9, 13]
HAVING_PLACES = ["blender", "transforms", "transforms lens", "transforms matrix", "record3d", "opensfm", "dtu", *FIELDS]
HAVING_PLACES += ["sog", "replica", "nerfies", "3dgs", "splats glb", "cage.glb", "cage.gltf", *OTHERS]


@pytest.mark.scaled
@pytest.mark.parametrize("name", HAVING_PLACES)
def test_each_value_in_place_of_each(tmp_path, name, at_night):
    """Values of other kinds and sizes, one at a time, in all places of files that hold trees or arrays."""
    put(tmp_path, whole(name))
    for file, data in whole(name).items():
        ending = ending_of(file, data)
        content = OPENED[ending][0](data) if ending else None
        for path in places(content):
            old = functools.reduce(operator.getitem, path, content)
            if isinstance(old, np.ndarray):
                values = [LEFT_OUT, *(ARRAYS if at_night else [ARRAYS[k] for k in ARRAYS_BY_DAY])]
            elif isinstance(old, bytes):
                values = [LEFT_OUT, b"", b"x", bytes(100)]
            else:
                values = VALUES_OF_EACH if at_night else VALUES_OF_EACH[:5]
            for value in values:
                read_or_refuse(name, tmp_path, {file: OPENED[ending][1](replaced(content, path, value))})
