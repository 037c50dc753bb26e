"""The tiles of a picture in the order of how long they took: each once, the longest first, and the same picture."""

from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from fields import BOX, ball, box_around, make_field, marches, shiny, shiny_field, use_march, view

from warpcage import Deformer
from warpcage.core import RecordedLaunch, limit_threads, recorded_launches
from warpcage.kernels.view.rays import TILE_SIZE
from warpcage.kernels.view.tile_order import MAX_TICKS, TileOrder, count_tiles, sort_tiles
from warpcage.render import BalancedTiles, tile_order

MOST = int(MAX_TICKS)
CENTERS = (-0.7, 0.0, 0.7)

#: Ticks of so many tiles by name.
TICKS = {
    "none": lambda random, count: np.zeros(count),
    "equal": lambda random, count: np.full(count, 1234),
    "most": lambda random, count: np.full(count, MOST),
    "spread": lambda random, count: 2 ** random.uniform(0, 31, count) - 1,
    "some": lambda random, count: np.where(random.random(count) < 0.1, random.integers(0, 5000, count), 0),
}


@pytest.fixture(autouse=True)
def one_thread():
    """On a CPU one thread sorts, as atomics are none there."""
    with limit_threads(1):
        yield


def sort(tiles, ticks):
    """(launches, tiles) order by ticks of that shape, as a view of such ticks leaves it for the next one."""
    for order, own in zip(tiles.orders, ticks, strict=True):
        order.ticks.assign(own)
    tiles.sort()
    return np.array([order.tiles.numpy() for order in tiles.orders])


@pytest.mark.parametrize("launches", [1, 3])
@pytest.mark.parametrize("tiles", [1, 31, 255, 512, 513, 20000])
def test_each_tile_once_and_the_longest_first(tiles, launches, device):
    """View after view, whatever the ticks. Those of tiles in one bin differ by a twelfth at most."""
    random = np.random.default_rng(tiles)
    sorter = tile_order.SortedTiles(launches, tiles, wp.get_device(device))
    for name in (*TICKS, *TICKS):
        ticks = TICKS[name](random, launches * tiles).astype(np.int32).reshape(launches, tiles)
        order = sort(sorter, ticks)
        np.testing.assert_array_equal(np.sort(order, axis=1), np.tile(np.arange(tiles), (launches, 1)), name)
        found = np.maximum(np.take_along_axis(ticks.astype(float), order, axis=1), 1)
        least_before = np.minimum.accumulate(found, axis=1)
        assert (found <= least_before * 2 ** (1 / 8) * (1 + 1e-5)).all(), name
        assert not any(order.ticks.numpy().any() for order in sorter.orders), name
        assert not sorter.bins[0].numpy().any(), name


def test_launches_are_sorted_apart(device):
    """Each by its own ticks, which are four times as long from tile to tile."""
    ticks = 4 ** np.array([[0, 1, 2, 3, 4], [4, 3, 2, 1, 0], [2, 4, 0, 3, 1]], np.int32)
    order = sort(tile_order.SortedTiles(3, 5, wp.get_device(device)), ticks)
    np.testing.assert_array_equal(order, np.argsort(-ticks, axis=1))


def permuted(tiles, device, random):
    """A TileOrder by hand, and its ticks."""
    order = TileOrder()
    order.tiles = wp.array(random.permutation(tiles).astype(np.int32), dtype=wp.int32, device=device)
    order.ticks = wp.zeros(tiles, dtype=wp.int32, device=device)
    return order


def views_in_any_order(deformer, camera, march, monkeypatch):
    """The same view as tiles lie in the picture, and in several orders by chance; how many tiles each launch has."""
    device, random, begun = deformer.device, np.random.default_rng(1), []

    def begin(self, launches, tiles):
        begun.append((launches, tiles))
        return [permuted(tiles, device, random) for _ in range(launches)]

    def plain(self, launches, tiles):
        return launches * [TileOrder()]

    frames = []
    for function in (plain, begin, begin, begin):
        with monkeypatch.context() as patch, recorded_launches() as launched:
            patch.setattr(BalancedTiles, "begin", function)
            frames.append(deformer.render(camera))
        assert set(marches(launched)) == {march}
    return frames, begun


def interrupted(*arguments):
    raise KeyboardInterrupt


def assert_same(frames):
    for frame in frames[1:]:
        for name in ("rgb", "alpha", "depth", "reveal", "fold", "outside"):
            np.testing.assert_array_equal(getattr(frame, name), getattr(frames[0], name), name)


@pytest.mark.parametrize("size", [(64, 64), (37, 21), (5, 3)])
@pytest.mark.parametrize("march", ["shaded", "rows"])
def test_no_order_changes_a_view(march, size, device, monkeypatch):
    use_march(march, device, monkeypatch)
    deformer = Deformer(shiny_field(device), BOX, coordinates="mean_value", resolution=16).pose(BOX.rotate(30))
    camera = view().resized(*size)
    expected = "views.shaded" if march == "shaded" else "views.rows"
    frames, begun = views_in_any_order(deformer, camera, expected, monkeypatch)
    assert frames[0].alpha.max() > 0.5
    assert_same(frames)
    ((launches, tiles),) = set(begun)
    assert launches == 1 and tiles * TILE_SIZE >= size[0] * size[1]


@pytest.mark.parametrize("march", ["shaded", "rows"])
def test_no_order_changes_a_view_of_several_edits(march, device, monkeypatch):
    """Rays keep their state from launch to launch, each of which has its own order."""
    use_march(march, device, monkeypatch)
    boxes = [box_around(x, 0, 0, half=0.22) for x in CENTERS]
    field = make_field(lambda x: sum(ball(x, (c, 0, 0)) for c in CENTERS), shiny, device=device)
    deformer = Deformer(field, boxes, coordinates="mean_value", resolution=16)
    deformer.pose([box.rotate(40, axis="x") for box in boxes])
    expected = "views.shaded+part" if march == "shaded" else "views.rows+part"
    frames, begun = views_in_any_order(deformer, view((2.4, 1.1, 1.0)).resized(45, 30), expected, monkeypatch)
    assert frames[0].alpha.max() > 0.5
    assert_same(frames)
    assert {launches for launches, _ in begun} == {3}


def test_a_cpu_follows_tiles_as_they_lie():
    balanced = BalancedTiles(wp.get_device("cpu"))
    for _ in range(2):
        assert [order.tiles for order in balanced.begin(2, 40)] == [None, None]
        balanced.end()


@pytest.fixture
def balanced(device, monkeypatch):
    """BalancedTiles that sort on any device."""
    if device != "cpu":
        return BalancedTiles(wp.get_device(device))
    arrays = tile_order.SortedTiles
    monkeypatch.setattr(
        tile_order, "SortedTiles", lambda launches, tiles, _: arrays(launches, tiles, wp.get_device("cpu"))
    )
    return BalancedTiles(SimpleNamespace(is_cpu=False, stream=SimpleNamespace(cuda_stream=None)))


def is_new(orders):
    """Whether tiles come as they lie in the picture, and have no ticks yet."""
    return all(
        np.array_equal(order.tiles.numpy(), np.arange(order.tiles.size)) and not order.ticks.numpy().any()
        for order in orders
    )


TICKS_OF_40 = 1 << (np.arange(40) * 7 % 31)


def followed(orders):
    for order in orders:
        order.ticks.assign(TICKS_OF_40)


def is_sorted(orders):
    """Whether the tiles of TICKS_OF_40 come by how long they took."""
    return all((np.diff(TICKS_OF_40[order.tiles.numpy()]) <= 0).all() for order in orders)


def test_orders_of_views_that_follow_each_other(balanced):
    """The second is sorted by the first; a new one where the picture is another than the last few, or a view was
    left."""
    for number in range(3):
        orders = balanced.begin(2, 40)
        assert is_new(orders) if number == 0 else is_sorted(orders)
        followed(orders)
        balanced.end()
    for launches, tiles in ((3, 40), (3, 20)):
        assert is_new(balanced.begin(launches, tiles))
        balanced.end()
    assert is_sorted(balanced.begin(2, 40))
    balanced.end()
    for tiles in range(1, 1 + tile_order.MAX_KEPT):
        assert is_new(balanced.begin(1, tiles))
        balanced.end()
    assert is_new(balanced.begin(2, 40))
    balanced.end()
    followed(balanced.begin(2, 40))
    assert is_new(balanced.begin(2, 40))


@pytest.mark.parametrize("kernel", [count_tiles, sort_tiles])
def test_an_interrupted_sort_leaves_no_order(kernel, balanced, monkeypatch):
    followed(balanced.begin(2, 40))
    whole = RecordedLaunch.__call__

    def interrupted_launch(launched, *arguments, **options):
        whole(launched, *arguments, **options)
        if launched.kernel is kernel:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(RecordedLaunch, "__call__", interrupted_launch)
        with pytest.raises(KeyboardInterrupt):
            balanced.end()
    balanced.end()
    orders = balanced.begin(2, 40)
    assert is_new(orders)
    followed(orders)
    balanced.end()
    assert is_sorted(balanced.begin(2, 40))


def test_views_after_one_that_was_left(device, monkeypatch):
    """Frames after it are right, and so they are where a view was left before its first launch."""
    use_march("shaded", device, monkeypatch)
    deformer = Deformer(shiny_field(device), BOX, coordinates="mean_value", resolution=16).pose(BOX.rotate(30))
    frames = [deformer.render(view())]
    for place in ("end", "begin"):
        with monkeypatch.context() as patch:
            patch.setattr(BalancedTiles, place, interrupted)
            with pytest.raises(KeyboardInterrupt):
                deformer.render(view((-1.2, 2.4, -1.5)))
        frames += [deformer.render(view()) for _ in range(2)]
    assert_same(frames)
