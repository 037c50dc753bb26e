"""Scenes with ground truth: models at rest and posed, ray cast, with the cages that pose them.

Truth of a pose: a Deformer shows at x what the field holds at phi(x), phi from coordinates of the *deformed* cage. So a
vertex p of the model belongs where phi(x) = p, which Newton's iteration finds in float64
(warpcage.reference.inverse_map: closed forms, or boundary elements for harmonic coordinates). Coordinates on the rest
cage applied to the deformed one, the usual way with meshes, are another map.

Light: a captured field holds the light that fell on the object at rest, so the truth carries colour, shadows and
highlights along, seen in the direction J d with J the Jacobian of phi (the limit of the paper's Eq. 4). TRUTHS names
two others, to measure what this costs against a new capture: "turned" takes highlights along by the rotation nearest to
J only, "relit" lights the posed object by lights fixed to the world.
"""

from __future__ import annotations

import dataclasses
import pathlib

import numpy as np

import warpcage
from warpcage.reference.inverse_map import InverseMap
from warpcage.reference.models import subdivided_model
from warpcage.reference.raycast import CarriedMesh
from warpcage.scene.scene import Scene

SCENES = ("bricks", "animal", "chair")
POSES = ("rigid", "twist", "bend", "stretch", "local")
TRUTHS = ("carried", "turned", "relit")
CAGES = pathlib.Path(__file__).parent / "cages"
FOV_DEGREES, DISTANCE = 39.6, 4.0


def pose_cages(name: str, rest: warpcage.Cage) -> dict[str, warpcage.Cage]:
    """The moderate poses of a scene: each moves parts by 0.1 to 0.4 of the cage's size."""
    bend_axis, towards = {"bricks": ("x", "z"), "animal": ("x", "y"), "chair": ("z", "y")}[name]
    offset, centre = {
        "bricks": ((0.25, -0.15, 0.2), (1.0, 0.0, 0.5)),
        "animal": ((0.1, 0.25, 0.2), (0.9, 0.0, 0.7)),
        "chair": ((-0.25, 0.2, 0.1), (-0.4, 0.0, 0.9)),
    }[name]
    return {
        "rigid": rest.rotate(35, axis="x").rotate(50, axis="z"),
        "twist": rest.twist(45),
        "bend": rest.bend(45, axis=bend_axis, towards=towards),
        "stretch": rest.stretch(1.5, axis="x", limits=(0.4, 0.9)),
        "local": rest.move(offset, centre=centre, radius=0.9),
    }


def cameras(target, count: int, size: int, *, sphere: bool) -> list[warpcage.Camera]:
    """Spread evenly over the sphere (training), or once around between 5 and 50 degrees up (test)."""
    k = np.arange(count) + 0.5
    turn = 2 * np.pi * k * (np.sqrt(5) - 1) / 2 if sphere else 2 * np.pi * k / count
    height = 1 - 2 * k / count if sphere else np.sin(np.radians(27.5 + 22.5 * np.sin(2 * turn + 0.5)))
    flat = np.sqrt(1 - height**2)
    eyes = np.asarray(target) + DISTANCE * np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)
    return [warpcage.Camera.look_at(eye, target, fov_degrees=FOV_DEGREES, width=size, height=size) for eye in eyes]


@dataclasses.dataclass
class View:
    """A camera, what it must see on white (h, w, 3), and the depth (h, w), inf where a pixel is not covered whole."""

    camera: warpcage.Camera
    image: np.ndarray
    depth: np.ndarray


@dataclasses.dataclass
class Place:
    """Vertices of a posed model (v, 3), the Jacobians there of the map back to rest (v, 3, 3), and the middle."""

    points: np.ndarray
    jacobians: np.ndarray
    middle: np.ndarray


class TruthScene:
    """A model, its cage, its training pictures, and its views at rest and in any pose."""

    def __init__(
        self,
        name: str,
        *,
        size: int,
        train_views: int,
        test_views: int,
        longest_edge: float,
        samples: int,
        cuts: int,
        device,
    ):
        self.name, self.size, self.test_views = name, size, test_views
        self.samples, self.cuts, self.device = samples, cuts, device
        self.mesh = CarriedMesh(*subdivided_model(name, longest_edge), device=device)
        self.cage = warpcage.Cage.load(CAGES / f"{name}.obj")
        self.train_views = train_views
        self._placed = None

    def training(self) -> Scene:
        """The pictures at rest that the field is fitted to, with alpha."""
        views = cameras((0, 0, 0), self.train_views, self.size, sphere=True)
        rgba, _ = self.mesh.render(views, samples=self.samples)
        return Scene(images=on_white(rgba), cameras=views, alphas=rgba[..., 3])

    def posed_training(self, posed: warpcage.Cage, kind: str) -> Scene:
        """As many "carried" pictures of a pose, from all around it, to which a field of the pose itself is fitted."""
        place = self._place(posed, kind)
        views = cameras(place.middle, self.train_views, self.size, sphere=True)
        rgba, _ = self.mesh.render(views, posed=place.points, view_matrices=place.jacobians, samples=self.samples)
        return Scene(images=on_white(rgba), cameras=views, alphas=rgba[..., 3])

    def rest_views(self) -> list[View]:
        return self._views(np.zeros(3), None, None, False)

    def posed_views(self, posed: warpcage.Cage, kind: str, truths=("carried",)) -> tuple[dict[str, list[View]], dict]:
        """Views of each of `truths`, and facts about the pose. Raises ValueError where a vertex has no place."""
        place = self._place(posed, kind)
        u, stretch, v = np.linalg.svd(place.jacobians)
        matrices = {"carried": place.jacobians, "turned": u @ v, "relit": None}
        views = {truth: self._views(place.middle, place.points, matrices[truth], truth == "relit") for truth in truths}
        facts = {
            "largest_move": float(np.linalg.norm(place.points - self.mesh.vertices, axis=1).max()),
            "stretch": [float(1 / stretch.max()), float(1 / stretch.min())],
        }
        return views, facts

    def _place(self, posed: warpcage.Cage, kind: str) -> Place:
        """Where a pose takes the model; the last one is kept."""
        if self._placed is None or self._placed[0] is not posed or self._placed[1] != kind:
            found = InverseMap(self.cage, posed, kind, cuts=self.cuts, device=self.device).invert(self.mesh.vertices)
            lost = int((found.residuals > 1e-8 * self.cage.size).sum())
            if lost:
                raise ValueError(f"{lost} vertices of {self.name} have no place in the {kind} pose")
            middle = (found.points.min(axis=0) + found.points.max(axis=0)) / 2
            self._placed = posed, kind, Place(found.points, found.jacobians, middle)
        return self._placed[2]

    def _views(self, target, points, matrices, light_stays) -> list[View]:
        places = cameras(target, self.test_views, self.size, sphere=False)
        rgba, depth = self.mesh.render(
            places, posed=points, view_matrices=matrices, light_stays=light_stays, samples=self.samples
        )
        return [View(*view) for view in zip(places, on_white(rgba), depth, strict=True)]


def on_white(rgba: np.ndarray) -> np.ndarray:
    """(..., 3) float32 colours of pictures with opacity (..., 4), before white."""
    return (rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:]).astype(np.float32)
