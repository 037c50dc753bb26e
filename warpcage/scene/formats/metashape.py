"""Agisoft Metashape's cameras.xml (Export Cameras, Agisoft XML)."""
# Transforms go from a camera with OpenCV's axes to its chunk; that of its component, or else of the chunk, leads on to
# the world: a turn, a shift and a scale. Pixels count from the corner of the picture, cx and cy from its middle. The
# manual's appendix D has the lens: P1 and P2 are OpenCV's p2 and p1, B1 is fx - fy, B2 a skew.

from __future__ import annotations

import dataclasses
import pathlib
import xml.etree.ElementTree as ET
from typing import Any

import numpy as np

from ...core.checks import shown, warn_caller
from ...core.files import read_limited
from ...core.names import error_line
from ...errors import InputError, MissingFileError
from ..box import Bounds
from ..lenses import Lens, all_around
from ..parsing import PictureFinder, chosen_part, first_with, floats, picture_size
from ..pictures import listed_scene
from ..scene import Scene
from ..sizes import View

MARK = "cameras.xml of Metashape beside images/"

#: Bytes of memory that a byte of XML takes at most: an element "<a/>" becomes an object.
XML_ROOM = 64

#: Coefficients of a lens in the order of OpenCV's; and in the order of METASHAPE's, of which some have no other's.
DISTORTION = ("k1", "k2", "p2", "p1", "k3")
ALL = ("k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")

#: Kinds of sensors that are read: with a lens, and all around.
KINDS = ("frame", "fisheye", "equidistant_fisheye", "spherical")


def is_scene(folder: pathlib.Path) -> bool:
    """Whether a folder holds cameras of Metashape."""
    return _listing(folder) is not None


def _listing(folder: pathlib.Path) -> pathlib.Path | None:
    """cameras.xml, or the first other .xml file that begins as Metashape's do."""
    paths = sorted(folder.glob("*.xml"), key=lambda path: (path.name != "cameras.xml", path.name))
    return first_with(paths, 4096, b"<document", b"<chunk")


@dataclasses.dataclass
class _Chunk:
    """What cameras of a chunk share."""

    path: pathlib.Path
    sensors: dict[str | None, ET.Element]
    worlds: dict[str | None, np.ndarray | None]  # (4, 4) by component; that of None is the chunk's own
    cameras: list[ET.Element]  # those that found a place


def read(folder: pathlib.Path, *, split: str, model: str | None = None, **options: Any) -> Scene:
    """Read a split: every eighth picture, by name, is `test`, the others are `train`. Options as for `load_scene`;
    of several chunks the one with most cameras is read, or the one of a label."""
    path = _listing(folder)
    if path is None:
        raise MissingFileError(f"{str(folder)!r} holds no cameras of Metashape ({MARK})")
    Bounds(folder).require(path, str(folder))
    chunk = _chosen(path, model)
    finder = PictureFinder(folder, ("images", ""))
    views = [_view(finder, chunk, camera) for camera in chunk.cameras]
    return listed_scene(folder, views, split, path, finder, **options)


def _document(path: pathlib.Path) -> ET.Element:
    data = read_limited(path, "cameras of Metashape", XML_ROOM)
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise InputError(f"{path} defines entities, which cameras of Metashape have none of")
    try:
        return ET.fromstring(data)
    except (ET.ParseError, ValueError, LookupError, RecursionError) as error:  # LookupError: an encoding
        raise InputError(f"{path} is not an XML file: {error_line(error, 300)}") from error


def _chosen(path: pathlib.Path, model: str | None) -> _Chunk:
    """The chunk of a label, or the one with most cameras; it warns of others, and of cameras without a place."""
    chunks = {each.get("label", str(index)): each for index, each in enumerate(_document(path).iter("chunk"))}
    placed = {name: [each for each in _cameras(chunk) if _is_placed(each)] for name, chunk in chunks.items()}
    if not any(placed.values()):
        raise InputError(f"{path} holds no enabled cameras with a transform")
    most = chosen_part({name: len(cameras) for name, cameras in placed.items()}, model, path, "chunk")
    if not placed[most]:
        raise InputError(f"{path}: chunk {most!r} holds no enabled cameras with a transform")
    chunk, cameras = chunks[most], placed[most]
    worlds = {
        each.get("id"): _similarity(each, f"{path}: component {each.get('id')}") for each in chunk.iter("component")
    }
    found = _Chunk(
        path,
        {each.get("id"): each for each in chunk.iter("sensor")},
        {None: _similarity(chunk, f"{path}: chunk {most!r}"), **worlds},
        cameras,
    )
    _keep_one_world(found)
    total = len(_cameras(chunk))
    if len(found.cameras) < total:
        off = sum(not _is_enabled(each) for each in _cameras(chunk))
        warn_caller(
            f"{path}: {total - len(found.cameras)} of {total} cameras are left out: {off} disabled, the others without "
            "a place beside those that are read"
        )
    return found


def _cameras(chunk: ET.Element) -> list[ET.Element]:
    """All cameras of a chunk, those in groups too."""
    found = chunk.find("cameras")
    return [] if found is None else list(found.iter("camera"))


def _is_enabled(camera: ET.Element) -> bool:
    return camera.get("enabled", "true").lower() not in ("false", "0")


def _is_placed(camera: ET.Element) -> bool:
    return _is_enabled(camera) and camera.find("transform") is not None


def _similarity(owner: ET.Element, where: str) -> np.ndarray | None:
    """The transform (4, 4) of a chunk or a component: rotation times scale, translation; None where it has none."""
    given = owner.find("transform")
    if given is None:
        return None
    result = np.eye(4)
    values = {name: _values(given.find(name), count, f"{where}: {name}") for name, count in SIMILARITY.items()}
    if values["rotation"] is not None:
        result[:3, :3] = np.reshape(values["rotation"], (3, 3))
    if values["translation"] is not None:
        result[:3, 3] = values["translation"]
    scale = 1.0 if values["scale"] is None else values["scale"][0]
    if not scale > 0 or not np.allclose(result[:3, :3] @ result[:3, :3].T, np.eye(3), atol=1e-4):
        raise InputError(f"{where}: its transform must be a rotation with a scale above zero")
    result[:3, :3] *= scale
    return result


#: Parts of a transform, and how many numbers they have.
SIMILARITY = {"rotation": 9, "translation": 3, "scale": 1}


def _values(element: ET.Element | None, count: int, where: str) -> list[float] | None:
    """The numbers of an element; None where it is not there."""
    if element is None:
        return None
    values = floats(element.text or "", where)
    if len(values) != count:
        raise InputError(f"{where} must hold {count} numbers, got {len(values)}")
    return values


def _keep_one_world(chunk: _Chunk) -> None:
    """Leave out the cameras of components that nothing connects with the largest one."""
    counts: dict[str | None, int] = {}
    for camera in chunk.cameras:
        counts[camera.get("component_id")] = counts.get(camera.get("component_id"), 0) + 1
    if len(counts) > 1 and any(chunk.worlds.get(name) is None for name in counts):
        most = max(counts, key=counts.__getitem__)
        chunk.cameras = [camera for camera in chunk.cameras if camera.get("component_id") == most]


def _view(finder: PictureFinder, chunk: _Chunk, camera: ET.Element) -> View:
    """One picture with its camera."""
    label = camera.get("label", "")
    where = f"{chunk.path}: camera {shown(label)}"
    values = _values(camera.find("transform"), 16, f"{where}: transform")
    assert values is not None
    pose = np.reshape(values, (4, 4))
    world = chunk.worlds.get(camera.get("component_id"))
    world = chunk.worlds[None] if world is None else world
    if world is not None:
        pose = world @ pose
        pose[:3, :3] /= np.cbrt(np.linalg.det(world[:3, :3]))
    sensor = chunk.sensors.get(camera.get("sensor_id"))
    if sensor is None:
        raise InputError(f"{where} has sensor {shown(camera.get('sensor_id'))}, which the file lacks")
    lens = _lens(sensor, f"{chunk.path}: sensor {shown(sensor.get('id'))}")
    return View(finder.find(label, where), pose, where, **lens)


def _lens(sensor: ET.Element, where: str) -> dict[str, Any]:
    """What a View takes of the lens of a sensor, as it was adjusted where that is there."""
    calibrations = sorted(sensor.findall("calibration"), key=lambda each: each.get("class") != "adjusted")
    kind = sensor.get("type", "frame")
    if kind not in KINDS:
        raise InputError(f"{where}: its type {shown(kind)} is not read, only {', '.join(KINDS)}")
    if not calibrations and kind != "spherical":
        raise InputError(f"{where} has no calibration")
    given = calibrations[0] if calibrations else sensor
    resolution = given.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    if resolution is None:
        raise InputError(f"{where} has no resolution")
    sides = floats(f"{resolution.get('width')} {resolution.get('height')}", f"{where}: resolution")
    if len(sides) != 2:
        raise InputError(f"{where}: resolution must have a width and a height, got {len(sides)} numbers")
    width, height = sides
    size = picture_size(width, height, where)
    if kind == "spherical":
        return {"intrinsics": all_around, "size": size, "lens": Lens("EQUIRECTANGULAR")}

    def value(name: str) -> float:
        found = _values(given.find(name), 1, f"{where}: {name}")
        return 0.0 if found is None else found[0]

    fx, fy = value("f") + value("b1"), value("f")
    if not min(fx, fy) > 0:
        raise InputError(f"{where}: f, and f with b1, must be positive, got {fy:g} and {fx:g}")
    whole = {"intrinsics": (fx, fy, width / 2 + value("cx"), height / 2 + value("cy")), "size": size}
    if kind == "frame" and not any(map(value, ("k4", "p3", "p4", "b2"))):
        return whole | {"distortion": tuple(map(value, DISTORTION))}
    return whole | {"lens": Lens("METASHAPE", (float(kind != "frame"), value("b2") / fx, *map(value, ALL)))}
