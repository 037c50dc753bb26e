"""Cameras of pictures by COLMAP (Schoenberger and Frahm 2016): pairs, matching, mapping, what was found."""

from __future__ import annotations

import contextlib
import dataclasses
import pathlib
import shutil
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from ...core.names import counted, extra_line
from ...core.reports import Progress, shows_bars
from ...core.threads import cpu_threads
from ...errors import InputError
from ...scene.camera_check import MIN_GROUP
from ...scene.pictures import COEFFICIENTS, distort
from .feature_masks import still_features
from .sources import StepBar


@dataclasses.dataclass(frozen=True)
class Lens:
    """A camera of a reconstruction."""

    size: tuple[int, int]  # width and height of its pictures, pixels
    intrinsics: tuple[float, float, float, float]  # (fx, fy, cx, cy), pixels; the centre of the first one is (0.5, 0.5)
    distortion: tuple[float, ...]  # in the order of COEFFICIENTS

    def enlarged(self, factor: float, size: tuple[int, int]) -> Lens:
        """The same lens for pictures `factor` times as large, of `size` pixels, which begin at the same corner."""
        fx, fy, cx, cy = self.intrinsics
        return Lens(size, (fx * factor, fy * factor, cx * factor, cy * factor), self.distortion)


@dataclasses.dataclass(frozen=True)
class Found:
    """Cameras and points of a reconstruction, of k pictures of n."""

    pictures: np.ndarray  # (k,) int64, which of the pictures have a camera, ascending
    poses: np.ndarray  # (k, 4, 4) float64, camera to world, OpenCV axes
    lenses: list[Lens]  # k; pictures of one camera share theirs
    points: np.ndarray  # (m, 3) float64, world units
    colors: np.ndarray  # (m, 3) uint8
    views: np.ndarray  # (m,) int64, pictures that each point was found in
    counts: np.ndarray  # (k,) int64, points that each picture shows
    errors: np.ndarray  # (k,) float64, mean distance of where a picture shows its points from their projections, pixels
    error: float  # the same over all pictures

    def moved(self, rotation: np.ndarray, center: np.ndarray, scale: float) -> Found:
        """The same in other coordinates, x -> scale * rotation @ (x - centre): rotation (3, 3), centre (3,)."""
        poses = self.poses.copy()
        poses[:, :3, :3] = rotation @ self.poses[:, :3, :3]
        poses[:, :3, 3] = scale * (self.poses[:, :3, 3] - center) @ rotation.T
        return dataclasses.replace(self, poses=poses, points=scale * (self.points - center) @ rotation.T)


def found_of(model: Any, names: Sequence[str]) -> Found:
    """The cameras of a pycolmap Reconstruction in the order of `names`, those of all pictures, and its points."""
    images = {image.name: image for image in model.images.values() if image.has_pose}
    pictures = np.array([k for k, name in enumerate(names) if name in images], np.int64)
    chosen = [images[names[k]] for k in pictures]
    lenses = {number: _lens(camera) for number, camera in model.cameras.items()}
    poses = np.tile(np.eye(4), (len(chosen), 1, 1))
    for pose, image in zip(poses, chosen, strict=True):
        pose[:3] = image.cam_from_world().inverse().matrix()
    points = [model.points3D[number] for number in sorted(model.points3D)]
    place = np.array([point.xyz for point in points]).reshape(-1, 3)
    rows = {image.image_id: row for row, image in enumerate(chosen)}
    seen = np.array(
        [(k, rows[e.image_id], e.point2D_idx) for k, point in enumerate(points) for e in point.track.elements], np.int64
    ).reshape(-1, 3)
    counts, errors, total = np.zeros(len(chosen), np.int64), np.zeros(len(chosen)), 0.0
    for row, image in enumerate(chosen):
        mine = seen[seen[:, 1] == row]
        keypoints = image.points2D
        there = np.array([keypoints[index].xy for index in mine[:, 2]]).reshape(-1, 2)
        distance = np.linalg.norm(_project(lenses[image.camera_id], poses[row], place[mine[:, 0]]) - there, axis=1)
        counts[row], errors[row] = len(mine), distance.mean() if len(mine) else np.inf
        total += float(distance.sum())
    return Found(
        pictures,
        poses,
        [lenses[image.camera_id] for image in chosen],
        place,
        np.array([point.color for point in points], np.uint8).reshape(-1, 3),
        np.bincount(seen[:, 0], minlength=len(points)),
        counts,
        errors,
        total / max(len(seen), 1),
    )


def _lens(camera: Any) -> Lens:
    """A camera of SIMPLE_RADIAL or RADIAL, the models that are asked for."""
    focal, cx, cy, *radial = (float(value) for value in camera.params)
    distortion = (*radial, *[0.0] * (len(COEFFICIENTS) - len(radial)))
    return Lens((int(camera.width), int(camera.height)), (focal, focal, cx, cy), distortion)


def _project(lens: Lens, pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(n, 2) pixels of points (n, 3) in the picture of a lens."""
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    x, y = distort(local[:, 0] / local[:, 2], local[:, 1] / local[:, 2], lens.distortion)
    fx, fy, cx, cy = lens.intrinsics
    return np.stack([fx * x + cx, fy * y + cy], axis=1)


#: Features of a picture by which likeness is judged: the largest ones, which other views show too (Wu 2013).
LARGEST = 300

#: A descriptor is the same as its nearest one where the second is farther by this ratio (Lowe 2004).
RATIO = 0.85

#: Fewer of these than this is chance.
MIN_ALIKE = 5

#: Frames of a video are compared with this many after them, and besides with those at powers of two.
NEIGHBORS = 10

#: Other pictures that each one is compared with, where not all are.
MAX_ALIKE = 20

#: Folders of so many pictures are compared whole.
SMALL_FOLDER = 32


def largest_features(scales: np.ndarray, descriptors: np.ndarray) -> np.ndarray:
    """Descriptors (n, 128) uint8 of the largest features of a picture, by their sizes (n,), as unit vectors.
    Returns (k, 128) float32, k at most LARGEST."""
    chosen = np.argsort(-scales, kind="stable")[:LARGEST]
    return unit_vectors(descriptors[chosen])


def unit_vectors(descriptors: np.ndarray) -> np.ndarray:
    """Descriptors (k, 128) as float32 of length 1."""
    vectors = descriptors.astype(np.float32)
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-6)


def likeness(first: np.ndarray, second: np.ndarray) -> int:
    """How many features of two pictures agree, each the other's nearest and clearly nearer than the next.
    They are unit vectors (k, 128) and (m, 128)."""
    if min(len(first), len(second)) < 2:
        return 0
    cosines = first @ second.T
    nearest, back = cosines.argmax(axis=1), cosines.argmax(axis=0)
    mutual = np.flatnonzero(back[nearest] == np.arange(len(first)))
    rows = cosines[mutual]
    two = np.partition(rows, -2, axis=1)[:, -2:]
    near, next_one = (np.sqrt(np.maximum(2.0 - 2.0 * two[:, k], 0.0)) for k in (1, 0))
    return int((near < RATIO * next_one).sum())


def neighbor_pairs(count: int) -> list[tuple[int, int]]:
    """Pairs of indices of frames, the smaller first: each with those that follow, and with some farther on."""
    steps = [*range(1, NEIGHBORS + 1)]
    while steps[-1] * 2 < count:
        steps.append(steps[-1] * 2)
    return [(k, k + step) for k in range(count) for step in steps if k + step < count]


def chosen_pairs(features: list[np.ndarray], *, video: bool) -> list[tuple[int, int]]:
    """The pairs of indices of pictures, the smaller first, in order, that are worth comparing in full.
    features: of each picture (k, 128) unit vectors from `largest_features`; video: pictures follow one another."""
    # All of a small folder; else the most alike, and neighbours in a video: views are tied where the camera comes back.
    count = len(features)
    every = [(a, b) for a in range(count) for b in range(a + 1, count)]
    if count <= SMALL_FOLDER and not video:
        return every
    alike = np.zeros((count, count), np.int32)
    for a, b in every:
        alike[a, b] = alike[b, a] = likeness(features[a], features[b])
    pairs = set(neighbor_pairs(count)) if video else set()
    most = MAX_ALIKE // 2 if video else MAX_ALIKE
    for a in range(count):
        best = np.argsort(-alike[a], kind="stable")[:most]
        pairs |= {(min(a, int(b)), max(a, int(b))) for b in best if alike[a, b] >= MIN_ALIKE}
    return sorted(pairs)


#: Processor seconds that a pair takes to match, and that each product of its two numbers of features adds; seconds that
#: each feature of a pair adds to what one thread then takes to find the cameras: 40 of bonsai and fox, 800 pixels long.
PAIR_SECONDS, PRODUCT_SECONDS, CAMERA_SECONDS = 0.044, 4e-9, 1e-5

#: From so many minutes on it is said what is quicker.
LONG_MINUTES = 5.0


def expected_seconds(features: np.ndarray, pairs: Sequence[tuple[int, int]], threads: int) -> float:
    """About how long pairs of pictures take to match, and the cameras after them, seconds.
    features: (n,) their number in each picture; pairs: indices of pictures."""
    first, second = np.asarray(features, np.float64)[np.array(pairs, np.int64).reshape(-1, 2)].T
    matching = PAIR_SECONDS * len(first) + PRODUCT_SECONDS * float((first * second).sum())
    return matching / threads + CAMERA_SECONDS * float((first + second).sum())


def time_line(pictures: int, pairs: int, seconds: float, threads: int) -> str:
    """One line that says how long it takes from before the matches on, and what is quicker where that is long."""
    minutes = max(1, round(seconds / 60))
    line = (
        f"{counted(pictures, 'picture')}, {counted(pairs, 'pair')} to match: about {counted(minutes, 'minute')} on "
        f"{counted(threads, 'core')}"
    )
    if seconds < 60 * LONG_MINUTES:
        return line
    return f"{line}; quicker: a smaller --feature-size, or fewer pictures (--pictures, of a video --frames)"


#: Features that a picture has at most.
MAX_FEATURES = 6000

#: Pictures and pairs that COLMAP takes at once: progress moves, and a killed run loses no more than this.
PICTURES_AT_ONCE, PAIRS_AT_ONCE = 8, 96

#: A camera with at least so many pictures gets the whole lens model and a principal point of its own.
PICTURES_FOR_LENS = 10

#: The principal point is freed where that takes this share of the mean squared error away: 0.0009 for a video with a
#: rolling shutter and its middle in the middle, 0.0034 and 0.015 for cameras whose middle is 1 to 3 % off.
MIN_GAIN = 0.002

#: The principal point lies within this share of the picture's sides of its middle, or it is left there.
MAX_OFF_CENTER = 0.1

#: Up to so many pictures the mapping runs on one thread, which takes hardly longer and always gives the same cameras.
MAX_ON_ONE_THREAD = 200

#: Groups of pictures that are distinguished where not all fit together.
MAX_GROUPS = 4

#: Focal length of a picture that says nothing of it, in longer sides: between phones and their videos.
DEFAULT_FOCAL = 0.9


def load_pycolmap() -> Any:
    """The module pycolmap, whose own messages are errors alone; ValueError where it is not installed."""
    try:
        import pycolmap
    except ImportError as error:
        raise InputError(f"finding cameras needs pycolmap: {extra_line('capture')}") from error
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL)
    return pycolmap


class Solver:
    """Finds the cameras of pictures."""

    def __init__(
        self,
        database: pathlib.Path,  # COLMAP's file; an earlier one is continued
        folder: pathlib.Path,  # of the pictures, all upright and no larger than features are looked for
        names: Sequence[str],  # file names, in order
        groups: Sequence[int],  # number of the camera of each picture
        focals: Sequence[float | None],  # pixels, of each camera; None where not known
        sizes: Sequence[tuple[int, int]],  # width and height of each camera's pictures
        *,
        masks: pathlib.Path | None = None,  # folder with NAME.png for each NAME, black where no feature counts
        seed: int = 0,
        progress: bool | Progress = False,
    ):
        self.colmap, self.masks = load_pycolmap(), masks
        self.database, self.folder, self.names = database, folder, list(names)
        self.groups, self.focals, self.sizes = list(groups), list(focals), list(sizes)
        self.seed, self.progress, self.threads = seed, progress, cpu_threads()
        self.colmap.set_random_seed(seed)

    def find_features(self) -> np.ndarray:
        """Find the features of all pictures that have none yet; returns (n,) their number for each picture."""
        colmap = self.colmap
        if not self.database.exists():
            self._import_pictures()
        options = colmap.FeatureExtractionOptions()
        options.num_threads, options.use_gpu = self.threads, False
        options.sift.max_num_features = MAX_FEATURES
        reading = {} if self.masks is None else {"reader_options": colmap.ImageReaderOptions(mask_path=self.masks)}
        counts = self._feature_counts()
        left = [name for name, count in zip(self.names, counts, strict=True) if count < 0]
        with self._begin(len(self.names), "features", done=len(self.names) - len(left)) as shown:
            for first in range(0, len(left), PICTURES_AT_ONCE):
                part = left[first : first + PICTURES_AT_ONCE]
                self._run(
                    colmap.extract_features,
                    self.database,
                    self.folder,
                    image_names=part,
                    extraction_options=options,
                    device=colmap.Device.cpu,
                    **reading,
                )
                shown.update(len(part))
        return np.maximum(self._feature_counts(), 0)

    def leave_out_still(self) -> np.ndarray:
        """Leave out the features that stay at their pixels, in a copy of the database that all further steps work on.
        Returns (n, 2) how many each picture had, and has left."""
        source, self.database = self.database, self.database.with_name("moving.db")
        if not self.database.exists():
            with self._opened(source) as database:
                numbers = self._numbers(database)
                keypoints = [np.asarray(_array(database.read_keypoints(number))) for number in numbers]
                described = [database.read_descriptors(number) for number in numbers]
            vectors = [unit_vectors(np.asarray(_array(each))) for each in described]
            still = still_features([each[:, :2] for each in keypoints], vectors)
            unfinished = source.with_name("unfinished.db")
            shutil.copy(source, unfinished)
            with self._opened(unfinished) as database:
                database.clear_keypoints()
                database.clear_descriptors()
                for number, points, each, left_out in zip(numbers, keypoints, described, still, strict=True):
                    each.data = np.ascontiguousarray(np.asarray(each.data)[~left_out])
                    database.write_keypoints(number, np.ascontiguousarray(points[~left_out]))
                    database.write_descriptors(number, each)
            unfinished.replace(self.database)
        before, after = (self._feature_counts(each) for each in (source, None))
        return np.stack([before, after], axis=1)

    def match(self, *, video: bool) -> tuple[int, int]:
        """Match the pairs of pictures that are worth it and have not been matched; video: pictures follow one another.
        Returns the number of the pairs, and of those that show the same."""
        colmap = self.colmap
        pairs, left = self._pairs(video)
        if shows_bars(self.progress):
            counts = self._feature_counts()
            seconds = expected_seconds(counts, left, self.threads)
            print(time_line(len(self.names), len(left), seconds, self.threads), file=sys.stderr)
        options, verification = colmap.FeatureMatchingOptions(), colmap.TwoViewGeometryOptions()
        options.num_threads, options.use_gpu = self.threads, False
        verification.ransac.random_seed = self.seed
        pairing, listed = colmap.ImportedPairingOptions(), self.database.with_name("pairs.txt")
        pairing.match_list_path = listed
        with self._begin(len(pairs), "matches", done=len(pairs) - len(left)) as shown:
            for first in range(0, len(left), PAIRS_AT_ONCE):
                part = left[first : first + PAIRS_AT_ONCE]
                listed.write_text("".join(f"{self.names[a]} {self.names[b]}\n" for a, b in part), encoding="utf-8")
                self._run(
                    colmap.match_image_pairs,
                    self.database,
                    matching_options=options,
                    pairing_options=pairing,
                    verification_options=verification,
                    device=colmap.Device.cpu,
                )
                shown.update(len(part))
        with self._opened() as database:
            _, inliers = database.read_two_view_geometry_num_inliers()
        return len(pairs), int((np.asarray(inliers) >= verification.min_num_inliers).sum())

    def verified_matches(self) -> tuple[list[np.ndarray], dict[tuple[int, int], np.ndarray]]:
        """Places (k, 2) of the features of all pictures, pixels, and by the indices of two pictures the (m, 2) features
        that match, as a geometry of these two alone explains."""
        with self._opened() as database:
            numbers = self._numbers(database)
            index = {number: k for k, number in enumerate(numbers)}
            places = [np.asarray(_array(database.read_keypoints(number)), np.float64)[:, :2] for number in numbers]
            matches = {}
            for pair, geometry in zip(*database.read_two_view_geometries(), strict=True):
                first, second = (index[number] for number in self.colmap.pair_id_to_image_pair(pair))
                rows = np.asarray(geometry.inlier_matches, np.int64).reshape(-1, 2)
                matches[min(first, second), max(first, second)] = rows if first < second else rows[:, ::-1]
        return places, matches

    def map_globally(self, folder: pathlib.Path) -> list[Any]:
        """The same as `map` by another way: focal lengths from all pairs, then all turns, then all places at once."""
        # GLOMAP (Pan et al. 2024): no order of pictures, so that no early mistake carries the rest along. Focal lengths
        # by the fundamental matrices of all pairs (Sweeney et al. 2015), written to a copy.
        colmap, database = self.colmap, folder / "calibrated.db"
        shutil.copy(self.database, database)
        calibration = colmap.ViewGraphCalibrationOptions(random_seed=self.seed, reestimate_relative_pose=False)
        self.run_in_thread(colmap.calibrate_view_graph, database, calibration)
        options, manager, stop = self._global_options(), colmap.ReconstructionManager(), threading.Event()
        opened = colmap.Database.open(database)
        try:
            with self._begin(None, "cameras") as shown:

                def step() -> None:
                    if stop.is_set():
                        raise InterruptedError  # ends the pipeline, which has no token
                    shown.update()

                pipeline = colmap.GlobalPipeline(options, opened, manager)
                pipeline.add_callback(colmap.GlobalPipelineCallback.MODEL_UPDATE_CALLBACK.value, step)
                self.run_in_thread(pipeline.run, cancel=stop.set)
        finally:
            opened.close()
        models = [colmap.Reconstruction(manager.get(k)) for k in range(manager.size())]
        return sorted(models, key=lambda model: -model.num_reg_images())

    def map(self, folder: pathlib.Path) -> list[Any]:
        """Find cameras and points from the matches, picture by picture; folder: an empty one for COLMAP's own files.
        Returns pycolmap Reconstructions, the largest first; several where the pictures fall apart into groups."""
        options = self._mapping_options()
        with self._begin(len(self.names), "cameras") as shown:
            found = self._run(
                self.colmap.incremental_mapping,
                self.database,
                self.folder,
                folder,
                options=options,
                initial_image_pair_callback=lambda: shown.update(2),
                next_image_callback=lambda: shown.update(),
            )
            models = sorted(found.values(), key=lambda model: -model.num_reg_images())
            if models:
                shown.update(min(models[0].num_reg_images(), len(self.names)) - shown.done)
        return models

    def refine(self, model: Any) -> Any:
        """A Reconstruction of `map` whose cameras and points are adjusted once more, with a loss that outliers hardly
        move (Cauchy)."""
        # The principal point of a lens stays in the middle, unless it explains clearly more when it is free: it is
        # hardly distinguished from a turn of the camera, so that rolling shutters and blur would move it about.
        freed = self._adjusted(model, free=True) if self._fixes_middle(model) else None
        gain = 0.0 if freed is None else 1.0 - mean_square(freed) / mean_square(model)
        return self._adjusted(model, free=gain > MIN_GAIN and _is_central(freed), robust=True)

    def _fixes_middle(self, model: Any) -> bool:
        """Whether each camera has pictures enough to find its principal point."""
        pictures = [image.camera_id for image in model.images.values() if image.has_pose]
        return min(pictures.count(camera) for camera in set(pictures)) >= PICTURES_FOR_LENS

    def _adjusted(self, model: Any, *, free: bool, robust: bool = False) -> Any:
        """A copy of a Reconstruction after bundle adjustment, with free principal points or without."""
        options = self.colmap.BundleAdjustmentOptions()
        options.refine_principal_point, options.print_summary = free, False
        options.ceres.solver_options.num_threads = self._mapping_threads
        options.ceres.solver_options.function_tolerance = 1e-7
        if robust:
            options.ceres.loss_function_type = self.colmap.LossFunctionType.CAUCHY
        copy, config = self.colmap.Reconstruction(model), self.colmap.BundleAdjustmentConfig()
        for number in copy.reg_image_ids():
            config.add_image(number)
        config.fix_gauge(self.colmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        # pycolmap.bundle_adjustment does the same, and turns COLMAP's messages on for good
        self.run_in_thread(self.colmap.create_default_bundle_adjuster(options, config, copy).solve)
        return copy

    # What these share

    _shown: StepBar | None = None  # of the step that is at work, or was last

    def _begin(self, total: int | None, step: str, *, done: int = 0) -> StepBar:
        self._shown = StepBar(total, step, self.progress, done=done)
        return self._shown

    def _import_pictures(self) -> None:
        """A database of cameras and pictures, in order: COLMAP itself would number them as its threads end."""
        colmap = self.colmap
        temporary = self.database.with_name("new.db")
        temporary.unlink(missing_ok=True)
        colmap.Database.open(temporary).close()
        for camera, (size, focal) in enumerate(zip(self.sizes, self.focals, strict=True)):
            names = [name for name, group in zip(self.names, self.groups, strict=True) if group == camera]
            model = "RADIAL" if len(names) >= PICTURES_FOR_LENS else "SIMPLE_RADIAL"
            options = colmap.ImageReaderOptions(camera_model=model, default_focal_length_factor=DEFAULT_FOCAL)
            if focal is not None:
                middle = f"{size[0] / 2},{size[1] / 2}"
                options.camera_params = f"{focal},{middle},0" + ",0" * (model == "RADIAL")
            colmap.import_images(
                temporary, self.folder, camera_mode=colmap.CameraMode.SINGLE, image_names=names, options=options
            )
        temporary.replace(self.database)

    @property
    def _mapping_threads(self) -> int:
        """One, as the order of sums and of what is drawn by lot hangs on threads; all of them where that takes long."""
        return 1 if len(self.names) <= MAX_ON_ONE_THREAD else self.threads

    def _mapping_options(self) -> Any:
        options = self.colmap.IncrementalPipelineOptions()
        options.num_threads = options.mapper.num_threads = self._mapping_threads
        options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = self.seed
        options.min_model_size, options.max_num_models = MIN_GROUP, MAX_GROUPS
        return options

    def _global_options(self) -> Any:
        options = self.colmap.GlobalPipelineOptions()
        mapper = options.mapper
        parts = (options, mapper, mapper.rotation_averaging, mapper.global_positioning, mapper.retriangulation)
        for part in parts:
            part.random_seed = self.seed
        options.num_threads = mapper.num_threads = self._mapping_threads
        mapper.bundle_adjustment.ceres.solver_options.num_threads = self._mapping_threads
        mapper.global_positioning.use_gpu = mapper.bundle_adjustment.ceres.use_gpu = False
        options.min_model_size, options.image_path = MIN_GROUP, self.folder
        return options

    def _pairs(self, video: bool) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
        """The pairs of indices of pictures that are worth matching, and those of them that have not been matched."""
        features = []
        with self._opened() as database:
            numbers = self._numbers(database)
            for number in numbers:
                scales = np.linalg.norm(np.asarray(_array(database.read_keypoints(number)))[:, 2:4], axis=1)
                features.append(largest_features(scales, np.asarray(_array(database.read_descriptors(number)))))
            pairs = chosen_pairs(features, video=video)
            return pairs, [(a, b) for a, b in pairs if not database.exists_two_view_geometry(numbers[a], numbers[b])]

    def _numbers(self, database: Any) -> list[int]:
        """COLMAP's numbers of the pictures, in the order of their names."""
        numbers = {image.name: image.image_id for image in database.read_all_images()}
        return [numbers[name] for name in self.names]

    def _feature_counts(self, path: pathlib.Path | None = None) -> np.ndarray:
        """(n,) features of each picture, of another database too; -1 where they have not been looked for."""
        with self._opened(path) as database:
            return np.array(
                [
                    database.num_keypoints_for_image(number) if database.exists_keypoints(number) else -1
                    for number in self._numbers(database)
                ]
            )

    @contextlib.contextmanager
    def _opened(self, path: pathlib.Path | None = None) -> Iterator[Any]:
        database = self.colmap.Database.open(path or self.database)
        try:
            yield database
        finally:
            database.close()

    def _run(self, function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        """Run a function of COLMAP that can be cancelled, in a thread: see `run_in_thread`."""
        token = self.colmap.CancellationToken()
        return self.run_in_thread(function, *arguments, cancel=token.cancel, cancellation_token=token, **options)

    def run_in_thread(
        self, function: Callable[..., Any], *arguments: Any, cancel: Callable[[], None] = lambda: None, **options: Any
    ) -> Any:
        """Run a function of COLMAP in a thread, while this one takes interrupts and reports progress; both end before
        this returns."""
        outcome: list[Any] = []
        failure: list[BaseException] = []

        ended = threading.Event()  # Python 3.11 takes a thread whose `join` is interrupted for one that has ended

        def work() -> None:
            try:
                outcome.append(function(*arguments, **options))
            except BaseException as error:
                failure.append(error)
            finally:
                ended.set()

        thread = threading.Thread(target=work, name="colmap")
        try:
            thread.start()
            while not ended.wait(0.1):
                if self._shown is not None:
                    self._shown.report()
        except BaseException:
            cancel()
            if thread.ident is not None:  # it was started
                ended.wait()
            raise
        if failure:
            raise failure[0]
        return outcome[0]


def mean_square(model: Any) -> float:
    """Mean squared distance, pixels squared, from points in the pictures of a Reconstruction to their projections."""
    total, count = 0.0, 0
    for image in model.images.values():
        if not image.has_pose:
            continue
        for point in image.points2D:
            if point.has_point3D():
                place = image.project_point(model.point3D(point.point3D_id).xyz)
                if place is not None:
                    total += float(((place - point.xy) ** 2).sum())
                    count += 1
    return total / max(count, 1)


def _is_central(model: Any) -> bool:
    """Whether the principal points of a Reconstruction lie near the middle of their pictures."""
    return all(
        abs(camera.principal_point_x / camera.width - 0.5) < MAX_OFF_CENTER
        and abs(camera.principal_point_y / camera.height - 0.5) < MAX_OFF_CENTER
        for camera in model.cameras.values()
    )


def _array(value: Any) -> Any:
    """The numbers of what COLMAP calls descriptors, which newer versions wrap."""
    return getattr(value, "data", value) if not isinstance(value, np.ndarray) else value
