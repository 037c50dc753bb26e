"""`warpcage.capture`: from a video or a folder of pictures to a scene with cameras; a killed one goes on."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.metadata
import json
import os
import pathlib
import shutil
import warnings
from collections.abc import Sequence
from types import TracebackType

import numpy as np

from ...core.checks import checked_flag, checked_path, checked_whole, listed
from ...core.files import atomic_path, check_parent
from ...core.names import agreed, counted
from ...core.reports import Progress, Reporter, reports_progress
from ...errors import InputError, MissingFileError
from ...scene.box_picture import box_text, draw_box
from ...scene.coverage import draw_coverage, find_coverage
from ...view.pictures import image_size, write_png
from .colmap import Solver, load_pycolmap
from .feature_masks import PictureMask, masks_of, write_feature_masks
from .report import MAX_THUMBNAILS, THUMBNAIL, CaptureReport, make_contact_sheet, make_report
from .scene_folder import cameras_of, object_box, placed, write_scene
from .solving import HOW_TO, MIN_PICTURES, Solution, doubts, solve
from .sources import ENDINGS, Source, chosen_names, read_sources, shrink_factor
from .video import MIN_STEP, FrameScores, pick_frames, scan_video, shrink_all, write_frames

#: Counts up when what the folder holds changes its meaning.
LAYOUT = 1


class WorkFolder:
    """A hidden folder beside the output, a context; another job (what is captured and how, for JSON) starts anew.
    It goes when the capture is done or the input unusable; a kill, an interrupt or a full disk leaves it to go on."""

    def __init__(self, output: pathlib.Path, job: dict, progress: bool | Progress = False):
        self._progress = progress
        self.path = output.with_name(f".{output.name}.capture")
        self._job = json.loads(json.dumps({"layout": LAYOUT, **job}))

    def __enter__(self) -> pathlib.Path:
        note = self.path / "job.json"
        self._made = [parent for parent in self.path.parents if not parent.exists()]  # the nearest first
        try:
            same = json.loads(note.read_text("utf-8")) == self._job
        except (OSError, ValueError):
            same = False
        if not same:
            shutil.rmtree(self.path, ignore_errors=True)
            self.path.mkdir(parents=True)
            with atomic_path(note) as temporary:
                temporary.write_text(json.dumps(self._job), encoding="utf-8")
        return self.path

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        ended = isinstance(self._progress, Reporter) and self._progress.error is not None  # by the caller
        if kind is None or (issubclass(kind, ValueError | FileNotFoundError) and not ended):
            shutil.rmtree(self.path, ignore_errors=True)
        if kind is not None:
            with contextlib.suppress(OSError):  # one that holds something
                for parent in self._made:
                    parent.rmdir()


def require_new_folder(path: pathlib.Path) -> None:
    """Refuse an output that is there already, or that cannot be made."""
    if path.is_dir():
        if any(path.iterdir()):
            raise InputError(f"output folder {str(path)!r} is there and not empty: give a new one, or remove it")
    elif path.exists() or path.is_symlink():
        raise InputError(f"output folder {str(path)!r} is a file: give a new one, or remove it")
    check_parent(path)


def publish(new: pathlib.Path, output: pathlib.Path) -> None:
    """Put a finished folder in its place, where nothing is, or an empty folder."""
    if output.is_dir():
        output.rmdir()  # empty, or this fails
    os.replace(new, output)


#: Fewest features that a usual picture must have.
MIN_FEATURES = 40

#: As MIN_STEP of `pick_frames`, where an object turns before a still wall, which most of a picture shows.
TURNTABLE_STEP = 0.1 * MIN_STEP

#: Bounds of the options.
MAX_FRAMES, MIN_SIZE, MAX_SIZE = 2000, 100, 8000


@reports_progress
def capture(
    path: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    pictures: str | os.PathLike[str] | Sequence[str] | None = None,
    masks: bool | str | os.PathLike[str] = True,
    turntable: bool = False,
    frames: int = 120,
    feature_size: int = 800,
    seed: int = 0,
    progress: bool | Progress = True,
) -> CaptureReport:
    """Make a scene of a video or of a folder of pictures: find the cameras, undistort the pictures.

    Of a video, sharp frames are picked that stand evenly along the way of the view. Their cameras are found by COLMAP
    (Schoenberger and Frahm 2016; the extra `capture`): neighbours and frames that look alike are
    compared, of a small folder all pictures. Pictures of one size, maker, model and focal length share a camera.
    Cameras are found all at once (GLOMAP, Pan et al. 2024), and picture by picture where the matches disagree with
    those. The scene is written with +z up, the object around the origin and its box two units long, in the format
    "transforms" of `load_scene`: images/, transforms.json, points.ply; and capture.md, capture.json, contact.png,
    box.png and seen.png, which say how good it is, where the object is and what was seen. The folder appears whole or
    not at all.

    What has been done is kept in a hidden folder beside the output until the end. After an interrupt or a kill the same
    call continues there.

    Args:
        path: A video that FFmpeg reads, or a folder of pictures (JPEG, PNG, WebP, BMP, TIFF). Their turns are obeyed:
            EXIF orientation and the rotation of a video.
        output: The folder to write, new or empty.
        pictures: Names of the pictures of the folder to use, with or without endings: a list, or a text file with one
            a line. None is all.
        masks: What hides parts of the pictures, in which no features are looked for: a folder with NAME.png or
            NAME.jpg.png for picture NAME.jpg (of a video frame_00012.png, for its frame 12, counted from 0), or one
            picture for all. True takes `masks` in the folder of pictures or beside it, `dynamic_mask_NAME.png` beside a
            picture, and the pictures' own opacity, by the rules of `load_scene`; False looks at whole pictures. The
            scene has masks/ and dynamic_mask_NAME.png, and so do fits.
        turntable: Whether an object turns before a camera that stands still: what stays at its pixels does not count.
        frames: Most frames of a video that are taken.
        feature_size: Longer side at which features are looked for, pixels; larger pictures are shrunk for that. More
            finds cameras more exactly, and takes longer.
        seed: Seed of COLMAP's random numbers. The same pictures, up to 200, give the same cameras on the same machine.
        progress: Whether bars are shown, and before the matches about how long it takes. A function is called with
            (done, total, step), total 0 where it is not known, and ends the work by returning False or by raising.

    Returns:
        What was found.

    Raises:
        FileNotFoundError: Where there is no such file or folder, or no picture in it.
        ValueError: For an output that is there, a video that cannot be read, and pictures whose cameras cannot be
            found: too few, too little texture, no overlap; and cameras that come out wrong, torn in parts or inside
            out, by the matches. The message says what to do. Also for names in `pictures` that are not in the folder,
            and where pycolmap is not installed; for masks of another size than their pictures, or of none of them.
        Cancelled: Where `progress` returned False. The same call continues there.

    Warns:
        UserWarning: For pictures and frames that cannot be read, and for pictures without a camera.
    """
    source, output = checked_path(path, "the capture"), checked_path(output, "the output folder")
    frames = checked_whole(frames, "frames", MIN_PICTURES, MAX_FRAMES)
    feature_size = checked_whole(feature_size, "feature_size", MIN_SIZE, MAX_SIZE)
    seed = checked_whole(seed, "seed", 0, 2**31 - 1)
    if not source.exists():
        raise MissingFileError(f"video or folder {str(source)!r} is not there")
    if source.is_file() and source.suffix.lower() in ENDINGS:
        raise InputError(f"{str(source)!r} is one picture: give a folder of pictures, or a video; {HOW_TO}")
    require_new_folder(output)
    chosen = None if pictures is None else sorted(set(chosen_names(pictures)))
    if chosen is not None and not source.is_dir():
        raise InputError(f"pictures chooses from a folder of pictures, and {str(source)!r} is a video: give frames")
    turntable = checked_flag(turntable, "turntable")
    masked = bool(masks) if isinstance(masks, bool | np.bool_) else checked_path(masks, "masks")
    load_pycolmap()
    job = {
        "source": str(source.resolve()),
        "files": _stamps(source),
        "pictures": chosen,
        "masks": [masked if isinstance(masked, bool) else str(masked.resolve()), *_mask_stamps(source, masked)],
        "turntable": turntable,
        "frames": frames,
        "feature_size": feature_size,
        "seed": seed,
        "pycolmap": importlib.metadata.version("pycolmap"),
    }
    with WorkFolder(output, job, progress) as work:
        given = _Given(source, output, work, chosen, masked, turntable, frames, feature_size, seed, progress)
        return _capture(given)


@dataclasses.dataclass(frozen=True)
class _Given:
    """What is captured, and how: the arguments of `capture`, checked."""

    source: pathlib.Path
    output: pathlib.Path
    work: pathlib.Path  # the hidden folder
    pictures: list[str] | None
    masks: bool | pathlib.Path
    turntable: bool
    frames: int
    feature_size: int
    seed: int
    progress: bool | Progress

    @property
    def is_video(self) -> bool:
        """Whether the source is a video, not a folder."""
        return not self.source.is_dir()


def _capture(given: _Given) -> CaptureReport:
    source, output, work, feature_size = given.source, given.output, given.work, given.feature_size
    facts: dict[str, object] = {}
    sources = _video_sources(given, facts) if given.is_video else read_sources(source, given.pictures)
    _require_several(len(sources), source, given.is_video)
    masks = masks_of(source, sources, given.masks)
    names, sharp = shrink_all(sources, work / "small", feature_size, given.progress)
    solution = _find(given, sources, masks, names, facts)
    found = placed(solution.found)
    facts["share_of_matches_that_agree"] = round(solution.agreement.share, 4)
    box = object_box(found)
    facts["object"] = f"{box_text(box.bounds)}, {box.reason}"

    new = work / "scene"
    shutil.rmtree(new, ignore_errors=True)
    new.mkdir()
    size, reshaped = write_scene(new, sources, sharp, found, feature_size, masks=masks, progress=given.progress)
    if reshaped:
        facts["pictures_cut_or_turned_to_that_size"] = reshaped
    to_pixels = 1.0 / shrink_factor(size, feature_size)
    kept = [source.name for source in sources]
    cameras = cameras_of(found)
    seen = find_coverage(cameras, np.zeros(3))
    report = make_report(output, source.name or str(source), kept, sharp, found, size, to_pixels, facts, seen)
    report.advice.extend(doubts(solution, kept))
    if given.turntable and (masks is None or not all(mask.opacity or mask.ignored for mask in masks)):
        report.advice.append(
            "What stands still was left out where cameras were looked for, and is in the pictures: before a fit, which "
            "would take it to turn around the object, write masks/NAME.png for each, white where the object is."
        )
    write_png(new / "box.png", draw_box(cameras, found.points, box))
    write_png(new / "seen.png", draw_coverage(seen, cameras, box.bounds))
    _write_contact_sheet(new / "contact.png", [work / "small" / name for name in names], report)
    (new / "capture.json").write_text(report.to_json(), encoding="utf-8")
    (new / "capture.md").write_text(report.to_markdown(), encoding="utf-8")
    publish(new, output)
    if report.left_out:
        warnings.warn(
            f"{len(report.left_out)} of {len(sources)} pictures "
            f"{agreed(len(report.left_out), 'has no camera and is', 'have no camera and are')} left out "
            f"({listed(report.left_out, 4)}): they overlap too little with the others, show something else, or are "
            "blurred",
            stacklevel=3,
        )
    return report


def _stamps(source: pathlib.Path) -> list[list[object]]:
    """Names, sizes and times of the files of a capture, which identify it."""
    files = sorted(source.iterdir()) if source.is_dir() else [source]
    return [[file.name, file.stat().st_size, file.stat().st_mtime_ns] for file in files if file.is_file()]


def _mask_stamps(source: pathlib.Path, masks: bool | pathlib.Path) -> list[list[object]]:
    """The same of the masks of a capture."""
    homes = [masks] if isinstance(masks, pathlib.Path) else [source / "masks", source.parent / "masks"] if masks else []
    return [stamp for home in homes if home.exists() for stamp in _stamps(home)]


def _require_several(count: int, source: pathlib.Path, video: bool) -> None:
    if count >= MIN_PICTURES:
        return
    if video:
        raise InputError(
            f"video {str(source)!r} shows {counted(count, 'different view')}: cameras are found where the view moves; "
            f"{HOW_TO}"
        )
    raise InputError(
        f"{str(source)!r} holds {counted(count, 'picture')}: cameras are found of at least {MIN_PICTURES}, "
        f"and 30 or more are better; {HOW_TO}"
    )


def _video_sources(given: _Given, facts: dict[str, object]) -> list[Source]:
    """The picked frames of a video, written as pictures."""
    video, work, progress = given.source, given.work, given.progress
    scores = _kept_scores(video, work / "scores.npz", progress)
    picked = pick_frames(scores, given.frames, TURNTABLE_STEP if given.turntable else MIN_STEP)
    facts["frames_of_the_video"] = len(scores.times)
    facts["frames_that_cannot_be_decoded"] = scores.broken
    if scores.transfer:
        facts["tone_mapped"] = f"from {scores.transfer} (BT.2100) to sRGB"
        warnings.warn(
            f"{str(video)!r} is of high dynamic range ({scores.transfer}): its frames are tone-mapped to sRGB",
            stacklevel=3,
        )
    if len(picked) < MIN_PICTURES:
        return [Source(str(k), video, scores.size, None, (), False) for k in picked]  # too few to be worth writing
    folder = work / "frames"
    folder.mkdir(exist_ok=True)
    names = [f"frame_{index:05d}" for index in picked]
    files = [folder / f"{name}.jpg" for name in names]
    write_frames(video, scores.times[picked], files, progress=progress)
    return [
        Source(name, file, scores.size, None, (scores.size,), False) for name, file in zip(names, files, strict=True)
    ]


def _kept_scores(video: pathlib.Path, file: pathlib.Path, progress: bool | Progress) -> FrameScores:
    """The measures of a video's frames, from an earlier run where there was one."""
    if file.is_file():
        kept = np.load(file)
        width, height, broken = (int(value) for value in kept["numbers"])
        transfer = str(kept["transfer"]) if "transfer" in kept else ""
        return FrameScores(kept["times"], kept["sharpness"], kept["way"], (width, height), broken, transfer)
    scores = scan_video(video, progress=progress)
    with atomic_path(file) as temporary:
        numbers = np.array([*scores.size, scores.broken])
        np.savez(
            temporary,
            times=scores.times,
            sharpness=scores.sharpness,
            way=scores.way,
            numbers=numbers,
            transfer=np.array(scores.transfer),
        )
    return scores


def _find(
    given: _Given,
    sources: Sequence[Source],
    masks: Sequence[PictureMask] | None,
    names: list[str],
    facts: dict[str, object],
) -> Solution:
    """Cameras and points, from an earlier run where there was one."""
    source, work, feature_size = given.source, given.work, given.feature_size
    small = [work / "small" / name for name in names]
    share = None if masks is None else write_feature_masks(work / "masks", sources, masks, small)
    if share is not None:
        facts["share_of_pixels_that_count"] = round(share, 4)
    sizes = [image_size(file) for file in small]
    cameras = list(dict.fromkeys(each.camera for each in sources))
    groups = [cameras.index(each.camera) for each in sources]
    first = [groups.index(camera) for camera in range(len(cameras))]
    focals = [
        None if (focal := sources[k].focal) is None else focal * shrink_factor(sources[k].size, feature_size)
        for k in first
    ]
    solver = Solver(
        work / "database.db",
        work / "small",
        names,
        groups,
        focals,
        [sizes[k] for k in first],
        masks=None if share is None else work / "masks",
        seed=given.seed,
        progress=given.progress,
    )
    kept, labels = work / "model", [each.name for each in sources]
    if kept.is_dir() and given.turntable:
        solver.leave_out_still()
    if kept.is_dir():
        return solve(solver, work / "mapping", source, labels, kept)
    _require_features(given, solver.find_features(), "" if share is None else " in what masks leave of them")
    if given.turntable:
        had, left = solver.leave_out_still().T
        facts["share_of_features_that_stand_still"] = round(1.0 - float(left.sum()) / max(float(had.sum()), 1.0), 4)
        _require_features(given, left, f" that turns, where {had.sum() - left.sum()} features stay at their pixels")
    pairs, alike = solver.match(video=given.is_video)
    if not alike:
        raise InputError(
            f"no two pictures of {str(source)!r} show the same ({pairs} pairs were compared): {HOW_TO}; what shines or "
            "moves cannot be matched"
        )
    return solve(solver, work / "mapping", source, labels, kept)


def _require_features(given: _Given, counts: np.ndarray, where: str) -> None:
    """Raises ValueError for pictures of too few features."""
    usual = float(np.median(counts))
    if usual < MIN_FEATURES:
        help_by = (
            "a pattern on the object, or on the turntable under it"
            if given.turntable
            else "something with a pattern around the object, such as a newspaper under it,"
        )
        raise InputError(
            f"the pictures of {str(given.source)!r} have too little detail to match{where}, {usual:.0f} features each: "
            f"more light, sharper pictures, or {help_by} help"
        )


def _write_contact_sheet(path: pathlib.Path, files: Sequence[pathlib.Path], report: CaptureReport) -> None:
    """The sheet of all pictures, or of some of them evenly where they are many."""
    from PIL import Image

    chosen = np.unique(np.linspace(0, len(files) - 1, min(len(files), MAX_THUMBNAILS)).round().astype(int))
    thumbnails = []
    for index in chosen:
        picture = Image.open(files[index])
        picture.thumbnail((THUMBNAIL, THUMBNAIL))
        thumbnails.append(np.asarray(picture.convert("RGB")))
    write_png(path, make_contact_sheet(thumbnails, [report.registered[index] for index in chosen]))
