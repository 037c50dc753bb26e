"""Writers of captures as programs of phones make them, of ARKit's poses, for pictures and cameras of ours."""

import json

import numpy as np
from program_writers import SHADES, SQUARE, write_pictures
from scene_writers import OPENGL, write_image
from scipy.spatial.transform import Rotation

#: What takes z up, as scenes of phones are read, to ARKit's world with y up.
TO_ARKIT = np.array([[0.0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


def write_json(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))


def write_polycam(folder, pictures, *, kinds=("",), shift=0.0):
    """kinds: "" and "corrected_"; shift: of the places of "", which are the phone's first guess."""
    for kind in kinds:
        for name, rgba, camera in zip(pictures.names, pictures.rgba, pictures.cameras, strict=True):
            pose = TO_ARKIT @ camera.camera_to_world @ OPENGL
            pose[:3, 3] += shift * (kind == "")
            content = {f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)}
            content |= {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
            content |= {"blur_score": 90.0, "neighbors": [], "timestamp": 1}
            write_json(folder / f"keyframes/{kind}cameras/{name}.json", content)
            write_image(folder / f"keyframes/{kind}images/{name}.png", rgba)


def write_record3d(folder, pictures, *, file="metadata.json", images="rgb", each=False):
    """each: intrinsics of each picture, and a wrong matrix."""
    first, poses = pictures.cameras[0], []
    write_pictures(folder / images, pictures, [f"{index}.png" for index in range(len(pictures.cameras))])
    for camera in pictures.cameras:
        pose = TO_ARKIT @ camera.camera_to_world @ OPENGL
        poses.append([*Rotation.from_matrix(pose[:3, :3]).as_quat(), *pose[:3, 3]])
    content = {"w": first.width, "h": first.height, "fps": 60, "poses": poses}
    content["K"] = [first.fx, 0, 0, 0, first.fy, 0, first.cx, first.cy, 1]
    if each:
        content["perFrameIntrinsicCoeffs"] = [[c.fx, c.fy, c.cx, c.cy] for c in pictures.cameras]
        content["K"] = [1.0] * 9
    write_json(folder / file, content)


def write_arkitscenes(
    folder, pictures, *, place="41069021_frames", images="lowres_wide", start=3454.225, mesh=True, between=True
):
    """place: of the folders, "" for the raw data; start: seconds of the first picture, of which there are 10 in a
    second; between: whether there are as many more, without poses. Times miss by what they do in the data."""
    home, lines = folder / place, []
    for index, (rgba, camera) in enumerate(zip(pictures.rgba, pictures.cameras, strict=True)):
        time = 3454.225 + 0.1 * index
        to_camera = np.linalg.inv(camera.camera_to_world)
        values = [*Rotation.from_matrix(to_camera[:3, :3]).as_rotvec(), *to_camera[:3, 3]]
        lines.append(" ".join([f"{time + 0.0004:.6f}", *(repr(float(value)) for value in values)]))
        name = f"41069021_{time:.3f}"
        write_image(home / images / f"{name}.png", rgba)
        if between:
            write_image(home / images / f"41069021_{time + 0.05:.3f}.png", rgba[::-1, ::-1])
        lens = f"{camera.width} {camera.height} {camera.fx} {camera.fy} {camera.cx} {camera.cy}"
        for shift in (0.001, 0.05):
            file = home / f"{images}_intrinsics" / f"41069021_{time + shift:.3f}.pincam"
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(lens)
    (home / "lowres_wide.traj").write_text("\n".join(lines) + "\n")
    if mesh:
        rows = [f"{x} {y} {z} {r:.0f} {g:.0f} {b:.0f}" for x, y, z, r, g, b in np.hstack([SQUARE, SHADES]).tolist()]
        head = ["ply", "format ascii 1.0", f"element vertex {len(rows)}", *(f"property float {axis}" for axis in "xyz")]
        head += [f"property uchar {color}" for color in ("red", "green", "blue")]
        head += ["element face 1", "property list uchar int vertex_indices", "end_header"]
        (folder / "41069021_3dod_mesh.ply").write_text("\n".join([*head, *rows, "3 0 1 2"]) + "\n")


def write_stray(folder, pictures):
    first = pictures.cameras[0]
    write_pictures(folder / "rgb", pictures, [f"{index:06d}.png" for index in range(len(pictures.cameras))])
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for index, camera in enumerate(pictures.cameras):
        pose = TO_ARKIT @ camera.camera_to_world
        values = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
        lines.append(", ".join([f"{0.0167 * index:.4f}", f"{index:06d}", *(repr(float(value)) for value in values)]))
    (folder / "odometry.csv").write_text("\n".join(lines) + "\n")
    rows = [[first.fx, 0.0, first.cx], [0.0, first.fy, first.cy], [0.0, 0.0, 1.0]]
    (folder / "camera_matrix.csv").write_text("\n".join(", ".join(map(repr, map(float, row))) for row in rows) + "\n")
