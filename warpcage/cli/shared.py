"""What commands share: fields, cages and views from their arguments."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import hashlib
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..cage.axes import with_up
from ..cage.cage import Cage
from ..cage.pose_file import PoseFile, cage_hash, is_preset
from ..cage.up_axis import object_points
from ..core.arrays import box_corners
from ..core.devices import resolve_device
from ..core.files import read_json, require_file
from ..core.names import BACKGROUNDS, TRANSPARENT
from ..deform.deformer import Deformer
from ..deform.fill import fill_unseen
from ..deform.stage import Stage
from ..editor.document import MAIN
from ..editor.session import FORMAT as SESSION_FORMAT
from ..editor.session import read_session
from ..edits.edits import MAX_EDITS, MOST_CELLS, CageEdit, picture_cells
from ..edits.stage_file import STAGE_ENDING
from ..edits.words import EditWords
from ..errors import InputError
from ..field.voxel_field import VoxelField
from ..mesh.queries import inside_mesh
from ..scene.load import load_scene
from ..scene.scene import Scene
from ..splats.io import is_splat_file, splat_path
from ..splats.io.formats import endings_written
from ..splats.splat_field import AnyField, SplatField, load_field
from ..view.camera import Camera
from ..view.frame import Frame
from .arguments import options
from .words import Keyframes, only_pose, parse_edit, posed_up, read_edits_file, read_rest


@dataclasses.dataclass(frozen=True)
class PosedEdit:
    """One edit, and the poses that its cage goes through (None for an edit that removes)."""

    edit: CageEdit
    keyframes: Keyframes | None

    def at(self, place: float) -> Cage | None:
        """The cage at a place, 0 at rest and 1 the first pose; after its last pose it stays. None: it is removed."""
        if self.keyframes is None:
            return None
        return self.keyframes.at(min(place, len(self.keyframes.cages) - 1.0))

    @property
    def film(self) -> PoseFile | None:
        """Keys at times, None where the poses follow one another evenly."""
        return None if self.keyframes is None else self.keyframes.film


class Deformation:
    """Edits in the order in which they act, at least one, each with its poses."""

    def __init__(self, parts: Sequence[PosedEdit]):
        self.parts = list(parts)
        self.edits = [part.edit for part in self.parts]
        # The cage at rest and the poses of the edit that has most of them.
        self.pose_count = max((len(part.keyframes.cages) for part in self.parts if part.keyframes), default=1)

    @property
    def posed(self) -> list[Cage | None]:
        """The last pose of each edit, None for one that removes."""
        return self.at(self.pose_count - 1.0)

    def at(self, place: float) -> list[Cage | None]:
        """The cages at a place between the poses: 0 at rest, 1 the first pose, and so on."""
        return [part.at(place) for part in self.parts]

    @property
    def film(self) -> PoseFile | None:
        """The keys at times that last longest, None where no edit has any."""
        films = [part.film for part in self.parts if part.film is not None]
        return max(films, key=lambda film: film.length, default=None)

    @property
    def camera_film(self) -> PoseFile | None:
        """The first keys at times that hold cameras too, None where none do."""
        return next((part.film for part in self.parts if part.film is not None and part.film.cameras), None)

    def at_time(self, seconds: float) -> list[Cage | None]:
        """The cages at a time of the film. Those without keys at times stay at their last pose."""
        return [
            part.at(self.pose_count - 1.0) if part.film is None else part.film.at_time(seconds) for part in self.parts
        ]

    @property
    def is_still(self) -> bool:
        """Whether nothing moves: the scene is the field as it is."""
        return not any(part.edit.remove or _moves(part) for part in self.parts)

    def drawn(self, cages: Sequence[Cage | None]) -> list[Cage]:
        """The cages that an overlay shows: posed ones, and at rest those whose content is removed."""
        return [edit.cage if cage is None else cage for edit, cage in zip(self.edits, cages, strict=True)]

    @property
    def vertices(self) -> np.ndarray:
        """(n, 3) vertices of all cages, at rest and posed, world units."""
        cages = [part.edit.cage for part in self.parts]
        cages += [cage for part in self.parts if part.keyframes for cage in part.keyframes.cages]
        return np.concatenate([cage.vertices for cage in cages])

    def fingerprints(self) -> dict[str, list[str]]:
        """Hashes of the edits, "cage", and of their poses, "posed": all that decides how the scene moves."""
        words = ([e.keep_source, e.remove, e.falloff, e.held, e.fragments] for e in self.edits)
        cages = [_hash([cage_hash(edit.cage), *each]) for edit, each in zip(self.edits, words, strict=True)]
        return {"cage": cages, "posed": [_pose_hash(part) for part in self.parts]}


def read_deformation(
    args: argparse.Namespace, field: VoxelField | SplatField, interpolation: str | None = None
) -> Deformation | None:
    """The deformation that a command's options name, None where nothing is deformed; the field tells the axes of cage
    files. interpolation: "smooth" or "linear", between several poses of an edit; None takes one pose an edit."""
    ways = [f"--{name}" for name in ("cage", "edit", "edits") if getattr(args, name) is not None]
    if len(ways) > 1:
        raise InputError(f"{ways[0]} and {ways[1]} do not go together: name each cage of several by --edit")
    if args.posed is not None and args.cage is None:
        raise InputError("--posed needs --cage, the same cage at rest")
    if args.cage is not None:
        if args.posed is None and not getattr(args, "overlay", False):
            raise InputError(
                "--cage and --posed go together: the cage at rest and the same cage posed (--overlay shows it at rest)"
            )
        texts = args.posed if isinstance(args.posed, list) else [args.posed or "rest"]
        return Deformation([_read_edit(EditWords(args.cage, texts[0]), texts, args, interpolation, field)])
    if args.edits is not None:
        return edits_of_file(args.edits, args, interpolation, field)
    words = [parse_edit(text) for text in args.edit or ()]
    return numbered_edits(words, args, interpolation, field) if words else None


def edits_of_file(
    path: str, args: argparse.Namespace, interpolation: str | None, field: VoxelField | SplatField
) -> Deformation:
    """The deformation of an edits file, or of a session of the editor."""
    if is_session(path):
        return session_edits(path, interpolation)[0]
    return numbered_edits(read_edits_file(path), args, interpolation, field)


def numbered_edits(
    words: Sequence[EditWords],
    args: argparse.Namespace,
    interpolation: str | None,
    field: VoxelField | SplatField | None = None,
) -> Deformation:
    """The deformation of several edits; messages say which is wrong. Without a field axes are those of the formats."""
    if len(words) > MAX_EDITS:
        raise InputError(f"a scene takes at most {MAX_EDITS} edits, got {len(words)}")
    parts = []
    for number, edit in enumerate(words, 1):
        with _named(f"edit {number} of {len(words)}"):
            texts = [] if edit.posed is None else [edit.posed]
            parts.append(_read_edit(edit, texts, args, interpolation, field, part=True))
    return Deformation(parts)


def is_deformed(args: argparse.Namespace) -> bool:
    """Whether options name a deformation."""
    return any(getattr(args, name, None) is not None for name in ("cage", "edit", "edits"))


def is_session(path: str) -> bool:
    """Whether a file of --edits is a session of the editor. Raises for a file that is not there or no JSON."""
    file = require_file(path, "edits file")
    try:
        return read_json(file, "edits file").get("format") == SESSION_FORMAT
    except ValueError as error:
        raise InputError(f"{file}: {error}") from None


def _own_or_all(own: float | None, args: argparse.Namespace, name: str) -> float:
    """What an edit says for itself, or else what an option says for all edits."""
    return (getattr(args, name, None) or 0.0) if own is None else own


def _read_edit(
    words: EditWords,
    texts: list[str],
    args: argparse.Namespace,
    interpolation: str | None,
    field: VoxelField | SplatField | None,
    part: bool = False,
) -> PosedEdit:
    """An edit with the cages that its words name. texts: words of --posed; part: whether it is one of several."""
    name = words.object or args.cage_object
    rest, expected = read_rest(words.cage, words.up or args.cage_up, field, part=part, name=name)
    texts = [with_up(text, None if field is None else field.up.tolist()) if is_preset(text) else text for text in texts]
    falloff = 0.0 if words.remove else _own_or_all(words.falloff, args, "falloff")
    if words.held != "cut" and not falloff and not words.remove:
        raise InputError("held names the walls that an edit fades towards: give it a falloff=WIDTH, or leave held out")
    size = _own_or_all(words.fragments, args, "fragments")
    edit = CageEdit(rest, words.keep, words.remove, falloff, words.held, size)
    if words.remove:
        return PosedEdit(edit, None)
    up, timed = words.up or posed_up(args), getattr(args, "timed", False)
    keyframes = Keyframes(
        rest, texts, interpolation or "smooth", up, expected, timed=timed, fps=getattr(args, "film_rate", None)
    )
    if interpolation is None and len(keyframes.cages) > 2:
        keyframes.cages[1:] = [only_pose(rest, texts[0], up, keyframes.cages[1:])]
    return PosedEdit(edit, keyframes)


def session_edits(path: str, interpolation: str | None = None) -> tuple[Deformation, list[str]]:
    """The visible edits of a session's own field, in the poses that it was left in, and a line on each edit."""
    visible = [edit for edit in read_session(path).edits_of(MAIN) if edit.visible]
    if not visible:
        raise InputError(f"{path}: the session has no visible edit")
    parts = []
    for edit in visible:
        with _named(f"{path}: edit {edit.name!r}"):
            cage_edit, keyframes = edit.cage_edit, None
            if not cage_edit.remove:
                keyframes = Keyframes(cage_edit.cage, [], interpolation or "smooth")
                posed = cage_edit.cage.with_vertices(edit.posed)
                posed.require_usable("the posed cage")
                keyframes.cages.append(posed)
            parts.append(PosedEdit(cage_edit, keyframes))
    return Deformation(parts), [f"{edit.name}: {edit.kind}" for edit in visible]


@contextlib.contextmanager
def _named(what: str) -> Iterator[None]:
    """Put a name before what is wrong."""
    try:
        yield
    except ValueError as error:
        raise InputError(f"{what}: {error}") from error


def _moves(part: PosedEdit) -> bool:
    """Whether a cage has a pose that is another than the cage at rest."""
    cages = [] if part.keyframes is None else part.keyframes.cages
    return any(
        cage is not part.edit.cage and not np.array_equal(cage.vertices, part.edit.cage.vertices) for cage in cages
    )


def _pose_hash(part: PosedEdit) -> str:
    """A hash of the poses of an edit."""
    keyframes = part.keyframes
    if keyframes is None:
        return ""
    preset = None if keyframes.preset is None else (keyframes.preset.family, keyframes.amounts)
    film = keyframes.film
    moments = None if film is None else (sorted(film.times.items()), sorted(film.easings.items()))
    return _hash([*map(cage_hash, keyframes.cages), preset, moments])


def _hash(parts: Sequence[object]) -> str:
    """sha256 of the texts of some values."""
    return hashlib.sha256("\n".join(map(str, parts)).encode()).hexdigest()


def chosen_device(args: argparse.Namespace) -> wp.Device:
    return resolve_device(args.device)


def read_field(args: argparse.Namespace) -> AnyField:
    """The field file of a command, voxels or splats, on the chosen device; sets `args.straightening`, and `args.up`
    where --up is not given."""
    args.field = str(splat_path(args.field))
    require_file(args.field, "field file")  # before Warp starts, which takes a while
    if is_splat_file(args.field):
        require_field_scale(args)
    elif getattr(args, "antialias", None) is not None:
        raise InputError(f"--antialias is for files of splats, got {args.field!r}")
    elif getattr(args, "map", None) == "forward":
        raise InputError(f"--map forward is for files of splats, voxels are looked up backward, got {args.field!r}")
    field = load_field(args.field, scene_scale=args.scene_scale, device=chosen_device(args))
    if getattr(args, "up", field) is None:  # a command with a view
        args.up = tuple(field.up)
    args.straightening = field.straightening  # cameras of scenes are moved by it
    return field


def read_scene(args: argparse.Namespace, background: str | ArrayLike, orient: str | None = None) -> Scene:
    """The scene folder of a command, by its --split, --downscale, --format and --masks. See `load_scene`."""
    return load_scene(
        args.scene,
        split=args.split,
        downscale=args.downscale,
        format=args.format,
        background=background,
        masks=args.masks,
        orient=orient,
        cameras=args.cameras,
        model=args.model,
    )


def is_field(path: str) -> bool:
    """Whether a file is a field: voxels (.npz) or splats."""
    return path.lower().endswith(".npz") or is_splat_file(path)


def splat_outputs() -> tuple[str, ...]:
    """Endings of files of splats that are written, those of other packages last."""
    return tuple(dict.fromkeys([*options.SPLAT_ENDINGS, *endings_written()]))


def is_stage(path: str) -> bool:
    """Whether a file is that of a stage, by its ending."""
    return path.lower().endswith(STAGE_ENDING)


def require_voxels(field: AnyField, what: str) -> VoxelField:
    """A field of voxels. Raises ValueError for splats; what: what is asked for, as the message begins."""
    if isinstance(field, SplatField):
        raise InputError(f"{what} is for fields of voxels (.npz), this one is of splats")
    return field


def scene_masks(path: str, field: AnyField) -> dict[str, Any]:
    """The masks of a scene's object and their cameras, as `select_nodes` takes them: of its training pictures, in the
    world of a field."""
    scene = load_scene(path, orient=field.straightening)
    if scene.alphas is None:
        raise InputError(f"the pictures of scene {path!r} have no opacity to take as masks")
    masks = scene.alphas
    if scene.weights is not None:  # the object may be wherever pixels do not say that it is not
        masks = np.where(scene.weights > 0.0, masks, 1.0)
    return {"masks": [scene.cut(index, mask) for index, mask in enumerate(masks)], "cameras": scene.cameras}


def require_field_scale(args: argparse.Namespace) -> None:
    """Raises ValueError for --scene-scale where no field takes it."""
    if getattr(args, "scene_scale", 1.0) != 1.0 and not str(args.field).lower().endswith(".npz"):
        raise InputError(f"--scene-scale is for fields (.npz), got {args.field!r}")


def require_deformation(args: argparse.Namespace, what: str) -> None:
    """Raises ValueError where no cage is given for something that needs one; what: how the message calls it."""
    if not is_deformed(args):
        alone = " (or --cage alone, at rest)" if what == "--overlay" else ""
        raise InputError(f"{what} needs a deformation: --cage and --posed{alone}, --edit or --edits")


#: Points of an object that --frame posed looks at, and the share of them that lies out of the cages by chance.
FRAMED_POINTS, LEAST_STAYING = 5000, 0.005


def visible_points(field: AnyField, deformation: Deformation | None, frame: str | None) -> np.ndarray:
    """(n, 3) points around what a picture shows, world units: vertices of the cages at rest and posed (frame "posed")
    with what lies in none of them and stays, else the corners of the field's box."""
    # Usually the field at rest, so that pictures before and after an edit, and of all its poses, can be compared.
    if deformation is not None and frame == "posed":
        seen = staying = object_points(field, FRAMED_POINTS)
        for edit in deformation.edits:
            staying = staying[~inside_mesh(staying, edit.cage)]
        few = len(staying) <= LEAST_STAYING * len(seen)
        return deformation.vertices if few else np.concatenate([deformation.vertices, staying])
    return box_corners(field.shown_bounds if isinstance(field, SplatField) else field.bounds)


def make_deformer(field: AnyField, deformation: Deformation, args: argparse.Namespace) -> Deformer:
    """The Deformer of the deformation options, not posed yet."""
    options = {"coordinates": args.coordinates, "resolution": lattice_cells(args), "density": args.density}
    return Deformer(field, deformation.edits, **options, map=args.map)


def lattice_cells(args: argparse.Namespace) -> int | None:
    """The lattice of --resolution, None for none; the finest usual one where `set_lattice` chose none."""
    return MOST_CELLS if args.resolution == options.BY_SIZE else args.resolution


def set_lattice(args: argparse.Namespace, camera: Camera) -> None:
    """Choose the lattice by the size of a camera's picture, where --resolution is not given."""
    if args.resolution == options.BY_SIZE:
        args.resolution = picture_cells(camera)


def posed_renderer(field: AnyField, deformation: Deformation | None, args: argparse.Namespace) -> AnyField | Deformer:
    """What renders the scene: the field itself, or a posed Deformer where something is deformed."""
    if deformation is None or deformation.is_still:
        return field
    return make_deformer(field, deformation, args).pose(deformation.posed)


def is_transparent(args: argparse.Namespace) -> bool:
    """Whether pictures have opacity instead of a background; refuses both, and unknown ones, before any long work."""
    known = (*BACKGROUNDS, TRANSPARENT)
    if isinstance(args.background, str) and args.background not in known:
        raise InputError(
            f"--background {args.background!r} is not known: {', '.join(known)}, or three numbers in [0, 1] such as "
            "0.2,0.3,0.4"
        )
    if args.transparent and args.background not in (None, TRANSPARENT):
        raise InputError("--transparent cannot be combined with --background: give one of them")
    return args.transparent or args.background == TRANSPARENT


def render_view(renderer: AnyField | Deformer | Stage, camera: Camera, args: argparse.Namespace) -> Frame:
    """The view of a camera before the chosen background; what no picture showed is filled where --fill asks for it."""
    splats = {} if args.antialias is None else {"antialias": args.antialias}
    frame = renderer.render(camera, **background_option(args), **splats)
    if not args.fill or frame.reveal is None or isinstance(renderer, Stage):
        return frame
    field = renderer.field if isinstance(renderer, Deformer) else renderer
    return fill_unseen(frame, require_voxels(field, "--fill"), camera)


def require_fillable(args: argparse.Namespace, field: AnyField) -> None:
    """Raises ValueError where --fill has nothing to fill."""
    if not args.fill:
        return
    require_deformation(args, "--fill")
    if args.background is not None or args.transparent:
        raise InputError("--fill continues the field's own background: it cannot be combined with --background")
    if field.background_model is None:
        raise InputError("--fill: behind this field there is one colour, so that nothing is missing where it shows")


def drawn_cages(renderer: AnyField | Deformer, deformation: Deformation | None) -> list[Cage]:
    """The cages that an overlay shows: as the Deformer has them, whose held walls stay at rest."""
    if deformation is None:
        return []
    posed = renderer.deformed if isinstance(renderer, Deformer) else None
    return deformation.drawn(deformation.posed if posed is None else posed)


def background_option(args: argparse.Namespace) -> dict:
    """The option `background` of a render, empty where the field's own is taken."""
    if is_transparent(args):
        return {"background": TRANSPARENT}
    return {} if args.background is None else {"background": args.background}
