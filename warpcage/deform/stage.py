"""Stage: several objects in one scene, each in its place, rendered together, saved in one file, and merged."""

from __future__ import annotations

import dataclasses
import os
import pathlib
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..cage.cage import Cage
from ..core.arrays import box_corners, empty_array
from ..core.checks import checked_flag, checked_number, checked_path, checked_whole, listed, renamed, require_type
from ..core.devices import HeldOnDevice, launch, resolve_device
from ..core.files import PathLike, require_file
from ..core.threads import in_turn
from ..edits.edits import CageEdit
from ..edits.place import Place, PlaceFile, as_places, seen_from
from ..edits.stage_file import deformation_json, read_deformation, read_stage_file, write_stage_file
from ..errors import InputError
from ..field.mixing import mixed_field
from ..field.render import RenderOptions, StageKeywords, View, picture_arrays, render_options, takes_options
from ..field.voxel_field import VoxelField
from ..kernels.view.compose import compose_objects
from ..render.surface_mesh import SurfaceMesh, load_object
from ..splats.io.axes import placed
from ..splats.io.contents import joined
from ..splats.splat_field import SplatField
from ..view.camera import Camera
from ..view.frame import MASK_NAMES, PART_NAMES, Frame, part_type
from .bake import MAX_RESOLUTION, STAND_IN_RESOLUTION, bake
from .deformer import Deformer
from .objects import SceneObject, field_of, render_object

if TYPE_CHECKING:
    from typing_extensions import Unpack  # of the type checker

#: Cells of the lattice on which a field without edits is moved: a similarity is exact on any.
PLACING_CELLS = 16

#: Distance of the cage that moves a field from all that it holds, as a share of the field's size.
STAND_OFF = 0.05


@dataclasses.dataclass
class StageItem:
    """One object of a stage; see `Stage.add`."""

    scene_object: SceneObject
    places: PlaceFile
    path: pathlib.Path | None  # the file of its field, None where that is not known
    hidden: bool = False

    @property
    def field(self) -> VoxelField | SplatField | SurfaceMesh:
        """Its field or mesh, without cages."""
        return field_of(self.scene_object)

    @property
    def bounds(self) -> np.ndarray:
        """(2, 3) box of what it shows, cages too, in its own coordinates."""
        field = self.field
        boxes = [field.shown_bounds if isinstance(field, SplatField) else field.bounds]
        posed = self.scene_object.deformed if isinstance(self.scene_object, Deformer) else None
        boxes += [cage.bounds for cage in posed or [] if cage is not None]
        return np.stack([np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)])


class Stage(HeldOnDevice):
    """Several objects in one scene: fields, meshes, and Deformers of those, each in its place.

    Each is rendered by a camera in its coordinates, and the pictures are composited ray by ray in order of depth. That
    is exact where objects are solid, or apart along the ray. Haze of two objects in one place is not mixed: the one of
    the smaller mean depth comes first (`merged` mixes voxels). Meshes follow the same rule.

    The surroundings, layers or an outer field, are those of the first object that has some; the colour behind all is
    the first object's. One thread at a time uses a Stage.

    References: Porter and Duff, "Compositing Digital Images" (SIGGRAPH 1984).

    Example::

        stage = Stage().add("room", "room.npz").add("cup", "cup.ply", place=Place((0.4, 0, 0), turn=(0, 0, 90)))
        frame = stage.render(camera)

    Args:
        device: Warp device. None is that of the first object, or for files CUDA where there is one.

    Attributes:
        device: Warp device, None before there is an object.
        items: What it holds, by name, in the order in which it was added.
        time: Seconds at which places that move are taken.
    """

    def __init__(self, *, device: wp.DeviceLike = None):
        self.device: wp.Device | None = None if device is None else resolve_device(device)
        self.items: dict[str, StageItem] = {}
        self.time = 0.0

    def __len__(self) -> int:
        return len(self.items)

    def __repr__(self) -> str:
        return f"Stage({listed(self.items, none='empty')})"

    def __getitem__(self, name: str) -> SceneObject:
        return self._item(name).scene_object

    @renamed(scene_object="thing")
    def add(
        self,
        name: str,
        scene_object: SceneObject | PathLike,
        *,
        place: Place | PlaceFile | ArrayLike | PathLike | None = None,
        path: PathLike | None = None,
    ) -> Stage:
        """Put an object on the stage.

        Args:
            name: Its name, which no other object has.
            scene_object: A VoxelField, a SplatField, a SurfaceMesh or a Deformer of one, whose pose may change later;
                or the file of a field or a mesh.
            place: Where it stands: a Place, a PlaceFile, a similarity (4, 4), or a place file. None is where it is.
            path: The file of the field or mesh, for `save`. None is `scene_object` where that is a file.

        Returns:
            This Stage.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: For a name that is there already or empty, another kind of object, a place that is none, or a
                Deformer on another device.
        """
        if not isinstance(name, str) or not name.strip():
            raise InputError(f"an object of a stage needs a name, got {name!r}")
        if name in self.items:
            raise InputError(f"the stage has an object {name!r} already: remove it first, or take another name")
        places = as_places(place)
        if not isinstance(scene_object, VoxelField | SplatField | SurfaceMesh | Deformer):
            path = require_file(checked_path(scene_object, "an object of a stage"), "field file")
            scene_object = load_object(path, device=self.device)
        self.items[name] = StageItem(
            self._here(name, scene_object), places, None if path is None else pathlib.Path(path)
        )
        return self

    @renamed(scene_object="thing")
    def replace(self, name: str, scene_object: SceneObject) -> Stage:
        """Put another object in the place of one, such as a Deformer in that of its field.

        Args:
            name: Name of the object.
            scene_object: The other object. Where its field is another one too, the stage does not know its file.

        Returns:
            This Stage.

        Raises:
            ValueError: As `add`, and for a name that is not there.
        """
        item = self._item(name)
        kept = item.path if field_of(scene_object) is item.field else None
        self.items[name] = dataclasses.replace(item, scene_object=self._here(name, scene_object), path=kept)
        return self

    def remove(self, name: str) -> Stage:
        """Take an object off the stage.

        Args:
            name: Name of the object.

        Returns:
            This Stage.

        Raises:
            ValueError: For a name that is not there.
        """
        self._item(name)
        del self.items[name]
        return self

    def place(self, name: str, place: Place | PlaceFile | ArrayLike | PathLike | None) -> Stage:
        """Put an object elsewhere.

        Args:
            name: Name of the object.
            place: As for `add`.

        Returns:
            This Stage.

        Raises:
            ValueError: For a name that is not there, or a place that is none.
        """
        self._item(name).places = as_places(place)
        return self

    def hide(self, name: str, hidden: bool = True) -> Stage:
        """Show an object no more, or again: it is neither rendered nor merged.

        Args:
            name: Name of the object.
            hidden: False shows it again.

        Returns:
            This Stage.

        Raises:
            ValueError: For a name that is not there.
        """
        self._item(name).hidden = checked_flag(hidden, "hidden")
        return self

    @property
    def length(self) -> float:
        """Seconds from 0 to the last key of a place, 0 where nothing moves."""
        return max((item.places.length for item in self.items.values()), default=0.0)

    @property
    def shown_points(self) -> np.ndarray:
        """(n, 3) float64 corners of the boxes of all that is shown, at `time`, cages too; world units of the stage."""
        return np.concatenate([self._placed(item).moved(box_corners(item.bounds)) for item in self._shown().values()])

    @property
    def up(self) -> np.ndarray:
        """(3,) unit vector: what is up for the first object."""
        item = next(iter(self._shown().values()))
        return self._placed(item).rotation @ item.field.up

    @takes_options(StageKeywords)
    def render(self, camera: Camera, **options: Unpack[StageKeywords]) -> Frame:
        """The view of a camera of all that is not hidden, at `time`.

        Args:
            camera: The camera, in the coordinates of the stage.
            options: Options of the frame by keyword, see docs/python.md.

        Returns:
            The frame, its arrays on the device. Depth is in world units of the stage, the mean over objects by the
            light that comes from each; masks are those of Deformers, dimmed by what is before them.

        Raises:
            ValueError: For a stage that shows nothing, and as `Deformer.render`.
        """
        return self._render(camera, render_options(options, StageKeywords))

    def _render(self, camera: Camera, options: RenderOptions) -> Frame:
        """See `render`."""
        items = list(self._shown().values())
        sides = [each.field.supersampling for each in items if not isinstance(each.field, SplatField)]
        around = next((each for each in items if each.field.background_model is not None), None)
        model = None if around is None or options.background is not None else around.field.background_model
        color = options.color(items[0].field.background if model is None else np.zeros(3, np.float32))
        assert self.device is not None
        view = View(camera, options, color, max(sides, default=1), self.device)
        cameras = [seen_from(self._placed(item), view.rays) for item in items]
        alone = options.of_object()
        frames = [render_object(item.scene_object, each, alone) for item, each in zip(items, cameras, strict=True)]
        scales = [self._placed(item).scale for item in items]
        unit = None if around is None or model is None else self._placed(around).scale
        arrays, depth = self._composed(frames, scales, color, unit)
        if around is not None and model is not None:
            masks = [array for name, array in arrays.items() if name not in PART_NAMES]
            model.add_around(seen_from(self._placed(around), view.rays), arrays["rgb"], arrays["alpha"], depth, masks)
        return view.finished(arrays, is_layered=model is not None)

    @in_turn
    def _composed(
        self, frames: Sequence[Frame], scales: Sequence[float], color: np.ndarray, unit: float | None
    ) -> tuple[dict[str, Any], wp.array]:
        """The arrays of frames of several objects as one before a colour, and its depth in units; an empty array for
        None of them."""
        assert self.device is not None
        device, count, objects = self.device, frames[0].width * frames[0].height, len(frames)
        names = [name for name in MASK_NAMES if any(name in frame.arrays for frame in frames)]
        seen = {name: empty_array(objects * count, part_type(name), device) for name in PART_NAMES}
        masks = wp.zeros(len(names) * objects * count, dtype=wp.float32, device=device)
        for index, frame in enumerate(frames):
            for name, array in seen.items():
                wp.copy(array, frame.arrays[name], dest_offset=index * count, count=count)
            for place, name in enumerate(names):
                if name in frame.arrays:
                    offset = (place * objects + index) * count
                    wp.copy(masks, frame.arrays[name], dest_offset=offset, count=count)
        made = picture_arrays(count, PART_NAMES, device)
        around = empty_array(0 if unit is None else count, wp.float32, device)
        mask = empty_array((len(names), count), wp.float32, device)
        sizes = wp.array(np.asarray(scales, np.float32), dtype=wp.float32, device=device)
        behind, stacked = wp.vec3(*map(float, color)), [array.reshape((objects, count)) for array in seen.values()]
        inputs = [sizes, behind, unit or 1.0, *stacked, masks.reshape((len(names), objects, count))]
        launch(compose_objects, count, inputs, [*(made[name] for name in PART_NAMES), around, mask], device=device)
        return made | {name: mask[place] for place, name in enumerate(names)}, around

    def save(self, path: PathLike) -> None:
        """Write the stage as one file: places, cages and poses in it, fields by the names of theirs.

        Args:
            path: The file; it must end in .stage.json. Fields are named relative to its folder.

        Raises:
            ValueError: For another ending, an empty stage, or a field whose file is not known.
        """
        path = checked_path(path, "the scene file")
        folder = path.absolute().parent
        write_stage_file(path, (_item_json(name, item, folder) for name, item in self.items.items()))

    @classmethod
    def load(cls, path: PathLike, *, device: wp.DeviceLike = None) -> Stage:
        """Read a stage file, and the fields that it names.

        Args:
            path: The file.
            device: Warp device. None is CUDA where there is one.

        Returns:
            The stage.

        Raises:
            FileNotFoundError: If the file, or one that it names, is not there.
            ValueError: What is wrong in which file.
        """
        path, stage = require_file(path, "scene file"), cls(device=resolve_device(device))
        for entry in read_stage_file(path):
            scene_object: SceneObject = load_object(path.parent / entry["field"], device=stage.device)
            if "deformation" in entry:
                try:
                    options, edits, poses = read_deformation(entry["deformation"])
                    scene_object = Deformer(scene_object, edits, **options).pose(poses)
                except ValueError as error:
                    raise InputError(f"{path}: object {entry['name']!r}: {error}") from None
            stage.add(entry["name"], scene_object, place=entry["place"], path=path.parent / entry["field"])
            stage.hide(entry["name"], entry.get("hidden", False))
        return stage

    def merged(
        self, *, resolution: int | None = None, convert: Callable[[VoxelField], SplatField] | None = None
    ) -> VoxelField | SplatField:
        """All that is not hidden, at `time`, as one field in the coordinates of the stage.

        Voxels are looked up anew on one grid, as `bake` does it: densities add up, and colours are their mean by
        density. Splats are moved and put into one list, those of lower degrees with zeros. The rest, what lies around
        too, is the first object's that has surroundings, or else the first object's.

        Args:
            resolution: Of voxels: how many along the longest side of all. None takes voxels as small as the smallest.
            convert: What makes splats of voxels where the stage holds both, such as `warpcage.to_splats`. None refuses
                such a stage.

        Returns:
            The field, on the stage's device.

        Raises:
            ValueError: For a stage that shows nothing or a mesh, voxels and splats without `convert`, surroundings of a
                object that is not in its own place, or a grid that memory does not hold.
        """
        items: list[Any] = list(self._shown().values())
        meshes = [name for name, each in self._shown().items() if isinstance(each.field, SurfaceMesh)]
        if meshes:
            raise InputError(f"{listed(meshes)}: meshes are not merged with fields, hide or remove them first")
        main = next((each for each in items if each.field.background_model is not None), items[0])
        kinds = {isinstance(each.field, SplatField) for each in items}
        if len(kinds) > 1 and convert is None:
            raise InputError("a stage of voxels and splats is merged as splats: give convert=warpcage.to_splats")
        if True in kinds:
            if resolution is not None:
                raise InputError("splats are merged one by one: leave resolution out")
            return self._merged_splats(items, main, convert)
        place = self._placed(main)
        options = main.field.view_options()
        if place != Place():
            if options["background_model"] is not None:
                raise InputError("what lies around a field cannot be moved: leave it in place, and move other objects")
            options = {**options, "up": place.rotation @ main.field.up, "straightening": None}
        return self._merged_voxels(items, options, resolution)

    def _merged_splats(self, items: list[StageItem], main: StageItem, convert: Any) -> SplatField:
        """`merged` as splats."""
        fields: list[SplatField] = []
        for item in items:
            scene_object: Any = item.scene_object
            if isinstance(item.field, VoxelField):
                scene_object = convert(bake(scene_object) if isinstance(scene_object, Deformer) else scene_object)
                require_type(scene_object, SplatField, "convert must make")
            fields.append(scene_object.baked() if isinstance(scene_object, Deformer) else scene_object)
        places = [self._placed(item) for item in items]
        moved = [
            placed(field.contents, place.rotation, place.position, place.scale)
            for field, place in zip(fields, places, strict=True)
        ]
        first = next((item.field for item in items if isinstance(item.field, SplatField)), None)
        options = {
            "background": main.field.background,
            "up": self._placed(main).rotation @ main.field.up,
            "antialias": first is not None and first.antialias,
        }
        return SplatField.from_contents(joined(moved), device=self.device, **options)

    def _merged_voxels(self, items: list[Any], options: dict[str, Any], resolution: int | None) -> VoxelField:
        """`merged` as voxels; options: of views of it."""
        boxes = [self._placed(item).moved(box_corners(_reached(item.scene_object))) for item in items]
        low, high = np.min(boxes, axis=(0, 1)), np.max(boxes, axis=(0, 1))
        longest = float((high - low).max())
        side = min(self._placed(item).scale * float(item.field.voxel_size.min()) for item in items)
        if resolution is not None:
            side = longest / checked_whole(resolution, "resolution", 2, MAX_RESOLUTION)
        elif longest / side > MAX_RESOLUTION:
            raise InputError(
                f"voxels of {side:.3g} along {longest:.4g} units are more than {MAX_RESOLUTION}: give a resolution"
            )
        shape = np.maximum(np.ceil((high - low) / side - 1e-6), 2).astype(int).tolist()
        baked = [self._baked(item, low, side) for item in items]
        assert self.device is not None
        return mixed_field(baked, low, side, shape, self.device, **options)

    def _baked(self, item: StageItem, origin: np.ndarray, side: float) -> VoxelField:
        """An object of voxels where it stands, on the grid of all of them. origin: (3,) its lower corner."""
        scene_object, place, field = item.scene_object, self._placed(item), item.field
        assert isinstance(field, VoxelField)
        reached = _reached(scene_object)
        pad = STAND_OFF * float((reached[1] - reached[0]).max())
        cage = Cage.box(reached[0] - pad, reached[1] + pad)
        edits: list[CageEdit] = []
        poses: list[Cage | None] = []
        options: dict[str, Any] = {"coordinates": "mean_value", "resolution": PLACING_CELLS}
        if isinstance(scene_object, Deformer):  # the move is one more edit, so that voxels are looked up once
            edits, poses = scene_object.edits, _poses(scene_object)
            options = {
                "coordinates": scene_object.coordinates,
                "resolution": scene_object.resolution or STAND_IN_RESOLUTION,
            }
            options["density"] = scene_object.density
        deformer = Deformer(field, [*edits, CageEdit(cage)], device=self.device, **options)
        deformer.pose([*poses, cage.with_vertices(place.moved(cage.vertices))])
        box = place.moved(box_corners(reached))
        begin, end = _cells(np.stack([box.min(axis=0), box.max(axis=0)]), origin, side)
        baked = bake(deformer, int((end - begin).max()), np.stack([origin + side * begin, origin + side * end]))
        if options.get("density") == "paper" and place.scale != 1.0:  # an object looks the same at any size
            opaque = baked.grid.density.numpy() / np.float32(place.scale)
            return VoxelField(baked.bounds, baked.grid.links, opaque, baked.grid.sh, device=self.device)
        return baked

    def _here(self, name: str, scene_object: Any) -> SceneObject:
        """An object on the stage's device, which the first one decides."""
        field = field_of(scene_object)
        if not isinstance(field, VoxelField | SplatField | SurfaceMesh):
            raise InputError(
                "a stage holds VoxelFields, SplatFields, SurfaceMeshes, Deformers of those and their files, got "
                f"{type(field).__name__}"
            )
        if self.device is None:
            self.device = scene_object.device
        if not isinstance(scene_object, Deformer):
            return scene_object.to(self.device)
        if scene_object.device != self.device:
            raise InputError(f"object {name!r} is a Deformer on {scene_object.device}, the stage is on {self.device}")
        return scene_object

    def _item(self, name: str) -> StageItem:
        if name not in self.items:
            raise InputError(f"the stage has no {name!r}, only {listed(self.items, none='nothing')}")
        return self.items[name]

    def _placed(self, item: StageItem) -> Place:
        return item.places.at(checked_number(self.time, "the time of a stage"))

    def _shown(self) -> dict[str, StageItem]:
        """What is not hidden, at least one."""
        shown = {name: item for name, item in self.items.items() if not item.hidden}
        if not shown:
            raise InputError("the stage shows nothing: add an object, or show one again")
        return shown


def _reached(scene_object: SceneObject) -> np.ndarray:
    """(2, 3) box of all voxels of an object, posed, in its own coordinates."""
    return scene_object.reached_bounds if isinstance(scene_object, Deformer) else scene_object.bounds


def _cells(box: np.ndarray, origin: np.ndarray, side: float) -> tuple[np.ndarray, np.ndarray]:
    """First and last (exclusive) cell, (3,) each, of a grid that a box (2, 3) reaches into."""
    first, last = np.floor((box[0] - origin) / side + 1e-6), np.ceil((box[1] - origin) / side - 1e-6)
    return first.astype(int), np.maximum(last, first + 2).astype(int)


def _poses(deformer: Deformer) -> list[Cage | None]:
    """The posed cages of a Deformer, at rest where it was not posed."""
    return deformer.deformed or [None if edit.remove else edit.cage for edit in deformer.edits]


def _item_json(name: str, item: StageItem, folder: pathlib.Path) -> dict[str, Any]:
    """An object as the file has it."""
    if item.path is None:
        raise InputError(f"the file of {name!r} is not known: save its field, and add it with path=FILE")
    try:
        field = pathlib.PurePath(os.path.relpath(item.path, folder)).as_posix()
    except ValueError:  # on another drive
        field = str(item.path.absolute())
    content: dict[str, Any] = {"name": name, "field": field, "place": item.places.to_json()}
    if item.hidden:
        content["hidden"] = True
    if isinstance(scene_object := item.scene_object, Deformer):
        options = {name: getattr(scene_object, name) for name in ("coordinates", "resolution", "density", "store")}
        if isinstance(scene_object.field, SplatField):
            options["map"] = scene_object.map
        content["deformation"] = deformation_json(options, scene_object.edits, _poses(scene_object))
    return content
