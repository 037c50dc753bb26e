"""How far tiles go before their rays meet anything: against NumPy, and pictures with and without."""

import numpy as np
import pytest
import warp as wp
from fields import BOX, box_around, shiny_field, two_balls, use_march, view

from warpcage import Cage, CageEdit, Camera, Deformer
from warpcage.kernels.edits.structs import LOOK_SKIP
from warpcage.kernels.render.beams import NEVER
from warpcage.kernels.view.rays import TILE_HEIGHT, TILE_WIDTH
from warpcage.render import TileStarts

SLAB = Cage.box([-0.3, -0.9, -0.9], [0.9, 0.9, 0.9], segments=2)
CASES = {
    "bend": (BOX, BOX.bend(70, axis="x", towards="z"), {}),
    "squeeze": (BOX, BOX.scale([0.2, 1.3, 1.0]).translate([0.2, 0, 0.1]), {}),
    "away": (BOX, BOX.rotate(30).translate([1.4, 0.5, 0.2]), {}),
    "grown": (BOX, BOX.scale(2.5), {}),
    "part of it": (SLAB, SLAB.rotate(25, axis="x").translate([0.1, 0, 0.2]), {}),
    "part of it, removed": (SLAB, None, {"remove": True}),
}
CAMERAS = {
    "beside": view((2.5, 1.2, 1.0), 40),
    "along an axis": view((0.0, -3.0, 1e-6), 40),
    "far": Camera.look_at((90, 120, 60), (0, 0, 0), width=40, height=24, fov_degrees=1.2),
    "within": view((0.1, 0.1, 0.05), 40),
    "near, wide": Camera.look_at((0.9, 0.8, 0.7), (0, 0, 0), width=16, height=12, fov_degrees=130),
    "few pixels": Camera.look_at((2.5, 1.2, 1.0), (0, 0, 0), width=9, height=5, fov_degrees=80),
}


@pytest.fixture(params=["rows", "shaded"])
def march(request, device, monkeypatch):
    """The marches that begin where a tile may meet something."""
    return use_march(request.param, device, monkeypatch)


def kept_begins(monkeypatch):
    """Lists, one a view, of what TileStarts found from now on."""
    found, find = [], TileStarts.find

    def noted(self, edits, grid, *rest):
        found.append([(edit, grid, begins) for edit, begins in zip(edits, find(self, edits, grid, *rest), strict=True)])
        return [begins for _, _, begins in found[-1]]

    monkeypatch.setattr(TileStarts, "find", noted)
    return found


def is_empty(edit, grid, places):
    """Whether nothing is at places (n, 3) relative to the field's origin, by the tables alone."""
    side = 1 << edit.fine_bits
    fine = (places - np.array(edit.lower)) / (edit.spacing / side)
    last, counts = np.array(edit.last_fine), np.array(edit.node_counts)
    within = ((fine >= 0) & (fine < last + 1)).all(axis=1)
    cell = np.clip(np.floor(fine).astype(int), 0, last)
    node = np.ravel_multi_index(tuple((cell // side).T), counts)
    part = np.ravel_multi_index(tuple((cell % side).T), (side, side, side))
    empty = edit.fine_look.numpy()[node * side**3 + part] >= int(LOOK_SKIP)
    g = (places - np.array(grid.lower)) / np.array(grid.voxel_size)
    skip = grid.skip.numpy()
    in_grid = ((g >= 0) & (g < skip.shape)).all(axis=1)
    plain = skip[tuple(np.clip(np.floor(g).astype(int), 0, np.array(skip.shape) - 1).T)] > 0
    return np.where(within, empty, ~in_grid | plain)


def pixels_of_tiles(camera):
    """(tiles, 32) pixel numbers, -1 beyond the picture."""
    across, down = -(-camera.width // int(TILE_WIDTH)), -(-camera.height // int(TILE_HEIGHT))
    rows, columns = np.mgrid[: down * int(TILE_HEIGHT), : across * int(TILE_WIDTH)]
    pixels = np.where((rows < camera.height) & (columns < camera.width), rows * camera.width + columns, -1)
    return pixels.reshape(down, int(TILE_HEIGHT), across, int(TILE_WIDTH)).swapaxes(1, 2).reshape(down * across, -1)


@pytest.mark.parametrize("place", CAMERAS)
@pytest.mark.parametrize("case", CASES)
def test_nothing_is_before_a_begin(case, place, march, device, monkeypatch):
    rest, pose, options = CASES[case]
    field, camera = shiny_field(device, resolution=48), CAMERAS[place]
    deformer = Deformer(field, CageEdit(rest, **options), resolution=10).pose(pose)
    found = kept_begins(monkeypatch)
    frame = deformer.render(camera)
    ((edit, grid, begins),) = found[-1]
    begins, pixels = begins.numpy(), pixels_of_tiles(camera)
    assert len(begins) == len(pixels)
    origins, directions = (values.reshape(-1, 3) for values in camera.rays())
    random, places = np.random.default_rng(4), []
    for begin, tile in zip(begins, pixels, strict=True):
        tile = tile[tile >= 0]
        if begin > 1e29:
            assert (frame.alpha.reshape(-1)[tile] == 0).all()
            begin = np.linalg.norm(camera.center) + 6.0
        t = random.uniform(max(0.0, begin - 6.0), begin, (len(tile), 60))
        if begin > 0:
            along = origins[tile][:, None] - field.center + t[..., None] * directions[tile][:, None]
            places.append(along.reshape(-1, 3))
    assert not places or is_empty(edit, grid, np.concatenate(places)).all()
    if place in ("beside", "along an axis", "far"):  # most of the way is known
        hit = np.array([(frame.alpha.reshape(-1)[tile[tile >= 0]] > 0.5).any() for tile in pixels])
        depth = np.array([np.nanmin(frame.depth.reshape(-1)[tile[tile >= 0]]) for tile in pixels])
        assert hit.any() and (begins[hit] <= depth[hit]).all()
        assert np.median(depth[hit] - begins[hit]) < 1.5


@pytest.mark.parametrize("place", CAMERAS)
@pytest.mark.parametrize("case", CASES)
def test_pictures_are_those_without_begins(case, place, march, device, monkeypatch):
    rest, pose, options = CASES[case]
    deformer = Deformer(shiny_field(device, resolution=48), CageEdit(rest, **options), resolution=10).pose(pose)
    compare(deformer, CAMERAS[place], monkeypatch)


@pytest.mark.parametrize("place", ["beside", "within", "near, wide"])
def test_pictures_of_parts_are_those_without_begins(place, march, device, monkeypatch):
    cages = [box_around(x, 0, 0, half=0.45) for x in (-0.5, 0.5)]
    deformer = Deformer(two_balls(device), cages, resolution=10)
    deformer.pose([cages[0].rotate(40, axis="x"), cages[1].scale([1.0, 0.7, 0.7])])
    found = kept_begins(monkeypatch)
    compare(deformer, CAMERAS[place], monkeypatch)
    assert all(len(view) == 2 for view in found)


def compare(deformer, camera, monkeypatch):
    """The same frame to the bit, wherever marches begin."""
    frame = deformer.render(camera)

    def from_the_camera(self, edits, grid, pinhole, tiles):
        return [wp.zeros(tiles, dtype=wp.float32, device=deformer.device) for _ in edits]

    with monkeypatch.context() as patch:
        patch.setattr(TileStarts, "find", from_the_camera)
        whole = deformer.render(camera)
    for name in ("rgb", "alpha", "depth", "reveal", "fold", "outside"):
        assert np.array_equal(getattr(frame, name), getattr(whole, name), equal_nan=True), name


def test_tiles_beside_everything_never_begin(march, device, monkeypatch):
    found = kept_begins(monkeypatch)
    deformer = Deformer(shiny_field(device), BOX, resolution=10).pose(BOX)
    camera = Camera.look_at((3, 0, 0), (6, 0, 0), width=16, height=8, fov_degrees=40)
    assert deformer.render(camera).alpha.max() == 0
    ((_, _, begins),) = found[-1]
    assert (begins.numpy() == np.float32(NEVER)).all()
