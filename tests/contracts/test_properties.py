"""What holds for any content: pose files come back as they were written, PLY files of any elements (Gaussian splats
among them) and JSON files of any tree are read or refused in one line.

WARPCAGE_FUZZ_EXAMPLES=2000 tries more of each, other ones each time.
"""

import json
import os

import numpy as np
import pytest

pytest.importorskip("hypothesis")

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from warpcage import Cage, PoseFile, load_scene

EXAMPLES = os.environ.get("WARPCAGE_FUZZ_EXAMPLES")

anything = settings(
    max_examples=int(EXAMPLES or 60),
    derandomize=EXAMPLES is None,
    deadline=None,
    database=None,
    suppress_health_check=list(HealthCheck),
)

#: Types of a PLY header and of NumPy.
TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
         "double": "f8"}  # fmt: skip

NAMES = st.text(st.characters(codec="ascii", min_codepoint=97, max_codepoint=122), min_size=1, max_size=8)

TREES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=12), inner, max_size=4),
    max_leaves=12,
)


def one_line(read):
    """What `read` gives, or the one line in which it refuses."""
    try:
        return read(), None
    except (ValueError, FileNotFoundError) as error:
        assert str(error) and "\n" not in str(error)
        return None, str(error)


def test_pose_files_come_back_as_they_were_written(tmp_path):
    """Names of any letters, in their order, and vertices of any size, to the last bit."""
    numbers = st.floats(-1e6, 1e6, allow_subnormal=False)
    poses = st.lists(st.lists(numbers, min_size=24, max_size=24), max_size=4)
    names = st.lists(st.text(st.characters(exclude_categories=["Cs", "Cc"]), min_size=1, max_size=20), unique=True)

    @given(poses, names, st.floats(1e-3, 1e6), st.integers(0, 23))
    @anything
    def check(rows, titles, size, turn):
        rest = Cage.box([0, 0, 0], [size, 2 * size, 3 * size])
        rest = Cage(np.roll(rest.vertices, turn % 8, axis=0), (rest.faces + turn) % 8)
        keyframes = [
            (title, np.reshape(row, (8, 3))) for title, row in zip(titles, rows, strict=False) if title.strip() == title
        ]
        PoseFile(rest, keyframes).save(tmp_path / "poses.json")
        again = PoseFile.load(tmp_path / "poses.json")
        assert list(again) == [title for title, _ in keyframes]
        assert np.array_equal(again.rest.vertices, rest.vertices) and np.array_equal(again.rest.faces, rest.faces)
        for title, vertices in keyframes:
            assert np.array_equal(again[title].vertices, vertices)

    check()


def test_two_keyframes_of_one_name_are_not_one(tmp_path):
    rest = Cage.box([0, 0, 0], [1, 1, 1])
    PoseFile(rest, {"a": rest.twist(20), "b": rest}).save(tmp_path / "poses.json")
    text = (tmp_path / "poses.json").read_text(encoding="utf-8")
    (tmp_path / "poses.json").write_text(text.replace('"name": "b"', '"name": "a"'), encoding="utf-8")
    with pytest.raises(ValueError, match="two of its keyframes are named 'a'"):
        PoseFile.load(tmp_path / "poses.json")


@pytest.mark.parametrize("key", ["whole", "format", "version", "cage", "keyframes"])
def test_pose_files_of_any_tree_are_refused_in_one_line(tmp_path, key):
    rest = Cage.box([0, 0, 0], [1, 1, 1])
    PoseFile(rest, {"twisted": rest.twist(20)}).save(tmp_path / "poses.json")
    valid = json.loads((tmp_path / "poses.json").read_text(encoding="utf-8"))

    @given(TREES)
    @anything
    def check(tree):
        content = tree if key == "whole" else {**valid, key: tree}
        (tmp_path / "poses.json").write_text(json.dumps(content), encoding="utf-8")
        file, _ = one_line(lambda: PoseFile.load(tmp_path / "poses.json"))
        if file is not None:  # the tree happens to be valid: no keyframes, or that version
            assert (key == "keyframes" and tree == []) or (key == "version" and tree == valid["version"])

    check()


@st.composite
def ply_files(draw):
    """A PLY file of splats, as bytes: positions among any other properties, and what its vertices are."""
    count = draw(st.integers(0, 6))
    order = draw(st.sampled_from(["ascii", "binary_little_endian", "binary_big_endian"]))
    others = draw(st.lists(st.tuples(NAMES.filter(lambda name: name not in "xyz"), st.sampled_from(sorted(TYPES))),
                           max_size=12, unique_by=lambda each: each[0]))  # fmt: skip
    kind = draw(st.sampled_from(["float", "double"]))
    properties = draw(st.permutations([*((axis, kind) for axis in "xyz"), *others]))
    rows = np.zeros(count, [(name, ("<" if order != "binary_big_endian" else ">") + TYPES[kind])
                            for name, kind in properties])  # fmt: skip
    for name, type_name in properties:
        if TYPES[type_name][0] == "f":
            values = st.floats(-1e3, 1e3, width=32, allow_subnormal=False)
        else:
            values = st.integers(np.iinfo(TYPES[type_name]).min, np.iinfo(TYPES[type_name]).max)
        rows[name] = draw(st.lists(values, min_size=count, max_size=count))
    lines = ["ply", f"format {order} 1.0", f"element vertex {count}"]
    lines += [f"property {type_name} {name}" for name, type_name in properties]
    if draw(st.booleans()):
        lines += ["element face 0", "property list uchar int vertex_indices"]
    head = "\n".join([*lines, "end_header", ""]).encode()
    if order == "ascii":
        body = "".join(" ".join(repr(value) for value in row.tolist()) + "\n" for row in rows).encode()
    else:
        body = rows.tobytes()
    return head + body


def test_splats_are_no_cage_and_say_so(tmp_path):
    """PLY files of points with any properties have no faces: one line says that, whatever else they hold."""

    @given(ply_files())
    @anything
    def check(content):
        (tmp_path / "points.ply").write_bytes(content)
        cage, said = one_line(lambda: Cage.load(tmp_path / "points.ply"))
        assert cage is None and "points.ply" in said

    check()


@pytest.mark.parametrize("name", ["transforms_train.json", "transforms.json"])
def test_scene_files_of_any_tree_are_refused_in_one_line(tmp_path, name):
    @given(TREES | st.fixed_dictionaries({"camera_angle_x": TREES, "frames": st.lists(TREES, max_size=3)}))
    @anything
    def check(tree):
        (tmp_path / name).write_text(json.dumps(tree), encoding="utf-8")
        scene, _ = one_line(lambda: load_scene(tmp_path))
        assert scene is None  # there is no picture

    check()
