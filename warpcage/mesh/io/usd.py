"""USD (.usd, .usda, .usdc) through usd-core: the polygons of all meshes of a stage, still and moving."""

from __future__ import annotations

import math
import pathlib
import tempfile
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...core.checks import listed, warn_caller
from ...core.memory import require_host_memory
from ...core.names import counted
from ...errors import InputError
from .gltf import linear_light, middle_of
from .gltf_animation import ON_FRAME, OWN_RATES, GltfMotion, at_keys, frames_of
from .obj_off import FacesToWrite, Polygons, listed_faces
from .usd_stage import attribute_times, errors_of_stage, opened_stage, placers_of, step_matrix, usd_library

#: How files of USD end: either kind, text, binary.
USD_ENDINGS = (".usd", ".usda", ".usdc")

#: Most corners of all faces of a stage.
MAX_CORNERS = 30_000_000


# -- Reading


class _Body:
    """A mesh of a stage with what moves its points: the shapes that it has, the skeleton that it follows."""

    def __init__(self, mesh: Any, skinning: Any = None, skeleton: Any = None, bones: Any = None):
        pxr = usd_library()
        self.mesh, self.skinning, self.skeleton = mesh, skinning, skeleton
        animation = skeleton.GetAnimQuery() if skeleton else None
        self.animation = animation if animation and animation.GetPrim() else None
        self.follows = bool(skinning and skinning.HasJointInfluences())
        self.place = bones.GetPrim() if self.follows else mesh.GetPrim()  # in whose place the points lie
        self.shape_names: list[str] = []
        if skinning and skinning.HasBlendShapes():
            self.shape_names = list(skinning.GetBlendShapeOrder() or ())
            self.shapes = pxr.UsdSkel.BlendShapeQuery(pxr.UsdSkel.BindingAPI(mesh.GetPrim()))
            self.offsets = (self.shapes.ComputeBlendShapePointIndices(), self.shapes.ComputeSubShapePointOffsets())
        # keys of joints and of the weights of shapes: more than one is a film, at whose rest they do not count
        self.joint_keys = self.animation.GetJointTransformTimeSamples() if self.follows and self.animation else []
        self.shape_keys = self.animation.GetBlendShapeWeightTimeSamples() if self.shape_names and self.animation else []

    def weights(self, time: Any) -> list[float]:
        """Of its shapes at a time; none where the file has none."""
        if not self.shape_names or self.animation is None:
            return []
        held = self.animation.ComputeBlendShapeWeights(time)
        return list(self.skinning.GetBlendShapeMapper().Remap(held)) if len(held) else []

    def shape(self, points: Any, weights: Sequence[float]) -> bool:
        """Move points, in place, by its shapes; False where those do not fit it."""
        if not any(weights):
            return True
        if len(weights) != self.shapes.GetNumBlendShapes():
            return False
        chosen = self.shapes.ComputeSubShapeWeights(usd_library().Vt.FloatArray(weights))
        return self.shapes.ComputeDeformedPoints(*chosen, *self.offsets, points)


class _Stage:
    """The meshes of a stage, those of one name, or with "" all. Times are its own codes; None is what stands still."""

    # All is found at each time anew. A film that UsdSkel bakes into the stage is straight between its keys, and in a
    # layer of another rate (24 where nothing says another), by which USD rescales its times.
    def __init__(self, path: pathlib.Path, name: str = ""):
        pxr = usd_library()
        self.path, self.geometry = path, pxr.UsdGeom
        self.stage = opened_stage(path)
        self.turned = pxr.UsdGeom.GetStageUpAxis(self.stage) == pxr.UsdGeom.Tokens.y
        self.steps: dict[Any, tuple[list[Any], bool]] = {}
        self.still: dict[Any, np.ndarray] = {}
        with errors_of_stage(path):
            bodies = self._bodies()
            self.bodies = [body for body in bodies if not name or self.name_of(body.mesh) == name]
            self.keys = self._keys()
        self.begin = pxr.Usd.TimeCode(self.keys[0]) if self.keys else pxr.Usd.TimeCode.Default()

    def _bodies(self) -> list[_Body]:
        """All meshes, those of instances too."""
        pxr = usd_library()
        everywhere, cache = pxr.Usd.TraverseInstanceProxies(), pxr.UsdSkel.Cache()
        found = list(pxr.Usd.PrimRange.Stage(self.stage, everywhere))
        bound: dict[Any, tuple[Any, Any, Any]] = {}
        for root in (pxr.UsdSkel.Root(prim) for prim in found if prim.IsA(pxr.UsdSkel.Root)):
            cache.Populate(root, everywhere)
            for binding in cache.ComputeSkelBindings(root, everywhere):
                bones = binding.GetSkeleton()  # of an instance: its skeleton's query knows the prototype alone
                skeleton = cache.GetSkelQuery(bones)
                bound |= {skin.GetPrim().GetPath(): (skin, skeleton, bones) for skin in binding.GetSkinningTargets()}
        placers = [prim for prim in found if prim.IsA(pxr.UsdGeom.PointInstancer)]
        if placers:
            names = listed([prim.GetName() for prim in placers], 4)
            warn_caller(
                f"{self.path}: what its point instancers place is not read ({names}): make it meshes of its own"
            )
        inside = [prim.GetPath() for prim in placers]
        meshes = [
            pxr.UsdGeom.Mesh(prim)
            for prim in found
            if prim.IsA(pxr.UsdGeom.Mesh) and not any(map(prim.GetPath().HasPrefix, inside))
        ]
        return [_Body(mesh, *bound.get(mesh.GetPath(), ())) for mesh in meshes]

    def name_of(self, mesh: Any) -> str:
        """What a mesh is called: Blender gives the object's name to the transform above it."""
        prim = mesh.GetPrim()
        above = prim.GetParent()
        of_object = above.IsA(self.geometry.Xform)
        if above.IsA(usd_library().UsdSkel.Root):  # that of one mesh with shapes
            of_object = sum(child.IsA(self.geometry.Mesh) for child in above.GetChildren()) == 1
        return (above if of_object and above != self.stage.GetDefaultPrim() else prim).GetName()

    def _keys(self) -> list[float]:
        """Times at which something is said of where points are."""
        found: set[float] = set()
        for body in self.bodies:
            found |= {*body.joint_keys, *body.shape_keys, *attribute_times(body.mesh.GetPointsAttr())}
            for above in placers_of(body.place):
                found.update(*(attribute_times(each.GetAttr()) for each in above.GetOrderedXformOps()))
        if not all(map(math.isfinite, found)):
            raise InputError(f"{self.path}: it has a time that is not finite")
        return sorted(found)

    def matrix(self, prim: Any, time: Any) -> np.ndarray:
        """(4, 4) float64 from a prim to the stage's world, for rows of points."""
        matrix = np.eye(4)
        for above in placers_of(prim):
            path = above.GetPath()
            if path not in self.steps:
                steps = list(reversed(above.GetOrderedXformOps()))
                self.steps[path] = steps, any(attribute_times(step.GetAttr()) for step in steps)
            steps, moves = self.steps[path]
            if not moves and path not in self.still:
                self.still[path] = self._matrix_of(steps, None)
            matrix = matrix @ (self._matrix_of(steps, time) if moves else self.still[path])
        return matrix

    def _matrix_of(self, steps: list[Any], time: Any) -> np.ndarray:
        """(4, 4) of the steps of a transform, the last of the file first."""
        matrix = np.eye(4)
        for step in steps:
            when = time
            if time is None:
                when = usd_library().Usd.TimeCode.Default() if step.Get() is not None else self.begin
            matrix = matrix @ step_matrix(step, when)
        return matrix

    def value(self, attribute: Any, time: Any) -> Any:
        """What an attribute says; of what stands still that which is said without a time, or else at first."""
        if time is not None:
            return attribute.Get(time)
        held = attribute.Get()
        return attribute.Get(self.begin) if held is None else held

    def points(self, body: _Body, time: Any, shapes: Mapping[str, float] | None = None) -> np.ndarray:
        """(v, 3) float64 of a mesh in the stage's world; shapes: weights by name in place of the file's."""
        pxr = usd_library()
        points = pxr.Vt.Vec3fArray(self.value(body.mesh.GetPointsAttr(), time) or ())
        when = self.begin if time is None else pxr.Usd.TimeCode(time)
        if shapes is not None:
            weights = [shapes.get(name, 0.0) for name in body.shape_names]
        else:
            weights = body.weights(when) if time is not None or len(body.shape_keys) < 2 else []
        if not body.shape(points, weights):
            raise InputError(f"{self.path}: mesh {self.name_of(body.mesh)!r} and its shapes do not fit each other")
        matrix = self.placed(body, time)
        if body.follows and (time is not None or len(body.joint_keys) < 2):
            joints = body.skeleton.ComputeSkinningTransforms(when)
            if not len(joints) or not body.skinning.ComputeSkinnedPoints(joints, points, when):
                raise InputError(
                    f"{self.path}: mesh {self.name_of(body.mesh)!r} and its skeleton do not fit each other"
                )
            matrix = self.matrix(body.place, time)
        found = np.array(points, np.float64).reshape(-1, 3)
        if not (np.isfinite(found).all() and np.isfinite(matrix).all()):
            raise InputError(f"{self.path}: it holds places that are not finite")
        return found @ matrix[:3, :3] + matrix[3, :3]

    def placed(self, body: _Body, time: Any) -> np.ndarray:
        """(4, 4) of the points of a mesh, for rows, where its skeleton is bound."""
        matrix = self.matrix(body.place, time)
        return np.array(body.skinning.GetGeomBindTransform()) @ matrix if body.follows else matrix

    def vertices(self, time: Any = None, shapes: Mapping[str, float] | None = None) -> np.ndarray:
        """(v, 3) float64, z up."""
        with errors_of_stage(self.path):
            joined = np.concatenate([np.zeros((0, 3)), *(self.points(body, time, shapes) for body in self.bodies)])
        return joined @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]) if self.turned else joined

    def polygons(self) -> Polygons:
        """Faces with numbers of vertices, all looking outward as the stage means them."""
        found: Polygons = []
        start = 0
        for body in self.bodies:
            mesh = body.mesh
            counts, corners = (
                np.array(self.value(each, None) or (), np.int64)
                for each in (mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr())
            )
            if (counts < 0).any() or counts.sum() != len(corners) or len(corners) > MAX_CORNERS:
                raise InputError(
                    f"{self.path}: mesh {self.name_of(mesh)!r} has {counted(len(corners), 'corner')} for "
                    f"{counted(len(counts), 'face')} of {counts.sum()}"
                )
            left = self.value(mesh.GetOrientationAttr(), None) == self.geometry.Tokens.leftHanded
            mirrored = left != (np.linalg.det(self.placed(body, None)[:3, :3]) < 0.0)
            points = len(self.value(mesh.GetPointsAttr(), None) or ())
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
    return list(dict.fromkeys(stage.name_of(body.mesh) for body in stage.bodies))


def read_usd(path: pathlib.Path, name: str = "") -> tuple[np.ndarray, Polygons]:
    """Vertices (v, 3) float64, z up whatever the file has, and polygons of a file, or of objects of one name."""
    stage = _Stage(path, name)
    lost = [body for body in stage.bodies if body.shape_names and body.animation and not body.weights(stage.begin)]
    if lost:  # Blender writes them with "Animation" among its options alone
        names = listed(lost[0].shape_names, 4)
        warn_caller(f"{path}: its shapes have no values ({names}): they are off, and as poses each is at 1")
    return stage.vertices(), stage.polygons()


def read_usd_motion(path: pathlib.Path, name: str = "", object: str = "") -> GltfMotion | None:
    """How the vertices of a USD file move, z up, in the order of `read_usd`; None where nothing does. Where no shape
    has a weight either, each shape is a pose. name: of a shape, "" is the film; object: as `read_usd` takes a name."""
    stage = _Stage(path, object)
    shapes = tuple(dict.fromkeys(shape for body in stage.bodies for shape in body.shape_names))
    if name and name not in shapes:
        held = f"only the shapes {listed(shapes)}" if shapes else "a USD file has one motion, without a name"
        raise InputError(f"{path}: there is no animation or shape key {name!r}: {held}")
    if name:
        return GltfMotion((name,), [stage.vertices(shapes={name: 1.0})])
    if len(stage.keys) > 1:
        return _film(stage)
    if not shapes or any(body.weights(stage.begin) for body in stage.bodies):
        return None
    return GltfMotion(shapes, [stage.vertices(shapes={shape: 1.0}) for shape in shapes])


def _film(stage: _Stage) -> GltfMotion:
    """The frames of a stage, at its own rate where its keys are on those frames."""
    path, a_second, begin = stage.path, float(stage.stage.GetTimeCodesPerSecond()), stage.keys[0]
    said = [float(stage.stage.GetFramesPerSecond())] if stage.stage.HasAuthoredMetadata("framesPerSecond") else []
    rates = [a_second] if a_second in said or OWN_RATES[0] <= a_second <= OWN_RATES[1] else []
    if not 0.0 < a_second < math.inf:
        raise InputError(f"{path}: {a_second:g} time codes a second")
    keys = (np.array(stage.keys) - begin) / a_second
    with errors_of_stage(path):
        times, fps = frames_of(keys, [rate for rate in [*rates, *said] if 0.0 < rate < math.inf])
    count = len(stage.vertices())
    require_host_memory(24 * count * len(times), f"its {len(times)} frames of {count} vertices need")
    codes = at_keys(begin + np.array(times) * a_second, np.array(stage.keys), ON_FRAME * a_second / fps)
    frames = [stage.vertices(code) for code in codes.tolist()]
    if any(len(frame) != count for frame in frames):
        raise InputError(f"{path}: the number of its points changes from frame to frame")
    return GltfMotion(tuple(f"frame {index + 1}" for index in range(len(codes))), frames, tuple(times), fps)


# -- Writing


def write_usd(
    vertices: np.ndarray,
    faces: FacesToWrite,
    *,
    ending: str = ".usdc",
    colors: np.ndarray | None = None,
    frames: np.ndarray | None = None,
    fps: float = 24.0,
    name: str = "cage",
) -> bytes:
    """A USD file of one mesh, vertices (v, 3) with z up, a unit a metre; colors (v, 3) in [0, 1], sRGB.
    frames: (n, v, 3), time samples from 0 on, fps a second; the vertices are what is said without a time."""
    pxr = usd_library()
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
    corners, sizes = _corners(faces)
    mesh.CreateFaceVertexCountsAttr(pxr.Vt.IntArray.FromNumpy(sizes))
    mesh.CreateFaceVertexIndicesAttr(pxr.Vt.IntArray.FromNumpy(corners))
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


def _corners(faces: FacesToWrite) -> tuple[np.ndarray, np.ndarray]:
    """The corners (c,) int32 of all faces, and how many each has, (f,) int32."""
    sizes = np.array([len(face) for face in faces], np.int32)
    return np.fromiter((corner for face in listed_faces(faces) for corner in face), np.int32), sizes


def write_usda(vertices: np.ndarray, faces: FacesToWrite) -> bytes:
    """The same as text."""
    return write_usd(vertices, faces, ending=".usda")
