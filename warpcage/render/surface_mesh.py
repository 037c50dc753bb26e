"""SurfaceMesh: a triangle mesh with its colours, and its pictures."""

from __future__ import annotations

import dataclasses
import math
import os
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.arrays import as_host_points, local_points
from ..core.checks import checked_direction, real_array, require_ordinary_side
from ..core.devices import HeldOnDevice, launch, resolve_device
from ..core.files import PathLike
from ..core.names import counted
from ..core.threads import in_turn
from ..errors import InputError
from ..field.render import NEW_TARGET, RenderKeywords, RenderOptions, RenderTarget, View, render_options, takes_options
from ..kernels.render.surface import SurfaceColors, cast_surface_rays
from ..splats.io import is_splat_file
from ..splats.splat_field import AnyField, field_size, load_field
from ..view.camera import Camera, camera_struct
from ..view.frame import PART_NAMES, Frame, checked_supersampling, parse_background
from ..view.pictures import PictureCuts, to_uint8
from .surface_file import GREY, HEADLIGHT, NO_PICTURE, SURFACE_ENDINGS, Surface, plain_surface, read_surface

if TYPE_CHECKING:
    from typing_extensions import Unpack  # of the type checker

#: How far behind a clear surface the next one is looked for, as a share of the mesh's size.
SKIP = 1e-6

#: Steps that a ray takes, for launches on the CPU.
RAY_WORK = 60


class SurfaceMesh(HeldOnDevice):
    """A triangle mesh with its colours, as an object of a `Stage`; `Deformer(mesh, cage)` poses its vertices by a cage.

    Colours are shown as they are, without light: what warpcage exports, and a scan, has the light of its place in them.
    Only a mesh with one colour for all, or none, is shaded, by a headlight at the camera, so that its shape is seen.
    Pictures on it are looked up between four texels, and go on beyond their edges; their opacity counts.

    Limitations: materials but for base colours (metal, roughness, normal maps, transforms of textures) are left out.
    Textures have no coarser levels: more `supersampling` keeps those of far meshes calm.

    Example::

        stage = Stage().add("lego", "lego.npz").add("cup", SurfaceMesh.load("cup.glb"), place=Place((1, 0, 0)))

    Args:
        vertices: (v, 3) world units, finite.
        faces: (f, 3) indices of vertices; both sides of a face are seen.
        colors: (v, 3) or (v, 4) in [0, 1], one for each vertex, as pictures have them; or one, (3,) or (4,), for all.
            The fourth is opacity. None is grey, or with a texture what that has.
        uv: (v, 2) places of the vertices in the texture, 0 to 1 from its upper left corner.
        texture: (h, w, 3) or (h, w, 4) uint8, or floats in [0, 1]; colours are multiplied by it.
        background: Colour behind the mesh, a name or (3,) in [0, 1].
        up: (3,) what is up in its world, of any length but zero.
        supersampling: Rays along each side of a pixel; `render` may choose another number.
        device: Warp device. None is CUDA where there is one.

    Raises:
        ValueError: For shapes that do not fit together, indices of vertices that are not there, values that are not
            finite, or a texture without uv.

    Attributes:
        surface: Vertices, faces and colours on the host. They are not to be written to.
        bounds: (2, 3) float64 box of the vertices of faces, world units.
        center: (3,) float64 middle of the box: positions on the device are relative to it.
        straightening: None, as for a field whose coordinates are those of its file.
        background_model: None: there is one colour behind a mesh.
        background: (3,) float32 colour behind the mesh.
        up: (3,) float64 unit vector.
        supersampling: Rays along each side of a pixel.
        device: Warp device.
    """

    straightening = background_model = None

    def __init__(
        self,
        vertices: ArrayLike,
        faces: ArrayLike,
        *,
        colors: ArrayLike | None = None,
        uv: ArrayLike | None = None,
        texture: ArrayLike | None = None,
        background: str | ArrayLike = "white",
        up: ArrayLike = (0.0, 0.0, 1.0),
        supersampling: int = 2,
        device: wp.DeviceLike = None,
    ):
        self.surface = _checked_surface(vertices, faces, colors, uv, texture)
        self._set_view(background, up, supersampling, device)

    def _set_view(
        self, background: str | ArrayLike, up: ArrayLike, supersampling: int, device: wp.DeviceLike
    ) -> SurfaceMesh:
        used = self.surface.vertices[self.surface.faces.reshape(-1)]
        self.bounds: np.ndarray = np.stack([used.min(axis=0), used.max(axis=0)])
        require_ordinary_side(float(np.ptp(self.bounds, axis=0).max()), "a mesh")
        self.background: np.ndarray = parse_background(background)
        self.up: np.ndarray = checked_direction(up, "up")
        self.supersampling = checked_supersampling(supersampling)
        self.device: wp.Device = resolve_device(device)
        self.center: np.ndarray = self.bounds.mean(axis=0)
        self._colors: Any = None  # on the device, from the first picture on
        self._mesh: wp.Mesh | None = None
        return self

    @classmethod
    def load(cls, path: PathLike, *, device: wp.DeviceLike = None) -> SurfaceMesh:
        """Read a mesh file, with its colours of vertices or its textures.

        Args:
            path: The file: .glb, .gltf, .obj (with its .mtl), .ply, .off, .stl or, without colours, USD. What has y up
                (glTF) is turned, so that z is up.
            device: Warp device. None is CUDA where there is one.

        Returns:
            The mesh.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: For a file that holds no triangles or cannot be read.
        """
        return cls._of(read_surface(path), device=device)

    @classmethod
    def _of(cls, surface: Surface, like: SurfaceMesh | None = None, device: wp.DeviceLike = None) -> SurfaceMesh:
        """A mesh of a surface, seen as another one is; device: None is that of the other one."""
        made = cls.__new__(cls)
        made.surface = surface
        if like is None:
            return made._set_view("white", (0.0, 0.0, 1.0), 2, device)
        return made._set_view(like.background, like.up, like.supersampling, like.device if device is None else device)

    @property
    def vertices(self) -> np.ndarray:
        """(v, 3) float64, world units."""
        return self.surface.vertices

    @property
    def faces(self) -> np.ndarray:
        """(f, 3) int32."""
        return self.surface.faces

    def __repr__(self) -> str:
        bounds = np.round(self.bounds, 4).tolist()
        return f"SurfaceMesh({len(self.vertices)} vertices, {len(self)} faces, bounds {bounds}, {self.device})"

    def __len__(self) -> int:
        return len(self.faces)

    def to(self, device: wp.DeviceLike) -> SurfaceMesh:
        """The same mesh on another device.

        Args:
            device: Warp device. None is CUDA where there is one.

        Returns:
            The mesh; this one if it is there already.
        """
        device = resolve_device(device)
        return self if device == self.device else self._of(self.surface, self, device)

    @in_turn
    def with_vertices(self, vertices: ArrayLike, *, refit: bool = False) -> SurfaceMesh:
        """The same mesh with its vertices elsewhere.

        Args:
            vertices: (v, 3) world units, finite.
            refit: Let the other mesh take what this one's rays meet and fit it to its vertices, which is quicker than
                to build it anew: for a mesh that moves. This one builds its own again if it is rendered once more.

        Returns:
            The mesh. It shares faces and colours with this one.

        Raises:
            ValueError: For another number of vertices, or values that are not finite.
        """
        places = np.asarray(as_host_points(vertices, name="vertices"), np.float64)
        if len(places) != len(self.vertices):
            raise InputError(f"the mesh has {len(self.vertices)} vertices, got {len(places)}")
        moved = self._of(dataclasses.replace(self.surface, vertices=places), self)
        moved._colors = self._colors
        if refit and (mesh := self._mesh) is not None:
            moved._mesh, self._mesh = mesh, None
            mesh.points = local_points(places, moved.center, self.device)  # which fits its boxes to them
        return moved

    def _chosen(self, vertices: np.ndarray, faces: np.ndarray, rows: np.ndarray, parts: np.ndarray) -> SurfaceMesh:
        """A mesh of other vertices and faces, which have the colours of those of these numbers here."""
        here = self.surface
        colors = {"colors": here.colors[rows], "uv": here.uv[rows], "face_pictures": here.face_pictures[parts]}
        return self._of(dataclasses.replace(here, vertices=vertices, faces=faces, **colors), self)

    @takes_options(RenderKeywords)
    def render(self, camera: Camera, **options: Unpack[RenderKeywords]) -> Frame:
        """The view of a camera.

        Args:
            camera: The camera.
            options: Options of the frame by keyword, see docs/python.md.

        Returns:
            The frame, its arrays on the mesh's device.

        Raises:
            ValueError: For a background that is not known, or supersampling out of range.
        """
        return self._render(camera, render_options(options, RenderKeywords))

    @in_turn
    def _render(self, camera: Camera, options: RenderOptions, target: RenderTarget = NEW_TARGET) -> Frame:
        """See `render`."""
        view = View(camera, options, options.color(self.background), self.supersampling, self.device, target)
        rays, arrays, (low, high) = view.rays, view.new_arrays(), self.bounds
        size = math.dist(low, high)
        farthest = math.dist(camera.center, self.center) + size
        mesh = self._traced()  # held until all is launched, whatever other threads build meanwhile
        inputs = [mesh.id, self._colors, camera_struct(rays, self.center), farthest, SKIP * size]
        inputs.append(wp.vec3(*view.color.tolist()))
        outputs = [arrays[name] for name in PART_NAMES]
        launch(cast_surface_rays, rays.width * rays.height, inputs, outputs, device=self.device, work=RAY_WORK)
        return view.finished(arrays)

    def _traced(self) -> wp.Mesh:
        """What rays meet; its colours are then on the device too."""
        surface, device = self.surface, self.device
        if self._colors is None:
            sizes = [(picture.shape[0], picture.shape[1]) for picture in surface.pictures]
            starts = np.cumsum([0, *(height * width for height, width in sizes)])
            rows = [(start, width, height) for start, (height, width) in zip(starts, sizes, strict=False)]
            texels = np.concatenate([np.zeros((0, 4), np.uint8), *(each.reshape(-1, 4) for each in surface.pictures)])
            colors = SurfaceColors()
            colors.faces = wp.array(surface.faces.reshape(-1), dtype=wp.int32, device=device)
            colors.colors = wp.array(surface.colors, dtype=wp.vec4, device=device)
            colors.uv = wp.array(surface.uv, dtype=wp.vec2, device=device)
            colors.face_pictures = wp.array(surface.face_pictures, dtype=wp.int32, device=device)
            colors.pictures = wp.array(np.array(rows, np.int32).reshape(-1, 3), dtype=wp.vec3i, device=device)
            colors.texels = wp.array(texels, dtype=wp.vec4ub, device=device)
            self._colors = colors
        if self._mesh is None:
            self._mesh = wp.Mesh(local_points(surface.vertices, self.center, device), self._colors.faces)
        return self._mesh


def _checked_surface(
    vertices: Any, faces: Any, colors: ArrayLike | None, uv: ArrayLike | None, texture: ArrayLike | None
) -> Surface:
    """What a SurfaceMesh is made of, checked."""
    places = np.asarray(as_host_points(vertices, name="vertices"), np.float64)
    corners = np.asarray(faces)
    if corners.ndim != 2 or corners.shape[1] != 3 or not len(corners) or corners.dtype.kind not in "iu":
        raise InputError(
            f"faces must be (f, 3) indices of vertices, at least one face, got {corners.dtype} {corners.shape}"
        )
    if corners.min() < 0 or corners.max() >= len(places):
        raise InputError(f"faces must name vertices 0 to {len(places) - 1}, got {corners.min()} to {corners.max()}")
    if (uv is None) != (texture is None):
        raise InputError("a texture needs uv, the places of the vertices in it, and uv needs a texture")
    rgba = np.array([(1.0,) * 4 if texture is not None else GREY], np.float32)
    look = 0 if texture is not None else HEADLIGHT
    if colors is not None:
        given = real_array(colors, "colors of a mesh", np.float32)
        each = np.atleast_2d(given)
        if each.shape[-1] not in (3, 4) or len(each) not in (1, len(places)) or each.ndim != 2:
            raise InputError(f"colors must be ({len(places)}, 3 or 4), or one for all, got {given.shape}")
        if not np.isfinite(each).all() or each.min() < 0.0 or each.max() > 1.0:
            raise InputError("colors of a mesh must be in [0, 1]")
        rgba = np.concatenate([each, np.ones((len(each), 4 - each.shape[1]), np.float32)], axis=1)
        look = look if texture is not None or given.ndim == 1 else NO_PICTURE
    made = plain_surface(places, corners, look=look)
    made = dataclasses.replace(made, colors=np.ascontiguousarray(np.broadcast_to(rgba, (len(places), 4))))
    if texture is None:
        return made
    cuts = PictureCuts()
    spots, pixels = real_array(uv, "uv", np.float32), to_uint8(texture, cuts)
    cuts.warn("the texture")
    if spots.shape != (len(places), 2) or not np.isfinite(spots).all():
        raise InputError(f"uv must be finite ({len(places)}, 2), got {spots.shape}")
    if pixels.ndim != 3 or pixels.shape[2] not in (3, 4) or 0 in pixels.shape:
        raise InputError(f"a texture must be (h, w, 3) or (h, w, 4), got {pixels.shape}")
    if pixels.shape[2] == 3:
        pixels = np.concatenate([pixels, np.full((*pixels.shape[:2], 1), 255, np.uint8)], axis=2)
    return dataclasses.replace(made, uv=spots, pictures=[np.ascontiguousarray(pixels)])


def is_mesh_file(path: str | os.PathLike[str]) -> bool:
    """Whether a file is read as a mesh: by its ending, where it does not hold splats."""
    return os.path.splitext(os.fspath(path))[1].lower() in SURFACE_ENDINGS and not is_splat_file(path)


#: What a stage may hold, without cages.
AnyObject: TypeAlias = AnyField | SurfaceMesh


def load_object(path: PathLike, *, device: wp.DeviceLike = None) -> AnyObject:
    """Read a field of voxels or of splats, or a mesh, by what the file holds."""
    return SurfaceMesh.load(path, device=device) if is_mesh_file(path) else load_field(path, device=device)


def object_size(scene_object: AnyObject) -> str:
    """The size of a field or mesh as text, such as "12000 triangles"."""
    return counted(len(scene_object), "triangle") if isinstance(scene_object, SurfaceMesh) else field_size(scene_object)
