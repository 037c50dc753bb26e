"""The surface of a field as a mesh, and its colours as seen along the normals."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from ..core.checks import Cuts, checked_positive
from ..core.names import checked_choice
from ..errors import InputError
from ..mesh.mesh import connected_parts
from ..view.pictures import PictureCuts

if TYPE_CHECKING:
    import trimesh

#: The half-opaque density is taken where at least this share of the occupied nodes reaches it.
_MIN_SHARE = 0.05


class DensityField(Protocol):
    """Anything with densities at nodes: node (i, j, k) lies at bounds[0] + (i + 0.5) * voxel_size."""

    @property
    def bounds(self) -> np.ndarray:
        """(2, 3) lower and upper corner, world units."""
        ...

    @property
    def voxel_size(self) -> np.ndarray:
        """(3,) world units."""
        ...

    def node_densities(self) -> np.ndarray:
        """(nx, ny, nz) densities, per world unit."""
        ...


class ColorField(DensityField, Protocol):
    """A field with view-dependent colours too."""

    background: np.ndarray  # (3,) behind everything

    def sample(self, points: Any, directions: Any) -> tuple[Any, Any]:
        """Color (n, 3) and density (n,) at points (n, 3), seen along directions (n, 3)."""
        ...


def extract_mesh(
    field: DensityField, *, threshold: float | None = None, components: str = "largest"
) -> trimesh.Trimesh:
    """The surface where a field's density crosses a threshold, per world unit, closed and looking outward; world units.
    threshold: None is `surface_density`."""
    import skimage.measure
    import trimesh

    checked_choice(components, "components", ("largest", "all"))
    densities, voxel_size = node_grid(field)
    if threshold is None:
        threshold = surface_density(densities, voxel_size)
    else:
        threshold = checked_positive(threshold, "threshold, a density,")
    solid = densities > threshold
    if not solid.any():
        raise InputError(
            f"no density of the field is above the threshold {threshold:.6g}: the largest is {densities.max():.6g}"
        )

    # cut to what is solid and its neighbours, then surround with empty nodes
    spans = [np.flatnonzero(solid.any(axis=tuple(k for k in range(3) if k != axis))) for axis in range(3)]
    low = np.array([max(span[0] - 1, 0) for span in spans])
    high = [span[-1] + 2 for span in spans]
    # Lewiner et al. 2003; the empty nodes around close the mesh
    block = np.pad(densities[tuple(slice(a, b) for a, b in zip(low, high, strict=True))], 1)
    nodes, faces, _, _ = skimage.measure.marching_cubes(block, level=threshold, gradient_direction="descent")
    vertices = np.asarray(field.bounds, dtype=np.float64)[0] + (nodes.astype(np.float64) + low - 0.5) * voxel_size

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if mesh.volume < 0.0:
        mesh.invert()
    return mesh if components == "all" else _largest_part(mesh)  # leaves floaters and cavities out


def surface_density(densities: np.ndarray, voxel_size: ArrayLike) -> float:
    """The density, per world unit, that is taken as the surface, of densities (nx, ny, nz) and voxel size (3,)."""
    # Thin shells of a fitted field are about two voxels thick and hold together at the half-opaque density. Where few
    # occupied nodes are that dense (fog), Otsu's threshold (1979) between them, or half the largest where all are the
    # same. Both scale as one over length: the same object at another size has the same surface.
    import skimage.filters

    occupied = densities[densities > 0.0]
    if not len(occupied):
        raise InputError("the field is empty: it has no density above 0")
    half_opaque = half_opaque_density(voxel_size)
    if np.mean(occupied > half_opaque) >= _MIN_SHARE:
        return half_opaque
    lowest, highest = float(occupied.min()), float(occupied.max())
    if highest <= lowest * (1.0 + 1e-6):
        return 0.5 * highest
    # normalised, so that the histogram's edges do not depend on the unit of length
    return float(skimage.filters.threshold_otsu(occupied.astype(np.float64) / highest)) * highest


def half_opaque_density(voxel_size: ArrayLike) -> float:
    """The density, per world unit, at which a ray across two voxels becomes half opaque; voxel size (3,)."""
    return float(0.5 * np.log(2.0) / np.prod(np.asarray(voxel_size, dtype=np.float64)) ** (1.0 / 3.0))


def require_field(field: object) -> None:
    """Refuse what has no densities at nodes."""
    if not hasattr(field, "node_densities"):
        raise InputError(f"a field is needed, or a selection of one, got {type(field).__name__}")


def node_grid(field: DensityField) -> tuple[np.ndarray, np.ndarray]:
    """Node densities (nx, ny, nz), per world unit, and voxel size (3,) float64, world units, of a field, checked."""
    require_field(field)
    densities = np.asarray(field.node_densities())
    voxel_size = np.broadcast_to(np.asarray(field.voxel_size, dtype=np.float64), 3)
    if densities.ndim != 3 or densities.size == 0:
        raise InputError(f"node densities must be (nx, ny, nz), got {densities.shape}")
    if not np.isfinite(densities).all():
        raise InputError(f"the field holds {np.count_nonzero(~np.isfinite(densities))} densities that are not finite")
    if not (np.isfinite(voxel_size).all() and (voxel_size > 0.0).all()):
        raise InputError(f"voxel_size must be positive and finite, got {voxel_size.tolist()}")
    return densities, voxel_size


def _largest_part(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The connected part of the largest signed volume."""
    import trimesh

    a, b, c = np.asarray(mesh.faces).T
    part, count = connected_parts(len(mesh.vertices), np.concatenate([a, b]), np.concatenate([b, c]))
    if count == 1:
        return mesh
    corners = np.asarray(mesh.vertices)[mesh.faces] - mesh.bounds.mean(axis=0)
    cones = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    kept = part == np.argmax(np.bincount(part[a], weights=cones, minlength=count))
    faces = (np.cumsum(kept) - 1)[np.asarray(mesh.faces)[kept[a]]]
    return trimesh.Trimesh(np.asarray(mesh.vertices)[kept], faces, process=False)


#: Where the samples of a surface point lie along its inward normal, in voxels, and how far apart they are.
FIRST, LAST, SPACING = -1.5, 3.0, 0.5


def surface_colors(field: ColorField, points: np.ndarray, normals: np.ndarray, cuts: Cuts) -> np.ndarray:
    """Colours (n, 3) float32 in [0, 1], sRGB, at surface points (n, 3) with outward unit normals (n, 3).
    As seen along the normal, without highlights elsewhere; the field's background where no sample has matter."""
    voxel = float(np.prod(field.voxel_size) ** (1.0 / 3.0))
    colors, weights = np.zeros((len(points), 3)), np.zeros(len(points))
    through = np.ones(len(points))
    for place in np.arange(FIRST, LAST, SPACING):
        rgb, density = field.sample(points - place * voxel * normals, -normals)
        opacity = through * -np.expm1(-np.asarray(density, np.float64) * SPACING * voxel)
        colors += opacity[:, None] * np.asarray(rgb)
        weights += opacity
        through -= opacity
    shown = np.where(weights[:, None] > 0.0, colors / np.maximum(weights, 1e-12)[:, None], field.background)
    return cuts.clip("values of colors", shown, 0.0, 1.0, 1.0 / 255.0).astype(np.float32)


def color_vertices(field: ColorField, mesh: trimesh.Trimesh) -> None:
    """Give the vertices of a mesh the colours of the surface, as `surface_colors` has them."""
    from trimesh.visual import ColorVisuals

    cuts = PictureCuts()
    shown = surface_colors(field, np.asarray(mesh.vertices), np.asarray(mesh.vertex_normals), cuts)
    cuts.warn("colors of the mesh")
    mesh.visual = ColorVisuals(mesh, vertex_colors=np.round(255.0 * shown).astype(np.uint8))
