"""Fields of another representation under cages, beside an analytic ball in float64 and beside voxels."""

import numpy as np
import pytest
import warp as wp
from fields import march_in_numpy, psnr, two_balls
from refusals import refused

import warpcage
from warpcage import Cage, CageEdit, Camera, Deformer, SampledField

RADIUS, SIGMA, COLOR = 0.5, 6.0, np.array([0.9, 0.3, 0.1])
BOUNDS = [[-1, -1, -1], [1, 1, 1]]
REST = Cage.box([-0.7] * 3, [0.7] * 3, segments=2)

LATTICE = {"coordinates": "mean_value", "resolution": 24}


def ball(points, directions):
    """A ball of one density, as somebody's own NumPy code has it."""
    x = points.numpy()
    return np.broadcast_to(COLOR, x.shape), np.where(np.linalg.norm(x, axis=1) < RADIUS, SIGMA, 0.0)


def facing(points, directions):
    """The same, whose colour is the direction from which it is seen."""
    return 0.5 + 0.5 * directions.numpy(), ball(points, directions)[1]


def chords(camera, matrix, offset):
    """(h, w) float64 lengths of rays inside the ball after x -> matrix x + offset, and distances to their middles."""
    origins, directions = camera.rays()
    inverse = np.linalg.inv(matrix)
    o, d = (origins - offset) @ inverse.T, directions @ inverse.T
    a, b, c = (d * d).sum(-1), (o * d).sum(-1), (o * o).sum(-1) - RADIUS**2
    root = np.sqrt(np.maximum(b * b - a * c, 0.0))
    return 2 * root / a, -b / a


CAMERA = Camera.look_at((2.4, 1.1, 0.9), (0, 0, 0), fov_degrees=40, width=40, height=32)
MATRICES = {
    "turned": REST.rotate(50, axis="y"),
    "stretched": REST.stretch(1.6),
    "moved": REST.translate((0.3, -0.2, 0.1)).scale(0.8),
}


@pytest.mark.parametrize("density", ["opacity", "paper"])
@pytest.mark.parametrize("pose", MATRICES)
def test_a_ball_under_an_affine_pose_is_an_ellipsoid(pose, density, device):
    posed = MATRICES[pose]
    field = SampledField(ball, BOUNDS, step=0.004, background="black", device=device)
    deformer = Deformer(field, REST, **LATTICE, density=density, device=device)
    frame = deformer.pose(posed).render(CAMERA)
    homogeneous = np.concatenate([REST.vertices, np.ones((len(REST.vertices), 1))], axis=1)
    solved = np.linalg.lstsq(homogeneous, posed.vertices, rcond=None)[0]
    matrix, offset = solved[:3].T, solved[3]
    length, middle = chords(CAMERA, matrix, offset)
    _, directions = CAMERA.rays()
    stretch = np.linalg.norm(directions @ np.linalg.inv(matrix).T, axis=-1) if density == "opacity" else 1.0
    alpha = 1 - np.exp(-SIGMA * stretch * length)
    rim = length < 0.15  # a step is a large part of what is there
    assert rim.mean() < 0.95 and np.abs(frame.alpha - alpha)[~rim].max() < 0.02
    assert np.abs(frame.alpha - alpha)[length == 0].max(initial=0.0) < 0.05
    assert np.abs(frame.rgb - frame.alpha[..., None] * COLOR).max() < 1e-5
    assert (frame.depth[~rim] < middle[~rim] + 0.01).all() and np.isinf(frame.depth[length == 0]).any()


def test_a_turn_moves_the_view(device):
    field = SampledField(facing, BOUNDS, step=0.01, device=device)
    deformer, still = (Deformer(field, REST, **LATTICE, device=device) for _ in range(2))
    deformer.pose(REST.rotate(90))
    ahead, side = (Camera.look_at(eye, (0, 0, 0), width=24, height=24) for eye in ((0, -3, 0), (-3, 0, 0)))
    seen, expected = deformer.render(ahead).rgb, still.render(side).rgb
    assert psnr(seen, expected) > 40 > 20 > psnr(still.render(ahead).rgb, expected)


@pytest.mark.parametrize(("density", "resolution"), [("opacity", 32), ("paper", None)])
def test_voxels_asked_as_a_function_are_those_voxels(density, resolution, device):
    voxels = two_balls(device)
    rest = Cage.box(*(voxels.bounds + [[0.05] * 3, [-0.05] * 3]))
    options = {"coordinates": "mean_value", "resolution": resolution, "density": density, "device": device}
    own = Deformer(SampledField(voxels.sample, voxels.bounds, step=voxels.step, device=device), rest, **options)
    poses = rest.bend(30, axis="x", towards="z")
    camera = Camera.look_at(np.ptp(voxels.bounds, axis=0) * 1.5, voxels.center, width=14, height=14)
    whole = Deformer(voxels, rest, **options).pose(poses)
    assert psnr(own.pose(poses).render(camera).rgb, whole.render(camera).rgb) > 55
    if density == "opacity":
        assert psnr(own.render(camera).rgb, march_in_numpy(voxels, whole, camera)) > 38
    points = np.random.default_rng(0).uniform(*voxels.bounds, (500, 3))
    assert all(
        np.array_equal(a, b) for a, b in zip(own.sample(points, points), whole.sample(points, points), strict=True)
    )
    here, along, region = whole.to_canonical(points.astype(np.float32), points.astype(np.float32))
    rgb, sigma = voxels.sample(here, along)
    if density == "paper":
        found = whole.sample(points, points)
        assert np.abs(found[1] - np.where(region == 1, 0, sigma)).max() < 1e-3 * sigma.max()
        assert np.abs(found[0] - rgb)[region != 1].max() < 1e-3


def test_poses_views_and_removals(device):
    field = SampledField(ball, BOUNDS, step=0.02, device=device)
    edits = [REST, CageEdit(Cage.box([0, -0.7, -0.7], [0.7] * 3), remove=True)]
    deformer = Deformer(field, edits, **LATTICE, device=device)
    frames = deformer.pose([REST, None]).render([CAMERA, CAMERA])
    assert np.array_equal(frames.rgb[0], frames.rgb[1])
    inside = np.array([[0.2, 0, 0], [-0.2, 0, 0], [5, 0, 0]])
    assert deformer.sample(inside, np.ones((3, 3)))[1].tolist() == pytest.approx([0.0, SIGMA, 0.0], rel=1e-3)
    apart = deformer.posed([REST.translate((0, 0, 4)), None])
    moved = apart.sample([[-0.2, 0, 0], [-0.2, 0, 4]], np.ones((2, 3)))[1]
    assert moved.tolist() == pytest.approx([0, SIGMA], rel=0.01)
    assert deformer.reached_bounds.tolist() == BOUNDS
    assert all(len(part) == 0 for part in deformer.sample(np.zeros((0, 3)), np.zeros((0, 3))))
    assert field.to(device) is field and "ball" in repr(field)


def test_a_picture_of_many_samples_comes_in_parts(device):
    seen = []

    def counted(points, directions):
        seen.append(len(points))
        return ball(points, directions)

    deformer = Deformer(SampledField(counted, BOUNDS, step=0.002, device=device), REST, resolution=16, device=device)
    camera = CAMERA.resized(20, 20)
    fine = deformer.render(camera.resized(40, 40), background="black", supersampling=1)
    assert len(seen) > 1 and max(seen) <= 1 << 20
    half = deformer.render(camera, background="black", supersampling=2)
    assert np.abs(half.rgb - fine.rgb.reshape(20, 2, 20, 2, 3).mean(axis=(1, 3))).max() < 1e-5


@pytest.mark.parametrize("said, function", [
    ("0 or more", lambda x, d: (np.zeros((len(x), 3)), np.full(len(x), -1.0))),
    ("finite and", lambda x, d: (np.zeros((len(x), 3)), np.full(len(x), np.nan))),
    ("densities of a field must be", lambda x, d: (np.zeros((len(x), 3)), np.zeros(len(x) + 1))),
    ("must return .* colours, got", lambda x, d: (np.zeros((len(x) + 1, 3)), np.zeros(len(x)))),
    ("real numbers, got list", lambda x, d: (np.zeros((len(x), 3)), ["a"] * len(x))),
    ("colours and densities, got ndarray", lambda x, d: np.zeros((len(x), 3))),
])  # fmt: skip
def test_what_a_function_may_not_return(said, function, device):
    deformer = Deformer(SampledField(function, BOUNDS, step=0.1, device=device), REST, resolution=16, device=device)
    refused(lambda: deformer.render(CAMERA), match=said)


def test_what_is_of_voxels_is_refused(device):
    field = SampledField(ball, BOUNDS, device=device)
    deformer = Deformer(field, REST, **LATTICE, device=device)
    for call in (
        lambda: SampledField("ball", BOUNDS),
        lambda: SampledField(ball, BOUNDS, step=0.0),
        lambda: Deformer(field, CageEdit(REST, falloff=0.1, held="still"), device=device),
        lambda: Deformer(field, REST, map="forward", device=device),
        lambda: deformer.render(CAMERA, antialias=True),
        lambda: deformer.render(CAMERA, outputs="instance"),
        lambda: warpcage.bake(deformer),
        lambda: warpcage.Stage().add("ball", deformer),
        lambda: warpcage.Stage().add("ball", field),
    ):
        refused(call, error=warpcage.Error)


@wp.kernel
def fill_ball(points: wp.array(dtype=wp.vec3), rgb: wp.array(dtype=wp.vec3), density: wp.array(dtype=float)):
    n = wp.tid()
    rgb[n] = wp.vec3(0.9, 0.3, 0.1)
    density[n] = wp.where(wp.length(points[n]) < 0.5, 6.0, 0.0)


def test_functions_of_other_libraries(device):
    def in_warp(points, directions):
        rgb = wp.empty(len(points), dtype=wp.vec3, device=device)
        density = wp.empty(len(points), dtype=float, device=device)
        wp.launch(fill_ball, dim=len(points), inputs=[points], outputs=[rgb, density], device=device)
        return rgb, density

    def picture(function):
        field = SampledField(function, BOUNDS, step=0.02, device=device)
        return Deformer(field, REST, resolution=16, device=device).pose(REST.twist(30)).render(CAMERA).rgb

    expected = picture(ball)
    assert np.abs(picture(in_warp) - expected).max() < 1e-5
    torch = pytest.importorskip("torch")

    def in_torch(points, directions):
        x = torch.from_dlpack(points)
        rgb = torch.tensor(COLOR, dtype=torch.float64, device=x.device).expand(len(x), 3)
        return rgb, torch.where(x.norm(dim=1, keepdim=True) < RADIUS, SIGMA, 0.0).half()  # (n, 1)

    assert np.abs(picture(in_torch) - expected).max() < 1e-5
