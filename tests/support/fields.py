"""Small fields, cages and cameras that tests share, and what they ask of views of deformed scenes."""

import contextlib
import math

import numpy as np
import pytest
import warp as wp
from field_oracles import SAMPLE_PLACE, surface_points

from warpcage import Cage, Camera, VoxelField
from warpcage.core import recorded_launches
from warpcage.field import LayeredBackground, OuterField, harmonics_on_host, tables
from warpcage.render import FramePlan, scene

KINDS = ("harmonic", "mean_value", "green", "maximum_likelihood", "biharmonic")
SIZE = 64
BOX = Cage.box([-0.75, -0.55, -0.4], [0.75, 0.55, 0.4], segments=2)


class OnlyDLPack:
    """An array of another library, which is read through DLPack alone."""

    def __init__(self, values):
        self.values = values

    def __dlpack__(self, **options):
        return self.values.__dlpack__(**options)

    def __dlpack_device__(self):
        return self.values.__dlpack_device__()


def nodes(resolution, bounds=((-1, -1, -1), (1, 1, 1))):
    """(..., 3) voxel centres. resolution: Of all axes, or of each."""
    spans = zip(np.broadcast_to(resolution, 3), *np.asarray(bounds, float), strict=True)
    axes = [low + (np.arange(count) + 0.5) / count * (high - low) for count, low, high in spans]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def make_field(density, sh, bounds=((-1, -1, -1), (1, 1, 1)), device=None, resolution=40, origin=(0, 0, 0)):
    """A field from functions of positions relative to `origin`."""
    x = nodes(resolution, bounds)
    bounds = np.asarray(bounds, float) + origin
    return VoxelField.from_dense(density(x), np.broadcast_to(sh(x), (*x.shape[:3], 9, 3)), bounds, device=device)


def ellipsoid(x, center=(0, 0, 0), radii=(0.55, 0.35, 0.25), sigma=30.0):
    return sigma * np.clip((1.15 - np.linalg.norm((x - center) / np.array(radii), axis=-1)) / 0.3, 0, 1)


def shiny(x):
    """Stripes whose colour depends strongly on the direction they are seen from."""
    sh = np.zeros((*x.shape[:3], 9, 3))
    sh[..., 0, :] = 0.8 * np.sin(x @ np.array([[7.0, 1, 2], [2, 6, -3], [1, -3, 7]]))
    random = np.random.default_rng(0)
    sh[..., 1:4, :] = 0.5 * random.normal(size=(3, 3))
    sh[..., 4:, :] = 0.25 * random.normal(size=(5, 3))
    return sh


def plain(color):
    def sh(x):
        result = np.zeros((*x.shape[:3], 9, 3))
        result[..., 0, :] = (np.asarray(color) - 0.5) / 0.28209479177387814
        return result

    return sh


def shiny_field(device, **options):
    return make_field(ellipsoid, shiny, device=device, **options)


def view(eye=(2.5, 1.2, 1.0), size=SIZE, **options):
    return Camera.look_at(np.asarray(eye, float), (0, 0, 0), width=size, height=size, fov_degrees=50, **options)


def slotted(width):
    """A prism with a slot of this width between two arms."""
    half = width / 2
    outline = np.array([[-0.8, -0.5], [0.8, -0.5], [0.8, 0.6], [half, 0.6], [half, -0.1], [-half, -0.1], [-half, 0.6],
                        [-0.8, 0.6]])  # fmt: skip
    top = np.array([[0, 1, 5], [1, 4, 5], [1, 2, 4], [2, 3, 4], [0, 5, 7], [5, 6, 7]])
    sides = [face for i in range(8) for j in [(i + 1) % 8] for face in ([i, j, j + 8], [i, j + 8, i + 8])]
    vertices = np.concatenate([np.column_stack([outline, np.full(8, height)]) for height in (-0.4, 0.4)])
    return Cage(vertices, np.concatenate([top[:, ::-1], top + 8, sides]))


def ball(x, center, radius=0.2):
    return ellipsoid(x, center, (radius, radius, radius))


def two_balls(device):
    def density(x):
        return ball(x, (-0.5, 0, 0)) + ball(x, (0.5, 0, 0))

    return make_field(density, plain([0.8, 0.3, 0.1]), device=device)


def box_around(*center, half=0.3):
    return Cage.box(np.array(center) - half, np.array(center) + half)


def psnr(a, b):
    return -10 * np.log10(max(np.mean((a - b) ** 2), 1e-12))


def rotation(z_degrees, x_degrees):
    a, b = np.radians([z_degrees, x_degrees])
    about_z = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    return about_z @ about_x


def counter_moved(camera, turn, offset):
    """The camera that sees the field at rest as `camera` sees it after x -> turn x + offset."""
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = turn, offset
    return camera.moved(np.linalg.inv(transform))


def march_in_numpy(field, deformer, camera, with_directions=True):
    """Every sample through to_canonical and field.sample, composited in float64 (density="opacity")."""
    origins, directions = (v.reshape(-1, 3) for v in camera.rays())
    step = field.step
    middle, half = field.center, 0.5 * np.ptp(field.bounds, axis=0)
    far = np.linalg.norm(camera.center - middle) + 1.5 * np.linalg.norm(half)
    times = (np.arange(int(far / step)) + SAMPLE_PLACE) * step
    color, light = np.zeros((len(origins), 3)), np.ones(len(origins))
    for t in times:
        x = origins + t * directions
        here, along, region = deformer.to_canonical(x, directions, step=step)
        ahead, _, region_ahead = deformer.to_canonical(x + step * directions, directions, step=step)
        length = np.where((region == 2) & (region_ahead == 2), np.linalg.norm(ahead - here, axis=1), step)
        rgb, density = field.sample(here, along if with_directions else directions)
        alpha = 1 - np.exp(-np.where(region == 1, 0, density) * length)
        color += (light * alpha)[:, None] * rgb
        light *= 1 - alpha
    return (color + light[:, None]).reshape(camera.height, camera.width, 3)


def alter_map(deformer, alter):
    """Let the map of a deformer's first edit be altered by hand at each pose. alter: of its positions, (..., 3)."""
    position_map = deformer.posed_edits().lattices.maps[0]
    finish = position_map.finish

    def finish_altered():
        positions = finish().data.positions
        positions.assign(alter(positions.numpy()))
        return position_map

    position_map.finish = finish_altered


def mirrored(positions):
    """Turns all matter over; see alter_map."""
    return positions * np.float32([-1, 1, 1])


#: The march of a CPU, as `recorded_launches` calls it.
TILES = "march_cpu.render_edit_tiles"


def marches(launched):
    """The marches of views of deformed scenes, among the labels of `recorded_launches`."""
    return [label for label in launched if label.startswith("views.") or label == TILES]


@contextlib.contextmanager
def general_march():
    """Marches posed edits by the kernel for any edits; they must have been rendered."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene, "plan_frame", lambda facts: FramePlan("stack"))
        yield


#: On a CPU by tiles; as CUDA marches near cameras and copies, by rows; and as it does else, of shaded voxels.
MARCHES = ("tiles", "rows", "shaded")
NEAR_VOXELS = tables.NEAR_VOXELS


def marches_of(device):
    """Those of MARCHES that a device has."""
    return MARCHES if wp.get_device(device).is_cpu else MARCHES[1:]


def use_march(name, device, monkeypatch):
    """Views by one of MARCHES, on any device that has it."""
    if name not in marches_of(device):
        pytest.skip("rays of a tile go side by side on a CPU alone")
    monkeypatch.setattr(tables, "TILES_ON_CPU", name == "tiles")
    monkeypatch.setattr(tables, "SHADED_ON_CPU", name == "shaded")
    monkeypatch.setattr(tables, "NEAR_VOXELS", math.inf if name == "rows" else NEAR_VOXELS)
    return name


def seen_by_marches(deformer, camera, monkeypatch, **options):
    """A view by each march that there is, and by the one for any edits: the name of the march, the labels of its
    launches, its frame, the frame by the march for any edits."""
    general = None
    for march in marches_of(deformer.device):
        use_march(march, deformer.device, monkeypatch)
        with recorded_launches() as launched:
            frame = deformer.render(camera, **options)
        if general is None:
            with recorded_launches() as launched_generally, general_march():
                general = deformer.render(camera, **options)
            assert marches(launched_generally) == ["views.stack"]
        yield march, marches(launched), frame, general


class GridField:
    """What extract_mesh needs of a field, from an array and bounds."""

    def __init__(self, densities, lower=(-1, -1, -1), upper=(1, 1, 1), weights=None):
        self.densities, self.weights = np.asarray(densities, dtype=np.float32), weights
        self.bounds = np.array([lower, upper], dtype=np.float64)
        self.voxel_size = np.ptp(self.bounds, axis=0) / self.densities.shape

    def node_densities(self):
        return self.densities

    def node_weights(self):
        return self.weights


def ball_densities(count=40, radius=0.6, density=200.0, center=(0.1, 0, 0)):
    """A ball whose density falls from 2 * density to 0 over four voxels around its radius."""
    distance = np.linalg.norm(nodes(count) - center, axis=-1) - radius
    return density * np.clip(1.0 - distance / (4.0 / count), 0.0, 2.0)


def boxes(*corners):
    """Matter in boxes given by their corners."""
    return lambda x: 40.0 * sum(((x > low) & (x < high)).all(axis=-1) for low, high in corners).clip(0, 1)


#: A cage, and boxes of matter that it cuts.
PART = Cage.box([0.0, -0.4, -0.4], [0.8, 0.4, 0.4])
INSIDE = ([0.1, -0.3, -0.3], [0.7, 0.3, 0.3])
NUB = ([0.2, -0.1, 0.2], [0.3, 0.0, 0.5])  # out of the cage by a little


#: Squares along the side of the cube that is at infinity.
CUBE_SIDE = 48


def colors_at_infinity(fog):
    """(nodes, 4) an even gradient at infinity; behind the ball random colours, as fits leave them there."""
    places = surface_points(CUBE_SIDE) / CUBE_SIDE * 2.0 - 1.0
    values = np.ones((len(places), 4))
    values[:, :3] = 0.5 + 0.6 * places[:, [0, 2, 2]] * [1.0, 1.0, -0.5]
    if fog:
        hidden = (np.linalg.norm(places[:, [0, 2]], axis=1) < 0.09) & (places[:, 1] == 1.0)
        assert hidden.sum() > 10
        values[hidden, :3] = np.random.default_rng(1).random((hidden.sum(), 3))
    return values


def surrounded_ball(device, around="layers", fog=True):
    """A ball before nothing but infinity, which is the last of two layers or the sky of an outer field."""
    field = make_field(lambda x: ellipsoid(x, radii=(0.4, 0.4, 0.4)), plain([0.8, 0.3, 0.1]), device=device)
    if around is None:
        return field
    values = np.stack([np.zeros_like(colors_at_infinity(fog)), colors_at_infinity(fog)])
    if around == "layers":
        background = LayeredBackground((0, 0, 0), 1.5, CUBE_SIDE, values, device=device)
    else:
        links = np.full((8, 8, 8), -1, np.int32)
        half = 0.5 * (field.bounds[1] - field.bounds[0])
        background = OuterField(
            (0, 0, 0), half, links, np.zeros((0, 4)), sky=colors_at_infinity(fog)[:, :3], device=device
        )
    return VoxelField(
        field.bounds, field.grid.links, field.grid.density, harmonics_on_host(field.grid.sh),
        background_model=background, device=device,
    )  # fmt: skip
