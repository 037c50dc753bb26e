"""Cages to and from other programs. tests/data/blender was written by Blender 5.0.1 through `python
benchmarks blender round-trip`: a cylinder cage, its export in each dialect after a bend, where Blender has it."""

import base64
import json
import pathlib
import struct

import numpy as np
import pytest
from refusals import refused

from warpcage import Cage
from warpcage.mesh import cut_polygon

FIXTURES = pathlib.Path(__file__).parents[2] / "data" / "blender"
POSED = sorted(
    path.name for path in FIXTURES.iterdir() if path.stem not in ("rest", "bent") and not path.stem.endswith("_rest")
)


def up(name):
    return "y" if name.split(".")[0] in ("obj_default", "obj_groups", "ply_ascii_y_up") else None


@pytest.mark.parametrize("name", POSED)
def test_a_pose_from_blender_is_matched(name):
    whole, bent = Cage.load(FIXTURES / "rest.obj"), np.loadtxt(FIXTURES / "bent.txt")
    own = FIXTURES / name.replace(".", "_rest.")
    rest = Cage.load(own, up=up(name)) if own.exists() else whole
    # which vertex of the whole cage each one is: n-gons have fewer
    near = np.linalg.norm(rest.vertices[:, None] - whole.vertices[None], axis=2)
    number = near.argmin(axis=1)
    assert near.min(axis=1).max() < 1e-5
    posed = Cage.load(FIXTURES / name, up=up(name))
    posed.require_usable()
    found = rest.match(posed)
    assert np.abs(found.vertices - bent[number]).max() < 3e-6 and found.faces is rest.faces
    assert np.abs(found.vertices - rest.vertices).max() > 0.1
    if "shuffled" in name:
        assert np.abs(posed.vertices - bent).max() > 0.1


def test_fixtures_hold_what_their_names_say():
    assert len(POSED) == 13
    lines = (FIXTURES / "obj_ngons.obj").read_text().splitlines()
    assert 7 in {len(line.split()) - 1 for line in lines if line.startswith("f ")}
    text = (FIXTURES / "obj_groups.obj").read_text()
    assert all(f"\n{word} " in text for word in ("g", "usemtl", "s", "vn"))
    assert b'"NORMAL"' in (FIXTURES / "glb.glb").read_bytes()


@pytest.mark.parametrize("ending", ["glb", "gltf"])
def test_gltf_keeps_order_and_digits_far_from_the_origin(tmp_path, ending):
    cage = Cage.box([0, 0, 0], [1, 1, 1])
    vertices = np.random.default_rng(1).normal(size=(11, 3)) + [1e6, -2e6, 3e6]
    vertices[10] = vertices[4]  # stays a vertex of its own
    cage = Cage(vertices, cage.faces + 1)
    cage.save(tmp_path / f"c.{ending}")
    back = Cage.load(tmp_path / f"c.{ending}")
    assert np.array_equal(back.faces, cage.faces) and np.abs(back.vertices - cage.vertices).max() < 1e-6
    back.save(tmp_path / f"d.{ending}")
    assert (tmp_path / f"c.{ending}").read_bytes() == (tmp_path / f"d.{ending}").read_bytes()


def test_trimesh_reads_our_gltf_y_up(tmp_path):
    import trimesh

    cage = Cage.box([0, 0, 0], [1, 2, 30])
    for name in ("c.glb", "c.gltf"):
        cage.save(tmp_path / name)
        mesh = trimesh.load(tmp_path / name, force="mesh", process=False)
        assert np.allclose(np.ptp(mesh.vertices, axis=0), [1, 30, 2]) and mesh.volume == pytest.approx(60)


@pytest.mark.parametrize("ending", ["obj", "ply", "off", "glb", "gltf"])
@pytest.mark.parametrize("axis", ["y", "z", None])
def test_up_turns_there_and_back(tmp_path, ending, axis):
    cage = Cage.icosphere([0, 0, 1], 1.0).scale([1.0, 2.0, 4.0], center=[0, 0, 0])
    cage.save(tmp_path / f"c.{ending}", up=axis)
    back = Cage.load(tmp_path / f"c.{ending}", up=axis)
    assert np.allclose(back.vertices, cage.vertices, atol=1e-6) and np.array_equal(back.faces, cage.faces)
    y_up = axis == "y" or (axis is None and "gl" in ending)
    raw = Cage.load(tmp_path / f"c.{ending}", up="z")
    expected = cage.vertices[:, [0, 2, 1]] * [1, 1, -1] if y_up else cage.vertices
    assert np.allclose(raw.vertices, expected, atol=1e-6) and raw.volume == pytest.approx(cage.volume, rel=1e-5)
    refused(lambda: Cage.load(tmp_path / f"c.{ending}", up="x"), match="up must be")


def gltf(**changes):
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], "<f4")
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], "<u2")
    data = points.tobytes() + faces.tobytes()
    document = {
        "asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}],
        "nodes": [{"children": [1], "translation": [5, 0, 0]},
                  {"mesh": 0, "scale": [2, 2, -2], "rotation": [0, 0, np.sin(np.pi / 4), np.cos(np.pi / 4)]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 4},
                      {"bufferView": 0, "byteOffset": 48, "componentType": 5123, "type": "SCALAR", "count": 12}],
        "bufferViews": [{"buffer": 0, "byteLength": len(data)}],
        "buffers": [{"byteLength": len(data), "uri": "data:x;base64," + base64.b64encode(data).decode()}],
    }  # fmt: skip
    return document | changes


def test_nodes_place_turn_and_mirror_their_mesh(tmp_path):
    (tmp_path / "c.gltf").write_text(json.dumps(gltf()))
    cage = Cage.load(tmp_path / "c.gltf", up="z")
    assert np.allclose(cage.vertices, [[5, 0, 0], [5, 2, 0], [3, 0, 0], [5, 0, -2]])
    cage.require_usable()
    assert cage.volume == pytest.approx(8 / 6)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"{", "c.gltf: not a glTF"),
        (b"[]", "c.gltf: not a glTF"),
        (b"glTF" + struct.pack("<II", 2, 99), "c.gltf: glTF version 2 of 99 bytes expected"),
        (gltf(buffers=[{"byteLength": 72, "uri": "other.bin"}]), "buffer 'other.bin' is not there"),
        (gltf(buffers=[{"byteLength": 900, "uri": "data:x;base64,AAAA"}]), "a buffer of 900 bytes expected, got 3"),
        (gltf(nodes=[{"children": [0]}]), "two parents"),
        (gltf(scenes=[{"nodes": []}]), "no vertices"),
        (gltf(bufferViews=[]), "c.gltf: not a glTF"),
        (gltf(accessors=[{"type": "VEC3", "count": 4, "componentType": 5126}] * 2), "sparse"),
        (gltf(accessors=[gltf()["accessors"][0] | {"count": 400}] * 2), "beyond its buffer"),
        (gltf(accessors=[gltf()["accessors"][0] | {"count": 3}, gltf()["accessors"][1]]), "3 vertices has 12 indices"),
    ],
)
def test_broken_gltf_is_refused_in_one_line(tmp_path, content, message):
    data = content if isinstance(content, bytes) else json.dumps(content).encode()
    (tmp_path / "c.gltf").write_bytes(data)
    refused(lambda: Cage.load(tmp_path / "c.gltf"), message, "c.gltf")


def test_concave_polygons_are_cut_without_folds():
    rng = np.random.default_rng(0)
    for count in (4, 5, 7, 12, 25):
        angle = np.sort(rng.random(count)) * 2 * np.pi
        angle = 2 * np.pi * (np.arange(count) + 0.3 * np.cos(angle)) / count
        radius = rng.uniform(0.2, 1.0, count)
        flat = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
        frame = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        frame *= np.sign(np.linalg.det(frame))
        points = np.concatenate([flat, np.zeros((count, 1))], axis=1) @ frame.T
        triangles = np.array(cut_polygon(points, list(range(count))))
        a, b, c = (flat[triangles[:, k]] for k in range(3))
        areas = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
        x, y = flat.T
        shoelace = 0.5 * (x * np.roll(y, -1) - y * np.roll(x, -1)).sum()
        assert len(triangles) == count - 2 and (areas > -1e-12).all() and areas.sum() == pytest.approx(shoelace)
