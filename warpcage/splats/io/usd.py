"""USD (.usd, .usda, .usdc, .usdz) through usd-core: the splats of all ParticleField3DGaussianSplat of a stage."""

from __future__ import annotations

import dataclasses
import pathlib
import tempfile
from collections.abc import Iterator
from typing import Any

import numpy as np

from ...core.checks import shown, warn_caller
from ...core.memory import require_host_memory
from ...core.names import agreed, counted
from ...errors import InputError, MissingPackageError
from ...mesh.io.gltf import middle_of
from ...mesh.io.usd_stage import (
    attribute_times,
    errors_of_stage,
    opened_stage,
    placers_of,
    still_matrix,
    still_value,
    usd_library,
)
from .axes import SPZ_AXES, axes_matrix, placed_by, turned
from .contents import (
    DEGREES,
    FLOAT_LOGS,
    LOGS,
    SplatContents,
    joined,
    logits_of,
    logs_of,
    opacities_of,
    rotation_matrices,
    rounding_of,
    unit_quaternions,
)

#: How files of USD end; the last is a package of one and what it needs.
USD_ENDINGS = (".usd", ".usda", ".usdc", ".usdz")

#: What files hold of what other formats bound, see SplatFormat.
RANGES = {LOGS: FLOAT_LOGS}

# The schema: "Particle Fields" of UsdVol (OpenUSD 26). Values are activated, quaternions and harmonics those of 3DGS:
# each splat's coefficients follow one another, by degree, then by order -l to l.
_SCHEMA, _KERNEL = "ParticleField3DGaussianSplat", "ParticleFieldKernelGaussianEllipsoidAPI"
_DEGREE, _HARMONICS = "radiance:sphericalHarmonicsDegree", "radiance:sphericalHarmonicsCoefficients"

#: Names of the colours of pictures, which splats are fitted to: "scene" is what usd-core knows, others write "display".
_SRGB = ("srgb_rec709_scene", "srgb_rec709_display")

#: Names that say nothing of colours.
_UNSAID = ("", "raw", "data", "unknown", "identity")

#: From the axes of a stage by the one that is up, with z to the back where y is, as USD's cameras look, to a field's.
_UP = {"Y": axes_matrix(SPZ_AXES), "Z": axes_matrix(SPZ_AXES) @ [[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]}

#: Bytes of memory that a splat of degree 3 takes while it is read.
_SPLAT_BYTES = 1500

#: An opacity that rounding took beyond 0 or 1 is so far from it at most.
_ROUNDED = 1e-3

#: A splat is drawn to so many standard deviations: what an extent holds.
_REACH = 3.0


def has_usd_splats(path: pathlib.Path) -> bool:
    """Whether a file of USD holds splats; without usd-core, or where it cannot be read, it is not known to."""
    if not path.is_file():
        return path.name.lower().endswith(".usdz")
    try:
        with errors_of_stage(path):
            return any(True for _ in splat_prims(opened_stage(path)))
    except (InputError, MissingPackageError):
        return False


def splat_prims(stage: Any) -> Iterator[Any]:
    """The prims of a stage that are splats, those of instances too."""
    # by names, which versions of usd-core without the schema have too
    for prim in stage.Traverse(usd_library().Usd.TraverseInstanceProxies()):
        kind = prim.GetTypeName()
        if kind == _SCHEMA or (kind == "ParticleField" and _KERNEL in prim.GetAppliedSchemas()):
            yield prim


def usd_counts(path: pathlib.Path) -> dict[str, int]:
    """How many of each kind of object a stage holds, those of instances too."""
    pxr, stage = usd_library(), opened_stage(path)
    with errors_of_stage(path):
        prims = list(stage.Traverse(pxr.Usd.TraverseInstanceProxies()))
        kinds = {"mesh": pxr.UsdGeom.Mesh, "camera": pxr.UsdGeom.Camera, "skeleton": pxr.UsdSkel.Skeleton}
        counts = {name: sum(prim.IsA(kind) for prim in prims) for name, kind in kinds.items()}
        return counts | {"prim of splats": len(list(splat_prims(stage)))}


def _library() -> Any:
    """The package of usd-core, one that has the schema."""
    pxr = usd_library()
    if not hasattr(pxr.UsdVol, _SCHEMA):
        raise MissingPackageError("splats in USD need usd-core 26.3 or later: pip install -U usd-core")
    return pxr


def read_usd_splats(path: pathlib.Path) -> SplatContents:
    """The splats of a stage that are shown, at their places, y or z up; of what moves the first moment."""
    pxr, stage = _library(), opened_stage(path)
    with errors_of_stage(path):
        lost = [" ".join(str(each).split()) for each in stage.GetCompositionErrors()]
        if lost:
            warn_caller(f"{path}: {counted(len(lost), 'part')} of its stage cannot be put together: {lost[0][:200]}")
        prims = _shown_prims(path, list(splat_prims(stage)))
        time = _first_time(path, prims)
        count = sum(len(_values(prim, "positions", 3, time)) for prim in prims)
        require_host_memory(_SPLAT_BYTES * count, f"{path}: its {counted(count, 'splat')} need")
        parts = []
        for prim in prims:
            where = f"{path}: prim {prim.GetPath()}"
            parts.append(placed_by(_splats_of(prim, time, where), still_matrix(prim, time).T, where))
        whole = joined(parts)
        up = pxr.UsdGeom.GetStageUpAxis(stage)
        if up not in _UP:
            raise InputError(f"{path}: the upAxis of a stage is Y or Z, got {shown(up)}")
        whole = turned(whole, _UP[up])
    if whole.centers.dtype == np.float64 and not rounding_of(whole)[0]:
        whole = dataclasses.replace(whole, centers=whole.centers.astype(np.float32))
    return whole


def _shown_prims(path: pathlib.Path, found: list[Any]) -> list[Any]:
    """Those of a stage's prims with splats that are shown; warns of the others; ValueError where there are none."""
    if not found:
        raise InputError(f"{path}: it has no splats: no prim of its stage is a {_SCHEMA}")
    prims = [prim for prim in found if _is_shown(prim)]
    if len(prims) < len(found):
        hidden = len(found) - len(prims)
        said = f"{path}: {hidden} of {counted(len(found), 'prim')} with splats {agreed(hidden, 'is', 'are')} invisible"
        if not prims:
            raise InputError(f"{said}: make one visible")
        warn_caller(f"{said} and left out")
    return prims


def _is_shown(prim: Any) -> bool:
    """Whether a prim is visible, and neither a guide nor a stand-in of another one."""
    geometry = usd_library().UsdGeom
    scene_object, tokens = geometry.Imageable(prim), geometry.Tokens
    hidden = scene_object.ComputeVisibility(usd_library().Usd.TimeCode.EarliestTime()) == tokens.invisible
    return not hidden and scene_object.ComputePurpose() not in (tokens.proxy, tokens.guide)


def _first_time(path: pathlib.Path, prims: list[Any]) -> Any:
    """The first time at which prims have values; warns where they move."""
    pxr = usd_library()
    times: set[float] = set()
    for prim in prims:
        times.update(*map(attribute_times, prim.GetAuthoredAttributes()))
        for above in placers_of(prim):
            times.update(*(attribute_times(step.GetAttr()) for step in above.GetOrderedXformOps()))
    if len(times) > 1:
        warn_caller(
            f"{path}: its splats move or change, at {len(times)} times: what is said without a time is read, or else "
            f"at {min(times):g}"
        )
    return pxr.Usd.TimeCode(min(times)) if times else pxr.Usd.TimeCode.Default()


def _values(prim: Any, name: str, width: int, time: Any) -> np.ndarray:
    """(n, width) the numbers of an attribute, or of its half floats where it has none itself."""
    for each in (name, f"{name}h"):
        attribute = prim.GetAttribute(each)
        value = still_value(attribute, time) if attribute and attribute.HasAuthoredValue() else None
        if value is not None:
            return np.asarray(value, np.float32).reshape(-1, width)
    return np.zeros((0, width), np.float32)


def _splats_of(prim: Any, time: Any, where: str) -> SplatContents:
    """The splats of a prim in its own axes; where: for messages."""
    places = _values(prim, "positions", 3, time)
    count = len(places)
    fitting = _Fitting(prim, time, where, count)
    scales = fitting.values("scales", 3, [1.0, 1.0, 1.0])
    opacities = fitting.values("opacities", 1, [1.0])[:, 0]
    turns = fitting.values("orientations", 4, [0.0, 0.0, 0.0, 1.0])  # x y z w, as they lie in memory
    if (scales < 0.0).any():
        raise InputError(f"{where}: scales must be above 0, got {scales.min():.3g}: USD has no logarithms of them")
    if ((opacities < -_ROUNDED) | (opacities > 1.0 + _ROUNDED)).any():
        worst = opacities[np.nanargmax(np.abs(opacities - 0.5))]
        raise InputError(f"{where}: opacities must be in [0, 1], got {worst:.3g}: USD has no logits of them")
    _warn_of_hints(prim, where)
    return SplatContents(
        places,
        logs_of(scales),
        np.roll(turns, 1, axis=1),
        logits_of(np.clip(opacities.astype(np.float64), 0.0, 1.0)),
        fitting.harmonics(),
    )


@dataclasses.dataclass(frozen=True)
class _Fitting:
    """Values of a prim, as many as it has splats: the schema cuts those beyond, and leaves out what is too short."""

    prim: Any
    time: Any
    where: str  # for messages
    count: int  # splats

    def values(self, name: str, width: int, usual: list[float]) -> np.ndarray:
        """(count, width), the usual ones where there are none."""
        found = _values(self.prim, name, width, self.time)
        if not len(found):
            return np.tile(np.array(usual, np.float32), (self.count, 1))
        return self._checked(name, found, self.count)

    def harmonics(self) -> np.ndarray:
        """(count, b, 3); grey where there are none."""
        found = _values(self.prim, _HARMONICS, 3, self.time)
        if not len(found):
            return np.zeros((self.count, 1, 3), np.float32)
        attribute = self.prim.GetAttribute(_DEGREE)
        degree = attribute.Get() if attribute else 3
        if degree not in DEGREES.values():
            raise InputError(f"{self.where}: harmonics are read of degree 0 to 3, got {shown(degree)}")
        width = (degree + 1) ** 2
        return self._checked(_HARMONICS, found, self.count * width).reshape(self.count, width, 3)

    def _checked(self, name: str, found: np.ndarray, needed: int) -> np.ndarray:
        """As many values as there are splats."""
        many = counted(self.count, "splat")
        if len(found) < needed:
            raise InputError(f"{self.where}: {many} need {needed} {name}, got {len(found)}")
        if len(found) > needed:
            warn_caller(f"{self.where}: of {len(found)} {name} the first {needed} are read, for {many}")
        return found[:needed]


def _warn_of_hints(prim: Any, where: str) -> None:
    """Warn of hints of a prim that are ignored: another projection, or other colours than pictures have."""
    projection = prim.GetAttribute("projectionModeHint")
    if projection and projection.Get() != "perspective":
        warn_caller(
            f"{where}: its splats have projectionModeHint {shown(projection.Get())}, they are drawn as 'perspective'"
        )
    color = _color_space(prim)
    if color not in (*_SRGB, *_UNSAID):
        warn_caller(f"{where}: its splats have colours in {shown(color)}, which are taken as {_SRGB[0]!r}")


def _color_space(prim: Any) -> str:
    """The name of the space that the colours of a prim are in, of its harmonics, itself, or the nearest above it."""
    for name in (_HARMONICS, f"{_HARMONICS}h"):
        attribute = prim.GetAttribute(name)
        if attribute and attribute.HasColorSpace():
            return str(attribute.GetColorSpace())
    while prim and not prim.IsPseudoRoot():
        attribute = prim.GetAttribute("colorSpace:name")
        if attribute and attribute.Get():
            return str(attribute.Get())
        prim = prim.GetParent()
    return ""


def write_usd_splats(contents: SplatContents, *, ending: str = ".usdc") -> bytes:
    """A USD file of one prim, y up, a unit a metre, with float32 numbers about its middle and an extent."""
    pxr = _library()
    contents = turned(contents, _UP["Y"].T)
    middle = middle_of(contents.centers) if contents.count else np.zeros(3)
    places = contents.centers.astype(np.float64) - middle
    turns, logs = unit_quaternions(contents.quaternions), contents.log_scales.astype(np.float64)
    with np.errstate(over="ignore"):
        scales = np.exp(logs).astype(np.float32)
    stage = pxr.Usd.Stage.CreateInMemory()
    pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.y)
    pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    prim = pxr.UsdVol.ParticleField3DGaussianSplat.Define(stage, "/splats")
    stage.SetDefaultPrim(prim.GetPrim())
    if middle.any():
        prim.AddTranslateOp(pxr.UsdGeom.XformOp.PrecisionDouble).Set(pxr.Gf.Vec3d(*middle.tolist()))
    pxr.Usd.ColorSpaceAPI.Apply(prim.GetPrim()).CreateColorSpaceNameAttr(_SRGB[0])

    def floats(kind: str, values: np.ndarray) -> Any:
        return getattr(pxr.Vt, f"{kind}Array").FromNumpy(np.ascontiguousarray(values, np.float32))

    prim.CreatePositionsAttr(floats("Vec3f", places))
    prim.CreateOrientationsAttr(floats("Quatf", np.roll(turns, -1, axis=1)))  # x y z w, as they lie in memory
    prim.CreateScalesAttr(floats("Vec3f", scales))
    prim.CreateOpacitiesAttr(floats("Float", opacities_of(contents.logits)))
    prim.CreateRadianceSphericalHarmonicsDegreeAttr(contents.degree)
    prim.CreateRadianceSphericalHarmonicsCoefficientsAttr(floats("Vec3f", contents.harmonics.reshape(-1, 3)))
    if contents.count:  # programs take a prim without one to be nowhere
        reach = _REACH * np.sqrt((rotation_matrices(turns) ** 2 * np.exp(2.0 * logs)[:, None]).sum(axis=2))
        box = np.stack([(places - reach).min(axis=0), (places + reach).max(axis=0)])
        prim.CreateExtentAttr(floats("Vec3f", box))
    with tempfile.TemporaryDirectory(prefix="warpcage-") as folder:
        path = pathlib.Path(folder, f"splats{ending}")
        if ending == ".usdz":
            layer = path.with_suffix(".usdc")
            stage.GetRootLayer().Export(str(layer))
            writer = pxr.Sdf.ZipFileWriter.CreateNew(str(path))
            writer.AddFile(str(layer), layer.name)
            writer.Save()
        else:
            stage.GetRootLayer().Export(str(path))
        return path.read_bytes()
