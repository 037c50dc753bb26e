"""Splats without what cannot be seen, hangs loose, is too large or is shown by no view; and the command for it."""

import re

import numpy as np
import pytest
from refusals import refused
from splat_scenes import CUP, FLOATER, TABLE, joined, one_splat, place, place_camera

from warpcage import Cage, NodeSelection, SplatField
from warpcage.select import CleanOptions
from warpcage.splats import clean_splats
from warpcage.splats.clean import views_of_splats
from warpcage.studio.cli import main
from warpcage.view.pictures import read_image

FAINT = 50


@pytest.fixture(scope="module")
def scene():
    return place(faint=FAINT)


@pytest.fixture(scope="module")
def saved(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("place")
    scene[0].save(folder / "place.ply")
    place_camera(size=96).save(folder / "view.json")
    return folder


@pytest.fixture
def folder(saved, monkeypatch):
    monkeypatch.chdir(saved)
    return saved


def test_floaters_go_and_nothing_else(scene):
    field, labels = scene
    cleaned = clean_splats(field, CleanOptions())
    np.testing.assert_array_equal(cleaned.gone, labels == FLOATER)
    assert len(cleaned.field) == np.count_nonzero(labels != FLOATER)
    np.testing.assert_array_equal(cleaned.field.contents.centers, field.contents.centers[labels != FLOATER])
    assert cleaned.notes == (
        "removed 50 splats (0.59 %) fainter than 1/255",
        "removed 24 splats (0.28 %) in 2 detached parts",
    )
    again = clean_splats(cleaned.field, CleanOptions())
    assert again.notes == () and not again.gone.any()
    kept = clean_splats(field, CleanOptions(floaters=0.0))
    assert kept.gone.sum() == FAINT


def test_a_thin_pole_stays_and_planted_floaters_go():
    """One row of splats on the table, thinner than a cell, and clouds of more splats in the air."""
    field, labels = place(faint=0)
    random = np.random.default_rng(0)
    heights = np.arange(0.72, 1.6, 0.02)
    pole = np.stack([np.full(len(heights), -0.2), np.full(len(heights), -0.1), heights], axis=1)
    floaters = np.concatenate([random.normal(each, 0.02, (40, 3)) for each in ((1.2, 1.0, 1.7), (-1.3, -1.2, 1.5))])
    centers, more = np.concatenate([pole, floaters]), len(pole) + len(floaters)
    values = np.full((more, 3), np.log(0.01)), np.eye(4)[[0] * more], np.full(more, 3.0), np.zeros((more, 1, 3))
    gone = clean_splats(joined(field, (centers, *values)), CleanOptions()).gone
    first = len(labels)
    assert not gone[first : first + len(pole)].any() and gone[first + len(pole) :].all()
    np.testing.assert_array_equal(gone[:first], labels == FLOATER)


def test_parts_that_are_kept_and_splats_that_are_too_large(scene):
    field, labels = scene
    # the room with its table is one part, the ball on the floor another only where it does not touch it
    cleaned = clean_splats(field, CleanOptions(parts=1))
    assert cleaned.gone[labels == FLOATER].all() and not cleaned.gone[(labels == CUP) | (labels == TABLE)].any()
    large = clean_splats(field, CleanOptions(floaters=0.0), largest_scale=0.1)
    np.testing.assert_array_equal(large.gone, (field.scales.max(axis=1) > 0.1) | (field.opacities < 1 / 255))


def test_what_a_view_shows_of_each_splat(device):
    """Opacities of splats beside each other, and of one behind an opaque one."""
    camera = place_camera((0, -3, 0), (0, 0, 0), 101)
    places = {(-0.8, 0, 0): 0.5, (0.8, 0, 0): 0.1, (0.24, 9, 0): 0.9, (0, -9, 0): 0.9}
    field = joined(*(one_splat(device, center, opacity=opacity) for center, opacity in places.items()))
    alpha = field.render(camera).alpha
    for pixels, row in ((alpha[:, :35].sum(), 0), (alpha[:, 65:].sum(), 1)):
        assert views_of_splats(field, [camera], 0.99 * pixels)[row] == 1
        assert views_of_splats(field, [camera], 1.01 * pixels)[row] == 0
    np.testing.assert_array_equal(views_of_splats(field, [camera, camera], 0.01), [2, 2, 2, 0])


def test_what_no_view_shows_goes(scene):
    field, _labels = scene
    camera = place_camera(size=96)
    away = place_camera(target=(1.6, -9.0, 1.7), size=96)  # sees nothing
    cleaned = clean_splats(field, CleanOptions(cameras=[camera, away]))
    before, after = field.render(camera), cleaned.field.render(camera)
    assert cleaned.gone.mean() > 0.2 and cleaned.notes[-1].endswith("that none of 2 views show")
    # but for the floaters the view is what it was
    free = clean_splats(field, CleanOptions()).field.render(camera)
    assert np.abs(free.rgb - after.rgb).max() < 0.03 and np.abs(before.rgb - free.rgb).max() > 0.3
    assert views_of_splats(cleaned.field, [camera], 0.005).all()
    with pytest.raises(ValueError, match="nothing would be left"):
        clean_splats(field, CleanOptions(cameras=[camera, away], least_views=2))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"floaters": 1.0}, "0 to below 1, got 1"),
        ({"floaters": -0.1}, "floaters must be a share"),
        ({"parts": 0}, "parts must be"),
        ({"least_weight": 0.0}, "least_weight must be"),
        ({"least_views": 0}, "least_views must be"),
        ({"cameras": [place_camera()], "least_views": 2}, "got 2 of 1 view"),
    ],
)
def test_options_that_make_no_sense(options, message):
    refused(lambda: CleanOptions(**options), match=message)


def run(*arguments):
    return main([str(each) for each in arguments])


def test_the_command_cleans_and_says_how_much(folder, scene, capsys):
    view = ("--camera", "view.json", "--preview", "gone.png")
    assert run("clean", "place.ply", "-o", "clean.ply", *view) == 0
    said = capsys.readouterr().out
    assert "removed 24 splats (0.28 %) in 2 detached parts" in said and "wrote clean.ply: 8421 splats" in said
    assert len(SplatField.load("clean.ply")) == np.count_nonzero(scene[1] != FLOATER)
    picture = read_image(folder / "gone.png")
    assert picture.shape[:2] == (96, 96)
    assert run("clean", "place.ply", "-o", "shown.spz", "--views", "view.json", "--least-weight", "0.1") == 0
    assert "that none of 1 view show" in capsys.readouterr().out and len(SplatField.load("shown.spz")) < 8000


def test_the_way_from_a_place_to_its_cup(folder, scene, capsys):
    field, labels = scene
    options = ("--up", "0", "0", "1", "--point", "0.29", "0.1", "0.85")
    assert run("select", "place.ply", "-o", "cup.npz", *options, "--camera", "view.json", "--preview", "cup.png") == 0
    assert "splats, from [" in capsys.readouterr().out and (folder / "cup.png").exists()
    assert run("cage", "place.ply", "--selection", "cup.npz", "-o", "cup.obj", "--vertices", "80") == 0
    assert run("bake", "place.ply", "--selection", "cup.npz", "-o", "cup.ply") == 0
    alone = SplatField.load("cup.ply")
    chosen = NodeSelection.load("cup.npz", SplatField.load("place.ply"))
    rows = chosen.field.splats_in(chosen.mask)
    assert set(labels[rows]) == {CUP} and len(alone) == rows.sum() > 0.9 * (labels == CUP).sum()
    np.testing.assert_array_equal(alone.contents.centers, field.contents.centers[rows].astype(np.float32))
    cage = Cage.load("cup.obj")
    inside = cage.contains(field.contents.centers.astype(np.float64))
    assert inside[rows].all() and not (inside & (labels == TABLE)).any()
    assert cage.check(field=chosen).field_enclosed == 1.0 and chosen.floor.heights(cage.vertices).min() > -1e-9
    capsys.readouterr()
    posed = ("--cage", "cup.obj", "--posed", "twist:40", "-o", "turned.ply", "--resolution", "24")
    assert run("bake", "place.ply", "--selection", "cup.npz", *posed) == 0
    captured = capsys.readouterr()
    # the cage is looked at beside what is cut out, not the whole place: a rim of the foot is below it
    held = re.search(r"holds ([\d.]+) % of the object", captured.err)
    assert "wrote turned.ply" in captured.out and (held is None or float(held[1]) > 90.0)
    assert run("bake", "place.ply", "--selection", "cup.npz", "-o", "a_##.ply", "--frames", "3") == 2
    assert "needs a deformation" in capsys.readouterr().err and not list(folder.glob("a_*"))
    assert run("cage", "place.ply", "--in-box", "0", "0", "0.74", "0.4", "0.3", "1", "--box", "-o", "box.obj") == 0
    low, high = Cage.load("box.obj").vertices[[0, -1]].min(axis=0), Cage.load("box.obj").vertices.max(axis=0)
    assert (low > [0.05, -0.05, 0.7]).all() and (high < [0.36, 0.26, 1.0]).all()  # not to a cell of the whole room
