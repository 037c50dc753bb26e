"""PosableMesh: a closed mesh and its poses, which have the same faces and other vertices."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from ..mesh.mesh import ClosedMesh, own_axis, principal_axes
from . import poses, random_poses

Posed = TypeVar("Posed", bound="PosableMesh")


class PosableMesh(ClosedMesh):
    """A closed mesh with a method for each function of `warpcage.cage.poses`, where the formulas are.

    Args:
        vertices: (v, 3) finite floats, world units.
        faces: (f, 3) indices of vertices, anticlockwise seen from outside.
    """

    __slots__ = ()

    def bend(
        self: Posed,
        degrees: float,
        *,
        axis: str | ArrayLike = "z",
        towards: str | ArrayLike = "x",
        limits: Sequence[float] = (0.0, 1.0),
        centre: ArrayLike | None = None,
    ) -> Posed:
        """Bend the mesh along an axis into a circular arc; see `warpcage.cage.poses.bend`.

        Args:
            degrees: Angle of the arc.
            axis: "x", "y" or "z", the axis that is bent; one of the mesh's own, "long", "middle" or "short" (see
                `principal_axes`); or a direction (3,) of any length.
            towards: The direction that it is bent to: another axis, "-x" against it, or a direction (3,), of which what
                is across the axis counts.
            limits: (2,) where the arc begins and ends, as shares of the bounding box along the axis. What is beyond
                follows rigidly.
            centre: (3,) a point on the line that is bent, world units. None is the middle of the bounding box.

        Returns:
            The pose.

        Raises:
            ValueError: For values that are not finite, and for other axes or limits.
        """
        return self._posed(poses.bend, degrees, axis=axis, towards=towards, limits=limits, centre=centre)

    def twist(
        self: Posed,
        degrees: float,
        *,
        axis: str | ArrayLike = "z",
        limits: Sequence[float] = (0.0, 1.0),
        centre: ArrayLike | None = None,
    ) -> Posed:
        """Turn the mesh about an axis by an angle that grows along it; see `warpcage.cage.poses.twist`.

        Args:
            degrees: Angle at the upper limit, anticlockwise seen against the axis.
            axis: "x", "y", "z", "long", "middle", "short", or a direction (3,).
            limits: (2,) where the angle begins and ends to grow, as shares of the bounding box along the axis.
            centre: (3,) a point on the line that it turns about, world units. None is the middle of the bounding box.

        Returns:
            The pose.

        Raises:
            ValueError: For values that are not finite, and for other axes or limits.
        """
        return self._posed(poses.twist, degrees, axis=axis, limits=limits, centre=centre)

    def taper(
        self: Posed,
        factor: float,
        *,
        axis: str | ArrayLike = "z",
        limits: Sequence[float] = (0.0, 1.0),
        centre: ArrayLike | None = None,
    ) -> Posed:
        """Scale the mesh across an axis by a factor that changes along it; see `warpcage.cage.poses.taper`.

        Args:
            factor: Factor at the upper limit, positive; it is 1 at the lower.
            axis: "x", "y", "z", "long", "middle", "short", or a direction (3,).
            limits: (2,) where the factor begins and ends to change, as shares of the bounding box along the axis.
            centre: (3,) a point on the line that it scales about, world units. None is the middle of the bounding box.

        Returns:
            The pose.

        Raises:
            ValueError: For a factor that is not positive and finite, and for other axes or limits.
        """
        return self._posed(poses.taper, factor, axis=axis, limits=limits, centre=centre)

    def stretch(
        self: Posed,
        factor: float,
        *,
        axis: str | ArrayLike = "z",
        limits: Sequence[float] = (0.0, 1.0),
        keep_volume: bool = False,
        centre: ArrayLike | None = None,
    ) -> Posed:
        """Make the mesh longer along an axis; see `warpcage.cage.poses.stretch`.

        Args:
            factor: Length afterwards over length before, positive.
            axis: "x", "y", "z", "long", "middle", "short", or a direction (3,).
            limits: (2,) what is stretched, as shares of the bounding box along the axis. What is beyond moves along.
            keep_volume: Whether to make it thinner across the axis by the square root of the factor. This needs the
                limits (0, 1).
            centre: (3,) a point on the line that it gets thinner about, world units. None is the middle of the
                bounding box.

        Returns:
            The pose.

        Raises:
            ValueError: For a factor that is not positive and finite, and for other axes or limits.
        """
        return self._posed(poses.stretch, factor, axis=axis, limits=limits, keep_volume=keep_volume, centre=centre)

    def scale(self: Posed, factor: ArrayLike, *, centre: ArrayLike | None = None) -> Posed:
        """Scale the mesh about a point.

        Args:
            factor: One positive number, or (3,) one for each axis.
            centre: (3,) the point that stays, world units. None is the middle of the bounding box.

        Returns:
            The pose.

        Raises:
            ValueError: For factors that are not positive and finite.
        """
        return self._posed(poses.scale, factor, centre=centre)

    def translate(self: Posed, offset: ArrayLike) -> Posed:
        """Move the mesh.

        Args:
            offset: (3,) world units.

        Returns:
            The pose.

        Raises:
            ValueError: For anything but 3 finite numbers.
        """
        return self.with_vertices(poses.translate(self.vertices, offset))

    def rotate(self: Posed, degrees: float, *, axis: str | ArrayLike = "z", centre: ArrayLike | None = None) -> Posed:
        """Turn the mesh about an axis.

        Args:
            degrees: Angle, anticlockwise seen against the axis.
            axis: "x", "y", "z", "long", "middle", "short", or a direction (3,) of any length.
            centre: (3,) a point on the axis, world units. None is the middle of the bounding box.

        Returns:
            The pose.

        Raises:
            ValueError: For values that are not finite, and for another axis.
        """
        return self._posed(poses.rotate, degrees, axis=axis, centre=centre)

    def move(
        self: Posed,
        offset: ArrayLike,
        *,
        group: ArrayLike | None = None,
        centre: ArrayLike | None = None,
        radius: float | None = None,
    ) -> Posed:
        """Move some vertices, and their surroundings less and less; see `warpcage.cage.poses.move`.

        Args:
            offset: (3,) world units.
            group: (k,) numbers of the vertices that are moved. None moves what is near `centre`.
            centre: (3,) the point about which vertices are moved, world units. None where there is a group.
            radius: Distance from the group or the centre where the effect ends, world units. None moves the group
                alone.

        Returns:
            The pose.

        Raises:
            ValueError: Without a group and a centre or with both, for a centre without a radius, for a radius that is
                not positive, or numbers of no vertices.
        """
        return self.with_vertices(poses.move(self.vertices, offset, group=group, centre=centre, radius=radius))

    def random_pose(
        self: Posed,
        seed: int = 0,
        number: int = 0,
        *,
        stretch: Sequence[float] = random_poses.USUAL_STRETCH,
        reach: Sequence[float] = random_poses.USUAL_REACH,
        modes: Sequence[str] = random_poses.POSE_MODES,
    ) -> Posed:
        """A random plausible pose: smooth, without folds, within bounds of stretch; see `warpcage.RandomPoses`.

        That class makes many poses sooner.

        Args:
            seed: Another one gives other poses.
            number: The pose's number among those of the seed, from 0.
            stretch: (2,) least and largest length in the pose over the length at rest.
            reach: (2,) shares between which the pose's share of the farthest that the bounds allow lies.
            modes: Which of "bend", "twist", "stretch", "taper", "wave" and "bump" may act.

        Returns:
            The pose.

        Raises:
            ValueError: For a mesh that is not usable, and for options that cannot be.
        """
        made = random_poses.RandomPoses(self, seed=seed, stretch=stretch, reach=reach, modes=modes)
        return made.pose(number)

    @property
    def principal_axes(self) -> np.ndarray:
        """(3, 3) unit vectors, one a row: the directions in which the surface reaches farthest, less and least.

        They are the principal axes of the surface's area, right-handed, each towards the positive side of the world
        axis that it is nearest to. In poses they are called "long", "middle" and "short", with "-long" against it.
        """
        return principal_axes(self)[0]

    def _posed(self: Posed, pose: Callable[..., np.ndarray], *arguments: Any, **options: Any) -> Posed:
        """A pose that goes by the bounding box of the vertices in use."""
        for name in ("axis", "towards"):
            if isinstance(options.get(name), str):
                options[name] = own_axis(self, options[name])
        oblique = any(not isinstance(options.get(name, "z"), str) for name in ("axis", "towards"))
        bounds = self.vertices[self.topology.used_vertices] if oblique else self.bounds
        return self.with_vertices(pose(self.vertices, *arguments, bounds=bounds, **options))
