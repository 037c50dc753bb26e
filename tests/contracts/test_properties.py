"""What holds for any content: pose files come back as they were written, PLY files of any elements (Gaussian splats
among them) are no cages."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import refused

from warpcage import Cage, PoseFile

#: Types of a PLY header and of NumPy.
TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
         "double": "f8"}  # fmt: skip

NAMES = st.text(st.characters(codec="ascii", min_codepoint=97, max_codepoint=122), min_size=1, max_size=8)

VERTICES = st.lists(st.floats(-1e6, 1e6, allow_subnormal=False), min_size=24, max_size=24)
TITLES = st.text(st.characters(exclude_categories=["Cs", "Cc"]), min_size=1, max_size=20)
KEYFRAMES = st.lists(
    st.tuples(TITLES.filter(lambda title: title.strip() == title), VERTICES), max_size=4, unique_by=lambda row: row[0]
)


@pytest.mark.scaled
@given(KEYFRAMES, st.floats(1e-3, 1e6), st.integers(0, 23))
def test_pose_files_come_back_as_they_were_written(tmp_path_factory, keyframes, size, turn):
    """Names of any letters, in their order, and vertices of any size, to the last bit."""
    path = tmp_path_factory.getbasetemp() / "poses.json"
    rest = Cage.box([0, 0, 0], [size, 2 * size, 3 * size])
    rest = Cage(np.roll(rest.vertices, turn % 8, axis=0), (rest.faces + turn) % 8)
    PoseFile(rest, [(title, np.reshape(row, (8, 3))) for title, row in keyframes]).save(path)
    again = PoseFile.load(path)
    assert list(again) == [title for title, _ in keyframes]
    assert np.array_equal(again.rest.vertices, rest.vertices) and np.array_equal(again.rest.faces, rest.faces)
    for title, row in keyframes:
        assert np.array_equal(again[title].vertices, np.reshape(row, (8, 3)))


def test_two_keyframes_of_one_name_are_not_one(tmp_path):
    rest = Cage.box([0, 0, 0], [1, 1, 1])
    PoseFile(rest, {"a": rest.twist(20), "b": rest}).save(tmp_path / "poses.json")
    text = (tmp_path / "poses.json").read_text(encoding="utf-8")
    (tmp_path / "poses.json").write_text(text.replace('"name": "b"', '"name": "a"'), encoding="utf-8")
    refused(lambda: PoseFile.load(tmp_path / "poses.json"), "two of its keyframes are named 'a'")


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


@pytest.mark.scaled
@given(ply_files())
def test_splats_are_no_cage_and_say_so(tmp_path_factory, content):
    """PLY files of points with any properties have no faces: one line says that, whatever else they hold."""
    path = tmp_path_factory.getbasetemp() / "points.ply"
    path.write_bytes(content)
    refused(lambda: Cage.load(path), "points.ply")
