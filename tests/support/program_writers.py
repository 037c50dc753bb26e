"""Writers of scenes as LLFF, Bundler, OpenSfM and Metashape make them, for pictures and cameras of ours."""

import json

import numpy as np
from scene_writers import OPENGL, write_image
from scipy.spatial.transform import Rotation

SQUARE = np.random.default_rng(3).uniform(-0.6, 0.6, (30, 3))  # points of a reconstruction
SHADES = np.random.default_rng(4).integers(0, 256, (30, 3))


def write_pictures(folder, pictures, names=None):
    for name, rgba in zip(names or [f"{name}.png" for name in pictures.names], pictures.rgba, strict=True):
        write_image(folder / name, rgba)


def shrunk(rgba, factor):
    """(h, w, 4) uint8 by averages of opaque pixels."""
    height, width, channels = rgba.shape
    blocks = rgba.reshape(height // factor, factor, width // factor, factor, channels)
    return np.round(blocks.mean(axis=(1, 3))).astype(np.uint8)


def write_llff(folder, pictures, factors=(1,), *, rows=None):
    """factors: of images/ (1) and images_<factor>/; rows: how many poses, None for all."""
    folder.mkdir(parents=True, exist_ok=True)
    table = []
    for camera in pictures.cameras:
        right, down, forward, place = camera.camera_to_world[:3].T
        size = (camera.height, camera.width, camera.fx)
        table.append([*np.stack([down, right, -forward, place, size], axis=1).ravel(), 1.5, 9.0])
    for factor in factors:
        for name, rgba in zip(pictures.names, pictures.rgba, strict=True):
            images = "images" if factor == 1 else f"images_{factor}"
            write_image(folder / images / f"{name}.png", shrunk(rgba, factor))
    np.save(folder / "poses_bounds.npy", np.array(table)[:rows])


def write_bundler(folder, pictures, *, distortion=(0.0, 0.0), lost=(), listing="list.txt", home="images/"):
    """lost: numbers of pictures without a camera; they are in the list all the same."""
    write_pictures(folder / home, pictures)
    lines = ["# Bundle file v0.3", f"{len(pictures.cameras)} {len(SQUARE)}"]
    for index, camera in enumerate(pictures.cameras):
        to_camera = OPENGL @ np.linalg.inv(camera.camera_to_world)
        rows = [[camera.fx, *distortion], *to_camera[:3, :3], to_camera[:3, 3]]
        lines += [" ".join(repr(float(value) * (index not in lost)) for value in row) for row in rows]
    for point, color in zip(SQUARE, SHADES, strict=True):
        lines += [" ".join(map(repr, point.tolist())), " ".join(map(str, color)), "2 0 7 1.5 -2.5 1 3 0.5 4.5"]
    place = folder / "bundle" / "bundle.out"
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_text("\n".join(lines) + "\n")
    if listing:
        rows = zip(pictures.names, pictures.cameras, strict=True)
        names = [f"{home}{name}.png 0 {camera.fx}" for name, camera in rows]
        (folder / listing).write_text("\n".join(names) + "\n")


def write_realityscan(folder, pictures, *, lens=(0.0,) * 6, name="cameras.csv", home="images"):
    """lens: k1 to k4, t1 and t2."""
    write_pictures(folder / home, pictures)
    lines = ["#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
    for picture, camera in zip(pictures.names, pictures.cameras, strict=True):
        longer = max(camera.width, camera.height)
        z, x, y = Rotation.from_matrix(camera.rotation @ OPENGL[:3, :3]).as_euler("ZXY", degrees=True)
        middle = (camera.cx - camera.width / 2) / longer, (camera.cy - camera.height / 2) / longer
        values = [*camera.center, -z, x, y, camera.fx * 36 / longer, *middle, *lens]
        lines.append(",".join([f"{picture}.png", *(repr(float(value)) for value in values)]))
    (folder / name).write_text("\n".join(lines) + "\n")


def opensfm_reconstruction(pictures, kind="brown", **coefficients):
    """The content of a reconstruction with a camera for each picture."""
    cameras, shots = {}, {}
    for name, camera in zip(pictures.names, pictures.cameras, strict=True):
        longer = max(camera.width, camera.height)
        given = {"projection_type": kind, "width": camera.width, "height": camera.height, **coefficients}
        if kind in ("perspective", "fisheye", "dual"):
            given["focal"] = camera.fx / longer
        elif kind not in ("spherical", "equirectangular"):
            given |= {"focal_x": camera.fx / longer, "focal_y": camera.fy / longer}
            given |= {"c_x": (camera.cx - camera.width / 2) / longer, "c_y": (camera.cy - camera.height / 2) / longer}
        cameras[f"v2 phone {name}"] = given
        to_camera = np.linalg.inv(camera.camera_to_world)
        turn = Rotation.from_matrix(to_camera[:3, :3]).as_rotvec()
        shots[f"{name}.png"] = {
            "rotation": turn.tolist(), "translation": to_camera[:3, 3].tolist(), "camera": f"v2 phone {name}",
            "orientation": 1, "gps_dop": 15.0,
        }  # fmt: skip
    rows = enumerate(zip(SQUARE.tolist(), SHADES.tolist(), strict=True))
    points = {str(index): {"coordinates": point, "color": color} for index, (point, color) in rows}
    return {"cameras": cameras, "shots": shots, "points": points, "reference_lla": {"latitude": 0.0}}


def write_opensfm(folder, pictures, *, place="", others=(), **options):
    """others: reconstructions beside the one of the pictures, which comes last."""
    write_pictures(folder / "images", pictures)
    (folder / place).mkdir(parents=True, exist_ok=True)
    content = [*others, opensfm_reconstruction(pictures, **options)]
    (folder / place / "reconstruction.json").write_text(json.dumps(content))


HERE = np.eye(4)


def transform_words(matrix, scale):
    """A similarity as Metashape has it in XML."""
    rotation, place = (" ".join(map(repr, part.ravel().tolist())) for part in (matrix[:3, :3], matrix[:3, 3]))
    return (
        f'<transform><rotation locked="true">{rotation}</rotation><translation locked="true">{place}</translation>'
        f'<scale locked="true">{scale!r}</scale></transform>'
    )


def metashape_chunk(
    pictures, *, lens=None, world=HERE, scale=1.0, owner="component", disabled=(), lost=(), label="Chunk 1",
    ending="", sensor="frame", home=""
):  # fmt: skip
    """A chunk whose cameras lie where `world`, after a scale, takes them from; owner of it: "component" or "chunk"."""
    sensors, cameras = [], []
    similarity = world @ np.diag([scale, scale, scale, 1.0])
    for index, (name, camera) in enumerate(zip(pictures.names, pictures.cameras, strict=True)):
        size = f'<resolution width="{camera.width}" height="{camera.height}"/>'
        values = {"f": camera.fy, "cx": camera.cx - camera.width / 2, "cy": camera.cy - camera.height / 2}
        values |= {"b1": camera.fx - camera.fy, **(lens or {})}
        words = "".join(f"<{key}>{value!r}</{key}>" for key, value in values.items())
        wrong = f'<calibration type="frame" class="initial">{size}<f>3.0</f></calibration>'
        right = f'<calibration type="{sensor}" class="adjusted">{size}{words}</calibration>'
        sensors.append(f'<sensor id="{index}" label="phone" type="{sensor}">{size}{wrong}{right}</sensor>')
        pose = np.linalg.inv(similarity) @ camera.camera_to_world
        pose[:3, :3] *= scale
        matrix = "" if index in lost else f"<transform>{' '.join(map(repr, pose.ravel().tolist()))}</transform>"
        states = f'enabled="{"false" if index in disabled else "true"}"'
        component = 'component_id="0"' if owner == "component" and index not in lost else ""
        cameras.append(
            f'<camera id="{index}" sensor_id="{index}" {component} label="{home}{name}{ending}" {states}>'
            f"{matrix}<orientation>1</orientation></camera>"
        )
    placed = transform_words(world, float(scale))
    whole = f'<components><component id="0" label="Component 1">{placed}</component></components>'
    grouped = f'<group id="0" label="Group 1" type="folder">{"".join(cameras[:2])}</group>{"".join(cameras[2:])}'
    return (
        f'<chunk label="{label}" enabled="true"><sensors next_id="9">{"".join(sensors)}</sensors>'
        f"{whole if owner == 'component' else ''}<cameras next_id='99' next_group_id='1'>{grouped}</cameras>"
        f"<reference>LOCAL_CS</reference>{placed if owner == 'chunk' else ''}</chunk>"
    )


def write_metashape(folder, pictures, *, others=(), name="cameras.xml", **options):
    write_pictures(folder / "images", pictures)
    chunks = "".join([*others, metashape_chunk(pictures, **options)])
    head = '<?xml version="1.0" encoding="UTF-8"?>\n'
    (folder / name).write_text(f'{head}<document version="2.0.0">{chunks}</document>\n')
