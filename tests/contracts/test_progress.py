"""Progress of long work: one protocol, which ends the work too and leaves nothing half-done."""

import contextlib
import functools

import numpy as np
import pytest
from fields import BOX, shiny_field, view
from refusals import refused
from runs import write_files
from scenes import blob_scene
from splat_scenes import scene_of, splats_in_box

import warpcage
from warpcage import Cage, Cancelled, Deformer
from warpcage.studio.films.video import write_film

POINTS = np.random.default_rng(0).uniform(-0.3, 0.3, (50, 3))
POSES = [BOX, BOX.bend(5), BOX.bend(10)]
FIT = {"device": "cpu", "resolution": 16, "levels": 1, "epochs": 1, "batch_rays": 256}
SPLAT_FIT = {"representation": "splats", "device": "cpu", "steps": 4, "most_splats": 80}


@pytest.fixture(scope="module")
def objects(tmp_path_factory):
    """What the calls need."""
    field, splats = shiny_field("cpu", resolution=12), splats_in_box("cpu", count=60, degree=0)
    cameras = [view(eye=eye, size=12) for eye in ((2.5, 0, 0.5), (0, 2.5, 0.5), (-2.5, 0, 0.5))]
    folder = tmp_path_factory.mktemp("progress")
    field.save(folder / "saved.npz")
    splats.save(folder / "saved.ply")
    return {
        "folder": write_files(folder),
        "scene": blob_scene(count=4, size=12, device="cpu"),
        "field": field,
        "splats": splats,
        "centers": splats.contents.centers,
        "cameras": cameras,
        "images": [splats.render(camera).rgb for camera in cameras],
        "deformer": Deformer(field, BOX, coordinates="mean_value", resolution=12).pose(BOX.bend(20)),
        "pictures": [np.full((16, 16, 3), shade, np.float32) for shade in (0.2, 0.5, 0.8)],
    }


def film(objects, ending, **options):
    write_film(objects["folder"] / f"film{ending}", objects["pictures"], **options)
    return (objects["folder"] / f"film{ending}").stat().st_size


#: Long work by its name: what it is, and a number that tells its results apart.
WORK = {
    "fit": lambda t, **options: warpcage.fit(t["scene"], **FIT, **options).node_densities().sum(),
    "fit of splats": lambda t, **options: len(
        warpcage.fit(scene_of(t["splats"], t["cameras"]), **SPLAT_FIT, **options)
    ),
    "fit_splats": lambda t, **options: warpcage.fit_splats(
        t["splats"], t["cameras"], t["images"], steps=4, **options
    ).opacities.sum(),
    "evaluate": lambda t, **options: warpcage.evaluate(t["field"], t["scene"], **options)[0]["psnr"],
    "load_scene": lambda t, **options: warpcage.load_scene(t["folder"] / "scene", **options).images.sum(),
    "bake": lambda t, **options: warpcage.bake(t["deformer"], 12, **options).voxel_count,
    "cage of a field": lambda t, **options: Cage.from_field(t["field"], 30, **options).volume,
    "field": lambda t, **options: (
        warpcage.VoxelField.load(t["folder"] / "saved.npz", device="cpu", **options).voxel_count
    ),
    "splats": lambda t, **options: len(warpcage.SplatField.load(t["folder"] / "saved.ply", device="cpu", **options)),
    "object": lambda t, **options: warpcage.select_object(t["field"], plane=None, **options).mask.sum(),
    "object of splats": lambda t, **options: warpcage.select_object(
        t["splats"], plane=None, point=t["centers"][0], **options
    ).mask.sum(),
    "harmonic weights": lambda t, **options: warpcage.harmonic_coordinates(
        POINTS, BOX, 12, device="cpu", **options
    ).std(),
    "splats bound by lattices": lambda t, **options: (
        Deformer(t["splats"], BOX, resolution=12, **options).pose(BOX.bend(20)).baked().contents.centers.std()
    ),
    "splats bound": lambda t, **options: (
        Deformer(t["splats"], BOX, coordinates="green", **options).pose(BOX.bend(20)).baked().contents.centers.std()
    ),
    "film": lambda t, **options: (
        warpcage.render_film(t["deformer"], t["folder"] / "film.gif", poses=POSES, camera=t["cameras"][0], **options)[0]
        .stat()
        .st_size
    ),
    "mp4": lambda t, **options: film(t, ".mp4", **options),
    "gif": lambda t, **options: film(t, ".gif", **options),
    "mov": lambda t, **options: film(t, ".mov", **options),
}


class Stop(ValueError):
    """An exception of the caller, of a class that is caught in places."""


@pytest.mark.parametrize("name", WORK)
def test_work_tells_how_far_it_is_and_ends_when_it_is_asked_to(name, objects, capfd):
    """At the first word and at the last one. Afterwards there is no new file, and the same work gives what it gives."""
    work = functools.partial(WORK[name], objects)
    expected, calls = work(progress=False), []
    assert work(progress=lambda *values: calls.append(values)) == pytest.approx(expected)
    assert calls and capfd.readouterr().out == ""
    for done, total, words in calls:
        assert type(done) is int and type(total) is int and done >= 0 and (done <= total or total == 0)
        assert isinstance(words, str) and words and "\n" not in words

    for made in objects["folder"].glob("film.*"):
        made.unlink()
    before = sorted(objects["folder"].rglob("*"))
    for last, kind in ((0, Stop), (len(calls) - 1, Stop), (len(calls) - 1, Cancelled)):
        told = []

        def progress(done, total, words, last=last, kind=kind, told=told):
            told.append(words)
            if len(told) > last and kind is Stop:
                raise Stop
            return len(told) <= last

        with pytest.raises(kind) as caught:
            work(progress=progress)
        assert len(told) == last + 1 and (kind is Stop or isinstance(caught.value, warpcage.Error))
        assert sorted(objects["folder"].rglob("*")) == before
    assert work(progress=False) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("answer", "ends"), [(np.bool_(False), True), (np.bool_(True), False), (0, False), ("", False)]
)
def test_a_false_of_numpy_ends_work(answer, ends, objects):
    """A zero does not, as functions that write or count return them."""
    with pytest.raises(Cancelled) if ends else contextlib.nullcontext():
        WORK["harmonic weights"](objects, progress=lambda *values: answer)


@pytest.mark.parametrize("flag", [bool, np.bool_])
def test_a_bar_goes_to_stderr(flag, objects, capfd):
    WORK["harmonic weights"](objects, progress=flag(False))
    assert capfd.readouterr() == ("", "")
    WORK["harmonic weights"](objects, progress=flag(True))
    printed = capfd.readouterr()
    assert printed.out == "" and "harmonic weights" in printed.err


@pytest.mark.parametrize("progress", [5, "yes", []])
def test_what_is_no_progress_is_told(progress, objects):
    refused(lambda: WORK["harmonic weights"](objects, progress=progress), match="progress must be True, False")


def test_a_cage_of_a_mesh_can_be_ended():
    told = []
    with pytest.raises(Cancelled, match="cage was cancelled"):
        Cage.from_mesh(BOX, 30, progress=lambda *values: told.append(values) or len(told) < 3)
    assert len(told) == 3


def test_a_caller_may_do_other_work_meanwhile(objects):
    """Which is not told to it."""
    told = []

    def progress(done, total, words):
        told.append(words)
        WORK["harmonic weights"](objects)
        objects["field"].render(objects["cameras"][0])

    WORK["evaluate"](objects, progress=progress)
    assert set(told) == {"evaluate"}


def test_a_cancelled_fit_goes_on_from_its_checkpoint(objects, tmp_path):
    file = tmp_path / "fit.npz"
    options = {**FIT, "checkpoint": file, "checkpoint_seconds": 0.0}
    whole = warpcage.fit(objects["scene"], **FIT, progress=False)
    with pytest.raises(Cancelled, match="fit was cancelled, 2 of"):
        warpcage.fit(objects["scene"], **options, progress=lambda done, total, words: done < 2)
    assert file.exists()
    begun = []
    again = warpcage.fit(objects["scene"], **options, progress=lambda done, total, words: begun.append(done))
    assert begun[0] == 2 and not file.exists()
    np.testing.assert_allclose(again.node_densities(), whole.node_densities(), atol=1e-5)
