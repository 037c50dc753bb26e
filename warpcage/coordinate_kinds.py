"""The kinds of cage coordinates: one row for each, which gives its names, help, solver and kernels."""

from __future__ import annotations

import functools
import importlib
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

from .errors import InputError

#: Names of kinds, as `coordinates=` takes them.
Coordinates: TypeAlias = Literal["harmonic", "mean_value", "green", "maximum_likelihood", "biharmonic"]


@dataclass(frozen=True, eq=False)
class CoordinateKind:
    """A kind of cage coordinates. Code is named as "module:name" below warpcage and imported when it is first used, so
    that names and help are known without Warp."""

    # A new kind takes a kernel file (as kernels/coordinates/mean_value.py), a row of COORDINATE_KINDS with its name in
    # `Coordinates`, and a test.

    name: Coordinates
    label: str  # in menus
    help: str  # what a pose looks like, in a few words
    move_points: str  # moves points, see `deform_points`
    solver: str  # the MapSolver on a lattice: of a closed form a ClosedFormSolver
    modules: tuple[str, ...]  # the kernel modules of the solver, besides those of every pose
    # Closed forms: the kernels that move points, move nodes of a lattice, weigh points, and bind splats, which each
    # take what those of mean value coordinates take (with face weights: those of Green coordinates)
    map_points: str | None = None
    map_nodes: str | None = None
    map_crossings: str | None = None  # on the cage, of kinds that are not linear on its faces
    weigh_points: str | None = None
    bind_points: str | None = None  # None of a closed form: it does not move splats
    map_quads: str | None = None  # points and weights of cages of quads; None: as their triangles
    weigh_quads: str | None = None
    bind_quads: str | None = None
    adjoint: str | None = None  # the Warp function that a backward pass is written for; None: not differentiable
    # numbers that each face has, of Green coordinates its normal; of three, the others follow (mesh/biharmonic.py)
    face_layers: int = 0
    is_iterative: bool = False  # there may be no solution at a point, which is NaN then
    has_gradients: bool = True  # whether maps and moved points have a backward pass
    is_precise: bool = False  # also evaluated at every sample, without a lattice (kernels/edits/trace.py)
    extends: bool = False  # defined outside of the cage too
    face_cells: int = 1  # along each edge of a face of more than three corners, of the surface that it is solved on

    @property
    def has_face_weights(self) -> bool:
        """Whether faces have weights besides vertices."""
        return self.face_layers > 0

    @property
    def is_closed_form(self) -> bool:
        """Whether weights follow from a formula, and not from a solution on a lattice."""
        return self.map_points is not None

    @property
    def is_summed(self) -> bool:
        """Whether weights are sums over all faces, whose denominators vanish or count twice in parts inside others."""
        return self.is_closed_form and not self.is_iterative

    def load(self, field: str) -> Any:
        """The function, class or kernel that a field names."""
        path = getattr(self, field)
        if path is None:
            raise InputError(f"{self.name} coordinates have no {field} (coordinate_kinds.py)")
        return _loaded(path)

    def require_precise(self, remedy: str) -> None:
        """Refuse a kind that is not evaluated at samples; remedy: what to do instead."""
        if not self.is_precise:
            raise InputError(f"{self.name} coordinates have no closed form at samples: {remedy}")

    def kernel_modules(self) -> list[Any]:
        """The kernel modules of the solver."""
        return [importlib.import_module(f"..{name}", __name__) for name in self.modules]


@functools.cache
def _loaded(path: str) -> Any:
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(f"..{module}", __name__), name)


#: All kinds by name, in the order in which help and messages list them.
COORDINATE_KINDS: dict[str, CoordinateKind] = {
    kind.name: kind
    for kind in (
        CoordinateKind(
            "harmonic",
            label="Harmonic",
            help="follows limbs",
            move_points="coordinates.coordinates:move_on_lattice",
            solver="lattice.harmonic:HarmonicSolver",
            face_cells=2,  # which cost it next to nothing
            modules=("kernels.lattice.harmonic", "kernels.lattice.harmonic_coarse", "kernels.lattice.cut_rows"),
        ),
        CoordinateKind(
            "mean_value",
            label="Mean value",
            help="smooth and fast",
            move_points="coordinates.coordinates:move_in_closed_form",
            solver="lattice.closed_form:VertexWeightSolver",
            modules=(
                "kernels.lattice.closed_form",
                "kernels.mesh.fans",
                "kernels.lattice.cut_rows",
                "kernels.lattice.corrections",
            ),
            map_points="kernels.coordinates.mean_value:map_mean_value",
            map_nodes="kernels.lattice.closed_form:map_nodes_mean_value",
            weigh_points="kernels.coordinates.mean_value:weigh_mean_value",
            bind_points="kernels.splats.bind:bind_mean_value",
            map_quads="kernels.coordinates.quad_mean_value:map_quad_mean_value",
            bind_quads="kernels.splats.bind:bind_quad_mean_value",
            weigh_quads="kernels.coordinates.quad_mean_value:weigh_quad_mean_value",
            adjoint="kernels.coordinates.mean_value:mean_value_position",
            is_precise=True,
            extends=True,
        ),
        CoordinateKind(
            "green",
            label="Green",
            help="keeps shapes, may bulge out of the cage",
            move_points="coordinates.coordinates:move_in_closed_form",
            solver="lattice.closed_form:GreenSolver",
            modules=("kernels.lattice.closed_form", "kernels.mesh.fans", "kernels.lattice.cut_rows"),
            map_points="kernels.coordinates.green:map_green_inside",
            map_nodes="kernels.lattice.closed_form:map_nodes_green",
            map_crossings="kernels.lattice.closed_form:map_crossings_green",
            weigh_points="kernels.coordinates.green:weigh_green",
            bind_points="kernels.splats.bind:bind_green",
            adjoint="kernels.coordinates.green:green_point",
            face_layers=1,
            is_precise=True,
        ),
        CoordinateKind(
            "maximum_likelihood",
            label="Maximum likelihood",
            help="no negative weights in concave cages",
            move_points="coordinates.coordinates:move_in_closed_form",
            solver="lattice.closed_form:IterativeSolver",
            modules=(
                "kernels.lattice.closed_form",
                "kernels.mesh.fans",
                "kernels.lattice.cut_rows",
                "kernels.lattice.corrections",
            ),
            map_points="kernels.coordinates.maximum_likelihood:map_maximum_likelihood",
            map_nodes="kernels.lattice.closed_form:map_nodes_maximum_likelihood",
            weigh_points="kernels.coordinates.maximum_likelihood:weigh_maximum_likelihood",
            bind_points="kernels.splats.bind:bind_maximum_likelihood",
            is_iterative=True,
        ),
        CoordinateKind(
            "biharmonic",
            label="Biharmonic",
            help="keeps shapes, ends at the cage",
            move_points="coordinates.coordinates:move_in_closed_form",
            solver="lattice.closed_form:BiharmonicSolver",
            modules=(
                "kernels.lattice.closed_form",
                "kernels.mesh.fans",
                "kernels.lattice.cut_rows",
                "kernels.coordinates.biharmonic",
            ),
            map_points="kernels.coordinates.biharmonic:map_biharmonic",
            map_nodes="kernels.lattice.closed_form:map_nodes_biharmonic",
            map_crossings="kernels.lattice.closed_form:map_crossings_biharmonic",
            weigh_points="kernels.coordinates.biharmonic:weigh_biharmonic",
            bind_points="kernels.splats.bind:bind_biharmonic",
            face_layers=3,
            has_gradients=False,
        ),
    )
}


def names_where(field: str) -> list[str]:
    """Names of the kinds of which a field or property is true."""
    return [kind.name for kind in COORDINATE_KINDS.values() if getattr(kind, field)]
