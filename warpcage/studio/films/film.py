"""One film: its frames by their numbers, written to a file, or to a folder which goes on after an interrupt."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import os
import pathlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from fractions import Fraction
from operator import attrgetter
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ...cage.cage import Cage
from ...cage.pose_file import DEFAULT_RATE, PoseFile, posed_cage
from ...core.checks import checked_path, checked_positive, checked_whole, require_type, shown
from ...core.files import PathLike
from ...core.names import MAX_FRAMES, MOVE_HELP, checked_choice, counted, named_errors
from ...core.reports import Progress, report_progress, reports_progress
from ...deform.deformer import Deformer
from ...deform.poses import PoseLike
from ...deform.stage import Stage
from ...edits.place import PlaceFile
from ...errors import InputError
from ...field.sparse import stored_harmonics
from ...field.voxel_field import VoxelField
from ...mesh.mesh import ClosedMesh
from ...render.surface_mesh import SurfaceMesh
from ...splats.splat_field import SplatField
from ...view import frame_parts
from ...view.camera import Camera, CameraFile, CameraKey, fitted
from ...view.exr import require_openexr
from ...view.frame import Frame
from ...view.motion import frame_rate, frame_times
from ...view.pictures import picture_cuts
from .folder import checked_film_path, frame_path, make_folder
from .moves import CameraMove, MovingCamera, camera_moves
from .overlap import BackgroundWriter
from .render import Look, Scene, Shot, blurred_picture, drawn_cages, picture_task, pose_bytes, render_shot
from .resolve import AssetResolver
from .timeline import CameraTrack, keyed_track, middle, moving_track, shown_corners, side_camera
from .video import checked_rate, require_clear_film, write_film

#: What renders a frame, or what is between two, and the cages that an overlay shows then.
Moment = Callable[[float], tuple[Scene, Sequence[Cage]]]


class Film:
    """Renders frames by their numbers, so that a folder can be continued anywhere."""

    def __init__(
        self,
        count: int,
        track: CameraTrack,
        moment: Moment,
        look: Look,
        shutter: tuple[float, int] | None = None,  # share of a frame that it is open for, and moments of it
    ):
        self.count, self.track, self.moment, self.look, self.shutter = count, track, moment, look, shutter
        self._cameras: list[Camera] | None = None
        self._shares: dict[str, list[float]] = {}  # what each mask marked of the frames so far
        self._scale: tuple[float, float] | None = None
        self._seen: tuple[Any, ...] | None = None  # what `picture` showed last, and that
        self._picture: np.ndarray | None = None
        self._now: tuple[float, Scene, Sequence[Cage]] | None = None

    def __iter__(self) -> Iterator[np.ndarray]:
        return map(self.picture, range(self.count))

    @property
    def cameras(self) -> list[Camera]:
        """The cameras of all frames."""
        if self._cameras is None:
            self._cameras = self.track(range(self.count))
        return self._cameras

    def camera(self, index: int) -> Camera:
        """The camera of a frame; long films begin before all are known."""
        return self.track([index])[0] if self._cameras is None else self._cameras[index]

    @property
    def stands(self) -> bool:
        """Whether the camera of all frames stands in one place."""
        first = self.cameras[0].camera_to_world
        return all(np.array_equal(camera.camera_to_world, first) for camera in self.cameras)

    @property
    def mask_shares(self) -> dict[str, float]:
        """What each mask marked of the frames so far, on average, where masks are shown."""
        return {name: sum(shares) / len(shares) for name, shares in self._shares.items()}

    @property
    def scale(self) -> tuple[float, float] | None:
        """Low and high disparity of pictures of depth and disparity, one for the whole film; None for others."""
        # by a few frames, always the same ones, so that a folder that is continued keeps its colours
        if self._scale is None and self.look.show in ("depth", "disparity"):
            probes = sorted({round(share * (self.count - 1)) for share in (0.0, 0.25, 0.5, 0.75)})
            frames = [self._shot(index, self.cameras[index]).frame for index in probes]
            self._scale = frame_parts.disparity_scale(frames)
        return self._scale

    def moments(self, index: int) -> list[float]:
        """Frames, or between which, a picture is taken: one, or those of a shutter, with the frame in their middle."""
        share, count = self.shutter or (0.0, 1)
        return (index + share * ((np.arange(count) + 0.5) / count - 0.5)).tolist()

    def taken(self, index: int) -> tuple[np.ndarray, Frame, Camera]:
        """What the film shows of a frame, (h, w, 3), (h, w) or, with opacity, (h, w, 4), and the frame itself."""
        scale = self.scale
        if self.shutter is None:
            shot = self._shot(index, self.camera(index))
            image = self.look.picture(*shot, scale)
        else:
            moments = self.moments(index)
            shots = map(self._shot, moments, self.track(moments))
            image, shot = blurred_picture(self.look, shots, len(moments), scale)
        return image, shot.frame, shot.camera

    def picture(self, index: int) -> np.ndarray:
        """What the film shows of a frame, read-only; where that is what it showed last, the same array."""
        seen = self._looks(index)
        if self._picture is None or seen is None or seen != self._seen:
            self._picture, self._seen = self.taken(index)[0], seen
            self._picture.flags.writeable = False  # a film takes it without a copy
        return self._picture

    def _looks(self, index: int) -> tuple[Any, ...] | None:
        """All that decides how a frame looks, None where that is not known, or where each is to be looked at."""
        if self.shutter is not None or self.look.show == "masks":
            return None
        scene, cages = self._at(index)
        camera = self.camera(index)
        lens = camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height
        return _shown_of(scene), lens, camera.camera_to_world.tobytes(), pose_bytes(cages)

    def _shot(self, number: float, camera: Camera) -> Shot:
        scene, cages = self._at(number)
        shot = render_shot(self.look, scene, camera, cages)
        if self.look.show == "masks":
            for name, share in frame_parts.mask_shares(shot.frame).items():
                self._shares.setdefault(name, []).append(share)
        return shot

    def _at(self, frame: float) -> tuple[Scene, Sequence[Cage]]:
        """The moment of a frame, found once for all that need it."""
        if self._now is None or self._now[0] != frame:
            self._now = None  # should this fail, what is held is of another
            self._now = frame, *self.moment(frame)
        return self._now[1:]

    def write_pictures(self, paths: Iterable[pathlib.Path]) -> None:
        """Write the frames to a file each."""
        paths = list(paths)
        named = paths[0] if len(paths) == 1 else f"{len(paths)} pictures"
        with picture_cuts(named) as cuts, BackgroundWriter() as beside:
            for index, path in enumerate(paths):
                beside.run(*picture_task(path, *self.taken(index), cuts))

    def write(
        self,
        path: pathlib.Path,
        fps: float | Fraction,
        settings: dict[str, Any] | None = None,  # of a folder, as `make_folder` has them
        *,
        loop: bool,  # of a GIF
        overwrite: bool = False,
        reported: Callable[[Sequence[int]], Any] = contextlib.nullcontext,
    ) -> int:
        """Write a film, whole or not at all, or the frames that a folder does not have yet; returns how many it had.
        reported: makes of numbers of frames a block that goes through them."""
        if path.suffix:
            with reported(range(self.count)) as numbers:
                write_film(path, map(self.picture, numbers), fps, loop=loop)
            return 0
        settings = settings or {}

        def make(missing: list[int], begin: Callable[[], None]) -> None:
            with reported(missing) as frames, picture_cuts(path) as cuts, BackgroundWriter() as beside:
                for index in frames:
                    task = picture_task(frame_path(path, index, settings["format"]), *self.taken(index), cuts)
                    if index == missing[0]:
                        begin()
                    beside.run(*task)
                    del task  # what is rendered next may take its place

        return make_folder(path, self.cameras, make, settings, overwrite=overwrite)


#: Width and height of pictures, and frames of a camera that moves, where nothing says others.
DEFAULT_SIZE, DEFAULT_FRAMES = (400, 400), 48


@reports_progress
def render_film(
    scene: VoxelField | SplatField | Deformer | Stage,
    path: PathLike,
    *,
    poses: PoseFile | PathLike | Iterable[PoseLike | Sequence[PoseLike | None]] | None = None,
    camera: Camera | CameraFile | PathLike | Sequence[Camera] | Sequence[CameraKey] | None = None,
    move: str | None = None,
    frames: int | None = None,
    fps: float | Fraction | None = None,
    size: int | tuple[int, int] | None = None,
    background: str | ArrayLike | None = None,
    supersampling: int | None = None,
    overlay: bool = False,
    format: str = "png",
    overwrite: bool = False,
    progress: bool | Progress = False,
) -> list[pathlib.Path]:
    """Render a film of a scene, and write it to a file, or to a folder which goes on after an interrupt.

    Each frame is, to the bit, what `scene.render(camera)` shows in its pose. Poses and cameras come one a frame, or as
    keys at times, which say how long the film is. It is written while the next frames are rendered, whole or not at
    all; of a folder each frame is, and a call with the same scene, poses and cameras makes those that are missing.

    Example::

        deformer = Deformer(field, cage)
        render_film(deformer, "bend.mp4", poses=[cage.bend(degrees) for degrees in range(0, 60, 2)], move="turn:90")

    Args:
        scene: What is shown. Of a Stage, objects are where their places are at the time of each frame.
        path: The film, .mp4, .gif, .mov or .webm; or a folder of pictures, which has no ending.
        poses: Of a Deformer, one a frame, each as `Deformer.pose` takes it; or a PoseFile of its one cage, or the file:
            its keys at times, or else a keyframe a frame. None stays in the pose that the Deformer has, which poses of
            a film do not change.
        camera: A camera that stands still, or one a frame; or the keys of a path, which are reached at their times, or
            else evenly: a CameraFile, its file, or a list of CameraKey. None are the cameras of the PoseFile, or one
            that sees all, from a corner.
        move: How a camera that stands moves: "turn", "dolly", "crane", "hand-held", "follow", with a number behind a
            colon and joined by "+" as in "turn:90+crane:20" (docs/films.md).
        frames: Number of frames. None is that of poses or cameras, that of keys at times, or else 48 of a camera that
            moves and 1 of one that does not. Keys from 0 to 2 s at 24 a second make 49 frames, 0 to 48: both ends are
            shown.
        fps: Frames per second. None is what the PoseFile or the CameraFile says, or 24.
        size: Width, or width and height of the pictures, pixels. None is that of the camera, 400 x 400 where none is
            given. Another shape is cut from the middle of the camera's picture.
        background: Colour behind the scene, a name or (3,) in [0, 1]; "transparent" for .mov, .webm and folders. None
            is the scene's own.
        supersampling: Rays along a pixel's side. None is the field's.
        overlay: Draw the edges of the cages.
        format: Of a folder: "png"; "exr", with depth; or "npz", 16 bits a channel (`warpcage.studio.films.video`).
        overwrite: Replace the frames of another film that are in the folder.
        progress: True shows a bar on stderr. A function is called with (done, total, message) and ends the film by
            returning False or by raising; frames of a folder stay.

    Returns:
        What was written: the film, or all frames of the folder in their order.

    Raises:
        FileNotFoundError: If there is no such file of poses or cameras.
        ValueError: For poses of no Deformer, a pose or a camera that cannot be used, numbers of frames that differ, a
            film that cannot hold opacity or has another ending, or a folder that holds another film.
        Cancelled: Where `progress` returned False.
    """
    if not isinstance(scene, VoxelField | SplatField | Deformer | Stage):
        raise InputError(f"render_film needs a field, a Deformer or a Stage, got {type(scene).__name__}")
    target = checked_film_path(checked_path(path, "the path of a film"), new=False)
    ending = target.suffix.lower()
    checked_choice(format, "format", ("png", "exr", "npz"))
    look = Look(background, supersampling=supersampling, overlay=overlay)
    if look.is_transparent:
        require_clear_film(target)
    if format == "exr" and not ending:
        require_openexr()
    request = _Request(scene, poses, camera, move, frames, fps, size)
    rate = checked_rate(request.fps, ending or ".mp4")
    before = scene.time if isinstance(scene, Stage) else 0.0
    try:
        film = Film(len(request.times), request.track, request.moment, look)
        numbers, settings = range(film.count), {}
        if not ending:
            settings = {
                "frames": film.count,
                "fps": str(rate),
                "size": [film.cameras[0].width, film.cameras[0].height],
                "format": format,
                "background": background if isinstance(background, str | None) else np.asarray(background).tolist(),
                "supersampling": supersampling,
                "overlay": overlay,
                "camera": _digest(film.cameras),
                "field": _digest(scene),
                "posed": _digest([request.pose(number) for number in numbers]),
            }

        def reported(missing: Sequence[int]) -> Any:
            return contextlib.nullcontext(_reported(missing, film.count, progress))

        film.write(target, rate, settings, loop=request.loop != "once", overwrite=overwrite, reported=reported)
        return [target] if ending else [frame_path(target, number, format) for number in numbers]
    finally:
        if isinstance(scene, Stage):
            scene.time = before


class _Request:
    """A film that `render_film` makes: its frames in time, and the pose and the camera of each."""

    def __init__(self, scene: Any, poses: Any, camera: Any, move: Any, frames: Any, fps: Any, size: Any):
        self.scene, self._held = scene, ((), None)
        self._rows, self._keys = _poses(scene, poses)
        file: Any = CameraFile.load(camera) if isinstance(camera, str | os.PathLike) else camera
        if file is None and move is None and self._keys is not None and self._keys.cameras:
            file = CameraFile(self._keys.cameras)
        self._path, self._each = _all_of(CameraKey, file), _all_of(Camera, file)
        self._size = () if size is None else tuple(size) if isinstance(size, Sequence) else (size,)
        if not all(checked_whole(side, "a side of a picture", 1) for side in self._size) or len(self._size) > 2:
            raise InputError(f"size must be a width, or a width and a height, got {shown(size)}")
        if file is None:
            width, height = (*self._size, *self._size)[:2] if self._size else DEFAULT_SIZE
            file = side_camera(self._points(), up=_field(scene).up, width=width, height=height)
        if self._path is None and self._each is None:
            require_type(file, Camera, "the camera of a film must be one, a list of them or of camera keys:")
        elif move is not None:
            raise InputError("move is for one camera, which stands still without it: leave it out, or the others")
        self._start: Any = file
        said = [each for each in (self._keys, file) if isinstance(each, PoseFile | CameraFile)]
        self.fps = next((each.fps for each in said if each.fps is not None), DEFAULT_RATE) if fps is None else fps
        self.loop = next((each.loop for each in said if each.loop is not None), "once")
        moves = [] if move is None else camera_moves(move)
        if moves is None:
            raise InputError(f"move {shown(move)} is not a camera move: {MOVE_HELP}")
        self.times = self._times(frames, bool(moves))
        self.track: CameraTrack = self._moving(moves) if moves else self._placed

    def _times(self, frames: int | None, moves: bool) -> list[float]:
        """Seconds of each frame."""
        counts = {"poses": self._rows, "cameras": self._each}
        known = {name: len(each) for name, each in counts.items() if each is not None}
        known |= {} if frames is None else {"frames": checked_whole(frames, "frames", 1, MAX_FRAMES)}
        if len(set(known.values())) > 1:
            numbers = ", ".join(f"{count} {name}" for name, count in known.items())
            raise InputError(f"poses and cameras come one a frame, got {numbers}")
        rate = frame_rate(checked_positive(self.fps, "fps") if not isinstance(self.fps, Fraction) else self.fps)
        places = self.scene.items.values() if isinstance(self.scene, Stage) else ()
        lengths = [item.places.length for item in places] + [key.time or 0.0 for key in self._path or ()]
        length = max(lengths + ([] if self._keys is None else [self._keys.length]), default=0.0)
        if not known and length > 0.0:
            return frame_times(length, rate, self.loop)
        count = next(iter(known.values()), DEFAULT_FRAMES if moves or self._path else 1)
        return [float(number / rate) for number in range(count)]

    def _points(self) -> np.ndarray:
        """(n, 3) points around what is seen, world units."""
        scene = _field(self.scene)
        return scene.shown_points if isinstance(scene, Stage) else shown_corners(scene)

    def _moving(self, moves: Sequence[CameraMove]) -> CameraTrack:
        camera, field = fitted(self._start, self._size), _field(self.scene)
        rate = float(self.fps)
        moving = MovingCamera(camera, middle(self._points()), field.up, moves, len(self.times), rate)
        edits = self.scene.edits if isinstance(self.scene, Deformer) else []
        return moving_track(moving, field, edits, lambda frame: self.pose(int(frame)), AssetResolver())

    def _placed(self, numbers: Sequence[float]) -> list[Camera]:
        """The cameras of frames that stand, come one a frame, or lie on a path."""
        if self._path is not None:
            cameras = keyed_track(self._path, len(self.times), lambda number: self.times[int(number)])(numbers)
        else:
            cameras = [self._start if self._each is None else self._each[int(number)] for number in numbers]
        return [fitted(camera, self._size) for camera in cameras]

    def pose(self, number: int) -> list[Cage | None]:
        """The cages of a frame, one an edit, None for what is removed; none where the scene stays as it is."""
        if self._keys is not None:
            return [self._keys.at_time(self.times[number])]
        if self._rows is not None:
            return self._rows[number]
        return list(self.scene.deformed or []) if isinstance(self.scene, Deformer) else []

    def moment(self, frame: float) -> tuple[Scene, Sequence[Cage]]:
        """What renders a frame, and the cages that an overlay shows; the Deformer's own pose stays."""
        number = int(frame)
        if isinstance(self.scene, Stage):
            self.scene.time = self.times[number]
        if not isinstance(self.scene, Deformer):
            return self.scene, []
        if self._keys is None and self._rows is None:
            return self.scene, drawn_cages(self.scene)
        cages = self.pose(number)
        pose = pose_bytes(cages)
        if self._held[1] is None or pose != self._held[0]:
            with named_errors(f"frame {number}"):
                self._held = pose, self.scene.posed(cages)
        return self._held[1], drawn_cages(self.scene, self._held[1].deformed)


def _all_of(kind: type, objects: Any) -> list[Any] | None:
    """A list that holds objects of one kind, and some of them; None for another."""
    found = list(objects) if isinstance(objects, Sequence) else []
    return found if found and all(isinstance(each, kind) for each in found) else None


def _field(scene: Any) -> Any:
    """The field of what is shown; of a stage that says what is up for it, the stage."""
    return scene.field if isinstance(scene, Deformer) else scene


def _poses(scene: Any, poses: Any) -> tuple[list[list[Cage | None]] | None, PoseFile | None]:
    """The cages of each frame, or keys at times; neither where the scene stays as it is."""
    if poses is None:
        return None, None
    if not isinstance(scene, Deformer):
        raise InputError(f"poses move the cages of a Deformer, got a {type(scene).__name__}")
    if isinstance(poses, str | os.PathLike | PoseFile):
        if len(scene.edits) != 1:
            raise InputError(f"a pose file moves one cage, got {len(scene.edits)} edits: give poses as lists of cages")
        file = poses if isinstance(poses, PoseFile) else PoseFile.load(poses, scene.edits[0].cage)
        if file.times or (file.cameras and not len(file)):
            return None, file
        poses = [file[name] for name in file.names]
    if not isinstance(poses, Iterable):
        raise InputError(f"poses must be one a frame, or a pose file, got {type(poses).__name__}")
    rows = []
    for number, pose in enumerate(poses):
        given = pose if isinstance(pose, list | tuple) else [pose]
        if len(given) != len(scene.edits):
            raise InputError(f"pose {number} has {counted(len(given), 'cage')}, the Deformer {len(scene.edits)}")
        pairs = zip(scene.edits, given, strict=True)
        rows.append([None if one is None else posed_cage(edit.cage, one, "a pose must be") for edit, one in pairs])
    if not rows:
        raise InputError("a film needs at least one pose")
    return rows, None


def _shown_of(scene: Scene) -> tuple[Any, ...]:
    """What a scene shows, but for the pose of what stands alone, which the cages of a moment give."""
    if not isinstance(scene, Stage):
        return (scene,)  # held, and equal to itself alone: a number of what has gone may come again
    return tuple(
        (item.scene_object, item.places.at(scene.time), pose_bytes(getattr(item.scene_object, "deformed", None) or ()))
        for item in scene.items.values()
        if not item.hidden
    )


def _reported(numbers: Sequence[int], total: int, progress: bool | Progress) -> Iterator[int]:
    """Numbers of frames, reported as they are done."""
    for done, number in enumerate(numbers, total - len(numbers) + 1):
        yield number
        report_progress(progress, done, total, "film")


def _digest(scene_object: Any) -> str:
    """sha256 of all that a scene, poses and cameras show, by which a film is known again."""
    digest, left = hashlib.sha256(), [scene_object]
    while left:
        each = left.pop()
        if isinstance(each, np.ndarray | wp.array):
            values = np.ascontiguousarray(each if isinstance(each, np.ndarray) else each.numpy())
            digest.update(f"{values.dtype} {values.shape}".encode() + values.tobytes())
        elif (parts := _parts(each)) is None:
            digest.update(f"{each!r};".encode())
        else:
            left += [*parts, len(parts)]
    return digest.hexdigest()


def _parts(scene_object: Any) -> list[Any] | None:
    """What an object is made of; None for a number or a text."""
    if isinstance(scene_object, Stage):
        poses = (getattr(scene_object[name], "deformed", None) for name in scene_object.items)
        return [*scene_object.items, *scene_object.items.values(), *poses]
    if isinstance(scene_object, Deformer):
        return [*attrgetter("field", "edits", "coordinates", "resolution", "density", "map")(scene_object)]
    if isinstance(scene_object, SplatField):
        return [scene_object.contents, scene_object.view_options()]
    if isinstance(scene_object, SurfaceMesh):
        return [scene_object.surface, scene_object.background, scene_object.supersampling]
    if isinstance(scene_object, VoxelField):
        behind = None if scene_object.background_model is None else scene_object.background_model.contents()
        harmonics = stored_harmonics(scene_object.stored).numpy().astype(np.float32)  # the same on all devices
        values = scene_object.bounds, scene_object.host_links(), scene_object.stored.density
        return [*values, harmonics, scene_object.background, scene_object.supersampling, behind]
    if isinstance(scene_object, ClosedMesh):
        return [scene_object.vertices, scene_object.faces]
    if isinstance(scene_object, dict | PlaceFile):
        return [*(scene_object if isinstance(scene_object, dict) else scene_object.to_json()).items()]
    if isinstance(scene_object, list | tuple):
        return list(scene_object)
    return list(vars(scene_object).values()) if dataclasses.is_dataclass(scene_object) else None
