"""SplatDeformer: Gaussian splats under posed cages."""

from __future__ import annotations

import os
import pathlib
import re
import warnings
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..cage.cage import Cage
from ..core.checks import checked_flag, checked_path, checked_whole, listed, require_type
from ..core.devices import resolve_device
from ..core.locks import owner_lock
from ..core.names import DENSITIES, SPLAT_MAPS, counted, require_coordinates, require_name
from ..edits.edits import CageEdit, checked_edits
from ..edits.falloff import FalloffBand
from ..kernels.splats.pose import LAW_DENSITY, LAW_RAYS
from ..lattice.buffers import StreamOrder
from ..splats.binding import turned_harmonics
from ..splats.io import splat_ending
from ..splats.io.contents import SplatContents, logits_of
from ..splats.io.ply import chosen_layout
from ..splats.splat_field import SplatDensity, SplatField, rotation_matrices
from ..view.camera import Camera
from ..view.frame import Frame, parse_background
from .deformer import Deformer
from .splat_edits import SplatEdits


class SplatDeformer(Deformer):
    """Gaussian splats as cages deform them. `Deformer(splat_field, cage)` makes one.

    Splats are matter, so that they move forward: each is bound to the cage at rest once, and a pose is one weighted sum
    a splat. Covariances follow by the map's Jacobian, J S J^T; harmonics turn by the rotation nearest to J; a splat
    that the pose bends is drawn in pieces; one at the wall of a cage goes and stays by its shares (docs/splats.md).

    References: Xu and Harada, "Deforming Radiance Fields with Cages" (ECCV 2022), Eq. 5, with the map of Joshi et al.
    2007, Ju et al. 2005 or Lipman et al. 2008 from the cage at rest to the posed one.
    Limitations: what an edit moves is carried through later edits as its centre goes, on a lattice; crumbs of edits are
    for voxels.

    Example::

        field = SplatField.load("scene.ply")
        cage = Cage.from_field(field)
        Deformer(field, cage).pose(cage.bend(40)).baked().save("bent.ply")

    Args:
        field: The splats.
        rest: A Cage around what is to be deformed, or a list of Cage or CageEdit, as for `Deformer`.
        coordinates: "harmonic", "mean_value" or "green".
        resolution: Cells along the longest side of a cage of lattices, on which harmonic coordinates are solved. None
            is 128. Mean value and Green coordinates need no lattice for one edit.
        density: "opacity" keeps how opaque the splat is to a ray that goes along, so that a part keeps its look when
            it is stretched. "paper" keeps matter per length: optical depth grows with the stretch (the root mean
            square over directions).
        device: Warp device. None is the field's.
        store: "map": splats keep the weights that they need in any case.
        map: "forward" or None; "backward" puts splats where voxels under the same cages would be (Newton's method on
            the lattices of `resolution` of the posed cages).

    Raises:
        ValueError: For names that do not exist, or a cage that cannot be used.

    Attributes:
        field: The SplatField, on the device.
        edits: The CageEdits in their order.
        deformed: The posed cages, one per edit, None for an edit that removes; None before the first pose.
    """

    field: SplatField  # pyright: ignore[reportIncompatibleVariableOverride]

    def __init__(
        self,
        field: SplatField,
        rest: Cage | CageEdit | Sequence[Cage | CageEdit],
        *,
        coordinates: str = "harmonic",
        resolution: int | None = 128,
        density: str = "opacity",
        device: wp.DeviceLike = None,
        store: str = "map",
        map: str | None = None,
    ):
        require_type(field, SplatField, "a SplatDeformer needs")
        self.coordinates = require_coordinates(coordinates)
        self.density = require_name(density, DENSITIES, "density")
        self.map = "forward" if map is None else require_name(map, SPLAT_MAPS, "map")
        if store != "map":
            raise ValueError(f'splats keep their weights: store must be "map", got {store!r}')
        self.store, self.resolution = store, resolution
        self.edits = checked_edits(rest)
        if any(edit.crumbs > 0.0 for edit in self.edits):
            raise ValueError("crumbs are for voxels: splats of a part that hang over its wall go by their shares")
        self.device = field.device if device is None else resolve_device(device)
        self.field = field.to(self.device)
        self.deformed = None
        self.lock, self._order = owner_lock(self.device), StreamOrder(self.device)
        self._held = None
        with self.lock:
            self._bands = [self._band(edit) if edit.falloff > 0.0 else None for edit in self.edits]
            law = LAW_RAYS if density == "opacity" else LAW_DENSITY
            backward = self.map == "backward"
            self._edits: Any = SplatEdits(self.field, self.edits, coordinates, resolution, law, backward, self._bands)

    def _band(self, edit: CageEdit) -> FalloffBand:
        """The band of an edit; what walls cut is found among the splats near its cage."""
        low, high = edit.cage.bounds
        reach = 0.1 * edit.cage.size
        matter: Any = SplatDensity(self.field, bounds=np.array([low - reach, high + reach]))
        return FalloffBand(edit, matter)

    def pose(self, deformed: Cage | Sequence[Cage | None]) -> SplatDeformer:
        """Move the cages; see `Deformer.pose`.

        Args:
            deformed: One Cage; or one per edit in their order, None for an edit that removes.

        Returns:
            This SplatDeformer.

        Raises:
            ValueError: As `Deformer.pose`.
        """
        super().pose(deformed)
        return self

    def posed_splats(self) -> Any:
        """The Splats of the last pose, for kernels (kernels/splats/splats.py), relative to `field.center`.

        The field's own at rest. The next pose overwrites them: hold `lock` over this and what reads it, where several
        threads use this Deformer. Splats that are not drawn have opacity 0.
        """
        return self.posed_edits().posed  # pyright: ignore[reportAttributeAccessIssue]

    def baked(self) -> SplatField:
        """The posed splats as a field of their own: with turned harmonics, for files that any viewer opens.

        Splats that did not move keep every bit, and all of them what their file says that nobody here knows. Those that
        are cleared, split or hidden are left out.

        Returns:
            The field, on the same device.
        """
        with self.lock:
            posed, edits = self.posed_splats(), self._edits
            if posed is self.field.splats:
                return self.field
            return _baked(self.field, posed, edits)

    def save_sequence(
        self,
        path: str | os.PathLike,
        poses: Iterable[Cage | Sequence[Cage | None]],
        *,
        first: int = 1,
        overwrite: bool = False,
    ) -> list[pathlib.Path]:
        """Write a file for each of several poses, for viewers and programs that play such sequences.

        Each file is written whole or not at all; those before a failure stay. Files of the same name with other
        numbers, as a longer sequence before has left them, stay too, with a warning that names them, unless they are to
        be replaced.

        Args:
            path: The files, with a run of # where the number goes (`walk_####.ply`), in any format that is saved.
            poses: As `pose` takes them.
            first: Number of the first file, from 0.
            overwrite: Whether all files of such a name are removed, whatever their numbers, as soon as the first one of
                this sequence is made.

        Returns:
            The files.

        Raises:
            ValueError: For a path without a run of #, a first number that is none, or as `pose`.
        """
        pattern = checked_path(path, "the name of a sequence")
        marks = re.findall("#+", pattern.name)
        if len(marks) != 1:
            raise ValueError(f"a sequence needs one run of # in its name, such as walk_####.ply, got {pattern.name!r}")
        splat_ending(pattern)
        checked_whole(first, "first", 0)
        written: list[pathlib.Path] = []
        for number, cages in enumerate(poses, first):
            with self.lock:
                baked = self.pose(cages).baked()
            for other in [] if written or not overwrite else _numbered(pattern, marks[0]):
                other.unlink()
            written.append(pattern.with_name(pattern.name.replace(marks[0], str(number).zfill(len(marks[0])))))
            baked.save(written[-1])
        _warn_of_others(pattern, marks[0], written)
        return written

    def _to_canonical(self, edits: Any, points: Any, directions: Any, step: float | None, return_outside: bool) -> Any:
        raise ValueError(
            "to_canonical looks points up backward, as voxels are: splats move forward; take deform_points for points, "
            "or posed_splats for the splats themselves"
        )

    def _render(
        self,
        posed_edits: Any,
        camera: Camera,
        background: str | ArrayLike | None,
        step: float | None,
        supersampling: int | None,
        antialias: bool,
    ) -> Frame:
        """`render` of a pose."""
        if step is not None:
            raise ValueError("splats are not marched through: leave step out")
        require_type(camera, Camera, "render needs")
        field = self.field
        return field.renderer.render(
            posed_edits().posed,
            camera,
            colour=field.background if background is None else parse_background(background),
            origin=field.center,
            near=field.near,
            supersampling=1 if supersampling is None else supersampling,
            antialias=checked_flag(antialias, "antialias"),
        )


def _warn_of_others(pattern: pathlib.Path, marks: str, written: list[pathlib.Path]) -> None:
    """Say which files of another sequence a player would take for this one's."""
    ours = {path.name for path in written}
    others = [path.name for path in _numbered(pattern, marks) if path.name not in ours] if written else []
    if others:
        warnings.warn(
            f"beside the {counted(len(written), 'file')} of this sequence lie {len(others)} of another one, which "
            f"players take for its own: {listed(others, 3)}; they are removed with overwrite",
            stacklevel=3,
        )


def _numbered(pattern: pathlib.Path, marks: str) -> list[pathlib.Path]:
    """The files of a name with a number for its marks, in their order; none where there is no such folder."""
    before, after = (re.escape(part) for part in pattern.name.split(marks))
    numbered = re.compile(f"{before}[0-9]{{{len(marks)},}}{after}")
    names = sorted(pattern.parent.iterdir()) if pattern.parent.is_dir() else []
    return [path for path in names if numbered.fullmatch(path.name) and path.is_file()]


def _baked(field: SplatField, posed: Any, edits: SplatEdits) -> SplatField:
    """The splats of a pose that can be seen, as files have them."""
    opacities = posed.opacities.numpy().astype(np.float64)
    kept = np.flatnonzero(opacities > 0.0)
    nodes = edits.instances.nodes[kept]
    rows = edits.tree.rows[nodes]
    jacobians = edits.carried.jacobians.numpy()[kept].astype(np.float64)
    held = field.contents

    # what is a splat of the file, and did not move
    places = posed.centres.numpy()[kept]
    whole = edits.tree.parents[nodes] < 0
    still = whole & (jacobians == np.eye(3)).all(axis=(1, 2)) & (places == edits.centres.numpy()[kept]).all(axis=1)
    same = whole & (posed.opacities.numpy()[kept] == field.opacities[rows].astype(np.float32))

    centres = np.where(still[:, None], held.centres[rows], (places.astype(np.float64) + edits.origin))
    axes, scales, _ = np.linalg.svd(jacobians @ edits.tree.factors[nodes])
    axes[:, :, 2] *= np.sign(np.linalg.det(axes))[:, None]
    log_scales = np.log(np.maximum(scales, np.finfo(np.float32).tiny)).astype(np.float32)
    turns = posed.turns.numpy()[kept].astype(np.float64)
    harmonics = held.harmonics[rows]
    harmonics[~still] = turned_harmonics(harmonics[~still], _matrices(turns[~still]))
    contents = SplatContents(
        centres.astype(held.centres.dtype),
        np.where(still[:, None], held.log_scales[rows], log_scales),
        np.where(still[:, None], held.quaternions[rows], quaternions_of(axes)).astype(np.float32),
        np.where(same, held.logits[rows], logits_of(np.minimum(opacities[kept], 1.0 - 1e-7))),
        harmonics,
        chosen_layout(held.layout, rows),
    )
    return SplatField.from_contents(contents, device=field.device, **field.view_options())


def quaternions_of(rotations: np.ndarray) -> np.ndarray:
    """Unit quaternions (n, 4) w x y z of rotations (n, 3, 3)."""
    r = rotations
    trace = np.einsum("nii->n", r)
    # four ways, of which the one with the largest number is taken
    squares = np.stack([trace, *(2.0 * r[:, k, k] - trace for k in range(3))], axis=1)
    best = np.argmax(squares, axis=1)
    w, x, y, z = r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1], 1.0 + squares
    xy, xz, yz = r[:, 0, 1] + r[:, 1, 0], r[:, 0, 2] + r[:, 2, 0], r[:, 1, 2] + r[:, 2, 1]
    ways = np.stack(
        [
            np.stack([z[:, 0], w, x, y], axis=1),
            np.stack([w, z[:, 1], xy, xz], axis=1),
            np.stack([x, xy, z[:, 2], yz], axis=1),
            np.stack([y, xz, yz, z[:, 3]], axis=1),
        ],
        axis=1,
    )
    chosen = ways[np.arange(len(r)), best]
    return chosen / np.linalg.norm(chosen, axis=1, keepdims=True)


def _matrices(turns: np.ndarray) -> np.ndarray:
    """(n, 3, 3) rotations of Warp's quaternions x y z w."""
    return rotation_matrices(np.roll(turns, 1, axis=1))
