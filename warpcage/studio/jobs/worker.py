"""A worker: makes items one after another, each whole or not at all, and keeps what the next ones need."""

from __future__ import annotations

import gc
import json
import os
import pathlib
import types
from collections.abc import Callable, Hashable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np
import warp as wp

from ... import __version__
from ...cage.cage import Cage
from ...core.arrays import array_bytes
from ...core.devices import resolve_device
from ...core.memory import LRUCache, free_bytes, is_shortage
from ...core.spec import defaults_of
from ...core.threads import cpu_threads
from ...deform.deformer import Deformer
from ...edits.edits import edit_from_spec, picture_cells
from ...edits.spec import canonical
from ...errors import InputError
from ...field.voxel_field import VoxelField
from ...fitting.cameras import tuned_scene
from ...fitting.evaluation import evaluation_report, in_world_of, moved_scene, refined_cameras_of, warn_of_mismatch
from ...fitting.fit import fit
from ...scene.load import load_scene
from ...scene.parsing import TO_OPENCV
from ...scene.scene import Scene
from ...splats.io import splat_path
from ...splats.splat_field import AnyField, read_field
from ...view.camera import Camera, CameraKey, camera_json
from ...view.exr import write_picture
from ...view.frame import RGB_BYTES, Frame, depth_along_view
from ...view.frame_parts import picture
from ...view.pictures import LIGHT_KEPT, PictureCuts
from ..films.overlap import SPARE, TASK_THREADS, Gate
from ..films.render import HeldPose, Look, Shot, blurred_picture, drawn_cages, render_shot, require_fillable
from ..films.resolve import AssetResolver, RestCage
from ..films.video import write_film_frame
from ..spec.scene import FitSceneSpec, SceneSpec
from .items import EvaluateItem, FitItem, FrameItem, Item, digest
from .job_file import Fingerprints
from .manifest import CHECKPOINTS, PARTS, MadeItem, Writer, write_array, write_outputs

#: Most deformers that stay bound to a field.
MAX_DEFORMERS = 4

#: Parts of a frame that no picture is needed for.
OF_RECORDS = ("pose", "record")

#: Endings of pictures with 8 bits a channel.
BYTE_ENDINGS = (".png", ".jpg", ".jpeg")

#: Bytes of a pixel of arrays on the host, 4 of others.
PIXEL_BYTES = {"rgb": 12, RGB_BYTES: 3}

#: Arrays of a frame that a part is made of, which is no array itself; others are made of all.
ARRAYS_OF_PARTS = {"film": ("rgb",), "depth": ("alpha", "depth"), "disparity": ("alpha", "depth")}


class Bound(HeldPose):
    """A Deformer, the pose that it holds, and its cages at rest."""

    def __init__(self, deformer: Deformer, rests: list[RestCage]):
        super().__init__(deformer)
        self.rests = rests


#: Most fields that stay loaded, and the share of the memory that is free at first for them and what is bound to them.
MAX_FIELDS, MEMORY_SHARE = 8, 0.5


class LoadedFields:
    """Fields by their files, of which those stay loaded that were used last.
    memory: bytes that they may take together, but one stays whatever it takes."""

    def __init__(self, resolver: AssetResolver, device: wp.Device, memory: int):
        self.resolver, self.device, self.read_count = resolver, device, 0
        self.dropped: Callable[[AnyField], Any] = lambda field: None  # called with a field that is let go, before it is
        self.kept: LRUCache[AnyField] = LRUCache(MAX_FIELDS, memory, array_bytes, lambda field: self.dropped(field))

    def get(self, name: str, scene_scale: float) -> tuple[Hashable, AnyField]:
        """A key that is another where the file has changed, and the field; scene_scale: as `VoxelField.load` has it."""
        path, stamp = self.resolver.stamped(str(splat_path(self.resolver.path(name))), "field file")

        def load() -> AnyField:
            self.read_count += 1
            return read_field(path, scene_scale=scene_scale)(self.device)

        key = path, stamp, scene_scale
        return key, self.kept.get(key, load)


class WorkerCuts(PictureCuts):
    """Counts over all pictures of a worker, and says it once."""

    def __init__(self, device: wp.Device):
        super().__init__()
        self.floats = not device.is_cuda  # from a GPU come bytes alone where they do: it has cut them
        self.said = False

    def report(self, path: str) -> None:
        """Report what was cut up to now, with the picture that showed it first."""
        self.said = self.said or self.warn(path, f"{LIGHT_KEPT}; others are not reported")


class FrameMaker:
    """Renders frames, and keeps what the next ones need: fields, deformers, and the map of the last pose.
    memory: bytes of deformers beside their fields, one stays whatever it takes."""

    def __init__(self, resolver: AssetResolver, fields: LoadedFields, memory: int):
        self.resolver, self.fields, self.cuts = resolver, fields, WorkerCuts(fields.device)
        # how often cages at rest were bound to a field, maps of poses made, and pictures rendered
        self.counts = types.SimpleNamespace(deformers=0, poses=0, frames=0)
        self.kept: LRUCache[Bound] = LRUCache(
            MAX_DEFORMERS, memory, lambda bound: array_bytes(bound.deformer, leave=(bound.deformer.field,))
        )
        fields.dropped = self._drop_bound_to

    def _drop_bound_to(self, field: AnyField) -> None:
        """Let go of what is bound to a field, which would keep it loaded."""
        for key, bound in self.kept.items():
            if bound.deformer.field is field:
                self.kept.drop(key)

    def make(self, item: FrameItem) -> MadeItem:
        """Render a frame; what is made writes its outputs."""
        field_key, field = self.fields.get(item.field, item.scene_scale)
        if item.antialias is not None and isinstance(field, VoxelField):
            raise InputError("'antialias' is for files of splats, this field is one of voxels (.npz)")
        if item.fill:
            require_fillable(field, "'fill'")
        look, moments = Look.of(item), item.shots
        cameras = [self.resolver.camera(each.camera, item.size, field) for each in moments]
        sizes = [(camera.width, camera.height) for camera in cameras]
        if other := next((number for number, size in enumerate(sizes, 1) if size != sizes[0]), None):
            raise InputError(f"moment {other} of 'moments' has a picture of another size than the first")
        bound_key, bound = self._bound(item, field_key, field, cameras[0]) if item.edits else (None, None)
        poses = [[] if bound is None else self._cages(each, bound) for each in moments]

        def shots() -> Iterator[Shot]:
            for camera, cages in zip(cameras, poses, strict=True):
                if bound is not None:
                    self.counts.poses += bound.pose(cages)
                self.counts.frames += 1
                drawn = [] if bound is None else drawn_cages(bound.deformer)
                yield render_shot(look, field if bound is None else bound.deformer, camera, drawn)

        mean, shot = blurred_picture(look, shots(), len(moments)) if item.moments else (None, next(shots()))
        needed = needed_arrays(item, shot.frame)
        shot.frame.begin_copies(*needed)  # on their way to the host when this returns
        posed = poses[len(moments) // 2]
        outputs = sorted(item.outputs.items(), key=lambda output: output[0] in OF_RECORDS)  # these last
        writers = {path: _writer(part, path, item, shot, posed, mean, self.cuts) for part, path in outputs}
        self.fields.kept.settle(field_key)
        self.kept.settle(bound_key)
        pixels = shot.frame.width * shot.frame.height
        return MadeItem(writers, sum(pixels * PIXEL_BYTES.get(name, 4) for name in needed))

    def _bound(self, item: FrameItem, field_key: Hashable, field: AnyField, camera: Camera) -> tuple[Hashable, Bound]:
        """A Deformer for an item, and its key."""
        options = item.deformer_options(picture_cells(camera))
        files = [self.resolver.stamped(edit.cage, "cage file") for edit in item.edits if isinstance(edit.cage, str)]
        rest = canonical([edit.rest for edit in item.edits])
        key = field_key, rest, tuple(files), *options.values()

        def bind() -> Bound:
            rests = [self.resolver.rest(edit.cage, edit.up, field, object=edit.object) for edit in item.edits]
            edits = [edit_from_spec(edit, rest.cage) for edit, rest in zip(item.edits, rests, strict=True)]
            self.counts.deformers += 1
            return Bound(Deformer(field, edits, **options), rests)

        return key, self.kept.get(key, bind)

    def _cages(self, item: FrameItem, bound: Bound) -> list[Cage | None]:
        """The posed cage of each edit of an item, None for one that removes."""
        edits = zip(item.edits, bound.rests, strict=True)
        return [None if edit.remove else self.resolver.pose(rest, edit.posed, edit.up) for edit, rest in edits]


def needed_arrays(item: FrameItem, frame: Frame) -> list[str]:
    """Names of the arrays of a frame that its outputs are made of: to copy all takes longer than a frame on a GPU."""
    needed = {"alpha"} if Look.of(item).is_transparent else set()
    for part, path in item.outputs.items():
        if part not in OF_RECORDS:
            own = (part,) if part in frame.arrays else frame.arrays
            needed.update([RGB_BYTES] if is_bytes(item, part, path) else ARRAYS_OF_PARTS.get(part, own))
    return [name for name in (*frame.arrays, RGB_BYTES) if name in needed]


def is_bytes(item: FrameItem, part: str, path: str) -> bool:
    """Whether an output is made of the colours of a frame as bytes, with nothing done to them."""
    plain = part == "rgb" and not Look.of(item).is_transparent and not item.overlay and not item.moments
    return plain and pathlib.PurePosixPath(path).suffix.lower() in BYTE_ENDINGS


def frame_record(item: FrameItem, camera: Camera, posed: Sequence[Cage | None]) -> dict[str, Any]:
    """What is written beside a picture, JSON; posed: the cage of each edit, None for one that removes."""
    edits = []
    for edit, cage in zip(item.edits, posed, strict=True):
        entry = edit.to_json()
        if isinstance(entry.get("posed"), list):
            del entry["posed"]  # numbers, which the pose's own file has
        edits.append(entry | {"pose_vertices": 0 if cage is None else len(cage.vertices)})  # rows in the pose's array
    record: dict[str, Any] = {
        "id": item.id,
        "field": item.field,
        "camera": camera_json(CameraKey(camera)),  # OpenCV axes
        "transform_matrix": (camera.camera_to_world @ TO_OPENCV).tolist(),  # of NeRF-synthetic: +y up, -z forward
        "background": item.background,
    }
    if edits:
        record |= {"coordinates": item.coordinates, "density": item.density, "edits": edits}
    return record if item.extra is None else record | {"extra": item.extra}


def _writer(
    part: str,
    path: str,
    item: FrameItem,
    shot: Shot,
    posed: Sequence[Cage | None],
    mean: np.ndarray | None,  # colours where they are those of several moments
    cuts: WorkerCuts,
) -> Writer:
    """What writes a part of a frame."""
    frame, camera = shot.frame, shot.camera
    if part == "pose":
        vertices = [cage.vertices for cage in posed if cage is not None]  # (v, 3) of one edit after the other
        return lambda temporary: write_array(temporary, np.concatenate([np.zeros((0, 3)), *vertices]))
    if part == "record":
        return lambda temporary: temporary.write_bytes(
            (json.dumps(frame_record(item, camera, posed), ensure_ascii=False) + "\n").encode()
        )
    ending = pathlib.PurePosixPath(path).suffix.lower()
    if part in ("reveal", "fold", "outside", "masks") and "reveal" not in frame.arrays:
        raise InputError(f"{part!r} is for fields of voxels (.npz), this one is of splats")
    if ending == ".npy":
        return lambda temporary: write_array(temporary, getattr(frame, part))

    def image() -> np.ndarray:
        if part == "depth" and ending == ".exr":
            return np.repeat(frame.alpha[..., None], 3, axis=-1)
        if is_bytes(item, part, path):
            return frame.rgb if cuts.floats else frame.rgb_bytes
        if part in ("rgb", "film"):
            return Look.of(item).picture(*shot) if mean is None else mean
        if part in ("reveal", "fold"):
            return np.clip(getattr(frame, part), 0.0, 1.0)
        return picture(frame, part, scale=item.disparity_scale)

    def write(temporary: pathlib.Path) -> None:
        if part == "film":
            write_film_frame(temporary, image(), cuts=cuts)
        else:
            depth = depth_along_view(frame, camera) if ending == ".exr" else None
            write_picture(temporary, image(), depth, cuts=cuts)
        if ending != ".exr":
            cuts.report(path)

    return write


def _scene(item: FitItem | EvaluateItem, resolver: AssetResolver, background: Any, **options: Any) -> Scene:
    spec = {name: getattr(item, name) for name in defaults_of(SceneSpec)}
    spec |= {"background": background, "cameras": None if item.cameras is None else resolver.path(item.cameras)}
    return load_scene(resolver.path(item.scene), **spec, **options)


class FitMaker:
    """Fits fields, and keeps the pictures of the last scene: to read them takes as long as a short fit.
    fingerprints: of what items read, by which a changed scene is known."""

    def __init__(self, resolver: AssetResolver, fingerprints: Fingerprints, device: wp.Device):
        self.resolver, self.fingerprints, self.device, self.read_count = resolver, fingerprints, device, 0
        self.scenes: LRUCache[Scene] = LRUCache(1)

    def make(self, item: FitItem, checkpoint: pathlib.Path) -> MadeItem:
        """Fit a field to the pictures of a scene, as `warpcage fit` does; what is made writes its outputs.
        checkpoint: file (.npz) that holds the progress, from which a fit goes on whose worker died."""
        scene = self._read(item)
        checkpoint.parent.mkdir(parents=True, exist_ok=True)
        field = fit(scene, device=self.device, progress=False, checkpoint=checkpoint, **item.options)
        writers: dict[str, Writer] = {item.outputs["field"]: field.save}
        refined = field.refined_cameras if isinstance(field, VoxelField) else None
        if refined is not None and "cameras" in item.outputs:
            writers[item.outputs["cameras"]] = refined.save
        return MadeItem(writers)

    def _read(self, item: FitItem) -> Scene:
        options = repr([getattr(item, name) for name in defaults_of(FitSceneSpec)])
        key = item.scene, options, self.fingerprints.of_inputs(item)

        def load() -> Scene:
            self.read_count += 1
            orient = "up" if item.straighten else None
            return _scene(item, self.resolver, item.background, orient=orient)

        return self.scenes.get(key, load)


def make_evaluation(item: EvaluateItem, resolver: AssetResolver, fields: LoadedFields) -> MadeItem:
    """Compare a field with pictures of a scene, as `warpcage evaluate` does; what is made writes the report."""
    key, field = fields.get(item.field, item.scene_scale)
    background = field.background if item.background is None else item.background
    scene, given = in_world_of(field, _scene(item, resolver, background)), None
    if item.tune_cameras:
        if not isinstance(field, VoxelField):
            raise InputError(f"'tune_cameras' is for fields of voxels (.npz), {item.field!r} is of splats")
        scene = tuned_scene(field, scene)
    elif refined_cameras_of(field) is not None and not item.given_cameras:
        scene, given = moved_scene(field, scene), scene
    found = evaluation_report(field, scene, given=given)
    warn_of_mismatch(field, scene)
    fields.kept.settle(key)
    content = {
        "field": item.field,
        "scene": item.scene,
        "split": item.split,
        "downscale": item.downscale,
        "tuned_cameras": item.tune_cameras,
        **found.to_json(),
    }
    text = json.dumps(content, indent=2) + "\n"
    return MadeItem({item.outputs["report"]: lambda path: path.write_bytes(text.encode())})


class Worker:
    """Makes items. One thread at a time may use it.
    memory: bytes of fields, and deformers beside them; those in use stay in any case; None is half of what is free."""

    def __init__(
        self,
        base: str | os.PathLike[str],
        out: str | os.PathLike[str],
        device: wp.DeviceLike = None,
        *,
        memory: int | None = None,
        encoders: int | None = None,  # threads that encode beside rendering; None is one a CPU thread, 16 at most
    ):
        self.out, self.device = pathlib.Path(out), resolve_device(device)
        self.resolver = AssetResolver(base, in_json=True)
        half = (int(MEMORY_SHARE * free_bytes(self.device)) if memory is None else memory) // 2
        self.fields = LoadedFields(self.resolver, self.device, half)
        self.frames = FrameMaker(self.resolver, self.fields, half)
        self._fingerprints = Fingerprints(self.resolver.base, self.out)
        self.fits = FitMaker(self.resolver, self._fingerprints, self.device)
        threads = min(TASK_THREADS, cpu_threads()) if encoders is None else encoders
        self._pool = ThreadPoolExecutor(threads, "warpcage-outputs")
        self._gate = Gate(threads + SPARE)

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Finish what is being written, and let go of all that is loaded."""
        self._pool.shutdown()
        self.forget()

    @property
    def held_bytes(self) -> int:
        """Bytes that all takes that is loaded."""
        return self.fields.kept.held_bytes + self.frames.kept.held_bytes

    def forget(self, *, scenes: bool = True) -> None:
        """Let go of all that is loaded, or of all but the scenes of fits."""
        if scenes:
            self.fits.scenes.clear()
        self.frames.kept.clear()
        self.fields.kept.clear()
        gc.collect()

    def run(self, item: Item, out: str | os.PathLike[str] | None = None) -> dict[str, int]:
        """Make an item; returns the bytes of its outputs, by their paths. out: their folder; None is that of the
        worker."""
        return self.submit(item, out).result()

    def submit(self, item: Item, out: str | os.PathLike[str] | None = None) -> Future[dict[str, int]]:
        """Make an item; its outputs are encoded and written in another thread, while the next item is rendered.
        Becomes the bytes of its outputs by their paths once they are in their places, or its error."""
        try:
            made = self._made(item)
        except Exception as error:
            failed = Future[dict[str, int]]()
            failed.set_exception(error)
            return failed
        folder = self.out if out is None else pathlib.Path(out)
        self._gate.enter(made.held_bytes)  # waits while there are two more than threads, or ROOM bytes of pictures
        return self._pool.submit(self._write, made, folder)

    def _write(self, made: MadeItem, folder: pathlib.Path) -> dict[str, int]:
        """Write the outputs of an item, in a thread of the pool."""
        try:
            return write_outputs(made.writers, folder, self.out / PARTS)
        finally:
            self._gate.leave(made.held_bytes)

    def _made(self, item: Item) -> MadeItem:
        """Make an item; where memory is short, once more with nothing else loaded."""
        try:
            return self._made_once(item)
        except Exception as error:
            if not is_shortage(error) or not self.held_bytes:
                raise
        self.forget()
        return self._made_once(item)

    def _made_once(self, item: Item) -> MadeItem:
        if isinstance(item, FitItem):
            self.forget(scenes=False)  # a fit plans with the memory that is free
            return self.fits.make(item, self.checkpoint_path(item))
        self.fits.scenes.clear()  # its pictures are for fits alone
        if isinstance(item, FrameItem):
            return self.frames.make(item)
        if isinstance(item, EvaluateItem):
            return make_evaluation(item, self.resolver, self.fields)
        raise InputError(f"a worker makes no {type(item).__name__}")

    def checkpoint_path(self, item: FitItem) -> pathlib.Path:
        """Where the progress of a fit is kept: another place for other inputs, and for another version."""
        name = digest([self._fingerprints.of(item), __version__])
        return self.out / CHECKPOINTS / f"{name}.npz"
