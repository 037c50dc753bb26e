"""Loss of pictures of splats: slopes against differences and the textbook's equations in float64."""

import functools

import numpy as np
import pytest
import warp as wp
from scipy.ndimage import correlate1d, minimum_filter
from skimage.metrics import structural_similarity

from warpcage.core import limit_threads, recorded_launches
from warpcage.fitting.splats import PictureLoss

C1, C2 = 0.01**2, 0.03**2
SIZES = [(24, 19), (13, 40), (11, 11), (8, 30), (70, 53), (33, 26)]


@functools.cache
def taps():
    offsets = np.arange(-5, 6)
    weights = np.exp(-(offsets**2) / (2 * 1.5**2))
    return weights / weights.sum()


def blurred(values):
    """The Gaussian of a picture's windows, zeros around it."""
    return correlate1d(correlate1d(values, taps(), axis=0, mode="constant"), taps(), axis=1, mode="constant")


def moments(x, y):
    """mx, my, g*x^2, g*(x y), g*y^2."""
    return blurred(x), blurred(y), blurred(x * x), blurred(x * y), blurred(y * y)


def factors(mx, my, xx, xy, yy):
    """A, B, P, Q of S = P Q / (A B)."""
    b = xx - mx * mx + yy - my * my + C2
    return mx * mx + my * my + C1, b, 2 * mx * my + C1, 2 * (xy - mx * my) + C2


def window_shares(weights, shape):
    """What a window counts around each pixel: the least of its pixels, 0 where it leaves the picture."""
    shares = np.zeros(shape)
    height, width = shape
    if min(height, width) >= 11:
        weights = np.ones(shape) if weights is None else weights
        shares[5:-5, 5:-5] = minimum_filter(weights, 11)[5:-5, 5:-5]
    return shares[..., None]


def loss_of(x, y, share=0.2, weights=None):
    """The loss of pictures (h, w, 3)."""
    height, width = x.shape[:2]
    by_pixel = np.ones((height, width, 1)) if weights is None else weights[..., None]
    color = (by_pixel * np.abs(x - y)).mean()
    if min(height, width) < 11:
        return color
    a, b, p, q = factors(*moments(x, y))
    unlike = window_shares(weights, x.shape[:2]) * (1 - p * q / (a * b))
    return (1 - share) * color + share * unlike.sum() / (3 * (height - 10) * (width - 10))


def slopes_of(x, y, share=0.2, weights=None):
    """Slopes of `loss_of` by x, by the three moments that depend on it."""
    height, width = x.shape[:2]
    by_pixel = np.ones((height, width, 1)) if weights is None else weights[..., None]
    color = by_pixel * np.sign(x - y) / x.size
    if min(height, width) < 11:
        return color
    mx, my, *_ = found = moments(x, y)
    a, b, p, q = factors(*found)
    w = -share * window_shares(weights, x.shape[:2]) / (3 * (height - 10) * (width - 10))
    by_mean = 2 / (a * b) * (my * (q - p) + mx * p * q * (1 / b - 1 / a))
    by_square, by_product = -p * q / (a * b * b), 2 * p / (a * b)
    similarity = blurred(w * by_mean) + 2 * x * blurred(w * by_square) + y * blurred(w * by_product)
    return (1 - share) * color + similarity


def random_pictures(shape, seed=0, *, smooth=True):
    """Two pictures of float32 numbers, in float64: one with structure, and another near it with noise."""
    rng = np.random.default_rng(seed)
    y = rng.random((*shape, 3))
    if smooth:
        y = np.clip(0.5 + 4 * (correlate1d(correlate1d(y, taps(), axis=0), taps(), axis=1) - 0.5), 0, 1)
    x = y + 0.1 * rng.normal(size=y.shape)
    return [picture.astype(np.float32).astype(np.float64) for picture in (x, y)]


def on_device(picture, device, dtype=wp.vec3):
    rows = picture.reshape(-1, 3) if dtype is wp.vec3 else picture.reshape(-1)
    return wp.array(rows.astype(np.float32), dtype=dtype, device=device)


def slopes_on(device, x, y, weights=None, **options):
    """Slopes (h, w, 3) times the numbers of the picture, and errors (h, w)."""
    height, width = x.shape[:2]
    loss = PictureLoss(width, height, device, **options)
    weights = None if weights is None else on_device(weights, device, wp.float32)
    found = loss.slopes(on_device(x, device), on_device(y, device), weights)
    return x.size * found.numpy().reshape(x.shape).astype(np.float64), loss.errors.numpy().reshape(height, width)


def assert_close(found, expected, size, most=2e-5):
    """Slopes times `size` are the expected ones, to a share of the largest of them."""
    expected = size * expected
    assert np.abs(found - expected).max() < most * max(1.0, np.abs(expected).max())


@pytest.mark.parametrize("shape", SIZES)
@pytest.mark.parametrize(("smooth", "share"), [(True, 0.2), (False, 0.2), (True, 0.0), (True, 1.0)])
def test_slopes_are_those_of_the_equations(shape, smooth, share, device):
    """By the share that similarity has of the loss."""
    x, y = random_pictures(shape, smooth=smooth)
    found, errors = slopes_on(device, x, y, ssim_share=share)
    assert_close(found, slopes_of(x, y, share), x.size)
    assert np.allclose(errors, ((x - y) ** 2).mean(-1), rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("shape", SIZES[:4])
def test_slopes_are_differences(shape, device):
    x, y = random_pictures(shape, seed=1)
    found, _ = slopes_on(device, x, y)
    step, rng = 1e-6, np.random.default_rng(2)
    for place in rng.permutation(x.size)[:60]:
        ends = []
        for side in (step, -step):
            moved = x.copy()
            moved.reshape(-1)[place] += side
            ends.append(loss_of(moved, y))
        expected = x.size * (ends[0] - ends[1]) / (2 * step)
        assert abs(found.reshape(-1)[place] - expected) < 2e-4 * np.abs(found).max()


def test_slopes_add_up_to_the_loss(device):
    """From the truth to the drawn picture, along a line: the loss there, whose similarity is that of scikit-image."""
    x, y = random_pictures((40, 31), seed=3)
    similarity = structural_similarity(
        x, y, channel_axis=-1, data_range=1.0, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
    )
    expected = 0.8 * np.abs(x - y).mean() + 0.2 * (1 - similarity)
    assert abs(loss_of(x, y) - expected) < 1e-12
    loss = PictureLoss(31, 40, device)
    total, truth = 0.0, on_device(y, device)
    for place, weight in zip(*np.polynomial.legendre.leggauss(12), strict=True):
        at = 0.5 + 0.5 * place
        found = loss.slopes(on_device(y + at * (x - y), device), truth).numpy().reshape(x.shape)
        total += 0.5 * weight * (found.astype(np.float64) * (x - y)).sum()
    assert abs(total - expected) < 1e-4 * expected


@pytest.mark.parametrize("shape", [(24, 19), (70, 53), (8, 30)])
def test_equal_pictures_have_no_slopes(shape, device):
    """To the bit, whether they have structure or one color."""
    _, y = random_pictures(shape)
    for picture in (y, np.full_like(y, 0.7), np.zeros_like(y)):
        found, errors = slopes_on(device, picture, picture)
        assert (found == 0).all() and (errors == 0).all()


@pytest.mark.parametrize("drawn", [0.0, 0.3, 0.71, 1.0, 2.5])
def test_pictures_of_one_color(drawn, device):
    """Variances are 0 but for rounding, which would show most where colors are bright."""
    drawn, shape = float(np.float32(drawn)), (24, 37, 3)
    flat = np.full(shape, drawn)
    for y in (np.full(shape, float(np.float32(0.7))), random_pictures(shape[:2])[1]):
        found, _ = slopes_on(device, flat, y)
        assert_close(found, slopes_of(flat, y), flat.size, 1e-3)
        found, _ = slopes_on(device, y, flat)
        assert_close(found, slopes_of(y, flat), flat.size, 1e-3)


def test_nearly_equal_pictures_of_one_color_keep_their_digits(device):
    """A 255th of contrast on a bright wall, where B is little more than C2."""
    rng = np.random.default_rng(5)
    y = (np.round(255 * 0.9 + rng.integers(0, 2, (30, 30, 3))) / 255).astype(np.float32).astype(np.float64)
    x = (y + 1e-3 * rng.normal(size=y.shape)).astype(np.float32).astype(np.float64)
    found, _ = slopes_on(device, x, y)
    assert_close(found, slopes_of(x, y), x.size, 1e-4)


@pytest.mark.parametrize("shape", [(40, 57), (9, 30)])
def test_weights(shape, device):
    """Windows count as the least of their pixels, and what is left out has no slopes and changes none."""
    rng = np.random.default_rng(6)
    x, y = random_pictures(shape, seed=7)
    mask = np.ones(shape)
    mask[:4, :9], mask[shape[0] // 2 :, 40:] = 0, 0
    for weights in (mask, mask * rng.uniform(0.2, 1.0, shape).astype(np.float32)):
        found, _ = slopes_on(device, x, y, weights)
        expected = slopes_of(x, y, weights=weights)
        assert_close(found, expected, x.size)
        other = np.where(mask[..., None] == 0, rng.random(x.shape), x)
        changed, _ = slopes_on(device, other, y, weights)
        assert (found[mask == 0] == 0).all() and (found == changed).all()
    whole, ones = slopes_on(device, x, y)[0], slopes_on(device, x, y, np.ones(shape))[0]
    assert (whole == ones).all()
    assert (slopes_on(device, x, y, np.zeros(shape))[0] == 0).all()
    half = np.ones(shape)
    half[:, shape[1] // 2 :] = 0  # the other half counts as before: the sum is not divided by less
    found, far = slopes_on(device, x, y, half)[0], shape[1] // 2 - 10
    assert np.abs(found[:, :far] - whole[:, :far]).max() < 1e-6 * np.abs(whole).max()


def test_any_number_of_threads_gives_the_same_bits():
    x, y = random_pictures((260, 301), seed=9)
    weights = np.random.default_rng(9).random((260, 301))
    found = []
    for threads in (1, 2, 5):
        with limit_threads(threads):
            found.append([*slopes_on("cpu", x, y), *slopes_on("cpu", x, y, weights)])
    assert all((one == other).all() for one, *others in zip(*found, strict=True) for other in others)


def test_kernels_of_both_kinds_agree(device):
    """Tiles in shared memory where there is some, whole rows and columns elsewhere."""
    x, y = random_pictures((45, 70), seed=10)
    with recorded_launches() as labels:
        found, _ = slopes_on(device, x, y)
    assert all(label.endswith("_of_tiles") for label in labels) == (device != "cpu")
    plain, _ = slopes_on(device, x, y, tiled=False)
    assert np.abs(found - plain).max() < 1e-5 * np.abs(plain).max()


def test_a_graph_replays_the_call(device):
    if device == "cpu":
        pytest.skip("graphs are those of CUDA")
    x, y = random_pictures((30, 40), seed=11)
    loss, drawn, truth = PictureLoss(40, 30, device), on_device(y, device), on_device(y, device)
    with wp.ScopedCapture(device=device) as capture:
        slopes = loss.slopes(drawn, truth)
    wp.copy(drawn, on_device(x, device))
    wp.capture_launch(capture.graph)
    assert_close(x.size * slopes.numpy().reshape(x.shape).astype(np.float64), slopes_of(x, y), x.size)


def test_pictures_of_another_size_are_refused(device):
    loss, rows = PictureLoss(12, 14, device), wp.zeros(14 * 12, dtype=wp.vec3, device=device)
    short, few = wp.zeros(14 * 11, dtype=wp.vec3, device=device), wp.zeros(1, dtype=wp.float32, device=device)
    for name, arrays in (("drawn", (short, rows)), ("truth", (rows, short)), ("weights", (rows, rows, few))):
        with pytest.raises(ValueError, match=f"{name} must have 168 pixels"):
            loss.slopes(*arrays)
