"""Files of Gaussian splats: foreign layouts and values, handmade files, damaged ones, what is none."""

import gzip
import struct

import numpy as np
import pytest
from field_oracles import basis
from messages import MESSAGES
from refusals import refused
from splat_scenes import DATA, VALUES, field_of, loaded, needs_data, some_splats

import warpcage
from warpcage.splats import is_splat_file, turned_over

DEGREE3, COMPRESSED = DATA / "small_degree3.ply", DATA / "biker.compressed.ply"


def foreign_ply(order, count=5):
    """A file whose properties come in another order, with foreign ones, doubles, and elements before and after."""
    rng = np.random.default_rng(3)
    names = ["rot_3", "rot_0", "rot_1", "rot_2", "label", "z", "x", "y", "f_dc_2", "f_dc_0", "f_dc_1", "opacity"]
    names += [f"f_rest_{k}" for k in reversed(range(9))] + ["scale_0", "scale_2", "scale_1", "beta"]
    kinds = {"label": "i2", "beta": "f4", "scale_0": "f8", "x": "f8"}
    types = {"i2": "short", "f4": "float", "f8": "double"}
    table = np.zeros(count, [(name, order + kinds.get(name, "f4")) for name in names])
    for name in names:
        table[name] = rng.integers(0, 9, count) if name == "label" else rng.normal(size=count)
    table["beta"][1] = np.nan  # foreign values may be anything
    lines = ["ply", f"format binary_{'little' if order == '<' else 'big'}_endian 1.0", "comment of mine"]
    lines += ["element camera 2", "property uchar id", f"element vertex {count}"]
    lines += [f"property {types[kinds.get(name, 'f4')]} {name}" for name in names]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header", ""]
    after = b"\x03" + np.arange(3, dtype=order + "i4").tobytes()
    return "\n".join(lines).encode() + b"\x07\x09" + table.tobytes() + after, table


@needs_data
def test_a_file_of_degree_3_is_the_same_file_again(tmp_path):
    field = loaded(DEGREE3)
    assert (field.splat_count, field.degree) == (9080, 3)
    field.save(tmp_path / "again.ply")
    assert (tmp_path / "again.ply").read_bytes() == DEGREE3.read_bytes()


@pytest.mark.parametrize("order", ["<", ">"])
def test_foreign_layouts_are_kept_to_the_bit(order, tmp_path):
    data, table = foreign_ply(order)
    path = tmp_path / "foreign.ply"
    path.write_bytes(data)
    field = loaded(path)
    np.testing.assert_array_equal(field.contents.centers, np.stack([table[axis] for axis in "xyz"], axis=1))
    np.testing.assert_array_equal(field.contents.quaternions[:, 3], table["rot_3"].astype(np.float32))
    # channel-major: the second harmonic of blue is f_rest_7 of nine
    np.testing.assert_array_equal(field.contents.harmonics[:, 2, 2], table["f_rest_7"].astype(np.float32))
    field.save(tmp_path / "again.ply")
    assert (tmp_path / "again.ply").read_bytes() == data
    some = field.chosen([4, 1])
    some.save(tmp_path / "some.ply")
    again = loaded(tmp_path / "some.ply")
    assert again.contents.layout.table.tobytes() == table[[4, 1]].tobytes()
    assert b"element camera 2" in again.contents.layout.header and b"element face" not in again.contents.layout.header


@needs_data
def test_supersplats_own_file(tmp_path):
    field = loaded(COMPRESSED)
    assert (field.splat_count, field.degree) == (152746, 0)
    assert np.allclose(np.linalg.norm(field.contents.quaternions, axis=1), 1.0, atol=1e-6)
    field.save(tmp_path / "again.compressed.ply")
    again = loaded(tmp_path / "again.compressed.ply")
    for name in set(VALUES) - {"quaternions"}:
        np.testing.assert_array_equal(getattr(again.contents, name), getattr(field.contents, name))
    assert np.abs(again.rotations - field.rotations).max() < 4e-3


def test_words_of_a_compressed_file_by_hand(tmp_path):
    """One splat at a third of its chunk's range, a quarter of a turn about z, opacity 51 / 255."""
    names = [f"{begin}{axis}" for begin in ("min_", "max_", "min_scale_", "max_scale_") for axis in "xyz"]
    chunk = np.array([-1, -2, -3, 1, 2, 3, -6, -6, -6, -2, -2, -2], "<f4")
    half = round((0.0 * np.sqrt(0.5) + 0.5) * 1023)
    quarter = 1023  # z = sqrt(1/2), the largest that the others can be
    uint32s = [
        (2047 << 21) | (0 << 11) | 2047,
        (0 << 30) | (half << 20) | (half << 10) | quarter,
        0,
        0x804020 << 8 | 51,
    ]
    lines = ["ply", "format binary_little_endian 1.0", "element chunk 1", *(f"property float {name}" for name in names)]
    lines += ["element vertex 1"]
    lines += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    path = tmp_path / "one.ply"
    head = "\n".join([*lines, "end_header", ""]).encode()
    path.write_bytes(head + chunk.tobytes() + np.array(uint32s, "<u4").tobytes())
    field = loaded(path)
    np.testing.assert_allclose(field.contents.centers, [[1, -2, 3]])
    np.testing.assert_allclose(field.contents.log_scales, [[-6, -6, -6]])
    np.testing.assert_allclose(field.rotations[0], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=3e-3)
    np.testing.assert_allclose(field.opacities, [0.2], atol=1e-6)
    color = 0.5 + 0.28209479 * field.contents.harmonics[0, 0]
    np.testing.assert_allclose(color, [128 / 255, 64 / 255, 32 / 255], atol=1e-6)


def test_opaque_splats_are_finite_in_a_file(tmp_path):
    """gsplat's exporter writes no splat at all where one logit is infinite."""
    field = warpcage.SplatField.from_arrays(
        np.zeros((3, 3)), np.full((3, 3), 0.1), np.tile([1.0, 0, 0, 0], (3, 1)), [0.0, 0.5, 1.0], colors=np.ones((3, 3))
    )
    field.save(tmp_path / "a.ply")
    again = loaded(tmp_path / "a.ply")
    assert np.isfinite(again.contents.logits).all()
    np.testing.assert_allclose(again.opacities, [0.0, 0.5, 1.0], atol=1e-12)


def test_spz_is_turned_over_and_back(tmp_path):
    """Half a turn about x: what is seen along a direction is seen along the turned one."""
    contents = some_splats(20)
    turned = turned_over(contents)
    directions = np.random.default_rng(1).normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    seen = np.einsum("nb,nbc->nc", basis(directions, 4), contents.harmonics)
    seen_turned = np.einsum("nb,nbc->nc", basis(directions * [1, -1, -1], 4), turned.harmonics)
    np.testing.assert_allclose(seen_turned, seen, atol=1e-6)
    half_turn = np.diag([1.0, -1.0, -1.0])
    np.testing.assert_allclose(field_of(turned).covariances, half_turn @ field_of(contents).covariances @ half_turn)
    for name in ("centers", "quaternions", "harmonics"):
        np.testing.assert_array_equal(getattr(turned_over(turned), name), getattr(contents, name))


def test_spz_of_version_2(tmp_path):
    """Rotations of three bytes: x y z, and w from them."""
    header = struct.pack("<4sIIBBBB", b"NGSP", 2, 1, 0, 12, 0, 0)
    body = (4096).to_bytes(3, "little") + (-8192).to_bytes(3, "little", signed=True) + bytes(3)
    body += bytes([128]) + bytes([255, 128, 0]) + bytes([160, 144, 128]) + bytes([128, 128, 255])
    (tmp_path / "old.spz").write_bytes(gzip.compress(header + body))
    field = loaded(tmp_path / "old.spz")
    np.testing.assert_allclose(field.contents.centers, [[1.0, 2.0, 0.0]])  # y down
    np.testing.assert_allclose(field.contents.log_scales, [[0.0, -1.0, -2.0]])
    np.testing.assert_allclose(field.contents.quaternions, [[0.0, 0.0, 0.0, -1.0]], atol=6e-3)
    np.testing.assert_allclose(field.opacities, [128 / 255], atol=1e-6)


def test_files_of_no_splats(tmp_path):
    refused(lambda: warpcage.SplatField.load(tmp_path / "none.ply"), match="not there", error=FileNotFoundError)
    refused(lambda: warpcage.SplatField.load(tmp_path / "splats.obj"), match="must end in")
    refused(lambda: field_of(some_splats(3)).save(tmp_path / "splats.npz"), match="must end in")
    warpcage.Cage.box((0, 0, 0), (1, 1, 1)).save(tmp_path / "cage.ply")
    assert not is_splat_file(tmp_path / "cage.ply")
    refused(lambda: warpcage.SplatField.load(tmp_path / "cage.ply"), match=MESSAGES["splats.no_splats"])
    far = some_splats(3)
    far.centers[1, 2] = 1e8
    refused(lambda: field_of(far).save(tmp_path / "far.spz"), match="holds positions up to")
    assert list(tmp_path.glob("*far*")) == []


@pytest.mark.parametrize(
    "values, said",
    [
        ({"harmonics": np.zeros((4, 5, 3))}, "1, 4, 9, 16"),
        ({"logits": np.zeros(3)}, "logits of 4 splats"),
        ({"log_scales": np.full((4, 3), 60.0)}, "float32 cannot hold"),
        ({"centers": np.full((4, 3), np.inf)}, "splat 0 has centers that are not finite"),
    ],
)
def test_values_that_do_not_fit(values, said):
    whole = {"centers": np.zeros((4, 3)), "log_scales": np.zeros((4, 3)), "quaternions": np.ones((4, 4))}
    whole |= {"logits": np.zeros(4), "harmonics": np.zeros((4, 1, 3))}
    refused(lambda: warpcage.SplatField(**(whole | values), device="cpu"), match=said)


def test_values_on_the_device(device):
    contents = some_splats(50)
    contents.quaternions[3] = 0.0
    field = warpcage.SplatField.from_contents(contents, device=device)
    np.testing.assert_array_equal(field.rotations[3], np.eye(3))
    splats = field.splats
    np.testing.assert_allclose(splats.centers.numpy() + field.center, contents.centers, atol=1e-6)
    held = splats.covariances.numpy()[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    np.testing.assert_allclose(held, field.covariances, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(np.linalg.eigvalsh(field.covariances), np.sort(field.scales**2, axis=1), rtol=1e-6)
    np.testing.assert_array_equal(splats.harmonics.numpy().reshape(contents.harmonics.shape), contents.harmonics)
    np.testing.assert_allclose(splats.opacities.numpy(), 1 / (1 + np.exp(-contents.logits)), rtol=1e-6)
    assert field.to(device) is field and (splats.degree, splats.turns.size, splats.rows.size) == (3, 0, 0)


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("faces", [0, 1])
def test_points_and_meshes_are_no_splats(tmp_path, kind, faces):
    head = f"ply\nformat {kind} 1.0\nelement vertex 3\n" + "".join(f"property float {name}\n" for name in "xyz")
    head += "property float nx\n" + "element face 1\nproperty list uchar int vertex_indices\n" * faces + "end_header\n"
    if kind == "ascii":
        body = b"0 0 0 1\n1 0 0 1\n0 1 0 1\n" + b"3 0 1 2\n" * faces
    else:
        body = bytes(48) + struct.pack("<Biii", 3, 0, 1, 2) * faces
    (tmp_path / "scan.ply").write_bytes(head.encode() + body)
    said = refused(lambda: warpcage.SplatField.load(tmp_path / "scan.ply"))
    assert "scan.ply: no 3DGS splats" in said
    assert said.endswith("it holds a mesh" if faces else "it holds points without scales")
