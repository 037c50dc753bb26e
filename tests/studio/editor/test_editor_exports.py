"""Files that a session makes, and the scene that its renderer and its films share."""

import dataclasses
import itertools
import shlex

import imageio.v3 as iio
import numpy as np
import pytest
from fields import BOX, shiny_field
from messages import MESSAGES

from warpcage import Cage, CageEdit, Camera, Deformer, PoseFile, VoxelField
from warpcage.studio.cli import main
from warpcage.studio.editor import (
    Cancelled,
    Document,
    Film,
    Jobs,
    Key,
    Outcome,
    PosedScene,
    Selection,
    Settings,
    Timeline,
    View,
    export_baked,
    export_cage,
    export_command,
    export_film,
    export_poses,
    film_pictures,
    frame_times,
    frozen_vertices,
    new_edit,
    state_at,
    view_camera,
    write_session,
)
from warpcage.studio.films import Look, atomic_folder
from warpcage.studio.films.session import scene as scene_module
from warpcage.studio.jobs import JobFile, Worker

VIEW = View((2.5, 1.2, 1.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 40.0)
BENT, TWISTED = BOX.bend(40, axis="x", towards="z"), BOX.twist(50, axis="x")
SMALL = Settings(coordinates="mean_value", resolution=16)
TINY = Film(40, 30)


@pytest.fixture
def field(device):
    return shiny_field(device)


def document(*edits, keys=(), settings=SMALL, **film):
    edits = edits or (new_edit(1, BOX, "Cage", posed=BENT.vertices),)
    return Document(edits, Selection(1), settings, VIEW, Timeline(tuple(keys), **film), next_id=99)


def moving(**film):
    """A film from rest to the bent pose with a moving camera, of a few frames."""
    other = dataclasses.replace(VIEW, eye=(0.5, 2.8, 1.5), fov=50.0)
    keys = (
        Key(10, 0.0, "rest", "smooth", {1: frozen_vertices(BOX.vertices)}, VIEW),
        Key(11, 0.5, "bent", "linear", {1: frozen_vertices(BENT.vertices)}, other),
    )
    return document(keys=keys, **{"length": 0.5, "fps": 6.0, **film})


def pictures_of(folder):
    return [iio.imread(path) for path in sorted(folder.glob("*.png"))]


# -- The scene


def test_a_view_is_a_camera_with_a_vertical_field_of_view():
    looking = view_camera(VIEW, 60, 30)
    assert (looking.width, looking.height, looking.fx) == (60, 30, looking.fy)
    assert 2 * np.degrees(np.arctan(15 / looking.fy)) == pytest.approx(40.0)
    square = Camera.look_at(VIEW.eye, VIEW.target, fov_degrees=40.0, width=50, height=50)
    np.testing.assert_allclose(view_camera(VIEW, 50, 50).fx, square.fx)
    np.testing.assert_array_equal(looking.camera_to_world, square.camera_to_world)


def test_a_scene_renders_what_a_deformer_of_its_edits_does(field):
    part = Cage.box([-0.7, -0.5, -0.4], [-0.2, 0.5, 0.4])
    edits = (
        new_edit(1, BOX, "bend", posed=BENT.vertices),
        new_edit(2, BOX, "hidden", posed=TWISTED.vertices),
        new_edit(3, part, "gone", kind="remove"),
        new_edit(4, part, "twin", kind="copy", posed=part.translate([0, 0, 0.8]).vertices),
    )
    hidden = tuple(dataclasses.replace(edit, visible=edit.id != 2) for edit in edits)
    scene, looking = PosedScene(field), view_camera(VIEW, 40, 30)
    scene.prepare(document(*hidden))
    oracle = Deformer(
        field, [BOX, CageEdit(part, remove=True), CageEdit(part, keep_source=True)],
        coordinates="mean_value", resolution=16,
    ).pose([BENT, None, part.translate([0, 0, 0.8])])  # fmt: skip
    shown, expected = scene.render(looking, Look("black")), oracle.render(looking, background="black")
    for name in ("rgb", "alpha", "depth", "fold"):
        np.testing.assert_array_equal(getattr(shown, name), getattr(expected, name))


@pytest.mark.parametrize("change", ["rest mode", "none visible", "no edits"])
def test_a_scene_without_visible_edits_is_the_field(field, change):
    shown = document()
    if change == "rest mode":
        shown = dataclasses.replace(shown, settings=dataclasses.replace(SMALL, mode="rest"))
    elif change == "none visible":
        shown = shown.with_edit(dataclasses.replace(shown.edits[0], visible=False))
    else:
        shown = dataclasses.replace(shown, edits=())
    scene, looking = PosedScene(field), view_camera(VIEW, 40, 30)
    scene.prepare(document())
    scene.prepare(shown)
    np.testing.assert_array_equal(scene.render(looking).rgb, field.render(looking).rgb)


def test_a_deformer_is_made_anew_only_for_what_it_is_made_of(field, monkeypatch):
    made, posed = [], []

    class Counted(Deformer):
        def __init__(self, *args, **options):
            made.append(options["resolution"])
            super().__init__(*args, **options)

        def pose(self, deformed):
            posed.append(1)
            return super().pose(deformed)

    monkeypatch.setattr(scene_module, "Deformer", Counted)
    scene, now = PosedScene(field), document()

    def counts(shown, resolution=None):
        made.clear(), posed.clear()
        scene.prepare(shown, resolution)
        return len(made), len(posed)

    assert counts(now) == (1, 1)
    assert counts(now) == counts(dataclasses.replace(now, view=dataclasses.replace(VIEW, fov=20.0))) == (0, 0)
    assert counts(Document.from_json(now.to_json())) == (0, 0)  # other arrays that hold the same
    edit = now.edits[0]
    now = now.with_edit(dataclasses.replace(edit, posed=frozen_vertices(TWISTED.vertices), name="other"))
    assert counts(now) == (0, 1)
    assert counts(now, 8) == (1, 1) and counts(now) == counts(now, 8) == (0, 0)  # one for drags, one at rest
    assert counts(now, 12) == (1, 1) and counts(now) == (1, 1)  # but no more of them
    for changed in (
        {"edits": (dataclasses.replace(now.edits[0], kind="copy"),)},
        {"edits": (dataclasses.replace(now.edits[0], rest=frozen_vertices(BOX.scale(1.1).vertices)),)},
        {"settings": dataclasses.replace(SMALL, coordinates="green")},
        {"settings": dataclasses.replace(SMALL, density="paper")},
    ):
        assert counts(dataclasses.replace(now, **changed)) == (1, 1)


@pytest.mark.parametrize("part", ["posed", "rest"])
def test_a_cage_that_cannot_be_used_leaves_the_scene_before(field, part):
    scene, looking, now = PosedScene(field), view_camera(VIEW, 40, 30), document()
    scene.prepare(now)
    before = scene.render(looking).rgb
    flat = frozen_vertices(BOX.vertices * [1, 1, 0])
    name = {"posed": "posed", "rest": "rest"}[part]
    with pytest.raises(ValueError, match=f"the {name} cage of 'Cage' "):
        scene.prepare(now.with_edit(dataclasses.replace(now.edits[0], **{part: flat})))
    np.testing.assert_array_equal(scene.render(looking).rgb, before)
    turned = now.with_edit(dataclasses.replace(now.edits[0], posed=frozen_vertices(TWISTED.vertices)))
    scene.prepare(turned)
    expected = Deformer(field, BOX, coordinates="mean_value", resolution=16).pose(TWISTED).render(looking)
    np.testing.assert_array_equal(scene.render(looking).rgb, expected.rgb)


# -- Films


def test_frames_are_those_of_deformers_at_their_times(field, tmp_path):
    shown, reports = moving(), []
    assert export_film(shown, field, tmp_path / "frames", TINY, lambda share, text: reports.append((share, text))) == 4
    deformer = Deformer(field, BOX, coordinates="mean_value", resolution=16)
    pictures = pictures_of(tmp_path / "frames")
    for time, picture in zip(frame_times(shown.timeline), pictures, strict=True):
        poses, view = state_at(shown, time)
        frame = deformer.pose(BOX.with_vertices(poses[1])).render(view_camera(view, 40, 30), supersampling=1)
        np.testing.assert_array_equal(picture, np.round(np.clip(frame.rgb, 0, 1) * 255).astype(np.uint8))
    assert reports == [(k / 4, f"frame {k + 1} of 4") for k in range(4)] + [(1.0, "finishes the file")]
    assert not np.array_equal(pictures[0], pictures[-1])


def test_films_have_their_rate_and_their_frames(field, tmp_path):
    shown = moving(loop="ping-pong")
    assert export_film(shown, field, tmp_path / "film.mp4", TINY) == 6
    assert export_film(shown, field, tmp_path / "film.gif", TINY) == 6
    assert iio.improps(tmp_path / "film.mp4", plugin="pyav").shape == (6, 30, 40, 3)
    assert iio.immeta(tmp_path / "film.mp4", plugin="pyav")["fps"] == 6.0
    assert iio.imread(tmp_path / "film.gif").shape[:3] == (6, 30, 40)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["film.gif", "film.mp4"]


def test_the_mode_of_the_session_does_not_change_its_film_and_still_moments_are_rendered_once(field, monkeypatch):
    rendered = []
    render = Look.render
    monkeypatch.setattr(Look, "render", lambda *args, **options: rendered.append(1) or render(*args, **options))
    still = document(length=1.0, fps=5.0)
    at_rest = dataclasses.replace(still, settings=dataclasses.replace(SMALL, mode="rest"))
    one, two = (list(film_pictures(shown, field, TINY)) for shown in (still, at_rest))
    assert len(one) == len(two) == 6 and len(rendered) == 2
    np.testing.assert_array_equal(one, two)


def test_pictures_are_made_when_they_are_asked_for(field):
    reports = []
    pictures = film_pictures(moving(length=1000.0), field, TINY, lambda share, text: reports.append(text))
    assert len(list(itertools.islice(pictures, 2))) == 2
    assert reports == ["frame 1 of 6001", "frame 2 of 6001"]


@pytest.mark.parametrize("overlay", [False, True])
def test_opacity_puts_a_film_before_any_background(field, overlay, tmp_path):
    shown = document(length=0.0)
    export_film(shown, field, tmp_path / "clear", Film(40, 30, overlay, transparent=True))
    (clear,) = (picture / 255.0 for picture in pictures_of(tmp_path / "clear"))
    assert clear.shape == (30, 40, 4) and clear[..., 3].min() == 0.0 and clear[..., 3].max() > 0.99
    for color in ((1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (0.2, 0.9, 0.4)):
        solid = dataclasses.replace(shown, settings=dataclasses.replace(SMALL, background=color))
        (expected,) = film_pictures(solid, field, Film(40, 30, overlay))
        composited = clear[..., :3] * clear[..., 3:] + (1.0 - clear[..., 3:]) * np.array(color)
        np.testing.assert_allclose(composited, np.clip(expected, 0.0, 1.0), atol=2.1 / 255)


@pytest.mark.parametrize("name", ["film.mp4", "film.gif", "frames"])
def test_a_cancelled_film_leaves_nothing(field, tmp_path, name):
    if name.endswith("mp4"):
        pytest.importorskip("av")
    (tmp_path / "film.gif").write_bytes(b"a film of before")

    def work(progress):
        def report(share, text):
            if text.startswith("frame 3"):
                jobs.cancel(number)
            progress(share, text)

        export_film(moving(), field, tmp_path / name, TINY, report)
        return Outcome("not reached")

    jobs = Jobs()
    number = jobs.start("film", "export", work)
    assert jobs.wait(60.0) and jobs.job(number).state == "cancelled"
    assert [path.name for path in tmp_path.iterdir()] == ["film.gif"]
    assert (tmp_path / "film.gif").read_bytes() == b"a film of before"


def test_a_pose_between_keys_that_cannot_be_used_is_named_by_its_time(field, tmp_path):
    keys = [Key(10 + k, float(k), "key", "linear", {1: frozen_vertices(BOX.vertices * [1, 1, 1 - k])}) for k in (0, 1)]
    with pytest.raises(ValueError, match=MESSAGES["editor.film_cage"]):
        export_film(document(keys=keys, length=1.0, fps=2.0), field, tmp_path / "frames", TINY)
    assert list(tmp_path.iterdir()) == []


def test_folders_with_something_in_them_stay_as_they_are(field, tmp_path):
    (tmp_path / "frames").mkdir()
    (tmp_path / "frames" / "frame_0000.png").write_bytes(b"mine")
    (tmp_path / "file").write_bytes(b"mine")
    for name in ("frames", "file"):
        with pytest.raises(ValueError, match=MESSAGES["editor.new_folder"]):
            export_film(moving(), field, tmp_path / name, TINY)
    with pytest.raises(ValueError, match="is not empty"), atomic_folder(tmp_path / "late") as folder:
        (folder / "frame_0000.png").write_bytes(b"new")
        (tmp_path / "late").mkdir()
        (tmp_path / "late" / "theirs").write_bytes(b"theirs")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "frames", "late"]
    assert [path.name for path in (tmp_path / "late").iterdir()] == ["theirs"]
    (tmp_path / "empty").mkdir()
    with atomic_folder(tmp_path / "empty") as folder:
        (folder / "frame_0000.png").write_bytes(b"new")
    assert (tmp_path / "empty" / "frame_0000.png").read_bytes() == b"new"


@pytest.mark.parametrize(
    ("name", "film", "message"),
    [
        ("film.avi", TINY, MESSAGES["editor.film_ending"]),
        ("film.mp4", Film(40, 30, transparent=True), "has no opacity: give .mov"),
    ],
)
def test_films_that_cannot_be_written(field, tmp_path, name, film, message):
    with pytest.raises(ValueError, match=message):
        export_film(moving(), field, tmp_path / name, film)
    with pytest.raises(ValueError, match=MESSAGES["editor.film_width"]):
        Film(0, 10)
    assert list(tmp_path.iterdir()) == []


# -- Cages, poses, fields


@pytest.mark.parametrize("ending", [".obj", ".ply", ".glb"])
def test_cages_are_written(tmp_path, ending):
    for rest, expected in ((False, BENT), (True, BOX)):
        export_cage(document(), 1, tmp_path / f"cage{ending}", rest=rest)
        read = Cage.load(tmp_path / f"cage{ending}")
        np.testing.assert_allclose(read.vertices, expected.vertices, atol=1e-6)
        np.testing.assert_array_equal(read.faces, BOX.faces)
    with pytest.raises(ValueError, match="must end in .obj, .ply, .glb"):
        export_cage(document(), 1, tmp_path / "cage.stl")


def test_poses_are_written(tmp_path):
    export_poses(moving(), 1, tmp_path / "poses.json")
    file = PoseFile.load(tmp_path / "poses.json")
    assert file.times == {"rest": 0.0, "bent": 0.5} and file.easings == {"rest": "smooth", "bent": "linear"}
    with pytest.raises(ValueError, match="must end in .json"):
        export_poses(moving(), 1, tmp_path / "poses.txt")


def test_a_baked_field_looks_like_the_posed_scene(field, tmp_path):
    reports = []
    at_rest = dataclasses.replace(document(), settings=dataclasses.replace(SMALL, mode="rest"))
    export_baked(at_rest, field, tmp_path / "baked.npz", lambda share, text: reports.append(share))
    scene, looking = PosedScene(field), view_camera(VIEW, 40, 30)
    scene.prepare(document())
    baked = VoxelField.load(tmp_path / "baked.npz", device=field.device)
    shown = scene.render(looking).rgb
    wrong, at_rest_wrong = (np.abs(other.render(looking).rgb - shown).mean() for other in (baked, field))
    assert wrong < 0.25 * at_rest_wrong
    assert reports == sorted(reports, key=lambda share: share or 0.0)
    export_baked(dataclasses.replace(document(), edits=()), field, tmp_path / "plain.npz")
    plain = VoxelField.load(tmp_path / "plain.npz", device=field.device)
    np.testing.assert_allclose(plain.render(looking).rgb, field.render(looking).rgb, atol=1e-3)

    def cancel(share, text):
        if text.startswith("writes"):
            raise Cancelled

    with pytest.raises(Cancelled):
        export_baked(document(), field, tmp_path / "never.npz", cancel)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["baked.npz", "plain.npz"]


# -- The same film without the editor


@pytest.fixture
def saved(tmp_path, field):
    folder = tmp_path / "a folder"
    folder.mkdir()
    field.save(folder / "ball.npz")
    write_session(folder / "ball.session.json", moving(loop="loop"), field, "ball.npz")
    return folder


@pytest.mark.parametrize(("overlay", "transparent"), [(False, False), (False, True), (True, True)])
def test_the_command_makes_the_film_of_the_editor_to_the_bit(saved, device, tmp_path, overlay, transparent, capsys):
    film, field = Film(36, 24, overlay, transparent), VoxelField.load(saved / "ball.npz", device=device)
    export_film(moving(loop="loop"), field, tmp_path / "of the editor", film)
    output = str(tmp_path / "of a command")
    command = export_command(saved / "ball.session.json", saved / "ball.npz", film, output=output)
    arguments = shlex.split(command)
    assert arguments[:2] == ["warpcage", "animate"] and "\n" not in command
    assert main([*arguments[1:], "--device", device, "--quiet"]) == 0
    assert f"wrote {output}: 3 frames of 36x24" in capsys.readouterr().out
    shown = [pictures_of(tmp_path / name) for name in ("of the editor", "of a command")]
    at = arguments.index("-o")
    jobs = [*arguments[1:at], *arguments[at + 2 :], "--jobs", str(saved / "film.jsonl"), "--quiet"]
    assert main(jobs) == (2 if overlay else 0)
    if not overlay:  # jobs of a session draw no cages
        with JobFile(saved / "film.jsonl") as job, Worker(job.folder, tmp_path / "of jobs", device) as worker:
            for item in job:
                worker.run(item)
        shown.append(pictures_of(tmp_path / "of jobs"))
    for pictures in zip(*shown, strict=True):
        assert len({picture.tobytes() for picture in pictures}) == 1
        assert pictures[0].shape == (24, 36, 4 if transparent else 3)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_a_film_of_a_session_without_two_keys_says_that_nothing_moves(saved, field, tmp_path, capsys, count):
    document = moving(loop="once")
    timeline = dataclasses.replace(document.timeline, keys=document.timeline.keys[:count], length=0.2, fps=10.0)
    session = saved / "still.session.json"
    write_session(session, dataclasses.replace(document, timeline=timeline), field, "ball.npz")
    arguments = ["animate", str(saved / "ball.npz"), "--session", str(session), "--device", "cpu", "--size", "24", "24"]
    assert main([*arguments, "--quiet", "-o", str(tmp_path / "film.gif")]) == 0
    assert ("nothing moves in this film: its 3 frames are equal" in capsys.readouterr().err) == (count < 2)


def test_the_command_is_safe_for_a_shell():
    command = export_command("it's; rm.session.json", "-field.npz", Film(8, 6), output="$(x).mp4", scene_scale=2 / 3)
    assert shlex.split(command) == [
        "warpcage", "animate", "./-field.npz", "--session", "it's; rm.session.json", "-o", "$(x).mp4",
        "--size", "8", "6", "--scene-scale", repr(2 / 3),
    ]  # fmt: skip
