"""Writers of scenes as data sets of research publish them, for pictures and cameras of ours, and where the formats' own
descriptions put points in their pictures; and an output folder of 3D Gaussian Splatting."""

import json

import numpy as np
from program_writers import SQUARE, shrunk, write_pictures
from scene_writers import intrinsic_matrix, write_image


def save_matrix(path, matrix):
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, matrix, fmt="%.17g")


def seen_with(k, to_camera, middle=0.0):
    """Pixels of SQUARE by a camera matrix; middle: how far the origin of pixels is from the corner of the first one."""
    x, y, z = (SQUARE @ to_camera[:3, :3].T + to_camera[:3, 3]).T
    return k[0, 0] * x / z + k[0, 2] + middle, k[1, 1] * y / z + k[1, 2] + middle


def write_scannet(folder, pictures, *, home="", lost=(), intrinsics="intrinsic/intrinsic_color.txt", ending=".png"):
    """As SensReader exports frames; lost: numbers of pictures without a pose; intrinsics: name of their file."""
    k = np.eye(4)
    k[:3, :3] = intrinsic_matrix(pictures.cameras[0], shift=0.5)
    save_matrix(folder / home / intrinsics, k)
    for index, (rgba, camera) in enumerate(zip(pictures.rgba, pictures.cameras, strict=True)):
        write_image(folder / home / f"color/{index}{ending}", rgba if ending == ".png" else rgba[..., :3])
        pose = np.full((4, 4), -np.inf) if index in lost else camera.camera_to_world
        save_matrix(folder / home / f"pose/{index}.txt", pose)


def seen_by_scannet(folder, _scene):
    k = np.loadtxt(next(folder.rglob("intrinsic*color.txt")))
    files = sorted(folder.rglob("pose/*.txt"), key=lambda file: int(file.stem))
    return [seen_with(k, np.linalg.inv(np.loadtxt(file)), 0.5) for file in files]


def write_replica(folder, pictures, *, beside=False):
    """As NICE-SLAM renders it; beside: whether the parameters are in the folder around, as in its download."""
    first = pictures.cameras[0]
    write_pictures(folder / "results", pictures, [f"frame{index:06d}.png" for index in range(len(pictures.cameras))])
    write_image(folder / "results" / "depth000000.png", pictures.rgba[0, ..., 0])
    save_matrix(folder / "traj.txt", [camera.camera_to_world.ravel() for camera in pictures.cameras])
    camera = {"w": first.width, "h": first.height, "fx": first.fx, "fy": first.fy, "scale": 6553.5}
    camera |= {"cx": first.cx - 0.5, "cy": first.cy - 0.5}
    ((folder.parent if beside else folder) / "cam_params.json").write_text(json.dumps({"camera": camera}))


def seen_by_replica(folder, _scene):
    given = json.loads(next(folder.glob("cam_params.json")).read_text())["camera"]
    k = np.array([[given["fx"], 0, given["cx"]], [0, given["fy"], given["cy"]], [0, 0, 1]])
    return [seen_with(k, np.linalg.inv(row.reshape(4, 4)), 0.5) for row in np.loadtxt(folder / "traj.txt")]


def write_semantic_nerf(folder, pictures):
    """Replica as Semantic-NeRF renders it: 90 degrees across, no intrinsics."""
    write_pictures(folder / "rgb", pictures, [f"rgb_{index}.png" for index in range(len(pictures.cameras))])
    save_matrix(folder / "traj_w_c.txt", [camera.camera_to_world.ravel() for camera in pictures.cameras])


def write_nerfies(folder, pictures, *, factors=(1,), lens=(0.0,) * 5, held=(0, 8), times=1, word="tangential"):
    """factors: of rgb/1x and others; lens: k1, k2, k3, p1, p2; held: numbers of `val`; times: moments that are seen."""
    for name, rgba, camera in zip(pictures.names, pictures.rgba, pictures.cameras, strict=True):
        for factor in factors:
            write_image(folder / f"rgb/{factor}x/{name}.png", shrunk(rgba, factor))
        content = {
            "orientation": camera.rotation.T.tolist(),
            "position": camera.center.tolist(),
            "focal_length": camera.fx,
            "principal_point": [camera.cx, camera.cy],
            "skew": 0.0,
            "pixel_aspect_ratio": camera.fy / camera.fx,
            "radial_distortion": list(lens[:3]),
            word: list(lens[3:]),
            "image_size": [camera.width, camera.height],
        }
        path = folder / f"camera/{name}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(content))
    val = [name for index, name in enumerate(pictures.names) if index in held]
    train = [name for name in pictures.names if name not in val]
    listing = {"count": len(pictures.names), "ids": pictures.names, "train_ids": train, "val_ids": val}
    metadata = {name: {"warp_id": index % times} for index, name in enumerate(pictures.names)}
    scene = {"scale": 0.04, "center": [1.0, 2.0, 3.0], "near": 0.02, "far": 0.8}
    for name, content in (("dataset", listing), ("metadata", metadata), ("scene", scene)):
        (folder / f"{name}.json").write_text(json.dumps(content))
    np.save(folder / "points.npy", SQUARE)


def seen_by_nerfies(folder, scene):
    for name in scene.names:
        given = json.loads((folder / f"camera/{name}.json").read_text())
        x, y, z = ((SQUARE - given["position"]) @ np.array(given["orientation"]).T).T
        (u, v), focal = given["principal_point"], given["focal_length"]
        yield focal * x / z + u, focal * given["pixel_aspect_ratio"] * y / z + v


def write_blendedmvs(folder, pictures, *, images="blended_images", ending=".png"):
    for index, (rgba, camera) in enumerate(zip(pictures.rgba, pictures.cameras, strict=True)):
        write_image(folder / images / f"{index:08d}{ending}", rgba if ending == ".png" else rgba[..., :3])
        if images == "blended_images":
            write_image(folder / images / f"{index:08d}_masked.png", 0 * rgba)
        rows = [["extrinsic"], *np.linalg.inv(camera.camera_to_world).tolist(), [], ["intrinsic"]]
        rows += [*intrinsic_matrix(camera).tolist(), [], [1.5, 0.025, 128, 4.7]]
        path = folder / f"cams/{index:08d}_cam.txt"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join(" ".join(map(str, row)) for row in rows) + "\n")
    (folder / "cams" / "pair.txt").write_text("1\n0\n0\n")


def seen_by_blendedmvs(folder, _scene):
    for path in sorted(folder.glob("cams/*_cam.txt")):
        words = path.read_text().split()
        to_camera, k = (np.array(words[at : at + n * n], float).reshape(n, n) for at, n in ((1, 4), (18, 3)))
        yield seen_with(k, to_camera)


def write_nerfpp(folder, pictures, *, splits=None, mask=False):
    """splits: numbers of pictures by the folder of their split."""
    for split, rows in (splits or {"train": range(7), "validation": range(7, 9), "test": range(9, 10)}).items():
        home = folder / split
        for index in rows:
            if index >= len(pictures.cameras):
                continue
            name, camera, k = pictures.names[index], pictures.cameras[index], np.eye(4)
            k[:3, :3] = intrinsic_matrix(camera)
            write_image(home / f"rgb/{name}.png", pictures.rgba[index])
            save_matrix(home / f"intrinsics/{name}.txt", k.reshape(1, 16))
            save_matrix(home / f"pose/{name}.txt", camera.camera_to_world.reshape(1, 16))
            if mask:
                write_image(home / f"mask/{name}.png", pictures.rgba[index, ..., 3])


def seen_by_nerfpp(folder, scene):
    for name in scene.names:
        (lens,), (pose,) = folder.glob(f"*/intrinsics/{name}.txt"), folder.glob(f"*/pose/{name}.txt")
        k, to_world = (np.loadtxt(file).reshape(4, 4) for file in (lens, pose))
        yield seen_with(k, np.linalg.inv(to_world))


def camera_rows(cameras, names):
    """cameras.json of 3D Gaussian Splatting, by its camera_to_JSON."""
    rows = zip(names, cameras, strict=True)
    return [
        {
            "id": index,
            "img_name": name,
            "width": camera.width,
            "height": camera.height,
            "position": camera.center.tolist(),
            "rotation": camera.rotation.tolist(),
            "fy": camera.fy,
            "fx": camera.fx,
        }
        for index, (name, camera) in enumerate(rows)
    ]


def write_output(folder, splats, cameras, names, source, *, iterations=(7000, 30000), **options):
    """An output folder of 3D Gaussian Splatting; the newest iteration holds `splats`, others half of them.
    options: words of cfg_args besides."""
    for number in iterations:
        path = folder / f"point_cloud/iteration_{number}/point_cloud.ply"
        path.parent.mkdir(parents=True, exist_ok=True)
        (splats if number == max(iterations) else splats.chosen(np.arange(0, len(splats), 2))).save(path)
    (folder / "cameras.json").write_text(json.dumps(camera_rows(cameras, names)))
    words = {"data_device": "cuda", "depths": "", "eval": True, "images": "images", "model_path": str(folder)}
    words |= {"resolution": -1, "sh_degree": 3, "source_path": str(source), "white_background": False, **options}
    (folder / "cfg_args").write_text(f"Namespace({', '.join(f'{name}={words[name]!r}' for name in sorted(words))})")
