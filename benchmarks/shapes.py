"""Fourteen objects that cages are made around, from code alone; two more fields may be given as files."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable

import numpy as np

#: Cells along the longest side of the box in which a surface is marched, and of the lattice for volumes and holes.
CELLS, LATTICE = 100, 64

#: Points on the surface of a mesh that distances are measured to.
SAMPLES = 200_000

Mesh = tuple[np.ndarray, np.ndarray]  # vertices (v, 3), faces (f, 3)
Distance = Callable[[np.ndarray], np.ndarray]  # of points (..., 3), negative inside


# Solids by signed distances


def cones(rows: Iterable[tuple[float, ...]], blend: float = 0.02) -> Distance:
    """Cones between two balls (start, end, both radii), joined smoothly over `blend`."""
    rows = np.array(list(rows))

    def distance(x):
        total = np.zeros(x.shape[:-1])
        for start, end, first, last in zip(rows[:, :3], rows[:, 3:6], rows[:, 6], rows[:, 7], strict=True):
            along = end - start
            share = np.clip((x - start) @ along / max(along @ along, 1e-12), 0.0, 1.0)
            off = np.linalg.norm(x - start - share[..., None] * along, axis=-1) - first - share * (last - first)
            total += np.exp(np.clip(-off / blend, -600.0, 600.0))
        return -blend * np.log(np.maximum(total, 1e-300))

    return distance


def mirrored(rows: Iterable[tuple[float, ...]]) -> list[tuple[float, ...]]:
    """Cones and their mirror images across y = 0."""
    rows = list(rows)
    return rows + [(x, -y, z, u, -v, w, *radii) for x, y, z, u, v, w, *radii in rows]


def slabs(*boxes: tuple) -> Distance:
    """Boxes between two corners each."""

    def distance(x):
        halves = [(0.5 * (np.array(low) + high), 0.5 * np.subtract(high, low)) for low, high in boxes]
        return np.min([(np.abs(x - middle) - half).max(axis=-1) for middle, half in halves], axis=0)

    return distance


def leaves(places, half: tuple[float, float, float]) -> Distance:
    """Flat ellipsoids about places (n, 3), each turned about the vertical as it lies around the axis."""

    def distance(x):
        found = np.full(x.shape[:-1], np.inf)
        for place in np.array(places):
            turn = np.arctan2(place[1], place[0])
            y = x - place
            along, across = (
                np.cos(turn) * y[..., 0] + np.sin(turn) * y[..., 1],
                np.cos(turn) * y[..., 1] - np.sin(turn) * y[..., 0],
            )
            scaled = np.stack([along, across, y[..., 2] + 0.5 * along], axis=-1) / half
            found = np.minimum(found, (np.linalg.norm(scaled, axis=-1) - 1.0) * min(half))
        return found

    return distance


def marched(*parts: Distance, half: float = 1.3) -> Mesh:
    """The surface of the union of solids within a cube about the origin."""
    from skimage.measure import marching_cubes

    axis = np.linspace(-half, half, CELLS + 1)
    nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    values = np.min([part(nodes) for part in parts], axis=0)
    vertices, faces, _, _ = marching_cubes(values, 0.0, spacing=(2.0 * half / CELLS,) * 3, gradient_direction="ascent")
    vertices = vertices - half
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return vertices, faces if np.einsum("fi,fi->", a, np.cross(b, c)) > 0 else faces[:, ::-1].copy()


def armadillo() -> Mesh:
    """A stout animal that stands on two legs: arms with hands held out, ears, a snout, a tail on the ground."""
    middle = [
        (0.0, 0.0, -0.25, 0.0, 0.0, 0.2, 0.34, 0.28),  # trunk
        (0.02, 0.0, 0.2, 0.1, 0.0, 0.55, 0.2, 0.17),  # neck and head
        (0.15, 0.0, 0.55, 0.42, 0.0, 0.45, 0.12, 0.05),  # snout
        (-0.2, 0.0, -0.4, -0.6, 0.0, -0.75, 0.17, 0.09),  # tail
        (-0.6, 0.0, -0.75, -1.05, 0.0, -0.8, 0.09, 0.03),
    ]
    sides = [
        (0.05, 0.1, 0.66, -0.02, 0.24, 0.95, 0.06, 0.035),  # ears
        (0.02, 0.25, 0.25, 0.12, 0.62, 0.22, 0.12, 0.085),  # arms
        (0.12, 0.62, 0.22, 0.42, 0.72, 0.4, 0.085, 0.065),
        (0.42, 0.72, 0.4, 0.58, 0.8, 0.5, 0.04, 0.02),  # fingers
        (0.42, 0.72, 0.4, 0.6, 0.66, 0.5, 0.04, 0.02),
        (0.0, 0.2, -0.45, 0.15, 0.3, -0.75, 0.17, 0.1),  # legs
        (0.15, 0.3, -0.75, 0.05, 0.32, -1.0, 0.1, 0.075),
        (0.05, 0.32, -1.03, 0.3, 0.36, -1.06, 0.075, 0.05),
    ]
    return marched(cones([*middle, *mirrored(sides)], 0.03))


def plant() -> Mesh:
    """A pot with thin stems that part, and a leaf at the end of each."""
    stems, ends = [(0.0, 0.0, -1.1, 0.0, 0.0, -0.75, 0.24, 0.34), (0.0, 0.0, -0.6, 0.0, 0.0, 0.3, 0.04, 0.03)], []
    for k, height in enumerate((-0.2, 0.0, 0.2, 0.3, 0.3)):
        turn = 2.4 * k
        end = np.array([0.65 * np.cos(turn), 0.65 * np.sin(turn), height + 0.45])
        stems.append((0.0, 0.0, height, *end, 0.03, 0.022))
        ends.append(end + 0.12 * np.array([np.cos(turn), np.sin(turn), 0.0]))
    return marched(cones(stems, 0.01), leaves(ends, (0.26, 0.14, 0.04)))


def arms(apart: float) -> list[tuple[float, ...]]:
    """Two arms side by side on one shoulder, their middles so far apart."""
    shoulder = (-0.8, -0.28, 0.0, -0.8, 0.28, 0.0, 0.22, 0.22)
    return [shoulder, *mirrored([(-0.8, 0.5 * apart, 0.0, 0.9, 0.5 * apart, 0.0, 0.11, 0.09)])]


def two_arms() -> Mesh:
    """Two arms side by side, a tenth of their length apart."""
    return marched(cones(arms(0.32)))


def with_trimesh(name: str, **options) -> Callable[[], Mesh]:
    def made() -> Mesh:
        import trimesh

        mesh = getattr(trimesh.creation, name)(**options)
        return np.asarray(mesh.vertices), np.asarray(mesh.faces)

    return made


def model(module: str, name: str) -> Callable[[], Mesh]:
    def made() -> Mesh:
        import importlib

        return getattr(importlib.import_module(module), name)()[:2]

    return made


def ring_field():
    from warpcage.demo import scene_field

    return scene_field("ring", 64)


def demo_field():
    import warpcage
    from warpcage.studio.editor import demo_files

    return warpcage.VoxelField.load(demo_files("cpu")[0])


#: Name: what makes a mesh, or a field.
SHAPES = {
    "armadillo": armadillo,
    "plant": plant,
    "chair": model("ground_truth.models", "chair_model"),
    "ring": ring_field,
    "two arms": two_arms,
    "bricks": model("warpcage.demo", "brick_model"),
    "animal": model("ground_truth.models", "animal_model"),
    "box": with_trimesh("box", extents=(1.0, 0.7, 1.6)),
    "L": lambda: marched(slabs(((-0.8, -0.3, -0.8), (-0.2, 0.3, 0.9)), ((-0.8, -0.3, -0.8), (0.9, 0.3, -0.2)))),
    "plate": with_trimesh("box", extents=(1.0, 1.0, 0.002)),
    "torus": with_trimesh("torus", major_radius=0.8, minor_radius=0.16, major_sections=160, minor_sections=60),
    "demo": demo_field,
}


# Limbs that bend by themselves


def fingers() -> list[tuple[float, ...]]:
    palm = [(-0.5, y, 0.0, 0.0, y, 0.0, 0.14, 0.12) for y in (-0.27, -0.09, 0.09, 0.27)]
    long = [(0.0, y, 0.0, end, y, 0.0, 0.08, 0.06) for y, end in ((-0.3, 0.55), (-0.1, 0.75), (0.1, 0.7), (0.3, 0.6))]
    return [*long, *palm, (-0.4, 0.3, 0.0, 0.1, 0.75, 0.0, 0.1, 0.07)]


def tentacles() -> list[tuple[float, ...]]:
    turns = np.arange(8) * 0.25 * np.pi
    ends = [(0.95 * float(np.cos(turn)), 0.95 * float(np.sin(turn))) for turn in turns]
    return [*((0.0, 0.0, -0.2, x, y, -0.5, 0.14, 0.05) for x, y in ends), (0.0, 0.0, -0.1, 0.0, 0.0, 0.3, 0.3, 0.34)]


def figure() -> list[tuple[float, ...]]:
    sides = [(0.0, 0.3, 0.4, 0.0, 0.36, -0.25, 0.09, 0.06), (0.0, 0.12, -0.1, 0.0, 0.2, -1.05, 0.13, 0.08)]
    return [*mirrored(sides), (0.0, 0.0, -0.1, 0.0, 0.0, 0.4, 0.16, 0.2), (0.0, 0.0, 0.7, 0.0, 0.0, 0.8, 0.15, 0.15)]


def animal_on_legs() -> list[tuple[float, ...]]:
    legs = [(x, 0.2, -0.1, x, 0.22, -0.85, 0.13, 0.08) for x in (-0.55, 0.5)]
    ears = [(0.85, 0.1, 0.45, 0.8, 0.22, 0.85, 0.06, 0.04)]
    return [*mirrored([*legs, *ears]), (-0.55, 0, 0, 0.5, 0, 0, 0.27, 0.27), (0.6, 0, 0.2, 0.95, 0, 0.35, 0.17, 0.12)]


#: Name: the cones of a shape, and which of them bends, without the others.
LIMBS = {
    "two arms": (arms(0.32), 1),
    "near arms": (arms(0.28), 1),
    "finger": (fingers(), 1),
    "thumb": (fingers(), 8),
    "octopus": (tentacles(), 2),
    "arm": (figure(), 0),
    "leg": (figure(), 1),
    "hind leg": (animal_on_legs(), 0),
    "ear": (animal_on_legs(), 2),
}


def bent(rows: list[tuple[float, ...]], number: int, points: np.ndarray, degrees: float) -> np.ndarray:
    """Where points (n, 3) are once the outer half of a cone is turned about its middle, smoothly over a third of it."""
    from scipy.spatial.transform import Rotation

    start, end = np.array(rows[number][:3]), np.array(rows[number][3:6])
    along, middle = end - start, 0.5 * (start + end)
    share = np.clip(((points - middle) @ along) / (along @ along) / 0.33 + 0.5, 0.0, 1.0)
    share = share * share * (3.0 - 2.0 * share)
    share[np.argmin([cones([row])(points) for row in rows], axis=0) != number] = 0.0
    axis = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
    turns = Rotation.from_rotvec(np.radians(degrees) * share[:, None] * axis / np.linalg.norm(axis))
    return middle + turns.apply(points - middle)


# What a cage is measured by


@dataclasses.dataclass
class Shape:
    """An object, and what lies in it."""

    name: str
    object: object  # a trimesh.Trimesh, VoxelField or SplatField
    points: np.ndarray  # (n, 3) on the surface, or the visible nodes of a field
    need: float  # least distance from a cage to the points
    volume: float
    lower: np.ndarray  # (3,) the first node of the lattice
    step: float
    solid: np.ndarray  # (i, j, k) bool, nodes of the lattice that are in the object

    @property
    def size(self) -> float:
        return float((self.points.max(axis=0) - self.points.min(axis=0)).max())


def shape_of(name: str, made) -> Shape:
    """A shape of what SHAPES make, or of a field."""
    import trimesh

    if not isinstance(made, tuple):
        return field_shape(name, made)
    mesh = trimesh.Trimesh(*made, process=False)
    sampled, _ = trimesh.sample.sample_surface(mesh, SAMPLES, seed=0)
    points = np.concatenate([mesh.vertices, sampled])
    size = float(mesh.extents.max())
    lower, step, skin = lattice(points, size / LATTICE)
    solid = filled(skin)
    single = len(mesh.split(only_watertight=False)) == 1
    volume = abs(mesh.volume) if single else (solid.sum() - 0.5 * skin.sum()) * step**3
    # 1 % of the size, and what `from_mesh` cannot resolve
    return Shape(name, mesh, points, 0.0145 * size, float(volume), lower, step, solid)


def field_shape(name: str, field) -> Shape:
    from warpcage.select import visible_nodes

    nodes = visible_nodes(field)
    voxel = np.broadcast_to(field.voxel_size, 3)
    lower, step, solid = lattice(nodes, max(float(voxel.max()), float(np.ptp(nodes, axis=0).max()) / LATTICE))
    need = float(voxel.max() + 0.5 * np.linalg.norm(voxel))
    return Shape(name, field, nodes, need, len(nodes) * float(voxel.prod()), lower, step, filled(solid))


def lattice(points: np.ndarray, step: float) -> tuple[np.ndarray, float, np.ndarray]:
    """The first node, the step, and which nodes have a point nearer than any other; room for a tenth around."""
    room = int(0.15 * LATTICE) + 2
    lower = points.min(axis=0) - room * step
    cells = np.round((points - lower) / step).astype(int)
    solid = np.zeros(cells.max(axis=0) + room + 1, bool)
    solid[tuple(cells.T)] = True
    return lower, step, solid


def filled(skin: np.ndarray) -> np.ndarray:
    """A solid of the nodes near a surface; a node that lacks one is bridged."""
    from scipy.ndimage import binary_closing, binary_fill_holes

    return binary_fill_holes(binary_closing(skin))


def topology(solid: np.ndarray) -> tuple[int, int]:
    """Parts and tunnels of a solid (i, j, k) whose cavities are filled: Euler number = parts - tunnels."""
    from scipy.ndimage import binary_fill_holes, label
    from skimage.measure import euler_number

    solid = binary_fill_holes(solid)
    parts = label(solid, np.ones((3, 3, 3)))[1]
    return parts, int(parts - euler_number(solid, connectivity=3))


def grown(shape: Shape, distance: float) -> np.ndarray:
    """Nodes of its lattice nearer to the object than a distance."""
    from scipy.ndimage import distance_transform_edt

    return distance_transform_edt(~shape.solid) * shape.step <= distance


def gap_points(shape: Shape, width: float) -> np.ndarray:
    """Nodes (n, 3), world units, between parts of the object nearer to each other than a width (by a closing), where a
    cage may leave space."""
    from scipy.ndimage import distance_transform_edt

    closed = distance_transform_edt(grown(shape, 0.5 * width)) * shape.step > 0.5 * width
    return shape.lower + shape.step * np.argwhere(closed & ~grown(shape, shape.need + shape.step))
