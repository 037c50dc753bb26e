"""Load a scene of any known format."""

from __future__ import annotations

import os
import pathlib
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..core.checks import checked_path, listed
from ..core.files import seen_note
from ..core.reports import Progress, reports_progress
from ..errors import InputError, MissingFileError
from ..view.camera import CameraFile, rigid_motion
from ..view.frame import parse_background
from .formats.table import SceneFormat, candidates, format_named
from .parsing import PICTURE_ENDINGS
from .scene import Scene, rotation_to


@reports_progress
def load_scene(
    path: str | os.PathLike[str],
    *,
    split: str = "train",
    downscale: int = 1,
    format: str | None = None,
    background: str | ArrayLike = "white",
    masks: bool | str = True,
    orient: str | ArrayLike | None = None,
    cameras: str | os.PathLike[str] | None = None,
    model: str | None = None,
    progress: bool | Progress = False,
) -> Scene:
    """Read one split of a scene from disk.

    What the scene's files name must lie in its folder, by real paths: neither names nor links lead out of it. One kind
    of link may: that to a whole folder, directly in the scene's, as `images -> /captures/fox/images`. The format's own
    files (transforms.json, cameras.npz, sparse/0/cameras.bin) are opened by these names, whether links or not.

    Args:
        path: Folder of the scene.
        split: "train", "val" or "test" as the format has them. Where it has none, every eighth picture is "test", the
            others are "train", and "all" is both.
        downscale: Whole factor by which width and height shrink, by area averages of premultiplied colour. Where
            smaller copies of the pictures alone are there (images_4), it counts from the size that they are copies of.
        format: "blender" (NeRF-synthetic), "nsvf", "dtu" (IDR layout), "transforms" (nerfstudio, instant-ngp),
            "colmap", "polycam" (its raw data), "record3d", "arkitscenes", "stray" (Stray Scanner), "opensfm",
            "metashape", "bundler", "realityscan" (its .csv), "llff", or one that another package adds. None takes the
            first of these that fits.
        background: Colour put behind transparent pixels, a name or (3,) in [0, 1].
        masks: True makes mask files alphas, and what they hide the background: those that the format names, or else
            those in masks/ with the names of the pictures (NAME.png, NAME.jpg.png). "split" keeps what they hide as the
            scene's surroundings, which `fit` puts into layers behind the object. "weights" makes them `Scene.weights`:
            pictures stay whole, and what is black in a mask is ignored. False leaves the pictures whole. But for
            False, what is not black in `dynamic_mask_NAME.png` beside picture NAME is ignored, as instant-ngp does.
        orient: "up" turns the world about its origin so that what is up for the training cameras (`Scene.up`) is +z;
            `Scene.straightening` is the turn. A rigid (4, 4) moves the world by it: that of a scene or a field that was
            straightened, to read another split of its scene without its training pictures. None leaves the coordinates
            as the files have them.
        cameras: Camera file (.json) whose cameras the pictures get, by their names, as `RefinedCameras.save` writes
            them after a fit. They are in the world that `orient` leads to. None takes those of the scene's files.
        model: Which of several COLMAP models, by its folder such as "1" or "sparse/1", of several reconstructions of
            OpenSfM, by its number, or of several chunks of Metashape, by its label. None takes the one with most
            pictures, of COLMAP models one for pictures of the size that is there. Of ARKitScenes the folder of
            pictures; None takes that of the largest.
        progress: True shows a bar on stderr. A function is called with (done, total, message), in pictures, and
            cancels the work by returning False or by raising.

    Returns:
        The scene.

    Raises:
        FileNotFoundError: For a missing folder, split, image or camera file.
        ValueError: For contents that cannot be used.
        Cancelled: Where `progress` returned False.
    """
    folder = checked_path(path, "the scene")
    if not folder.is_dir():
        what = f"is a file{seen_note(folder)}" if folder.is_file() else "is not there"
        raise MissingFileError(f"scene folder {str(folder)!r} {what}")
    if int(downscale) != downscale or downscale < 1:
        raise InputError(f"downscale must be a whole number of at least 1, got {downscale}")
    found = holding_format(folder) if format is None else format_named(format)
    if masks not in (True, False, "split", "weights"):
        raise InputError(f"masks must be True, False, 'split' or 'weights', got {masks!r}")
    if isinstance(orient, str) and orient != "up":
        raise InputError(f"orient must be 'up', a rigid (4, 4), or None for the coordinates of files, got {orient!r}")
    motion = None if orient is None or isinstance(orient, str) else rigid_motion(orient, "orient")

    if model is not None and "model" not in found.options:
        raise InputError(f"model chooses among several that a scene holds: those of the format {found.name!r} hold one")
    chosen: dict[str, Any] = {} if model is None else {"model": model}
    if "progress" in found.options:
        chosen["progress"] = progress

    def read(name: str) -> Scene:
        color, factor = parse_background(background), int(downscale)
        return found.read(folder, split=name, downscale=factor, background=color, masks=masks, **chosen)

    scene = read(split)
    if isinstance(orient, str):
        motion = _straightening(scene if split == "train" else _other_split(read, scene))
    scene = scene if motion is None else scene.moved(motion, round_bounds=found.round_bounds)
    if cameras is None:
        return scene
    try:
        return scene.with_cameras(CameraFile.load(cameras))
    except ValueError as error:
        raise InputError(f"{cameras}: {str(error).removeprefix(f'{cameras}: ')}") from None


def _other_split(read: Callable[[str], Scene], scene: Scene) -> Scene:
    """The training split, by which all splits stay in one world; the scene itself where there is none."""
    try:
        return read("train")
    except FileNotFoundError:
        return scene


def _straightening(scene: Scene) -> np.ndarray | None:
    """The turn that makes a scene's up +z, None where it is."""
    return rotation_to(scene.up, np.array([0.0, 0.0, 1.0]))


def holding_format(path: str | os.PathLike[str]) -> SceneFormat:
    """The first format that fits a scene folder; ValueError, with what is nearest and what is there, where none is."""
    folder = pathlib.Path(path)
    for each in candidates():
        if each.is_scene(folder):
            return each
    there = listed(sorted(entry.name + "/" * entry.is_dir() for entry in folder.iterdir()), none="nothing")
    inner = next((entry for entry in sorted(folder.iterdir()) if entry.is_dir() and _is_scene(entry)), None)
    hint = "" if inner is None else f": give its folder {inner.name!r}, which is a scene"
    hint = scene_around(folder) or hint  # a folder of COLMAP's model, of pictures
    near = _said_of(folder, NOT_READ) or _nearest(folder) or _said_of(folder, dict([VIDEOS])) or UNKNOWN
    raise InputError(f"{str(folder)!r} is not a scene of a known format: {near}; it holds {there}{hint}")


#: What folders hold that is not read, by names of which one is enough, and what to do.
NOT_READ = {
    "*.sens": "ScanNet's .sens is not read: export color/, pose/ and intrinsic/ with its SensReader",
    "*_COLMAP_SfM.log": "Tanks and Temples as its authors publish it has poses without focal lengths and is not read: "
    "convert its pictures with ns-process-data, or find cameras with `warpcage capture`",
    "habitat/ mesh_semantic.ply": "Replica's own download holds meshes and no pictures: take renders of it (traj.txt)",
    "nerfstudio_models/": "a result of nerfstudio is not a scene: `ns-export gaussian-splat` writes its splats, and "
    "the scene is the folder that was given to ns-train",
}

#: What messages say of a folder of videos, and of one that nothing is known of.
VIDEOS = "*.mp4 *.mov *.MP4 *.MOV", "a video has no cameras: `warpcage capture VIDEO -o scene` finds them"
UNKNOWN = "`warpcage info` lists those that are known"

#: What folders of each format hold, to name what is missing in one that is almost a scene: folders end in a slash, of
#: names with | between them one is enough.
PARTS = {
    "colmap": "images/ sparse/0/|sparse/ sparse/0/cameras.bin|sparse/0/cameras.txt|sparse/cameras.* "
    "sparse/0/images.bin|sparse/0/images.txt|sparse/images.*",
    "blender": "transforms_train.json train/",
    "transforms": "transforms.json images/",
    "nsvf": "rgb/ pose/ intrinsics.txt",
    "dtu": "image/ cameras_sphere.npz|cameras.npz",
    "polycam": "keyframes/ keyframes/cameras/ keyframes/images/",
    "nerfies": "dataset.json camera/ rgb/",
    "record3d": "metadata.json|metadata rgb/|rgbd/",
    "arkitscenes": "lowres_wide.traj lowres_wide/ lowres_wide_intrinsics/",
    "stray": "odometry.csv camera_matrix.csv rgb/|rgb.mp4",
    "opensfm": "reconstruction.json images/",
    "metashape": "cameras.xml images/",
    "bundler": "bundle/bundle.out|bundle.out list.txt|bundle/list.txt",
    "llff": "poses_bounds.npy images/",
    "scannet": "color/ pose/ intrinsic/",
    "replica": "traj.txt|traj_w_c.txt results/|rgb/",
    "blendedmvs": "cams/*_cam.txt blended_images/|images/",
    "nerfpp": "train/rgb/ train/pose/ train/intrinsics/",
    "3dgs": "cameras.json cfg_args point_cloud/ point_cloud/iteration_*/point_cloud.ply",
}

#: Folders of pictures, which say nothing of a format by themselves.
PICTURES_ALONE = ("images/", "rgb/", "image/", "train/", "train/rgb/", "color/", "results/", "blended_images/")


def _said_of(folder: pathlib.Path, kinds: dict[str, str]) -> str:
    """The message of the first kind of which a folder holds one of the names; "" for none."""
    return next((said for names, said in kinds.items() if any(_holds(folder, name) for name in names.split())), "")


def _nearest(folder: pathlib.Path) -> str:
    """What the format that is nearest to a folder has of it, and what is missing; "" where none is near."""
    nearest, most = "", 0.0
    for form, parts in PARTS.items():
        found = [
            (part.split("|"), [name for name in part.split("|") if _holds(folder, name)]) for part in parts.split()
        ]
        there = [names[0] for _, names in found if names]
        missing = [" or ".join(names[:2]) for names, held in found if not held]
        if len(there) / len(found) > most and missing and set(there) - set(PICTURES_ALONE):
            verb = "is" if len(missing) == 1 else "are"
            nearest = f"nearest is {form}: it has {_joined(there)}, but {_joined(missing)} {verb} missing"
            most = len(there) / len(found)
    pictures = next((name for name in PICTURES_ALONE if _holds(folder, name)), None)
    if nearest:
        return nearest
    if pictures is None and not any(file.suffix.lower() in PICTURE_ENDINGS for file in folder.iterdir()):
        return ""
    place, where = (folder, "") if pictures is None else (folder / pictures, f" in {pictures}")
    return f"it has pictures{where}, but no cameras: `warpcage capture {place} -o scene` finds them"


def _holds(folder: pathlib.Path, name: str) -> bool:
    """Whether a folder holds a file, or a folder where the name ends in a slash; with * as in names of files."""
    return any(found.is_dir() == name.endswith("/") for found in folder.glob(name.rstrip("/")))


def _joined(names: list[str]) -> str:
    """ "a, b and c"."""
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))


def scene_around(path: pathlib.Path) -> str:
    """The hint for a file or folder that is part of a scene; "" for others."""
    above = [
        each for each in path.absolute().parents[:3] if "sparse" not in each.parts[-2:]
    ]  # COLMAP's has no pictures
    around = next(filter(_is_scene, above), None)
    return "" if around is None else f"; it is part of the scene {str(around)!r}: give that folder"


def _is_scene(folder: pathlib.Path) -> bool:
    """Whether a folder is a scene; no for one whose files cannot be read."""
    try:
        return any(each.is_scene(folder) for each in candidates())
    except (ValueError, OSError):
        return False
