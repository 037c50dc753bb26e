"""Views of Gaussian splats: against the equations in float64 at every pixel, and what must hold for any splats."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import warp as wp
from refusals import refused
from splat_scenes import reference_view

from warpcage import Cage, Camera, SplatField
from warpcage.cage import standing_of_rest
from warpcage.field.render import RenderOptions
from warpcage.kernels.splats.splats import Splats
from warpcage.splats import SplatRenderer, render

WHITE = (1.0, 1.0, 1.0)


def psnr(one, two):
    return -10 * np.log10(max(np.mean((np.asarray(one) - np.asarray(two)) ** 2), 1e-30))


def random_rotations(count, rng):
    q, r = np.linalg.qr(rng.normal(size=(count, 3, 3)))
    q = q * np.sign(np.einsum("nii->ni", r))[:, None]
    return q * np.sign(np.linalg.det(q))[:, None, None]


def random_parts(count, scale, *, degree=3, seed=0):
    """Centres, covariances, opacities and harmonics of splats in [-1, 1]^3, some flat, some long; float32."""
    rng = np.random.default_rng(seed)
    axes = random_rotations(count, rng) * (scale * np.exp(rng.normal(size=(count, 1, 3))))
    parts = (
        rng.uniform(-1, 1, (count, 3)),
        axes @ axes.transpose(0, 2, 1),
        rng.uniform(0, 1, count),
        0.2 * rng.normal(size=(count, (degree + 1) ** 2, 3)),
    )
    return tuple(part.astype(np.float32) for part in parts)


def quaternions(matrices):
    """(n, 4) x y z w."""
    return np.array([wp.quat_from_matrix(wp.mat33(*m.ravel().astype(float))) for m in matrices], np.float32)


def on_device(parts, device, *, turns=None, rows=None):
    centers, covariances, opacities, harmonics = parts
    splats = Splats()
    splats.centers = wp.array(centers, dtype=wp.vec3, device=device)
    six = covariances[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    splats.covariances = wp.array(six, dtype=wp.float32, device=device)
    splats.opacities = wp.array(opacities, dtype=wp.float32, device=device)
    rows_of = harmonics.reshape(len(harmonics), 3 * harmonics.shape[1])
    splats.harmonics = wp.array(rows_of, dtype=wp.float32, device=device)
    splats.degree = round(harmonics.shape[1] ** 0.5) - 1
    turned = np.empty((0, 4), np.float32) if turns is None else quaternions(turns)
    splats.turns = wp.array(turned, dtype=wp.quat, device=device)
    splats.rows = wp.array(np.empty(0, np.int32) if rows is None else rows, dtype=wp.int32, device=device)
    return splats


def camera(width=75, height=60, eye=(2.0, -3.0, 1.0), **options):
    return Camera.look_at(eye, (0, 0, 0), width=width, height=height, **options)


def assert_is_reference(frame, reference, *, least=75.0):
    color, opacity, depth = reference
    assert psnr(frame.rgb, color) > least and psnr(frame.alpha, opacity) > least
    assert (np.isfinite(frame.depth) == np.isfinite(depth)).mean() > 0.999  # alpha beside its limit
    both = np.isfinite(frame.depth) & np.isfinite(depth) & (opacity > 0.01)
    assert both.any() and np.abs(frame.depth[both] / depth[both] - 1).max() < 1e-3


#: Splats, camera and options of views.
VIEWS = {}
for count, scale, degree in ((500, 0.03, 0), (400, 0.1, 1), (300, 0.05, 2), (60, 0.5, 3)):
    for kind, antialias in (("plain", False), ("antialiased", True)):
        options = {"color": (1, 0.5, 0.2), "antialias": antialias}
        VIEWS[f"{count} splats, {kind}"] = random_parts(count, scale, degree=degree), camera(), options
# the principal point is off the middle, and splats are beside, behind and all around it
AMONG = Camera(50, 60, 20, 44.5, 75, 60, Camera.look_at((0.1, 0.2, 0.1), (0, 1, 0)).camera_to_world)
VIEWS["a camera among the splats"] = random_parts(700, 0.1), AMONG, {"near": 0.05}
for size in ((1, 1), (16, 16), (17, 31), (300, 3)):
    VIEWS[f"a picture of {size}"] = random_parts(100, 0.2, degree=0), camera(*size), {"color": WHITE}


@pytest.mark.parametrize("name", VIEWS)
def test_views_are_those_of_the_equations(name, device):
    parts, view, options = VIEWS[name]
    frame = SplatRenderer(device).render(on_device(parts, device), view, **options)
    options = {{"color": "background"}.get(key, key): value for key, value in options.items()}
    assert_is_reference(frame, reference_view(*parts, view, **options))


def test_splats_that_are_turned_and_share_rows(device):
    centers, covariances, opacities, harmonics = random_parts(300, 0.1)
    rng = np.random.default_rng(1)
    turns, rows = random_rotations(300, rng), rng.integers(0, 20, 300).astype(np.int32)
    splats = on_device((centers, covariances, opacities, harmonics[:20]), device, turns=turns, rows=rows)
    reference = reference_view(centers, covariances, opacities, harmonics[rows], camera(), turns=turns)
    assert_is_reference(SplatRenderer(device).render(splats, camera()), reference)


@pytest.mark.parametrize("name", ["small_degree3.ply", "biker.compressed.ply"])
def test_views_of_real_files(name, device, real_data):
    path = real_data / "splats" / name
    if not path.is_file():
        pytest.skip(f"no {path}")
    field = SplatField.load(path, device=device)
    if len(field) > 10_000:  # its head
        field = field.chosen(field.contents.centers[:, 1] < -2.75)
    middle = np.median(field.contents.centers, axis=0)
    radius = np.percentile(np.linalg.norm(field.contents.centers - middle, axis=1), 90)
    view = Camera.look_at(middle + radius * np.array([2, 0.5, -2]), middle, up=field.up, width=24, height=21)
    held = field.contents
    parts = (held.centers, field.covariances, field.opacities, held.harmonics)
    reference = reference_view(*parts, view, WHITE, near=field.near)
    assert_is_reference(field.render(view, background="white"), reference, least=70)


def ball(place=(0.0, 0.0, 0.0), size=0.3, opacity=0.8, color=(0.9, 0.3, 0.1)):
    """One splat without a view-dependent colour."""
    harmonics = (np.array(color) - 0.5) / 0.28209479177387814
    covariance = np.diag([size * size] * 3)
    return tuple(np.array(part, np.float32)[None] for part in (place, covariance, opacity, harmonics[None]))


def join(*parts):
    return tuple(np.concatenate(each) for each in zip(*parts, strict=True))


def test_one_splat_over_another(device):
    """In the middle of each the colour is that of its opacity, and the depth the mean of both distances."""
    view = Camera.look_at((0, -4, 0), (0, 0, 0), width=33, height=33)
    parts = join(ball((0, 1, 0), 0.6, 0.5, (0, 0, 1)), ball((0, 0, 0), 0.3, 0.8, (1, 0, 0)))
    frame = SplatRenderer(device).render(on_device(parts, device), view, color=WHITE)
    assert np.allclose(frame.rgb[16, 16], 0.8 * np.array([1, 0, 0]) + 0.1 * np.array([0, 0, 1]) + 0.1, atol=2e-6)
    assert np.isclose(frame.alpha[16, 16], 0.9, atol=2e-6)
    assert np.isclose(frame.depth[16, 16], (0.8 * 4 + 0.1 * 5) / 0.9, rtol=1e-5)
    assert np.allclose(frame.rgb[0, 0], 1) and frame.alpha[0, 0] == 0 and np.isinf(frame.depth[0, 0])


def test_the_depth_of_a_slanted_disc_is_that_of_its_plane(device):
    axes = np.array([[1, 0, 0], [0, 0.6, 0.8], [0, -0.8, 0.6]]).T  # the last one is its normal
    covariance = (axes * np.array([0.1, 0.1, 1e-4]) ** 2) @ axes.T
    parts = list(ball())
    parts[1] = covariance[None].astype(np.float32)
    view = Camera.look_at((0, 0, 6), (0, 0, 0), up=(0, 1, 0), width=80, height=80, fov_degrees=4)
    frame = SplatRenderer(device).render(on_device(parts, device), view)
    origins, directions = (np.asarray(each).reshape(80, 80, 3) for each in view.rays())
    plane = -(origins @ axes[:, 2]) / (directions @ axes[:, 2])
    seen = frame.alpha > 0.3
    slant = np.ptp(plane[seen])
    assert seen.sum() > 300 and np.abs(frame.depth - plane)[seen].max() < 0.02 * slant


@pytest.mark.parametrize(
    ("change", "seen"),
    [
        ({"size": 0.0}, True),  # the blur of the picture shows it
        ({"size": 1e3}, True),
        ({"size": 1e12}, False),  # beyond float32
        ({"place": (0, -3.99999, 0), "size": 0.01}, True),  # at the camera
        ({"place": (0, -4.5, 0), "size": 0.5}, False),  # behind it
        ({"place": (0, -4, 0)}, False),  # in its plane
        ({"opacity": 0.0}, False),
        ({"opacity": 1 / 256}, False),
        ({"opacity": 1.0}, True),
        ({"place": (np.nan, 0, 0)}, False),
        ({"size": np.nan}, False),
        ({"size": np.inf}, False),
        ({"opacity": np.nan}, False),
        ({"place": (1e30, 1e30, 0)}, False),
    ],
)
def test_degenerate_splats(change, seen, device):
    """They are drawn or left out, and what is behind them stays as it is."""
    view = Camera.look_at((0, -4, 0), (0, 0, 0), width=33, height=33)
    renderer = SplatRenderer(device)
    frame = renderer.render(on_device(ball(**change), device), view, color=WHITE)
    assert np.isfinite(frame.rgb).all() and (frame.alpha >= 0).all() and (frame.alpha <= 1).all()
    assert not np.isnan(frame.depth).any() and (frame.depth > 0).all()
    assert (frame.alpha.max() > 0.5) == seen
    if not seen:
        behind = ball((0, 1, 0), 0.5)
        alone = renderer.render(on_device(behind, device), view)
        both = renderer.render(on_device(join(behind, ball(**change)), device), view)
        assert (both.rgb == alone.rgb).all() and (both.depth == alone.depth).all()


def test_views_of_nothing(device):
    renderer = SplatRenderer(device)
    none = tuple(part[:0] for part in ball())
    away = ball((0, 0, 90))
    for parts in (none, away):
        frame = renderer.render(on_device(parts, device), camera(20, 10), color=(0.2, 0.4, 0.6))
        assert np.allclose(frame.rgb, (0.2, 0.4, 0.6)) and (frame.alpha == 0).all() and np.isinf(frame.depth).all()


def test_the_same_view_twice_and_in_bands(device, monkeypatch):
    """Also with buffers that held something larger before, and where entries are sorted in several parts."""
    splats = on_device(random_parts(2000, 0.1), device)
    view = camera(100, 90)
    first = SplatRenderer(device).render(splats, view)
    renderer = SplatRenderer(device)
    renderer.render(on_device(random_parts(3000, 0.2), device), camera(150, 150))
    frames = [renderer.render(splats, view)]
    assert renderer.entry_count > 4000
    monkeypatch.setattr(render, "MAX_ENTRIES", 1000)
    frames.append(renderer.render(splats, view))
    for frame in frames:
        assert (frame.rgb == first.rgb).all() and (frame.depth == first.depth).all()


def test_threads_share_a_renderer(device):
    """Its buffers are used by one at a time."""
    renderer = SplatRenderer(device)
    splats = [on_device(random_parts(count, 0.1, seed=count), device) for count in (200, 1500)]
    views = [camera(40, 30), camera(90, 80)]
    alone = [renderer.render(*each).rgb for each in zip(splats, views, strict=True)]
    with ThreadPoolExecutor(4) as pool:
        frames = list(pool.map(lambda i: renderer.render(splats[i % 2], views[i % 2]).rgb, range(24)))
    assert all((frame == alone[i % 2]).all() for i, frame in enumerate(frames))


def test_the_order_of_splats_does_not_matter(device):
    parts = random_parts(500, 0.1)
    shuffled = np.random.default_rng(3).permutation(500)
    renderer = SplatRenderer(device)
    one = renderer.render(on_device(parts, device), camera())
    two = renderer.render(on_device(tuple(part[shuffled] for part in parts), device), camera())
    assert (one.rgb == two.rgb).all()


@pytest.mark.parametrize("antialias", [False, True])
def test_several_rays_for_a_pixel(antialias, device):
    """The mean of a finer picture that is blurred as widely, so that the field keeps its look."""
    parts = random_parts(250, 0.03)
    renderer = SplatRenderer(device)
    view = camera(32, 24)
    fine = reference_view(*parts, camera(96, 72), WHITE, blur=0.3 * 9, antialias=antialias)
    frame = renderer.render(
        on_device(parts, device), view, color=WHITE, options=RenderOptions(supersampling=3, antialias=antialias)
    )
    assert psnr(frame.rgb, fine[0].reshape(24, 3, 32, 3, 3).mean(axis=(1, 3))) > 75
    assert psnr(frame.alpha, fine[1].reshape(24, 3, 32, 3).mean(axis=(1, 3))) > 75
    assert psnr(frame.rgb, renderer.render(on_device(parts, device), view, color=WHITE, antialias=antialias).rgb) > 30


def test_a_field_renders(device):
    rng = np.random.default_rng(4)
    field = SplatField(
        1000 + rng.uniform(-1, 1, (200, 3)),  # its origin is its centre, so that far away is as good
        np.log(0.1 * np.exp(rng.normal(size=(200, 3)))),
        rng.normal(size=(200, 4)),
        rng.normal(size=200),
        0.2 * rng.normal(size=(200, 4, 3)),
        background="white",
        device=device,
    )
    view = Camera.look_at(field.center + (2, -3, 1), field.center, width=50, height=40)
    held = field.contents
    parts = (held.centers, field.covariances, field.opacities, held.harmonics)
    assert_is_reference(field.render(view), reference_view(*parts, view, WHITE, near=field.near), least=65)
    frame = field.render(view, background=(0.1, 0.2, 0.3), supersampling=2, antialias=True)
    assert frame.rgb.shape == (40, 50, 3) and frame.arrays["rgb"].device == field.device
    for option, value in (("background", "mauve"), ("supersampling", 0), ("supersampling", 99)):
        with pytest.raises(ValueError, match="mauve" if value == "mauve" else option):
            field.render(view, **{option: value})
    refused(lambda: field.render("front"), match="Camera")


def test_a_cage_around_an_object_is_its_cage_however_far_other_splats_lie(device):
    """Fits of whole places have a few splats thousands of times as far as their objects."""
    rng = np.random.default_rng(0)
    centers = np.concatenate([rng.uniform(-0.5, 0.5, (600, 3)), rng.uniform(-9, 9, (600, 3)), [[5e3, -4e3, 3e3]]])
    count = len(centers)
    turns, rest = rng.normal(size=(count, 4)), (np.full(count, 2.0), np.zeros((count, 1, 3)))
    field = SplatField(centers, np.full((count, 3), np.log(0.05)), turns, *rest, device=device)
    assert len(field.shown_points) > 1100 and np.abs(field.shown_points).max() < 10
    standing = standing_of_rest(Cage.box((-0.6, -0.6, -0.6), (0.6, 0.6, 0.6)), "z", field)
    assert not standing.lost and not standing.turned
    away = standing_of_rest(Cage.box((50, 50, 50), (51, 51, 51)), "z", field)
    assert away.lost
