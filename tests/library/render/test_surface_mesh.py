"""Meshes with their colours against rays that are cast in float64, files of them, their poses, and what is refused."""

import concurrent.futures
import functools
import io
import json
import struct

import numpy as np
import pytest
import scipy.ndimage
import trimesh
from fields import BOX, make_field, plain, view
from messages import MESSAGES
from PIL import Image
from refusals import refused

import warpcage
from warpcage import Cage, CageEdit, Deformer, Place, Stage, SurfaceMesh
from warpcage.coordinates import stretched_normals
from warpcage.mesh import write_glb, write_shown_mesh
from warpcage.mesh.io.gltf import Texture
from warpcage.render.surface_file import read_surface

BALL = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
COLORS = np.random.default_rng(0).random((len(BALL.vertices), 3))
PICTURE = np.random.default_rng(1).integers(0, 256, (5, 7, 3), dtype=np.uint8)
SQUARE = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]])
SQUARE_UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)


def pixel_rays(camera):
    """Unit directions (h * w, 3) through the middles of pixels."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    along = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
    along = along.reshape(-1, 3) @ camera.camera_to_world[:3, :3].T
    return along / np.linalg.norm(along, axis=1, keepdims=True)


def cast(vertices, faces, camera):
    """Depth (n,), inf for nothing, face and barycentric weights of what each pixel's ray meets first, by all planes."""
    triangles, directions = np.asarray(vertices)[faces], pixel_rays(camera)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    depth, face = np.full(len(directions), np.inf), np.full(len(directions), -1)
    shares = np.zeros((len(directions), 3))
    for number, (triangle, normal) in enumerate(zip(triangles, normals, strict=True)):
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = ((triangle[0] - camera.center) @ normal) / (directions @ normal)
        distance = np.where(np.isfinite(distance), distance, -1.0)
        points = camera.center + distance[:, None] * directions
        weights = trimesh.triangles.points_to_barycentric(np.repeat(triangle[None], len(points), axis=0), points)
        met = (weights > -1e-9).all(axis=1) & (distance > 0.0) & (distance < depth)
        depth[met], face[met], shares[met] = distance[met], number, weights[met]
    return depth, face, shares


def same_hits(frame, depth):
    """Pixels that both meet, but for a few at edges that rounding decides."""
    met, expected = frame.alpha.reshape(-1) > 0.5, np.isfinite(depth)
    assert (met != expected).sum() <= 2 and expected.sum() > 100
    assert np.isinf(frame.depth[frame.alpha == 0]).all()
    return met & expected


@pytest.mark.parametrize("origin", [(0, 0, 0), (2000, -500, 30)], ids=["here", "far"])
def test_hits_depths_and_colors_are_those_of_cast_rays(origin, device):
    camera = view((1.3, 0.5, 0.6), size=48).moved(Place(origin).matrix)
    vertices = BALL.vertices + origin
    frame = SurfaceMesh(vertices, BALL.faces, colors=COLORS, device=device).render(camera, supersampling=1)
    depth, face, shares = cast(vertices, BALL.faces, camera)
    met = same_hits(frame, depth)
    np.testing.assert_allclose(frame.depth.reshape(-1)[met], depth[met], atol=2e-4 if any(origin) else 1e-5)
    expected = (COLORS[BALL.faces[face[met]]] * shares[met][..., None]).sum(axis=1)
    np.testing.assert_allclose(frame.rgb.reshape(-1, 3)[met], expected, atol=5e-3 if any(origin) else 1e-4)
    np.testing.assert_array_equal(frame.rgb[frame.alpha == 0], 1.0)  # its own background


def test_a_texture_is_bilinear_and_goes_on_beyond_its_edges(device):
    uv = SQUARE_UV * 2.5 - 0.7
    mesh = SurfaceMesh(*SQUARE, uv=uv, texture=PICTURE, colors=(1.0, 0.5, 1.0), device=device)
    camera = view((0.4, 0.3, 2.0), size=48)
    frame = mesh.render(camera, supersampling=1)
    depth, face, shares = cast(*SQUARE, camera)
    met = same_hits(frame, depth)
    spots = (uv[SQUARE[1][face[met]]] * shares[met][..., None]).sum(axis=1)
    places = [spots[:, 1] * 5 - 0.5, spots[:, 0] * 7 - 0.5]
    expected = [
        scipy.ndimage.map_coordinates(PICTURE[..., k] / 255, places, order=1, mode="grid-wrap") for k in range(3)
    ]
    np.testing.assert_allclose(frame.rgb.reshape(-1, 3)[met], np.stack(expected, axis=1) * [1, 0.5, 1], atol=1e-3)


def test_clear_faces_show_what_is_behind_them(device):
    vertices = np.concatenate([SQUARE[0], SQUARE[0] - [0, 0, 1]])
    faces = np.concatenate([SQUARE[1], SQUARE[1] + 4])
    colors = np.repeat([[1.0, 0, 0, 0.25], [0, 0, 1.0, 0.5]], 4, axis=0)
    mesh = SurfaceMesh(vertices, faces, colors=colors, background="black", device=device)
    frame = mesh.render(view((0.02, 0.03, 2.0), size=33), supersampling=1)
    np.testing.assert_allclose(frame.rgb[16, 16], [0.25, 0, 0.375], atol=1e-5)
    assert frame.alpha[16, 16] == pytest.approx(0.625, abs=1e-5)
    assert frame.depth[16, 16] == pytest.approx((0.25 * 2 + 0.375 * 3) / 0.625, rel=1e-2)
    clear = mesh.render(view((0.02, 0.03, 2.0), size=33), background="transparent")
    assert clear.transparent and clear.rgba[16, 16, 3] == pytest.approx(0.625, abs=1e-3)


def test_one_color_is_seen_by_a_headlight_and_colors_of_vertices_as_they_are(device):
    camera = view((1.3, 0.5, 0.6), size=48)
    one = SurfaceMesh(BALL.vertices, BALL.faces, colors=(0.5, 0.8, 0.2), device=device).render(camera, supersampling=1)
    depth, face, _ = cast(BALL.vertices, BALL.faces, camera)
    met = same_hits(one, depth)
    cosine = np.abs((BALL.face_normals[face[met]] * pixel_rays(camera)[met]).sum(axis=1))
    expected = (0.3 + 0.7 * cosine)[:, None] * [0.5, 0.8, 0.2]
    np.testing.assert_allclose(one.rgb.reshape(-1, 3)[met], expected, atol=1e-4)
    each = np.tile([0.5, 0.8, 0.2], (len(BALL.vertices), 1))
    flat = SurfaceMesh(BALL.vertices, BALL.faces, colors=each, device=device).render(camera, supersampling=1)
    np.testing.assert_allclose(flat.rgb.reshape(-1, 3)[met], np.tile([0.5, 0.8, 0.2], (met.sum(), 1)), atol=1e-5)


def test_supersampling_is_the_mean_of_a_larger_picture(device):
    mesh = SurfaceMesh(BALL.vertices, BALL.faces, colors=COLORS, device=device)
    camera = view((1.3, 0.5, 0.6), size=20)
    fine = mesh.render(camera.resized(60, 60), supersampling=1).rgb.reshape(20, 3, 20, 3, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(mesh.render(camera, supersampling=3).rgb, fine, atol=1e-5)
    np.testing.assert_array_equal(mesh.render(camera).rgb, mesh.render(camera, supersampling=2).rgb)
    again = mesh.with_vertices(BALL.vertices + [0.1, 0, 0], refit=True).with_vertices(BALL.vertices, refit=True)
    np.testing.assert_allclose(again.render(camera).rgb, mesh.render(camera).rgb, atol=1e-4)


# files ----------------------------------------------------------------------------------------------------------------


def png(pixels):
    data = io.BytesIO()
    Image.fromarray(pixels).save(data, "PNG")
    return data.getvalue()


def file_of(ending, kind, folder):
    """A file of the ball with colours of vertices, or of the square with a texture; z is up."""
    path = folder / f"object{ending}"
    if kind == "texture":
        if ending == ".glb":
            texture = Texture(SQUARE_UV.astype(np.float64), np.tile([0.0, 0, 1], (4, 1)), png(PICTURE))
            write_shown_mesh(path, *SQUARE, texture=texture)
        else:
            material = trimesh.visual.material.SimpleMaterial(image=Image.fromarray(PICTURE))
            visual = trimesh.visual.TextureVisuals(SQUARE_UV * [1, -1] + [0, 1], material=material)
            trimesh.Trimesh(*SQUARE, visual=visual, process=False).export(path)
    elif ending in (".glb", ".gltf"):
        write_shown_mesh(path, BALL.vertices, BALL.faces, colors=COLORS)
    else:
        trimesh.Trimesh(BALL.vertices, BALL.faces, vertex_colors=COLORS, process=False).export(path)
    return path


@pytest.mark.parametrize("ending", [".glb", ".gltf", ".ply", ".obj"])
def test_files_with_colors_of_vertices(ending, tmp_path, device):
    camera = view((1.3, 0.5, 0.6), size=40)
    mesh = SurfaceMesh.load(file_of(ending, "colors", tmp_path), device=device)
    expected = SurfaceMesh(BALL.vertices, BALL.faces, colors=COLORS, device=device).render(camera)
    np.testing.assert_allclose(mesh.render(camera).rgb, expected.rgb, atol=0.004)
    np.testing.assert_allclose(mesh.bounds, BALL.bounds, atol=1e-6)


#: A square with a notch, whose fan reaches across it, and the ways in which it may stand in a file.
NOTCHED = [(0, 0), (4, 0), (4, 4), (2, 1), (0, 4)]
OBJ_CORNERS = "".join(f"v {x} {y} 0\n" for x, y in NOTCHED)
PLY_HEAD = "ply\nformat ascii 1.0\nelement vertex 5\n" + "".join(f"property float {axis}\n" for axis in "xyz")
PLY_FACES = "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
CONCAVE = {
    "plain.obj": OBJ_CORNERS + "f 1 2 3 4 5\n",
    "backward.obj": OBJ_CORNERS + "f -5 -4 -3 -2 -1\n",
    "two lines.obj": OBJ_CORNERS + "f 1 2 3 \\\n4 5 # a face\n",
    "texture.obj": OBJ_CORNERS + "vt 0 0\nvt 1 1\n" + "f 1/1 2/2 3/1 4/2 5/1\n",
    "plain.off": "OFF\n5 1 0\n" + "".join(f"{x} {y} 0\n" for x, y in NOTCHED) + "5 0 1 2 3 4\n",
    "plain.ply": PLY_HEAD + PLY_FACES + "".join(f"{x} {y} 0\n" for x, y in NOTCHED) + "5 0 1 2 3 4\n3 0 1 2\n",
    "normals.ply": PLY_HEAD
    + "".join(f"property float n{axis}\n" for axis in "xyz")
    + PLY_FACES
    + "".join(f"{x} {y} 0 0 0 1\n" for x, y in NOTCHED)
    + "5 0 1 2 3 4\n3 0 1 2\n",
}


@pytest.mark.parametrize("name", CONCAVE)
def test_concave_faces_stay_within_themselves(name, tmp_path):
    (tmp_path / name).write_text(CONCAVE[name])
    surface = read_surface(tmp_path / name)
    a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
    areas = 0.5 * np.cross(b - a, c - a)[:, 2]
    assert areas.min() > 0.0
    assert areas.sum() == pytest.approx(18.0 if name.endswith(".ply") else 10.0)  # PLY has a triangle of 8 beside it


@pytest.mark.parametrize("kind, white", [("uchar", 255), ("ushort", 65535), ("float", 1.0)])
def test_faces_of_ply_files_with_colors_are_cut_in_their_own(kind, white, tmp_path):
    head = PLY_HEAD + PLY_FACES.removesuffix("end_header\n")
    head += "".join(f"property {kind} {name}\n" for name in ("red", "green", "blue")) + "end_header\n"
    dark = round(0.2 * white, 0 if white > 1 else 3)
    rows = [f"{x} {y} 0" for x, y in NOTCHED] + [f"5 0 1 2 3 4 {white} 0 {dark}", f"3 0 1 2 0 {white} 0"]
    (tmp_path / "object.ply").write_text(head + "\n".join(rows) + "\n")
    surface = read_surface(tmp_path / "object.ply")
    a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
    areas, shown = 0.5 * np.cross(b - a, c - a)[:, 2], surface.colors[surface.faces]
    assert areas.min() > 0.0 and areas[:3].sum() == pytest.approx(10.0)
    np.testing.assert_allclose(shown[:3], np.broadcast_to([1.0, 0.0, 0.2, 1.0], (3, 3, 4)), atol=1e-5)
    np.testing.assert_allclose(shown[3:], np.broadcast_to([0.0, 1.0, 0.0, 1.0], (1, 3, 4)), atol=1e-5)


@pytest.mark.parametrize("kind, white", [("uchar", 255), ("ushort", 65535), ("float", 1.0), ("double", 255.0)])
def test_colors_of_ply_files_are_shares_of_what_is_white_in_their_type(kind, white, tmp_path):
    shares = np.array([1.0, 0.5, 0.25, 0.75])
    shown = " ".join(f"{value:g}" for value in (np.round(shares * white) if white > 1 else shares))
    head = ["ply", "format ascii 1.0", "element vertex 3", *(f"property float {axis}" for axis in "xyz")]
    head += [*(f"property {kind} {name}" for name in ("red", "green", "blue", "alpha")), "element face 1"]
    head += ["property list uchar int vertex_indices", "end_header"]
    path = tmp_path / "object.ply"
    path.write_text(
        "\n".join([*head, *(f"{place} {shown}" for place in ("0 0 0", "1 0 0", "0 1 0")), "3 0 1 2"]) + "\n"
    )
    np.testing.assert_allclose(read_surface(path).colors, np.tile(shares, (3, 1)), atol=0.003)


@pytest.mark.parametrize("ending", [".glb", ".obj"])
def test_files_with_textures(ending, tmp_path, device):
    camera = view((0.4, 0.3, 2.0), size=40)
    mesh = SurfaceMesh.load(file_of(ending, "texture", tmp_path), device=device)
    expected = SurfaceMesh(*SQUARE, uv=SQUARE_UV, texture=PICTURE, device=device).render(camera)
    np.testing.assert_allclose(mesh.render(camera).rgb, expected.rgb, atol=1e-3)


@pytest.mark.parametrize("ending", [".stl", ".off", ".glb"])
def test_files_without_colors(ending, tmp_path, device):
    path = tmp_path / f"object{ending}"
    if ending == ".glb":
        path.write_bytes(write_glb(BALL.vertices[:, [0, 2, 1]] * [1, 1, -1], BALL.faces))
    else:
        BALL.export(path)
    camera = view((1.3, 0.5, 0.6), size=40)
    expected = SurfaceMesh(BALL.vertices, BALL.faces, device=device).render(camera)
    np.testing.assert_allclose(SurfaceMesh.load(path, device=device).render(camera).rgb, expected.rgb, atol=2e-3)


def gltf_of(materials, pictures=(), **extra):
    """A glTF document of two squares, one above the other, of a material each; y is up."""
    points, uv = np.float32(SQUARE[0])[:, [0, 2, 1]] * np.float32([1, 1, -1]), np.float32(SQUARE_UV)
    parts = [points.tobytes(), uv.tobytes(), np.uint16(SQUARE[1]).tobytes(), *map(png, pictures)]
    views, body = [], b""
    for part in parts:
        views.append({"buffer": 0, "byteOffset": len(body), "byteLength": len(part)})
        body += part + bytes(-len(part) % 4)
    accessors = [
        {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 4},
        {"bufferView": 1, "componentType": 5126, "type": "VEC2", "count": 4},
        {"bufferView": 2, "componentType": 5123, "type": "SCALAR", "count": 6},
    ]
    names = {"POSITION": 0, "TEXCOORD_0": 1}
    meshes = [{"primitives": [{"attributes": names, "indices": 2, "material": k}]} for k in range(len(materials))]
    nodes = [{"mesh": k, "translation": [0, -k, 0]} for k in range(len(materials))]
    document = {
        "asset": {"version": "2.0"}, "scenes": [{"nodes": list(range(len(nodes)))}], "nodes": nodes, "meshes": meshes,
        "accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": len(body)}], "materials": materials,
        "textures": [{"source": k} for k in range(len(pictures))],
        "images": [{"bufferView": 3 + k, "mimeType": "image/png"} for k in range(len(pictures))],
    } | extra  # fmt: skip
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(body))
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(body), 0x004E4942) + body
    return head + chunks


def textured(number, **words):
    return {"pbrMetallicRoughness": {"baseColorTexture": {"index": number}, **words.pop("metal", {})}, **words}


def test_materials_of_gltf(tmp_path, device):
    """Two pictures, the upper one cut out on its left side; and opacity of a material that is blended, or not."""
    upper = np.full((8, 8, 4), [255, 0, 0, 255], np.uint8)
    upper[:, :4, 3] = 100
    lower = np.full((4, 4, 4), [0, 255, 0, 9], np.uint8)
    camera = view((0.0, 0.01, 3.0), size=33)
    seen = {}
    for mode in ("MASK", "BLEND", "OPAQUE"):
        path = tmp_path / f"{mode}.glb"
        factor = {"baseColorFactor": [0.2, 1, 1, 0.5]}
        path.write_bytes(gltf_of([textured(0, alphaMode=mode), textured(1, metal=factor)], [upper, lower]))
        frame = SurfaceMesh.load(path, device=device).render(camera, supersampling=1)
        spots = camera.project(np.array([[-0.4, 0.0, 0.0], [0.4, 0.0, 0.0]]))[0].astype(int)
        seen[mode] = [frame.rgb[row, column] for column, row in spots]
    green, red = [0, 1, 0], [1, 0, 0]
    np.testing.assert_allclose(seen["MASK"], [green, red], atol=1e-4)
    np.testing.assert_allclose(seen["OPAQUE"], [red, red], atol=1e-4)
    share = 100 / 255
    np.testing.assert_allclose(seen["BLEND"], [[share, 1 - share, 0], red], atol=1e-4)
    metal = {"pbrMetallicRoughness": {"baseColorFactor": [0.2140411, 1, 0.0, 1]}}  # of light; as pictures have it 0.5
    unlit = {**metal, "extensions": {"KHR_materials_unlit": {}}}
    (tmp_path / "plain.glb").write_bytes(gltf_of([unlit]))
    frame = SurfaceMesh.load(tmp_path / "plain.glb", device=device).render(camera, supersampling=1)
    np.testing.assert_allclose(frame.rgb[16, 16], [0.5, 1, 0], atol=1e-4)
    (tmp_path / "lit.glb").write_bytes(gltf_of([metal]))
    lit = SurfaceMesh.load(tmp_path / "lit.glb", device=device).render(camera, supersampling=1)
    np.testing.assert_allclose(lit.rgb[16, 16], [0.5, 1, 0], atol=1e-3)  # seen from the front
    assert lit.rgb[16, 5, 1] < 0.98


def test_broken_files_are_told_in_one_line(tmp_path):
    good, square = png(PICTURE), [textured(0)]
    data = gltf_of(square, [PICTURE])
    numbers = b"".join(b"property float %s\n" % axis for axis in (b"x", b"y", b"z"))
    ply = b"ply\nformat ascii 1.0\nelement vertex 3\n" + numbers
    ply += b"element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 %s\n1 0 0\n0 1 0\n3 %s\n"
    wrong = {
        "cut.glb": (data.replace(good[:30], b"x" * 30), "picture 0' cannot be read"),
        "none.glb": (gltf_of(square, [PICTURE], textures=[{}]), MESSAGES["surface.texture"]),
        "out.glb": (gltf_of(square, [PICTURE], images=[{"uri": "../a.png"}]), "picture '../a.png' leads out"),
        "away.glb": (gltf_of(square, [PICTURE], images=[{"uri": "a.png"}]), "picture 'a.png' is not there"),
        "number.glb": (gltf_of([textured(7)], [PICTURE]), "IndexError"),
        "empty.glb": (gltf_of([]), "no faces in it"),
        "text.ply": (b"ply\nnothing", "text.ply"),
        "text.obj": (b"nothing", "text.obj"),
        "text.xyz": (b"nothing", "must end in"),
        "index.ply": (ply % (b"0", b"1 2 9"), "index.ply"),
        "nan.ply": (ply % (b"nan", b"0 1 2"), "a vertex of its faces is not finite"),
    }
    for name, (content, message) in wrong.items():
        (tmp_path / name).write_bytes(content)
        refused(functools.partial(SurfaceMesh.load, tmp_path / name), name, match=message, error=warpcage.Error)
    refused(lambda: SurfaceMesh.load(tmp_path / "nothing.glb"), error=FileNotFoundError)
    uv = SQUARE_UV.astype("<f4").tobytes()  # places that are none are taken for the corner
    (tmp_path / "uv.glb").write_bytes(data.replace(uv, np.full((4, 2), np.nan, "<f4").tobytes()))
    frame = SurfaceMesh.load(tmp_path / "uv.glb", device="cpu").render(view((0.0, 0.1, 2.0), size=9))
    assert np.isfinite(frame.rgb).all() and frame.alpha.max() == 1.0


def test_what_a_mesh_refuses(device):
    vertices, faces = SQUARE
    for options, message in (
        ({"faces": [[0, 1, 4]]}, "must name vertices 0 to 3, got 0 to 4"),
        ({"faces": [[0.0, 1, 2]]}, "faces must be"),
        ({"vertices": vertices[:, :2]}, "vertices must be"),
        ({"vertices": np.where(vertices == 1, np.nan, vertices)}, "finite"),
        ({"vertices": 0 * vertices}, "a longest side of 0"),
        ({"colors": np.ones((3, 3))}, "colors must be"),
        ({"colors": np.full((4, 3), 255)}, MESSAGES["surface.colors"]),
        ({"uv": SQUARE_UV}, "uv needs a texture"),
        ({"uv": SQUARE_UV[:2], "texture": PICTURE}, "uv must be"),
        ({"uv": SQUARE_UV, "texture": PICTURE[0]}, "a texture must be"),
        ({"supersampling": 9}, "supersampling must be"),
    ):
        with pytest.raises(ValueError, match=message):
            SurfaceMesh(**{"vertices": vertices, "faces": faces, "device": device, **options})
    mesh = SurfaceMesh(vertices, faces, device=device)
    refused(lambda: mesh.with_vertices(vertices[:3]), match="has 4 vertices, got 3")
    refused(lambda: mesh.render(5), match="render needs a Camera")
    assert mesh.to(device) is mesh and "2 faces" in repr(mesh)


# poses ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["mean_value", "green", "harmonic", "maximum_likelihood", "biharmonic"])
def test_a_pose_moves_vertices_by_their_coordinates(kind, device):
    mesh = SurfaceMesh(0.7 * BALL.vertices, BALL.faces, colors=COLORS, device=device)
    posed = BOX.twist(40, axis="x").scale(1.1)
    deformer = Deformer(mesh, BOX, coordinates=kind).pose(posed)
    if kind == "green":
        weights, slopes = warpcage.green_coordinates(mesh.vertices, BOX, device="cpu")
        edges, moved = (cage.vertices[cage.faces] for cage in (BOX, posed))
        (u, v), (p, q) = ((each[:, 1] - each[:, 0], each[:, 2] - each[:, 0]) for each in (edges, moved))
        dot = lambda a, b: (a * b).sum(axis=1)  # noqa: E731
        normals = np.cross(p, q)
        area = np.linalg.norm(np.cross(u, v), axis=1)
        stretch = np.sqrt(dot(p, p) * dot(v, v) - 2 * dot(p, q) * dot(u, v) + dot(q, q) * dot(u, u)) / (
            np.sqrt(2) * area
        )
        normals *= (stretch / np.linalg.norm(normals, axis=1))[:, None]
        expected = weights @ posed.vertices + slopes @ normals  # Lipman et al. 2008, Eq. 3
    elif kind == "biharmonic":
        weights, slopes = warpcage.biharmonic_coordinates(mesh.vertices, BOX, device="cpu")
        expected = weights @ posed.vertices + slopes @ stretched_normals(BOX, posed)
    else:
        weights = getattr(warpcage, f"{kind}_coordinates")(mesh.vertices, BOX, device="cpu")
        expected = weights @ posed.vertices
    np.testing.assert_allclose(deformer.posed_edits().mesh.vertices, expected, atol=2e-4)
    camera = view((1.6, 0.6, 0.7), size=40)
    frame = deformer.render(camera, supersampling=1)
    depth, face, shares = cast(expected, BALL.faces, camera)
    met = same_hits(frame, depth)
    near = np.abs(frame.depth.reshape(-1)[met] - depth[met]) < 2e-3
    colors = (COLORS[BALL.faces[face[met]]] * shares[met][..., None]).sum(axis=1)
    assert near.mean() > 0.99 and np.median(np.abs(frame.rgb.reshape(-1, 3)[met] - colors)) < 2e-3


def test_threads_share_a_mesh_and_pose_it(device):
    """Each thread makes what rays meet where it is not there yet, and none takes it from another one."""
    cage = Cage.box((-0.6,) * 3, (0.6,) * 3)
    camera, poses = view((1.3, 0.5, 0.6), size=40), [cage.twist(angle) for angle in (20, 35, 50)]
    fresh = SurfaceMesh(BALL.vertices, BALL.faces, colors=COLORS, device=device)
    expected = fresh.render(camera).rgb
    posed = Deformer(fresh, cage, coordinates="mean_value").pose(poses[-1]).render(camera).rgb
    for _ in range(5):
        mesh = SurfaceMesh(BALL.vertices, BALL.faces, colors=COLORS, device=device)

        def work(number, mesh=mesh):
            deformer = Deformer(mesh, cage, coordinates="mean_value")
            frames = [deformer.pose(pose).render(camera).rgb for pose in poses]
            return mesh.render(camera).rgb, frames[-1]

        with concurrent.futures.ThreadPoolExecutor(4) as pool:
            for plain, last in pool.map(work, range(4)):
                np.testing.assert_array_equal(plain, expected)
                np.testing.assert_array_equal(last, posed)


def test_a_mesh_on_the_vertices_of_a_cage_goes_where_they_go(device):
    posed = BOX.bend(35, axis="x", towards="z")
    deformer = Deformer(SurfaceMesh(BOX.vertices, BOX.faces, device=device), BOX, coordinates="mean_value")
    np.testing.assert_allclose(deformer.pose(posed).posed_edits().mesh.vertices, posed.vertices, atol=1e-6)
    rested = deformer.pose(BOX).posed_edits().mesh
    np.testing.assert_allclose(rested.vertices, BOX.vertices, atol=1e-6)
    assert np.all(deformer.reached_bounds[1] >= BOX.bounds[1] - 1e-6)


def test_cages_copy_remove_and_follow_each_other(device):
    """Two triangles, one in each of two cages."""
    corner = np.array([[0.0, 0, 0], [0.2, 0, 0], [0, 0.2, 0]])
    vertices, faces = np.concatenate([corner, corner + [2, 0, 0]]), np.array([[0, 1, 2], [3, 4, 5]])
    mesh = SurfaceMesh(vertices, faces, colors=np.eye(6)[:, :3], device=device)
    left, right = (Cage.box((x - 0.5, -0.5, -0.5), (x + 0.5, 0.5, 0.5)) for x in (0.0, 2.0))
    options = {"coordinates": "mean_value", "resolution": 16}
    up = (0.0, 0.0, 1.0)

    def posed(edits, poses):
        made = Deformer(mesh, edits, **options).pose(poses).posed_edits().mesh
        return made.vertices[made.faces], made.surface.colors[made.faces]

    places, colors = posed([CageEdit(left, keep_source=True)], [left.translate(up)])
    np.testing.assert_allclose(places, np.stack([corner, corner + [2, 0, 0], corner + up]), atol=1e-5)
    np.testing.assert_array_equal(colors[2], colors[0])
    places, _ = posed([CageEdit(left, remove=True), right], [None, right.translate(up)])
    np.testing.assert_allclose(places, [corner + [2, 0, 1]], atol=1e-5)
    places, _ = posed([left, right], [left.translate((2, 0, 0)), right.translate(up)])  # the second finds both
    np.testing.assert_allclose(places, np.stack([corner + [2, 0, 1]] * 2), atol=1e-5)
    with pytest.raises(ValueError, match="remove all of the mesh"):
        posed([CageEdit(left, remove=True), CageEdit(right, remove=True)], [None, None])


def test_what_a_posed_mesh_refuses(device):
    mesh = SurfaceMesh(BALL.vertices, BALL.faces, device=device)
    cage = Cage.box((-0.6,) * 3, (0.6,) * 3)
    deformer = Deformer(mesh, cage, coordinates="mean_value")
    for attempt, message in (
        (lambda: Deformer(mesh, CageEdit(cage, falloff=0.1)), MESSAGES["surface.falloff"]),
        (lambda: Deformer(mesh, cage, map="backward"), "map must be"),
        (lambda: Deformer(mesh, cage, store="weights"), 'store must be "map"'),
        (lambda: Deformer(mesh, cage, coordinates="linear"), "coordinates must be"),
        (lambda: deformer.render(view(), step=0.1), "step is for voxels"),
        (lambda: deformer.sample([[0, 0, 0]], [[0, 0, 1]]), "no density at points"),
        (lambda: deformer.to_canonical([[0, 0, 0]], [[0, 0, 1]]), "meshes do"),
        (lambda: deformer.render(view(), outputs="canonical"), "meshes do"),
        (lambda: warpcage.bake(deformer), "a VoxelField"),
    ):
        refused(attempt, match=message)


# stages ---------------------------------------------------------------------------------------------------------------


def solid_box(device):
    """A red box of voxels from -0.5 to 0.5, as good as solid."""
    return make_field(lambda x: 400.0 * (np.abs(x).max(axis=-1) < 0.5), plain([0.9, 0.1, 0.1]), device=device)


@pytest.mark.parametrize("order", [("box", "plane"), ("plane", "box")], ids=["box first", "mesh first"])
def test_a_plane_through_a_box_of_voxels_hides_what_is_behind_it(order, device):
    """Where the ray enters the box, and where it meets the plane, both as equations; the nearer one is seen."""
    tilted = Place((0.0, 0.0, 0.1), (10, 0, 15), 0.9)
    objects = {"box": solid_box(device), "plane": SurfaceMesh(*SQUARE, colors=np.tile([0.1, 0.2, 0.9], (4, 1)))}
    stage = Stage(device=device)
    for name in order:
        stage.add(name, objects[name], place=tilted if name == "plane" else None)
    camera = view((2.2, 1.4, 1.2), size=64)
    frame = stage.render(camera, supersampling=1, background="black")
    directions = pixel_rays(camera)

    def entry(half):
        low, high = ((side - camera.center) / directions for side in (-half, half))
        enter, leave = np.minimum(low, high).max(axis=1), np.maximum(low, high).min(axis=1)
        return np.where(enter < leave, enter, np.inf)

    box = entry(0.5)
    plane = cast(tilted.moved(SQUARE[0]), SQUARE[1], camera)[0]
    both = np.isfinite(box) & np.isfinite(plane)
    sure = ~both | (np.abs(np.where(both, box, 0.0) - np.where(both, plane, 1.0)) > 0.1)
    sure &= np.isfinite(entry(0.44)) == np.isfinite(entry(0.56))  # voxels fade out over their width
    red, blue = (sure & (one < other) for one, other in ((box, plane), (plane, box)))
    rgb, seen = frame.rgb.reshape(-1, 3), frame.depth.reshape(-1)
    assert red.sum() > 100 and (blue & np.isfinite(box)).sum() > 100 and (blue & np.isinf(box)).sum() > 100
    assert (rgb[blue].argmax(axis=1) == 2).all() and (rgb[red].argmax(axis=1) == 0).all()
    np.testing.assert_allclose(seen[blue], plane[blue], rtol=1e-4)
    assert np.median(np.abs(seen[red] - box[red])) < 0.05


def test_a_placed_mesh_is_one_with_moved_vertices(device):
    place, camera = Place((0.3, -0.2, 0.1), (20.0, -35.0, 70.0), 1.7), view((4, 1.5, 2), size=48)
    mesh = SurfaceMesh(BALL.vertices, BALL.faces, colors=COLORS, device=device)
    frame = Stage().add("ball", mesh, place=place).render(camera)
    moved = mesh.with_vertices(place.moved(BALL.vertices)).render(camera)
    np.testing.assert_allclose(frame.rgb, moved.rgb, atol=0.03)
    assert np.abs(frame.rgb - moved.rgb).mean() < 1e-4
    both = (frame.alpha > 0.99) & (moved.alpha > 0.99)
    np.testing.assert_allclose(frame.depth[both], moved.depth[both], rtol=1e-4)


def test_a_stage_file_with_a_posed_mesh_is_opened_again(tmp_path, device):
    path = file_of(".glb", "colors", tmp_path)
    solid_box(device).save(tmp_path / "box.npz")
    cage = Cage.box((-0.6,) * 3, (0.6,) * 3)
    deformer = Deformer(SurfaceMesh.load(path, device=device), cage, coordinates="mean_value").pose(cage.twist(50))
    stage = Stage(device=device).add("box", tmp_path / "box.npz")
    stage.add("ball", deformer, place=Place((1.2, 0, 0), (0, 30, 0)), path=path)
    stage.add("other", path, place=Place((-1.2, 0, 0)))
    stage.save(tmp_path / "all.stage.json")
    again = Stage.load(tmp_path / "all.stage.json", device=device)
    camera = view((0.5, 4, 1), size=40)
    np.testing.assert_array_equal(again.render(camera).rgb, stage.render(camera).rgb)
    assert isinstance(again["other"], SurfaceMesh) and isinstance(again["ball"], Deformer)
    refused(again.merged, match=MESSAGES["surface.merged"])
    assert again.hide("ball").hide("other").merged().voxel_count > 0
    far = np.abs(again.hide("box").hide("other", False).shown_points).max()
    assert far == pytest.approx(1.7, abs=1e-3)
