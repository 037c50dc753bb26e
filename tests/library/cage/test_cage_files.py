import numpy as np
import pytest
from refusals import refused

from warpcage import Cage


def awkward_cage():
    """Vertices with all their digits, out of order, one unused and two in the same place."""
    box = Cage.box([0, 0, 0], [1, 1, 1])
    vertices = np.random.default_rng(1).normal(size=(11, 3)) * 1e3 + 0.1
    vertices[10] = vertices[4]
    return Cage(vertices, box.faces + 1)


@pytest.mark.parametrize("ending", ["obj", "ply", "off", "OBJ"])
def test_every_vertex_keeps_its_place_and_its_last_bit(tmp_path, ending):
    cage = awkward_cage()
    cage.save(tmp_path / f"sub/cage.{ending}")
    back = Cage.load(tmp_path / f"sub/cage.{ending}")
    assert np.array_equal(back.vertices, cage.vertices) and np.array_equal(back.faces, cage.faces)
    assert [each.name for each in (tmp_path / "sub").iterdir()] == [f"cage.{ending}"]


@pytest.mark.parametrize("ending", ["obj", "ply", "off"])
def test_trimesh_reads_what_is_written(tmp_path, ending):
    import trimesh

    cage = Cage.icosphere([1, 2, 3], 2.0)
    cage.save(tmp_path / f"c.{ending}")
    mesh = trimesh.load(tmp_path / f"c.{ending}", process=False)
    assert np.allclose(mesh.vertices, cage.vertices, atol=1e-6) and np.array_equal(mesh.faces, cage.faces)


OBJ = """# a quad, a pentagon and a triangle
mtllib cage.mtl
o cage
v 0 0 0 1.0
v 1 0 0
v 1 1 0 # corner
vn 0 0 1
vt 0.5 0.5
v 0 1 0
g side
usemtl red
s off
f 1/1/1 2/1/1 3//1 4/1
v 0 0 1
f -1 -2 -3 -4 \\
  -5
f 1 2 5
"""


def test_obj_with_polygons_negative_indices_and_materials(tmp_path):
    (tmp_path / "c.obj").write_text(OBJ)
    cage = Cage.load(tmp_path / "c.obj")
    assert cage.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1]]
    assert cage.faces.tolist() == [[0, 1, 2], [0, 2, 3], [3, 2, 1], [3, 1, 0], [0, 4, 3], [0, 1, 4]]


@pytest.mark.parametrize("ending", ["obj", "off"])
def test_a_byte_order_mark_is_no_text(tmp_path, ending):
    cage = Cage.box((0, 0, 0), (1, 2, 3))
    cage.save(tmp_path / f"c.{ending}")
    lines = (tmp_path / f"c.{ending}").read_bytes().replace(b"# cage\n", b"")
    (tmp_path / f"c.{ending}").write_bytes(b"\xef\xbb\xbf" + lines)
    assert np.array_equal(Cage.load(tmp_path / f"c.{ending}").vertices, cage.vertices)


def test_off_with_comments_and_colors(tmp_path):
    (tmp_path / "c.off").write_text(
        "OFF # head\n# note\n4 2 0\n0 0 0\n1 0 0\n\n1 1 0\n0 1 0\n4 0 1 2 3 255 0 0\n3 0 1 2\n"
    )
    cage = Cage.load(tmp_path / "c.off")
    assert len(cage.vertices) == 4 and cage.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2]]


def test_off_of_meshlab(tmp_path):
    """Colours and normals stand behind the places: NCOFF."""
    meshlab = pytest.importorskip("pymeshlab")
    box = Cage.box((0, 0, 0), (1, 2, 3))
    meshes = meshlab.MeshSet(verbose=False)
    meshes.add_mesh(meshlab.Mesh(box.vertices, box.faces))
    meshes.save_current_mesh(str(tmp_path / "c.off"))
    assert (tmp_path / "c.off").read_text().startswith("NCOFF")
    np.testing.assert_array_equal(Cage.load(tmp_path / "c.off").vertices, box.vertices)


PLY = """ply
format ascii 1.0
comment by hand
element vertex 4
property float x
property float y
property float z
property uchar red
element edge 1
property int vertex1
property int vertex2
element face 1
property list uchar int vertex_index
property uchar flags
end_header
0 0 0 255
1 0 0 255
1 1 0 0
0.1 1 0 0
0 1
4 0 1 2 3 7
"""


def test_ascii_ply_with_other_elements(tmp_path):
    (tmp_path / "c.ply").write_text(PLY)
    cage = Cage.load(tmp_path / "c.ply")
    assert cage.vertices[3].tolist() == [0.1, 1, 0] and cage.faces.tolist() == [[0, 1, 2], [0, 2, 3]]


@pytest.mark.parametrize("order", ["little", "big"])
def test_binary_ply_of_another_writer(tmp_path, order):
    sign = "<" if order == "little" else ">"
    header = (
        f"ply\nformat binary_{order}_endian 1.0\nelement vertex 4\nproperty float x\nproperty float y\n"
        "property float z\nproperty uchar q\nelement face 2\n"
        "property list uint8 uint32 vertex_indices\nend_header\n"
    )
    vertices = np.zeros(4, dtype=[("p", sign + "f4", 3), ("q", "u1")])
    vertices["p"] = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.5]]
    quad, triangle = np.array([0, 1, 2, 3], sign + "u4"), np.array([0, 3, 1], sign + "u4")
    faces = b"\x04" + quad.tobytes() + b"\x03" + triangle.tobytes()
    (tmp_path / "c.ply").write_bytes(header.encode() + vertices.tobytes() + faces)
    cage = Cage.load(tmp_path / "c.ply")
    assert cage.vertices[3].tolist() == [0, 1, 0.5] and cage.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 3, 1]]
    (tmp_path / "cut.ply").write_bytes((header.encode() + vertices.tobytes() + faces)[:-3])
    refused(lambda: Cage.load(tmp_path / "cut.ply"), match="cut.ply.*ends within")


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("c.obj", "v 0 0\nf 1 1 1\n", "c.obj:1: a vertex needs 3"),
        ("c.obj", "v 0 0 0\nv 0 0 x\n", "c.obj:2: numbers expected"),
        ("c.obj", "v 0 0 nan\n", "c.obj:1: finite"),
        ("c.obj", "v 0 0 0\nf 1 2 3\n", "c.obj:2: face with vertex 1"),
        ("c.obj", "v 0 0 0\nf 1 1\n", "c.obj:2: a face needs at least 3"),
        ("c.obj", "v 0 0 0\nf 0 1 1\n", "c.obj:2: OBJ counts vertices from 1"),
        ("c.obj", "v 0 0 0\nf 1 1 a\n", "c.obj:2: whole numbers"),
        ("c.obj", "v 0 0 0\n", "no faces"),
        ("c.obj", "", "no vertices"),
        ("c.off", "FOO\n1 1 0\n", "c.off:1: an OFF file begins"),
        ("c.off", "", "c.off:1: an OFF file begins"),
        ("c.off", "OFF\n3 1 0\n0 0 0\n", "3 vertices and 1 face announced, 1 and 0 found"),
        ("c.off", "OFF\n1 1 0\n0 0 0\n3 0 0\n", "c.off:4: a face of 3"),
        ("c.ply", "pli\n", "c.ply:1: a PLY file begins"),
        ("c.ply", "ply\nformat ascii 1.0\nelement vertex 1\n", "no end_header"),
        ("c.ply", "ply\nformat text 1.0\n", "c.ply:2: unknown PLY format"),
        ("c.ply", PLY.replace("4 0 1 2 3 7\n", ""), "1 PLY elements 'face' announced, 0 found"),
        ("c.ply", PLY.replace("4 0 1 2 3 7", "4 0 1"), "c.ply:21: too few numbers"),
        ("c.ply", PLY.replace("4 0 1 2 3 7", "4 0.5 1 2 3 7"), "c.ply:21: a face needs whole numbers, got 0.5, 1.0"),
        ("c.ply", PLY.replace("property float z\n", ""), "need properties x, y, z"),
        ("c.stl", "solid\n", "must end in .obj, .ply, .off, .glb, .gltf, .usd, .usdc or .usda"),
    ],
)
def test_errors_name_the_file_and_the_line(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    refused(lambda: Cage.load(tmp_path / name), message)


def test_missing_files_and_unknown_endings(tmp_path):
    refused(lambda: Cage.load(tmp_path / "nothing.obj"), match="nothing.obj", error=FileNotFoundError)
    refused(lambda: awkward_cage().save(tmp_path / "cage.txt"), match="must end in")
    assert list(tmp_path.iterdir()) == []
