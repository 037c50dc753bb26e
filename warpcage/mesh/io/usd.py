"""USD (.usd, .usda, .usdc) through usd-core: the polygons of all meshes of a stage, still and moving."""

from __future__ import annotations

import importlib
import pathlib
import tempfile
from typing import Any

import numpy as np

from ...core.memory import require_host_memory
from ...core.names import counted
from ...errors import InputError, MissingPackageError
from .gltf import linear_light, middle_of
from .gltf_animation import MAX_FRAMES, GltfMotion
from .obj_off import Polygons

#: How files of USD end: either kind, text, binary.
USD_ENDINGS = (".usd", ".usda", ".usdc")

#: Most corners of all faces of a stage.
MAX_CORNERS = 30_000_000


def _library() -> Any:
    """The package of usd-core."""
    try:
        for part in ("Gf", "Sdf", "Tf", "Usd", "UsdGeom", "UsdSkel", "Vt"):
            importlib.import_module(f"pxr.{part}")
        return importlib.import_module("pxr")
    except ImportError as error:
        raise MissingPackageError('USD needs its library: pip install "warpcage[usd]"') from error


# -- Reading


class _Stage:
    """The meshes of a stage, those of one name, or with "" all."""

    def __init__(self, path: pathlib.Path, name: str = ""):
        pxr = _library()
        self.path, self.geometry = path, pxr.UsdGeom
        try:
            self.stage = pxr.Usd.Stage.Open(str(path))
        except pxr.Tf.ErrorException as error:
            line = " ".join(str(error).split())[-160:]
            raise InputError(f"{path}: not a USD file that can be read: {line}") from None
        # skins and shapes become places of points, in a layer that is not written
        with pxr.Usd.EditContext(self.stage, self.stage.GetSessionLayer()):
            pxr.UsdSkel.BakeSkinning(self.stage.Traverse())
        found = self.stage.Traverse(pxr.Usd.TraverseInstanceProxies())
        self.meshes = [pxr.UsdGeom.Mesh(prim) for prim in found if prim.IsA(pxr.UsdGeom.Mesh)]
        if name:
            self.meshes = [mesh for mesh in self.meshes if self.name_of(mesh) == name]
        self.turned = pxr.UsdGeom.GetStageUpAxis(self.stage) == pxr.UsdGeom.Tokens.y

    def name_of(self, mesh: Any) -> str:
        """What a mesh is called: Blender gives the object's name to the transform above it."""
        prim = mesh.GetPrim()
        above = prim.GetParent()
        of_object = above.IsA(self.geometry.Xform) and above != self.stage.GetDefaultPrim()
        return (above if of_object else prim).GetName()

    def times(self) -> list[float]:
        """Times, in the stage's own count, at which something is said of where points are."""
        found: set[float] = set()
        for mesh in self.meshes:
            found.update(mesh.GetPointsAttr().GetTimeSamples())
            prim = mesh.GetPrim()
            while prim and not prim.IsPseudoRoot():
                if prim.IsA(self.geometry.Xformable):
                    found.update(self.geometry.Xformable(prim).GetTimeSamples())
                prim = prim.GetParent()
        return sorted(found)

    def matrices(self, time: Any) -> list[np.ndarray]:
        """(4, 4) of each mesh, for rows of points, to the stage's world."""
        cache = self.geometry.XformCache(time)
        return [np.array(cache.GetLocalToWorldTransform(mesh.GetPrim())) for mesh in self.meshes]

    def vertices(self, time: Any) -> np.ndarray:
        """(v, 3) float64, z up."""
        parts = [np.zeros((0, 3))]
        for mesh, matrix in zip(self.meshes, self.matrices(time), strict=True):
            points = np.array(mesh.GetPointsAttr().Get(time) or (), np.float64).reshape(-1, 3)
            if not (np.isfinite(points).all() and np.isfinite(matrix).all()):
                raise InputError(f"{self.path}: it holds places that are not finite")
            parts.append(points @ matrix[:3, :3] + matrix[3, :3])
        joined = np.concatenate(parts)
        return joined @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]) if self.turned else joined

    def first(self) -> Any:
        """The time of what stands still: what is said without one, else the first."""
        pxr = _library()
        without = all(mesh.GetPointsAttr().Get() is not None for mesh in self.meshes)
        times = self.times()
        return pxr.Usd.TimeCode.Default() if without or not times else pxr.Usd.TimeCode(times[0])

    def polygons(self) -> Polygons:
        """Faces with numbers of vertices, all looking outward as the stage means them."""
        found: Polygons = []
        start, time = 0, self.first()
        for mesh, matrix in zip(self.meshes, self.matrices(time), strict=True):
            counts = np.array(mesh.GetFaceVertexCountsAttr().Get(time) or (), np.int64)
            corners = np.array(mesh.GetFaceVertexIndicesAttr().Get(time) or (), np.int64)
            if (counts < 0).any() or counts.sum() != len(corners) or len(corners) > MAX_CORNERS:
                raise InputError(
                    f"{self.path}: mesh {self.name_of(mesh)!r} has {counted(len(corners), 'corner')} for "
                    f"{counted(len(counts), 'face')} of {counts.sum()}"
                )
            left = mesh.GetOrientationAttr().Get(time) == self.geometry.Tokens.leftHanded
            mirrored = left != (np.linalg.det(matrix[:3, :3]) < 0.0)
            points = len(mesh.GetPointsAttr().Get(time) or ())
            if len(corners) and not 0 <= corners.min() <= corners.max() < points:
                raise InputError(
                    f"{self.path}: corners {corners.min()} to {corners.max()} of a mesh of {points} points"
                )
            for index, face in enumerate(np.split(corners + start, np.cumsum(counts)[:-1]) if len(counts) else ()):
                found.append((f"face {index}", (face[::-1] if mirrored else face).tolist()))
            start += points
        return found


def usd_object_names(path: pathlib.Path) -> list[str]:
    """The names of the objects with meshes of a USD file, in the order of `read_usd`."""
    stage = _Stage(path)
    return list(dict.fromkeys(map(stage.name_of, stage.meshes)))


def read_usd(path: pathlib.Path, name: str = "") -> tuple[np.ndarray, Polygons]:
    """Vertices (v, 3) float64, z up whatever the file has, and polygons of a file, or of objects of one name."""
    stage = _Stage(path, name)
    return stage.vertices(stage.first()), stage.polygons()


def read_usd_motion(path: pathlib.Path, name: str = "", object: str = "") -> GltfMotion | None:
    """How the vertices of a USD file move, z up, in the order of `read_usd`; None where nothing does.
    name: there are no animations to choose from, so "" alone; object: as `read_usd` takes a name."""
    stage = _Stage(path, object)
    if name:
        raise InputError(f"{path}: there is no animation or shape {name!r}: a USD file has one motion, without a name")
    codes = stage.times()
    if len(codes) < 2:
        return None
    fps = float(stage.stage.GetTimeCodesPerSecond())
    if all(code == round(code) for code in codes):  # a frame each, those too at which nothing is said
        codes = [
            float(code) for code in range(round(codes[0]), min(round(codes[-1]), round(codes[0]) + MAX_FRAMES) + 1)
        ]
    if len(codes) > MAX_FRAMES:
        raise InputError(f"{path}: its motion has more frames than the {MAX_FRAMES} that are read")
    count = len(stage.vertices(codes[0]))
    require_host_memory(24 * count * len(codes), f"its {len(codes)} frames of {count} vertices need")
    frames = [stage.vertices(code) for code in codes]
    if any(len(frame) != count for frame in frames):
        raise InputError(f"{path}: the number of its points changes from frame to frame")
    names = tuple(f"frame {index + 1}" for index in range(len(codes)))
    return GltfMotion(names, frames, tuple((code - codes[0]) / fps for code in codes), fps)


# -- Writing


def write_usd(
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    ending: str = ".usdc",
    colors: np.ndarray | None = None,
    frames: np.ndarray | None = None,
    fps: float = 24.0,
    name: str = "cage",
) -> bytes:
    """A USD file of one mesh, vertices (v, 3) with z up, a unit a metre; colors (v, 3) in [0, 1], sRGB.
    frames: (n, v, 3), time samples from 0 on, fps a second; the vertices are what is said without a time."""
    pxr = _library()
    middle = middle_of(vertices)  # points are float32, and keep their digits around it
    stage = pxr.Usd.Stage.CreateInMemory()
    pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.z)
    pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    mesh = pxr.UsdGeom.Mesh.Define(stage, f"/{pxr.Tf.MakeValidIdentifier(name)}")
    stage.SetDefaultPrim(mesh.GetPrim())
    if middle.any():
        mesh.AddTranslateOp(pxr.UsdGeom.XformOp.PrecisionDouble).Set(pxr.Gf.Vec3d(*middle.tolist()))
    mesh.CreateSubdivisionSchemeAttr(pxr.UsdGeom.Tokens.none)  # else it is smoothed
    mesh.CreateDoubleSidedAttr(True)
    mesh.CreateFaceVertexCountsAttr(pxr.Vt.IntArray(len(faces), 3))
    mesh.CreateFaceVertexIndicesAttr(pxr.Vt.IntArray.FromNumpy(np.ascontiguousarray(faces, np.int32).reshape(-1)))
    times = [pxr.Usd.TimeCode.Default(), *map(pxr.Usd.TimeCode, range(0 if frames is None else len(frames)))]
    for time, places in zip(times, [vertices, *(() if frames is None else frames)], strict=True):
        points = pxr.Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(places - middle, np.float32))
        mesh.GetPointsAttr().Set(points, time)
        mesh.GetExtentAttr().Set(pxr.UsdGeom.PointBased.ComputeExtent(points), time)
    if colors is not None:
        shown = mesh.CreateDisplayColorPrimvar(pxr.UsdGeom.Tokens.vertex)
        shown.Set(pxr.Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(linear_light(colors), np.float32)))
    if frames is not None:
        stage.SetTimeCodesPerSecond(fps)
        stage.SetFramesPerSecond(fps)
        stage.SetStartTimeCode(0.0)
        stage.SetEndTimeCode(len(frames) - 1.0)
    with tempfile.TemporaryDirectory(prefix="warpcage-") as folder:
        path = pathlib.Path(folder, f"stage{ending}")
        stage.GetRootLayer().Export(str(path))
        return path.read_bytes()


def write_usda(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    """The same as text."""
    return write_usd(vertices, faces, ending=".usda")
