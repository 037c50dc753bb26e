"""Several objects in a file, split vertices, strips and fans, formats of other packages."""

import dataclasses
import functools
import struct

import numpy as np
import pytest
from entry_points import plug
from refusals import refused
from runs import run, succeed, write_files
from scene_writers import GltfWriter

from warpcage import Cage, PoseFile
from warpcage.mesh import MeshFormat, mesh_formats
from warpcage.mesh.io import object_names
from warpcage.studio.cli.cages import read_mesh as read_object

BALL = Cage.icosphere((0, 0, 0), 1.0, 1)
BOX = Cage.box((2, 0, 0), (3, 1, 2))
BENT = BALL.bend(30, axis="x", towards="z")


def obj_lines(cage, name, first, *, ahead=False):
    """Lines of an object as Blender writes them, and with vertices before its name, as other programs do."""
    points = [f"v {x!r} {y!r} {z!r}" for x, y, z in cage.vertices.tolist()]
    faces = [f"f {a + first}/1/1 {b + first}/2/1 {c + first}/3/1" for a, b, c in cage.faces.tolist()]
    named = [f"o {name}"]
    return [*(points + named if ahead else named + points), "vt 0 0", "vn 0 0 1", "g side", *faces]


def write_two(path, one=BALL, two=BOX, **options):
    names = options.pop("names", ("body", "left arm"))
    lines = obj_lines(one, names[0], 1, **options) + obj_lines(two, names[1], 1 + len(one.vertices), **options)
    path.write_text("\n".join(["# Blender", "mtllib a.mtl", *lines]) + "\n")
    return path


def same(one, two):
    return np.array_equal(one.vertices, two.vertices) and np.array_equal(one.faces, two.faces)


@pytest.mark.parametrize("ahead", [False, True])
def test_an_object_is_chosen_by_its_name(tmp_path, ahead):
    path = write_two(tmp_path / "two.obj", ahead=ahead)
    assert object_names(path) == ["body", "left arm"]
    body, arm, both = (Cage.load(path, object=name) for name in ("body", "left arm", "*"))
    assert same(body, BALL) and same(arm, BOX) and len(both.vertices) == len(BALL.vertices) + len(BOX.vertices)
    assert (body.object_name, arm.object_name, both.object_name) == ("body", "left arm", "")
    assert body.bend(10, axis="x", towards="z").object_name == "body"
    said = refused(lambda: Cage.load(path))
    assert "two.obj holds 2 objects (body, left arm): choose one by object= (--cage-object NAME)" in said
    refused(lambda: Cage.load(path, object="leg"), match="'leg' in it, only body, left arm")
    refused(lambda: Cage.load(path, object=3), match="object must be a str, got int")


def test_files_of_one_object_are_read_whole(tmp_path):
    """With vertices of no face, whatever the name; groups are no objects, and without a name any is taken."""
    lines = obj_lines(BOX, "crate", 2)
    (tmp_path / "one.obj").write_text("\n".join(["v 9 9 9", "o empty", *lines, "g other", "v 8 8 8"]))
    cage = Cage.load(tmp_path / "one.obj")
    assert len(cage.vertices) == 10 and cage.object_name == "crate"
    assert same(Cage.load(tmp_path / "one.obj", object="crate"), cage)
    refused(lambda: Cage.load(tmp_path / "one.obj", object="box"), match="'box' in it, only crate")
    BOX.save(tmp_path / "plain.obj")
    with pytest.warns(UserWarning, match="is taken for 'box'"):
        assert same(Cage.load(tmp_path / "plain.obj", object="box"), BOX)
    (tmp_path / "mixed.obj").write_text((tmp_path / "plain.obj").read_text() + "o late\nf 1 2 4\n")
    assert object_names(tmp_path / "mixed.obj") == ["unnamed", "late"]
    assert same(Cage.load(tmp_path / "mixed.obj", object="unnamed"), BOX)


def test_vertices_that_objects_share_are_in_both(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 5 5 5\no one\nf 1 2 3\nv 7 7 7\no two\nf 2 3 4\n")
    one, two = (Cage.load(tmp_path / "a.obj", object=name) for name in ("one", "two"))
    assert one.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0], [7, 7, 7]] and one.faces.tolist() == [[0, 1, 2]]
    assert two.vertices.tolist() == [[1, 0, 0], [0, 1, 0], [5, 5, 5]] and two.faces.tolist() == [[0, 1, 2]]
    (tmp_path / "wrong.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\no one\nf 1 2 3\no two\nf 1 2 4\n")
    refused(lambda: Cage.load(tmp_path / "wrong.obj", object="two"), match=r"wrong.obj:7: face with vertex")


def test_a_pose_is_the_object_of_its_cage(tmp_path):
    """By its name, or by its mesh; of several that fit none is taken."""
    rest = Cage.load(write_two(tmp_path / "rest.obj"), object="body")
    assert same(Cage.load(write_two(tmp_path / "posed.obj", BENT), reference=rest), BENT)
    swapped = write_two(tmp_path / "swapped.obj", BENT, names=("other", "third"))
    assert same(Cage.load(swapped, reference=rest), BENT)
    twins = write_two(tmp_path / "twins.obj", BENT, BALL, names=("other", "third"))
    refused(lambda: Cage.load(twins, reference=rest), match="other, third fit the cage at rest")
    assert same(Cage.load(twins, reference=rest, object="other"), BENT)


def write_nodes(path, named=(("body", BALL), ("arm", BOX))):
    points = [cage.vertices[:, [0, 2, 1]] * [1, 1, -1] for _, cage in named]  # y up
    writer = GltfWriter(points[0], named[0][1].faces)
    writer.nodes[0]["name"] = named[0][0]
    meshes = [{"primitives": [writer.primitive]}]
    for (name, cage), place in zip(named[1:], points[1:], strict=True):
        meshes.append({"primitives": [{"attributes": {"POSITION": writer.add(place)},
                                       "indices": writer.add(cage.faces, "u")}]})  # fmt: skip
        writer.nodes.append({"mesh": len(meshes) - 1, "name": name})
    writer.more["meshes"] = meshes
    return writer.save(path)


def test_objects_of_gltf_files(tmp_path):
    path = write_nodes(tmp_path / "two.gltf")
    assert object_names(path) == ["body", "arm"]
    assert len(Cage.load(path).vertices) == len(BALL.vertices) + len(BOX.vertices)  # as ever
    body = Cage.load(path, object="body")
    assert np.allclose(body.vertices, BALL.vertices, atol=1e-6) and np.array_equal(body.faces, BALL.faces)
    posed = Cage.load(write_nodes(tmp_path / "posed.gltf", (("lamp", BOX), ("body", BENT))), reference=body)
    assert np.allclose(posed.vertices, BENT.vertices, atol=1e-6)
    posed = Cage.load(write_nodes(tmp_path / "named.gltf", (("lamp", BOX), ("cage", BENT))), reference=body)  # its mesh
    assert np.allclose(posed.vertices, BENT.vertices, atol=1e-6)


@pytest.mark.parametrize("named", ["body", "cage"])
def test_a_film_of_several_objects_is_that_of_its_cage(tmp_path, named):
    """By its name, which Blender gives the transform or, of what has shapes, the skeleton's root; or by its mesh."""
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom, UsdSkel

    stage = Usd.Stage.CreateNew(str(tmp_path / "film.usda"))
    UsdGeom.SetStageUpAxis(stage, "Z")
    for kind, name, cage, shift in ((UsdGeom.Xform, "lamp", BOX, 0.0), (UsdSkel.Root, named, BALL, 2.0)):
        kind.Define(stage, f"/film/{name}")
        mesh = UsdGeom.Mesh.Define(stage, f"/film/{name}/Mesh")
        mesh.CreatePointsAttr(cage.vertices)
        mesh.CreateFaceVertexCountsAttr([3] * len(cage.faces))
        mesh.CreateFaceVertexIndicesAttr(np.ravel(cage.faces).tolist())
        for frame in (0, 24):
            mesh.GetPointsAttr().Set((cage.vertices + shift * frame / 24).astype(np.float32), frame)
    stage.Save()
    assert object_names(tmp_path / "film.usda") == ["lamp", named]
    film = PoseFile.load(tmp_path / "film.usda", BALL.named("body"))
    np.testing.assert_allclose(film.at_time(1.0).vertices, BALL.vertices + 2.0, atol=1e-6)


def test_commands_choose_objects(tmp_path, capsys):
    files = write_files(tmp_path)
    rest, posed = Cage.load(files / "cage.obj"), Cage.load(files / "posed.obj")
    write_two(files / "two.obj", rest, BOX)
    write_two(files / "two_posed.obj", posed, BOX)
    render = ["render", "@ball.npz", "--size", "24", "--coordinates", "mean_value", "--resolution", "16"]
    succeed(files, *render, "--cage", "@cage.obj", "--posed", "@posed.obj", "-o", "@plain.png")
    succeed(files, *render, "--cage", "@two.obj", "--posed", "@two_posed.obj", "--cage-object", "body", "-o", "@a.png")
    succeed(files, *render, "--edit", "@two.obj:@two_posed.obj:object=body", "-o", "@b.png")
    plain = (files / "plain.png").read_bytes()
    assert (files / "a.png").read_bytes() == plain == (files / "b.png").read_bytes()
    capsys.readouterr()
    assert run(files, *render, "--cage", "@two.obj", "--posed", "@posed.obj", "-o", "@c.png") == 2
    assert "holds 2 objects (body, left arm)" in capsys.readouterr().err
    succeed(files, "check", "@two.obj", "--cage-object", "left arm")
    succeed(files, "pose", "@two.obj", "--cage-object", "body", "--twist", "20", "-o", "@twisted.obj")
    assert len(Cage.load(files / "twisted.obj").vertices) == len(rest.vertices)
    succeed(files, "cage", "@two.obj", "--object", "left arm", "--box", "-o", "@around.obj")
    np.testing.assert_allclose(Cage.load(files / "around.obj").bounds.mean(axis=0), BOX.bounds.mean(axis=0), atol=1e-6)
    capsys.readouterr()
    succeed(files, "info", "@two.obj")
    assert "object 'left arm'" in capsys.readouterr().out
    succeed(files, "sweep", "@ball.npz", "--cage", "@two.obj", "--cage-object", "body", "--poses", "@two_posed.obj",
            "--cameras", "orbit:1", "--size", "16", "-o", "@sweep.jsonl", "--quiet")  # fmt: skip
    succeed(files, "run", "@sweep.jsonl", "-o", "@out", "--quiet")


def seam_ply(cage, *, binary, posed=None, extra=()):
    """A PLY file with a vertex for each pair of a vertex and a texture coordinate, as Blender writes seams: in the
    order of the first corner that uses it. Returns the bytes and, for each row, the vertex that it is."""
    rows, faces = {}, []
    for number, face in enumerate(cage.faces.tolist()):
        corners = []
        for vertex in face:
            uv = (0.25 * (number % 3), 0.5) if vertex % 2 else (0.0, 0.0)  # every second vertex lies on a seam
            corners.append(rows.setdefault((vertex, uv), len(rows)))
        faces.append(corners)
    places = (cage if posed is None else posed).vertices
    header = "ply\nformat {} 1.0\nelement vertex {}\n" + "".join(
        f"property {'uchar' if name == 'red' else 'double'} {name}\n" for name in ("x", "y", "z", *extra, "s", "t")
    )
    header += f"element face {len(faces)}\nproperty list uchar uint vertex_indices\nend_header\n"
    lines = [(*places[vertex].tolist(), *((vertex % 2 * 200,) if extra else ()), *uv) for vertex, uv in rows]
    if binary:
        pattern = "<3d" + "B" * len(extra) + "2d"
        body = b"".join(struct.pack(pattern, *line) for line in lines)
        body += b"".join(struct.pack("<B3I", 3, *face) for face in faces)
    else:
        body = "".join(" ".join(map(repr, line)) + "\n" for line in lines).encode()
        body += "".join(f"3 {a} {b} {c}\n" for a, b, c in faces).encode()
    kind = "binary_little_endian" if binary else "ascii"
    return header.format(kind, len(rows)).encode() + body, [vertex for vertex, _ in rows]


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("extra", [(), ("red",)])
def test_seams_of_ply_files_are_joined_in_order_of_appearance(tmp_path, binary, extra):
    data, vertices = seam_ply(BALL, binary=binary, extra=extra)
    (tmp_path / "a.ply").write_bytes(data)
    order = list(dict.fromkeys(vertices))
    assert len(vertices) > len(order) == len(BALL.vertices)
    cage = Cage.load(tmp_path / "a.ply")
    cage.require_usable()
    assert np.array_equal(cage.vertices, BALL.vertices[order])
    assert np.array_equal(np.array(order)[cage.faces], BALL.faces)
    # there and back: poses that are saved in any format, and those that the other program saves
    (tmp_path / "posed.ply").write_bytes(seam_ply(BALL, binary=binary, posed=BENT, extra=extra)[0])
    assert np.array_equal(Cage.load(tmp_path / "posed.ply").vertices, BENT.vertices[order])
    bent = cage.bend(30, axis="x", towards="z")
    for name in ("b.ply", "b.obj", "b.off"):
        bent.save(tmp_path / name)
        back = Cage.load(tmp_path / name)
        assert same(back, bent) and same(cage.match(back), bent)


def test_what_differs_in_more_than_seams_stays_apart(tmp_path):
    """Vertices at one place with other values of their own, and all in files without seams."""
    text = (
        "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n{}"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
        "0 0 0 1 0\n1 0 0 2 0\n0 1 0 3 0\n0 0 0 4 0\n0 0 0 4 1\n3 0 1 2\n"
    )
    counts = []
    for names in (("quality", "flag"), ("quality", "s"), ("nx", "t")):
        path = tmp_path / f"{names[0]}_{names[1]}.ply"
        path.write_text(text.format("".join(f"property float {name}\n" for name in names)))
        counts.append(len(Cage.load(path).vertices))
    assert counts == [5, 4, 3]


@pytest.mark.parametrize("kind", ["strip", "fan"])
@pytest.mark.parametrize("indexed", [True, False])
def test_strips_and_fans(tmp_path, kind, indexed):
    """glTF 2.0, 3.7.2.1: a strip turns every second triangle, a fan goes around its first vertex. Each beside the
    triangles that its picture in the specification shows."""
    points = np.array([[0, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 0], [2, 0, 0], [2, 1, 0]], float)
    triangles = [[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4]]
    if kind == "fan":
        points = np.array([[0, 0, 0], *([np.cos(a), np.sin(a), 0] for a in np.linspace(0, 1.5, 5))])
        triangles = [[1, 2, 0], [2, 3, 0], [3, 4, 0], [4, 5, 0]]
    order = np.array([5, 3, 1, 0, 2, 4])
    writer = GltfWriter(points[np.argsort(order)] if indexed else points, order)
    writer.primitive["mode"] = {"strip": 5, "fan": 6}[kind]
    if not indexed:
        del writer.primitive["indices"]
    cage = Cage.load(writer.save(tmp_path / "a.gltf"), up="z")
    expected = points[np.array(triangles)]
    np.testing.assert_allclose(cage.vertices[cage.faces], expected, atol=1e-6)
    normals = np.cross(expected[:, 1] - expected[:, 0], expected[:, 2] - expected[:, 0])[:, 2]
    assert (normals < 0).all() or (normals > 0).all()


def test_strips_that_go_on_elsewhere(tmp_path):
    """A closed box of two strips joined by triangles without area, which are left out; a mesh for `warpcage cage`."""
    box = Cage.box((0, 0, 0), (1, 1, 1))
    strip, used = [], set()
    for number, face in enumerate(box.faces.tolist()):
        strip += [strip[-1], face[0]] if strip else []
        strip += [face[0]] if len(strip) % 2 else []
        strip += face
        used.add(number)
    writer = GltfWriter(box.vertices, np.array(strip))
    writer.primitive["mode"] = 5
    cage = Cage.load(writer.save(tmp_path / "a.gltf"), up="z")
    cage.require_usable()
    assert cage.volume == pytest.approx(1.0) and len(cage.faces) == 12
    with pytest.raises(ValueError, match="no faces"):
        writer = GltfWriter(box.vertices, [0, 1])
        writer.primitive["mode"] = 5
        Cage.load(writer.save(tmp_path / "short.gltf"))


def test_strips_count_before_they_are_read(tmp_path, monkeypatch):
    from warpcage.mesh.io import gltf

    writer = GltfWriter(BALL.vertices, np.arange(12))
    writer.primitive["mode"] = 5
    monkeypatch.setattr(gltf, "MAX_TRIANGLES", 9)
    refused(lambda: Cage.load(writer.save(tmp_path / "a.gltf")), match="10 triangles and 42 vertices")


def test_objects_around_which_cages_go_have_strips_too(tmp_path):
    from warpcage.mesh.io.gltf import JSON_CHUNK

    writer = GltfWriter(np.array([[0, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 0]], float), [0, 1, 2, 3])
    writer.primitive["mode"] = 5
    text = writer.save(tmp_path / "a.gltf").read_bytes()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 20 + len(text)) + struct.pack("<II", len(text), JSON_CHUNK)
    (tmp_path / "a.glb").write_bytes(head + text)
    mesh = read_object(str(tmp_path / "a.glb"))
    assert len(mesh.faces) == 2
    np.testing.assert_allclose(mesh.bounds, [[0, 0, 0], [1, 0, 1]], atol=1e-6)  # y up in the file


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
def test_points_are_no_mesh(tmp_path, kind):
    head = f"ply\nformat {kind} 1.0\nelement vertex 3\n" + "".join(f"property float {name}\n" for name in "xyz")
    body = b"0 0 0\n1 0 0\n0 1 0\n" if kind == "ascii" else np.eye(3, dtype="<f4").tobytes()
    (tmp_path / "scan.ply").write_bytes(head.encode() + b"end_header\n" + body)
    refused(lambda: Cage.load(tmp_path / "scan.ply"), match="scan.ply holds 3 points without faces")
    refused(lambda: read_object(str(tmp_path / "scan.ply")), match="points without faces")


# Formats of other packages


def read_tri(path):
    numbers = np.array(path.read_text().split(), float).reshape(-1, 9)
    points = numbers.reshape(-1, 3)
    return points, np.arange(len(points)).reshape(-1, 3)


def write_tri(vertices, faces):
    return "\n".join(" ".join(map(repr, row)) for row in vertices[faces].reshape(-1, 9).tolist()).encode()


TRI = MeshFormat("triangles", (".tri",), read_tri, write_tri, up="y")


@pytest.fixture
def plugged(monkeypatch):
    """Entry points of other packages, by name."""

    yield functools.partial(plug, monkeypatch, "warpcage.mesh_formats", mesh_formats)
    mesh_formats.cache_clear()


def test_another_package_adds_a_format(tmp_path, plugged, capsys):
    plugged(tri=TRI)
    BOX.save(tmp_path / "a.tri")
    back = Cage.load(tmp_path / "a.tri")
    np.testing.assert_array_equal(back.vertices[back.faces], BOX.vertices[BOX.faces])
    np.testing.assert_array_equal(Cage.load(tmp_path / "a.tri", up="z").vertices[:, 1], back.vertices[:, 2])
    succeed(tmp_path, "info", "@a.tri")
    succeed(tmp_path, "info")
    said = capsys.readouterr().out
    assert "triangles (.tri): read and written" in said and "OBJ (.obj): read and written" in said
    BOX.save(tmp_path / "a.obj")
    succeed(tmp_path, "pose", "@a.obj", "--twist", "10", "-o", "@b.tri")
    refused(lambda: Cage.load(__file__), match=".usda or .tri")


def test_formats_that_do_one_object_only(tmp_path, plugged):
    plugged(tri=dataclasses.replace(TRI, write=None))
    refused(lambda: BOX.save(tmp_path / "a.tri"), match="triangles files are not written")
    plugged(tri=dataclasses.replace(TRI, read=None))
    BOX.save(tmp_path / "a.tri")
    refused(lambda: Cage.load(tmp_path / "a.tri"), match="triangles files are not read")


@pytest.mark.parametrize("wrong", [None, dataclasses.replace(TRI, endings=("TRI",)), dataclasses.replace(TRI, up="x")])
def test_a_format_that_cannot_be_used_is_reported_and_left_out(tmp_path, plugged, wrong):
    plugged(broken=wrong, tri=TRI)
    with pytest.warns(UserWarning, match="'broken' of package:broken cannot be"):
        BOX.save(tmp_path / "a.tri")
    assert [format.name for format in mesh_formats()][-1] == "triangles"


def test_a_format_cannot_take_an_ending_of_ours(tmp_path, plugged):
    plugged(tri=dataclasses.replace(TRI, endings=(".obj", ".tri")))
    BOX.save(tmp_path / "a.obj")
    assert (tmp_path / "a.obj").read_text().startswith("# cage")
