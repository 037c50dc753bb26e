"""The march for one edit against the general one, and the two ways to store a map."""

import numpy as np
import pytest
from fields import (
    BOX,
    KINDS,
    TILES,
    alter_map,
    box_around,
    general_march,
    make_field,
    marches,
    marches_of,
    mirrored,
    plain,
    psnr,
    seen_by_marches,
    shiny_field,
    slotted,
    two_balls,
    use_march,
    view,
)
from refusals import refused

from warpcage import Cage, CageEdit, Camera, Deformer
from warpcage.core import recorded_launches
from warpcage.kernels.edits.structs import CELL_ALONE


def single_by_marches(deformer, camera, monkeypatch, **options):
    """Views by each march for one edit: its name, its frame, and that of the march for any number."""
    for march, marched, single, general in seen_by_marches(deformer, camera, monkeypatch, **options):
        edits = deformer.posed_edits()
        table = "shaded" if edits.plan.is_shaded else "rows"
        sides = "+sides" if edits.tables.edits[0].has_sides else ""
        assert marched == [TILES if march == "tiles" else f"views.{table}{sides}"]
        yield march, single, general


SLAB = Cage.box([-0.3, -0.9, -0.9], [0.9, 0.9, 0.9], segments=2)
CASES = {
    "bend": (BOX, BOX.bend(70, axis="x", towards="z"), {}),
    "twist that folds": (BOX, BOX.twist(230, axis="x"), {}),
    "squeeze": (BOX, BOX.scale([0.2, 1.3, 1.0]).translate([0.2, 0, 0.1]), {}),
    "away": (BOX, BOX.rotate(30).translate([0.4, 0.5, 0.2]), {}),
    "part of it, kept": (SLAB, SLAB.rotate(25, axis="x").translate([0.5, 0, 0.2]), {"keep_source": True}),
    "part of it, removed": (SLAB, None, {"remove": True}),
    "beside the field": (BOX.translate([4, 0, 0]), BOX.translate([4, 2, 0]), {}),
}


@pytest.mark.parametrize(
    ("case", "density"), [*((case, "opacity") for case in CASES), ("bend", "paper"), ("squeeze", "paper")]
)
def test_the_march_for_one_edit_sees_what_the_general_one_sees(case, density, device, monkeypatch):
    rest, pose, options = CASES[case]
    deformer = Deformer(shiny_field(device), CageEdit(rest, **options), resolution=40, density=density).pose(pose)
    for march, single, general in single_by_marches(deformer, view(), monkeypatch):
        # sub-samples take differences of their own length in the one, of a whole step in the other
        least = 45 if case in ("squeeze", "twist that folds") else 60 if march == "shaded" else 80
        assert psnr(single.rgb, general.rgb) > least
        for name in ("alpha", "reveal", "fold"):
            np.testing.assert_allclose(getattr(single, name), getattr(general, name), atol=0.06)
            assert np.abs(getattr(single, name) - getattr(general, name)).mean() < 1e-3
        assert np.abs(single.outside - general.outside).mean() < 0.05
        seen = general.alpha > 0.5
        assert seen.any() and np.abs(single.depth[seen] - general.depth[seen]).mean() < 2e-3


def test_sizes_that_are_no_multiple_of_a_tile(device, monkeypatch):
    field = shiny_field(device)
    deformer = Deformer(field, BOX, resolution=24)
    for size in ((1, 1), (9, 5), (31, 2)):
        camera = Camera.look_at([2.5, 1.2, 1.0], (0, 0, 0), width=64, height=64, fov_degrees=30).resized(*size)
        expected = field.render(camera).rgb
        for _, single, general in single_by_marches(deformer, camera, monkeypatch):
            assert psnr(single.rgb, expected) > 50 and psnr(general.rgb, expected) > 50


def test_a_cage_posed_so_far_away_that_steps_blur_is_marched_to_its_end(device, monkeypatch):
    """At 4e7 steps float32 knows every fourth number only: the march takes those that there are."""
    field = make_field(lambda x: np.full(x.shape[:3], 8.0), plain([0.5, 0.5, 0.5]), device=device)
    far = 1.0e6
    deformer = Deformer(field, BOX, coordinates="mean_value", resolution=8).pose(BOX.translate([far, 0, 0]))
    camera = Camera.look_at((3.0, 0, 0), (far, 0, 0), width=5, height=5, fov_degrees=np.degrees(1 / far))
    assert far / field.step > 2**25
    for march in marches_of(device):
        use_march(march, device, monkeypatch)
        frame = deformer.render(camera)
        assert frame.alpha.max() > 0.9 and np.isfinite(frame.rgb).all()


def test_samples_sent_out_are_counted_the_same(device, monkeypatch):
    field = make_field(lambda x: np.full(x.shape[:3], 2.0), plain([0.5, 0.5, 0.5]), device=device)
    deformer = Deformer(field, BOX, coordinates="green", resolution=40).pose(BOX.stretch(1.6, axis="z"))
    for _, single, general in single_by_marches(deformer, view(), monkeypatch):
        assert general.outside.max() > 3
        assert np.abs(single.outside - general.outside).mean() < 0.02 * general.outside.mean()


def test_only_what_a_map_moved_counts_as_folded(device, monkeypatch):
    """Not the matter around a posed cage, in cells that its walls cut; the positions are mirrored by hand."""
    field = make_field(lambda x: np.full(x.shape[:3], 2.0), plain([0.5, 0.5, 0.5]), device=device)
    cage = box_around(0.1, 0, 0, half=0.3)
    deformer = Deformer(field, CageEdit(cage, keep_source=True), coordinates="mean_value", resolution=8)
    alter_map(deformer, mirrored)
    camera = view((2.5, 0.4, 0.3))
    origins, directions = camera.rays()
    ends = (cage.bounds[:, None, None] - origins) / directions
    meets = ends.min(axis=0).max(axis=-1) < ends.max(axis=0).min(axis=-1) + 1e-3
    for _, single, general in single_by_marches(deformer.pose(cage), camera, monkeypatch):
        assert single.fold[meets].max() > 0.15 and single.alpha[~meets].max() > 0.5
        assert single.fold[~meets].max() == 0
        np.testing.assert_allclose(single.fold, general.fold, atol=0.05)  # a sample at a wall counts or not


@pytest.mark.parametrize("kind", ["harmonic", "mean_value"])
def test_a_slot_that_a_pose_closes_to_less_than_a_cell(kind, device, monkeypatch):
    """What lies on both sides of a slot comes from both sides of a wide one: nothing is drawn over the slot."""
    field = make_field(
        lambda x: np.where(np.abs(x[..., 0]) < 0.2, 0.0, 30.0) * (np.abs(x).max(axis=-1) < 0.9),
        plain([0.2, 0.6, 0.3]),
        device=device,
    )
    deformer = Deformer(field, slotted(0.5), coordinates=kind, resolution=32).pose(slotted(0.03))
    camera = Camera.look_at([0.1, 0.6, 3.0], (0, 0.1, 0), up=(0, 1, 0), width=64, height=64, fov_degrees=40)
    for _, single, general in single_by_marches(deformer, camera, monkeypatch):
        assert psnr(single.rgb, general.rgb) > 45
        assert general.alpha.max() > 0.9
    assert deformer.posed_edits().tables.edits[0].has_sides == 1 or kind != "harmonic"


# -- Weights instead of the map


@pytest.mark.parametrize("kind", KINDS)
def test_stored_weights_render_the_same_picture(kind, device):
    field, camera = shiny_field(device), view()
    pose = BOX.bend(50, axis="x", towards="z")
    frames = [
        Deformer(field, BOX, coordinates=kind, resolution=32, store=store).pose(pose).render(camera)
        for store in ("map", "weights")
    ]
    assert psnr(frames[0].rgb, frames[1].rgb) > 60
    assert psnr(frames[0].rgb, field.render(camera).rgb) < 30


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"store": "both"}, "store must be one of map, weights"),
        ({"store": "weights", "coordinates": "green", "resolution": None}, "give a resolution"),
    ],
)
def test_stores_that_cannot_be_are_refused(options, message):
    refused(lambda: Deformer(shiny_field(None, resolution=8), BOX, **options), match=message)


# -- Several edits: the march without fragments and narrow gaps, and cells that no earlier edit has anything in


def into_each_other():
    """Edits and their poses: each turned, the second into where the first is and was, the third nowhere near."""
    rests = [box_around(-0.5, 0, 0), box_around(0.5, 0, 0), box_around(0, 0.7, 0, half=0.25)]
    moves = [(0.1, 0.0, 0.1), (-0.75, 0.1, 0.0), (0.0, 0.0, 0.2)]
    return rests, [rest.rotate(25, axis="y").translate(move) for rest, move in zip(rests, moves, strict=True)]


def removing():
    """The first removes what the second would be moved to, and the third keeps its source."""
    left, right = box_around(-0.5, 0, 0), box_around(0.5, 0, 0)
    rests = [CageEdit(left, remove=True), CageEdit(right), CageEdit(right, keep_source=True)]
    return rests, [None, right.translate((-0.9, 0.0, 0.1)), right.translate((0.0, 0.4, 0.0))]


@pytest.mark.parametrize("scene", [into_each_other, removing])
def test_several_edits_are_seen_as_by_slower_ways(scene, device):
    """The march without fragments and gaps as the one with them; and without asking edits that have nothing in a cell
    as when each is asked."""
    rests, posed = scene()
    deformer = Deformer(two_balls(device), rests, resolution=24).pose(posed)
    with recorded_launches() as launched:
        plainly = deformer.render(view())
        with general_march():
            generally = deformer.render(view())
    assert marches(launched) == ["views.stack+simple", "views.stack"]
    assert_same_frame(plainly, generally)
    edits = deformer.posed_edits()
    assert any((struct.cells.numpy() & CELL_ALONE).any() for struct, _ in edits.lattices.posed())
    for struct, _ in edits.lattices.posed():
        struct.cells.assign(struct.cells.numpy() & (255 - CELL_ALONE))
    edits.tables.fill(edits.lattices.posed())
    assert_same_frame(plainly, deformer.render(view()))


def assert_same_frame(a, b):
    """To the bit on a CPU; compilers for GPUs join products and sums of two kernels in different ways."""
    assert {"reveal", "fold", "outside"} <= a.arrays.keys()
    for name, array in a.arrays.items():
        here, there = array.numpy(), b.arrays[name].numpy()
        if array.device.is_cpu:
            assert np.array_equal(here, there), name
        elif name in ("fold", "outside"):  # a sample at a wall counts or not
            assert here.sum() == pytest.approx(there.sum(), rel=0.02, abs=2.0), name
        elif name != "depth":
            assert psnr(here, there) > 70, name
