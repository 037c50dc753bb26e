"""Writers of files that are read: scene folders in every format, for pictures and cameras of the project's own; a glTF
document and a PNG by hand."""

import base64
import dataclasses
import json
import struct
import zlib

import imageio.v3 as iio
import numpy as np
from scipy.spatial.transform import Rotation

from warpcage import Camera
from warpcage.demo import brick_model, render_mesh_views

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclasses.dataclass
class Pictures:
    """rgba (n, h, w, 4) uint8 with straight alpha, and n cameras."""

    rgba: np.ndarray
    cameras: list

    @property
    def names(self):
        return [f"view_{i:02d}" for i in range(len(self.cameras))]

    def pick(self, indices):
        return Pictures(self.rgba[list(indices)], [self.cameras[i] for i in indices])

    def over(self, background):
        """(n, h, w, 3) float64, composited, and (n, h, w) alphas."""
        values = self.rgba / 255.0
        alpha = values[..., 3:]
        return values[..., :3] * alpha + (1 - alpha) * np.asarray(background), alpha[..., 0]


def spiral_cameras(count, *, width=24, height=20, centered=False, radius=4.0):
    """Cameras all around, with unlike focal lengths and a principal point off the middle unless `centred`."""
    cameras = []
    for i in range(count):
        turn, lift = 2.4 * i, np.sin(1.3 * i)
        eye = radius * np.array([np.cos(turn) * np.cos(lift), np.sin(turn) * np.cos(lift), np.sin(lift)])
        pose = Camera.look_at(eye, [0.1, 0.0, -0.05], up=[0.1, 0.2, 1.0]).camera_to_world
        off = (31.0, 29.5, width / 2 + 0.7, height / 2 - 0.4)
        intrinsics = (30.0, 30.0, width / 2, height / 2) if centered else off
        cameras.append(Camera(*intrinsics, width, height, pose))
    return cameras


def brick_pictures(count=10, **options):
    """The brick model in small pictures."""
    cameras = spiral_cameras(count, **options)
    return Pictures(np.round(render_mesh_views(*brick_model(), cameras, samples=2) * 255).astype(np.uint8), cameras)


def intrinsic_matrix(camera, shift=0.0):
    return np.array([[camera.fx, 0, camera.cx - shift], [0, camera.fy, camera.cy - shift], [0, 0, 1.0]])


def write_image(path, image, **options):
    path.parent.mkdir(parents=True, exist_ok=True)
    iio.imwrite(path, image, **options)


def change_json(path, change):
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def write_blender(folder, pictures, split="train"):
    frames = []
    for name, rgba, camera in zip(pictures.names, pictures.rgba, pictures.cameras, strict=True):
        write_image(folder / split / f"{name}.png", rgba)
        pose = camera.camera_to_world @ OPENGL
        frames.append({"file_path": f"./{split}/{name}", "transform_matrix": pose.tolist()})
    angle = 2 * np.arctan(0.5 * camera.width / camera.fx)
    (folder / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))


def write_nsvf(folder, pictures, splits, *, style="4x4", bbox=(-1.5, -1.5, -1.5, 1.5, 1.5, 1.5)):
    """splits: "0", "1" or "2" a picture."""
    (folder / "pose").mkdir(parents=True)
    for prefix, name, rgba, camera in zip(splits, pictures.names, pictures.rgba, pictures.cameras, strict=True):
        write_image(folder / "rgb" / f"{prefix}_{name}.png", rgba)
        np.savetxt(folder / "pose" / f"{prefix}_{name}.txt", camera.camera_to_world)
    matrix = np.eye(4)
    matrix[:3, :3] = intrinsic_matrix(camera)
    if style == "4x4":
        np.savetxt(folder / "intrinsics.txt", matrix)
    else:
        lines = [f"{camera.fx} {camera.cx} {camera.cy} 0.", "0. 0. 0.", "0.", "1.", f"{camera.height} {camera.width}"]
        (folder / "intrinsics.txt").write_text("\n".join(lines) + "\n")
    if bbox is not None:
        (folder / "bbox.txt").write_text(" ".join(map(str, bbox)) + " 0.4\n")


def write_dtu(folder, pictures, *, name="cameras_sphere.npz", masks=True, seed=0):
    """The scene's world is the unit-sphere space; a scale_mat leads out of it."""
    scale = np.diag([231.0, 231.0, 231.0, 1.0])
    scale[:3, 3] = [-28.5, -13.2, 641.5]
    rng, matrices = np.random.default_rng(seed), {}
    for i, (rgba, camera) in enumerate(zip(pictures.rgba, pictures.cameras, strict=True)):
        write_image(folder / "image" / f"{i:06d}.png", rgba[..., :3])
        if masks:
            write_image(folder / "mask" / f"{i:03d}.png", np.repeat(rgba[..., 3:], 3, axis=-1))
        world = np.eye(4)
        world[:3, :3] = intrinsic_matrix(camera, shift=0.5)  # pixel centres are integers in these files
        world = world @ np.linalg.inv(camera.camera_to_world) @ np.linalg.inv(scale)
        world[:3] *= rng.uniform(0.5, 2.0) * rng.choice([-1, 1])  # a projection's scale and sign mean nothing
        matrices |= {f"world_mat_{i}": world, f"scale_mat_{i}": scale}
    np.savez(folder / name, **matrices)
    return scale


def write_transforms(
    folder, pictures, *, shared=True, masks=False, extension=True, ending=".png", distortion=None, sized=True,
    name="transforms.json", **top,
):  # fmt: skip
    frames = []
    for stem, rgba, camera in zip(pictures.names, pictures.rgba, pictures.cameras, strict=True):
        write_image(folder / "images" / f"{stem}{ending}", rgba if ending == ".png" and not masks else rgba[..., :3])
        pose = camera.camera_to_world @ OPENGL
        frame = {"file_path": f"images/{stem}{ending if extension else ''}", "transform_matrix": pose.tolist()}
        if masks:
            write_image(folder / "masks" / f"{stem}.png", rgba[..., 3])
            frame["mask_path"] = f"masks/{stem}.png"
        intrinsics = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
        intrinsics |= ({"w": camera.width, "h": camera.height} if sized else {}) | (distortion or {})
        frames.append(frame if shared else frame | intrinsics)
    content = {"camera_model": "OPENCV", **(intrinsics if shared else {}), "frames": frames[::-1], **top}
    (folder / name).write_text(json.dumps(content))


#: COLMAP's camera models, by their numbers.
MODELS = "SIMPLE_PINHOLE PINHOLE SIMPLE_RADIAL RADIAL OPENCV OPENCV_FISHEYE FULL_OPENCV"
MODEL_NUMBERS = {name: number for number, name in enumerate(MODELS.split())} | {"EQUIRECTANGULAR": 17}


def write_colmap(
    folder, pictures, *, binary, model="PINHOLE", distortion=(), points=None, colors=None, masks=False, where="sparse/0"
):
    """colors: (n, 3) whole numbers to 255 of the points; None is grey."""
    (folder / where).mkdir(parents=True)
    cameras, images = [], []
    for i, (name, rgba, camera) in enumerate(zip(pictures.names, pictures.rgba, pictures.cameras, strict=True)):
        write_image(folder / "images" / f"{name}.png", rgba[..., :3] if masks else rgba)
        if masks:
            write_image(folder / "masks" / f"{name}.png.png", rgba[..., 3])
        focal = (camera.fx,) if model.startswith("SIMPLE") or model == "RADIAL" else (camera.fx, camera.fy)
        parameters = (*focal, camera.cx, camera.cy, *distortion)
        if model == "EQUIRECTANGULAR":
            parameters = (camera.width, camera.height)
        cameras.append((i + 1, model, camera.width, camera.height, parameters))
        inverse = np.linalg.inv(camera.camera_to_world)
        x, y, z, w = Rotation.from_matrix(inverse[:3, :3]).as_quat()
        images.append((i + 1, w, x, y, z, *inverse[:3, 3], i + 1, f"{name}.png"))
    write = write_colmap_binary if binary else write_colmap_text
    points = np.zeros((0, 3)) if points is None else points
    write(folder / where, cameras, images[::-1], points, np.full((len(points), 3), 128) if colors is None else colors)


def write_colmap_text(folder, cameras, images, points, colors):
    lines = ["# Camera list", *(" ".join(map(str, [*row[:4], *row[4]])) for row in cameras)]
    (folder / "cameras.txt").write_text("\n".join(lines) + "\n")
    lines = ["# Image list", *(" ".join(map(str, row)) + "\n" + ("" if row[0] % 2 else "1.5 2.5 -1") for row in images)]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    rows = zip(points, colors, strict=True)
    lines = [f"{i + 1} {x} {y} {z} {r} {g} {b} 0.5 1 0 2 0" for i, ((x, y, z), (r, g, b)) in enumerate(rows)]
    (folder / "points3D.txt").write_text("# 3D points\n" + "\n".join(lines) + "\n")


def write_colmap_binary(folder, cameras, images, points, colors):
    data = struct.pack("<Q", len(cameras))
    for number, model, width, height, parameters in cameras:
        data += struct.pack(f"<iiQQ{len(parameters)}d", number, MODEL_NUMBERS[model], width, height, *parameters)
    (folder / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(images))
    for number, *pose, camera, name in images:
        keypoints = number % 2
        data += struct.pack("<i7di", number, *pose, camera) + name.encode() + b"\0" + struct.pack("<Q", keypoints)
        data += struct.pack("<ddq", 1.5, 2.5, -1) * keypoints
    (folder / "images.bin").write_bytes(data)
    data = struct.pack("<Q", len(points))
    for i, (point, color) in enumerate(zip(points, colors, strict=True)):
        data += struct.pack("<Q3d3Bd", i + 1, *point, *color, 0.5) + struct.pack("<Q4i", 2, 1, 0, 2, 0)
    (folder / "points3D.bin").write_bytes(data)


KINDS = {"f": 5126, "u": 5125, "B": 5121}
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}


class GltfWriter:
    """Collects numbers and writes a .gltf of one mesh on node 0."""

    def __init__(self, vertices, faces):
        self.body, self.views, self.accessors = b"", [], []
        self.primitive = {"attributes": {"POSITION": self.add(vertices)}, "indices": self.add(faces, "u")}
        self.nodes, self.more = [{"mesh": 0}], {}

    def view(self, values, kind="f"):
        data = np.ascontiguousarray(values, {"f": "<f4", "u": "<u4", "B": "u1"}[kind]).tobytes()
        self.views.append({"buffer": 0, "byteOffset": len(self.body), "byteLength": len(data)})
        self.body += data + b"\0" * (-len(data) % 4)
        return len(self.views) - 1

    def add(self, values, kind="f", width=None, **more):
        values = np.asarray(values)
        width = width or (1 if kind == "u" or values.ndim == 1 else values.shape[-1])
        self.accessors.append({"bufferView": self.view(values, kind), "componentType": KINDS[kind],
                               "type": TYPES[width], "count": values.size // width, **more})  # fmt: skip
        return len(self.accessors) - 1

    def add_sparse(self, count, rows, values):
        self.accessors.append({
            "componentType": 5126, "type": "VEC3", "count": count,
            "sparse": {"count": len(rows), "indices": {"bufferView": self.view(rows, "u"), "componentType": 5125},
                       "values": {"bufferView": self.view(values)}}})  # fmt: skip
        return len(self.accessors) - 1

    def animate(self, *channels, name=None):
        """channels: (node, path, times, values, interpolation)."""
        samplers, targets = [], []
        for node, path, times, values, way in channels:
            samplers.append({"input": self.add(times), "output": self.add(values), "interpolation": way})
            targets.append({"sampler": len(samplers) - 1, "target": {"node": node, "path": path}})
        named = {} if name is None else {"name": name}
        self.more.setdefault("animations", []).append({"samplers": samplers, "channels": targets, **named})

    def save(self, path, **mesh):
        uri = "data:application/octet-stream;base64," + base64.b64encode(self.body).decode()
        children = {child for node in self.nodes for child in node.get("children", [])}
        document = {
            "asset": {"version": "2.0"}, "scene": 0, "nodes": self.nodes,
            "scenes": [{"nodes": [k for k in range(len(self.nodes)) if k not in children]}],
            "meshes": [{"primitives": [self.primitive], **mesh}], "accessors": self.accessors,
            "bufferViews": self.views, "buffers": [{"byteLength": len(self.body), "uri": uri}], **self.more,
        }  # fmt: skip
        path.write_text(json.dumps(document))
        return path


def png_bytes(width, height, depth, kind, data):
    """A PNG by hand: kind is 0 grey, 2 colour, 4 grey with alpha, 6 colour with alpha."""

    def chunk(name, content):
        return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))

    header = struct.pack(">IIBBBBB", width, height, depth, kind, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")


def write_deep_png(path, image):
    """(h, w, c) uint16 as a PNG of 16 bits a channel."""
    height, width, channels = image.shape
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in image)
    path.write_bytes(png_bytes(width, height, 16, {1: 0, 2: 4, 3: 2, 4: 6}[channels], rows))
