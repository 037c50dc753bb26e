"""Specs: each comes back from JSON and from flags, refuses the same values everywhere, and an option of a shot shows
alike by commands, jobs, films, sweeps, the editor and the library."""

import dataclasses
import json
import pathlib
import re
from fractions import Fraction

import imageio.v3 as iio
import numpy as np
import pytest
from fields import surrounded_ball
from hypothesis import given
from hypothesis import strategies as st
from refusals import refused
from runs import DEFORMED, run, run_with, succeed, write_files
from splat_scenes import splats_in_box

import warpcage
from warpcage import Cage, CageEdit, CameraFile, Deformer
from warpcage.core.spec import checked_keys, checkers, options_json, options_of, schema
from warpcage.edits.spec import EditSpec
from warpcage.field.render import RenderOptions
from warpcage.splats import load_field
from warpcage.studio.cli.program import build_parser
from warpcage.studio.cli.shared import shot_of
from warpcage.studio.editor import (
    Document,
    Film,
    Selection,
    Timeline,
    View,
    film_pictures,
    new_edit,
    run_command,
    view_camera,
)
from warpcage.studio.films import read_edits_file, write_edits_file
from warpcage.studio.jobs import Item, JobFile, write_jobs
from warpcage.studio.spec import FilmSpec, FitSceneSpec, FitSpec, SceneSpec, Settings, ShotSpec

NUMBERS = st.floats(-1e6, 1e6, allow_subnormal=False)
LENGTHS = st.floats(1e-3, 1e3)
NAMES = st.text("abcxyz/._-", min_size=1, max_size=12).filter(lambda name: name.strip())
POINTS = st.lists(st.tuples(NUMBERS, NUMBERS, NUMBERS).map(list), min_size=1, max_size=3)

#: Values of options whose schema does not say them all.
VALUES = {
    "resolution": st.integers(1, 512) | st.just("precise"),
    "disparity_scale": st.tuples(LENGTHS, LENGTHS).map(sorted).map(tuple),
    "fps": st.fractions(Fraction(1, 4), 240, max_denominator=1001),
    "shutter": st.tuples(st.integers(1, 360).map(lambda degrees: degrees / 360), st.integers(1, 256)),
    "masks": st.booleans() | st.sampled_from(["split", "weights"]),
    "cage": NAMES | st.fixed_dictionaries({"vertices": POINTS, "faces": st.just([[0, 1, 2]])}),
    "posed": NAMES | POINTS,
    "held": st.sampled_from(["cut", "still", (3,), (1, 2)]),
}


def refuses(check, *arguments):
    try:
        check(*arguments)
    except ValueError:
        return True
    return False


def values_of(name, option):
    """Values that an option takes, by its schema."""
    described = option.values.schema
    if name in VALUES and "maximum" not in described:
        return VALUES[name].filter(lambda value: not refuses(option.values.check, value, name))
    if described.get("format") == "color":
        names, channels = described["anyOf"][0]["enum"], st.floats(0, 1, allow_subnormal=False)
        return st.sampled_from(names) | st.tuples(channels, channels, channels)
    if "enum" in described:
        return st.sampled_from(described["enum"])
    low, high = described.get("minimum"), described.get("maximum")
    kinds = {
        "boolean": st.booleans(),
        "integer": st.integers(low, high or 4096),
        "number": LENGTHS if low is not None or "exclusiveMinimum" in described else NUMBERS,
        "string": NAMES,
    }
    return kinds[described["type"]]


def specs(kind):
    return st.fixed_dictionaries(
        {}, optional={name: values_of(name, option) for name, option in options_of(kind).items()}
    ).map(lambda options: kind(**options))


def from_json(kind, text):
    return kind(**checked_keys(json.loads(text), checkers(kind), "it"))


@pytest.mark.parametrize("kind", [ShotSpec, FilmSpec, SceneSpec, FitSceneSpec, FitSpec, Settings])
@given(data=st.data())
def test_a_spec_comes_back_from_its_json(kind, data):
    spec = data.draw(specs(kind))
    assert from_json(kind, json.dumps(options_json(spec))) == spec


@given(
    options=st.fixed_dictionaries(
        {"cage": VALUES["cage"], "posed": VALUES["posed"]},
        optional={
            name: values_of(name, option)
            for name, option in options_of(EditSpec).items()
            if name not in ("cage", "posed", "remove")
        },
    )
)
def test_an_edit_comes_back_from_its_json(options):
    edit = EditSpec(**options)
    assert EditSpec.from_json(json.loads(json.dumps(edit.to_json())), "it").to_json() == edit.to_json()


def argv_of(spec):
    """The flags that say what a spec says."""
    argv = []
    for name, value in options_json(spec).items():
        option = options_of(type(spec))[name]
        if option.flag is None:
            continue
        flag = option.flag.split()[0]
        if isinstance(value, bool):
            argv.append(flag if value else f"--no-{flag[2:]}")
        elif name == "shutter":
            argv.append(f"{flag}={360 * value[0]!r}:{value[1]}")
        else:
            argv.append(f"{flag}={','.join(map(repr, value)) if isinstance(value, list) else value}")
    return argv


@given(spec=specs(FilmSpec))
def test_a_film_comes_back_from_the_flags_that_say_it(spec):
    args = build_parser().parse_args(["animate", "ball.npz", "-o", "film.mp4", *argv_of(spec)])
    for name, value in vars(args).items():  # what a session decides where it is not given
        setattr(args, name, getattr(value, "value", value))
    flags = {name for name, option in options_of(FilmSpec).items() if option.flag is not None}
    parsed, said = shot_of(args), options_json(spec)
    assert options_json(parsed) == {name: value for name, value in said.items() if name in flags}


@pytest.mark.parametrize("kind", [EditSpec, ShotSpec, FilmSpec, SceneSpec, FitSpec, Settings])
def test_a_schema_says_of_each_option_what_it_does(kind):
    properties = schema(kind)["properties"]
    assert list(properties) == list(options_of(kind)) and json.dumps(properties)
    for name, entry in properties.items():
        assert entry["description"], name
        if "default" in entry and entry["default"] is not None:
            from_json_value = checkers(kind)[name](entry["default"], name)
            assert json.loads(json.dumps(entry["default"])) is not None and from_json_value is not None


#: Values that each option refuses, as JSON has them; their texts are wrong for flags too.
WRONG = {
    "antialias": ["yes"], "background": ["pink", [0, 1], [0, 2, 0], 3], "cage": [3, {}, {"vertices": "a.npy"}],
    "cameras": [3, "\0"], "coordinates": ["mvc"], "density": ["thick"], "disparity_scale": [[2, 1], [1], "near"],
    "downscale": [0, 1.5], "epochs": [0, "many"], "falloff": [-1, "wide"], "fill": [1], "format": [3],
    "fps": [0, "1/0", "1e999999999"], "fragments": [-1, "small"], "frames": [0, 1.5], "held": ["all", [-1]],
    "interpolation": ["cubic"], "keep": ["yes"], "loop": ["twice"], "map": ["sideways"], "masks": ["maybe", 3],
    "max_memory": [[]], "mode": ["look"], "most_splats": [0], "motion": ["jump"], "object": [3], "overlay": ["no"],
    "overwrite": [1], "posed": [3, {}, []], "quality": ["best"], "remove": [1], "resolution": [0, 1.5, "fine"],
    "scene_scale": [0, -1, "1e999999999"], "seed": [-1, 0.5], "show": ["normals"],
    "shutter": ["0", "400", "180:0", "180:many"], "split": [3], "steps": [0], "straighten": [1],
    "supersampling": [0, 9, 1.5, True], "turn": ["far", "nan"], "up": ["x"], "variation": [-1],
}  # fmt: skip


def wrong_values(*kinds, only=lambda name: True):
    """Names and values of options of specs, each wrong."""
    return [(name, value) for kind in kinds for name in options_of(kind) if only(name) for value in WRONG[name]]


def test_each_option_has_a_wrong_value():
    kinds = (FilmSpec, EditSpec, FitSceneSpec, FitSpec, Settings)
    assert WRONG.keys() == {name for kind in kinds for name in options_of(kind)}


#: Commands, what each needs, and the specs of its flags.
COMMANDS = {
    "render": ("@ball.npz -o a.png", ShotSpec, EditSpec),
    "animate": ("@ball.npz -o a.mp4", FilmSpec, EditSpec),
    "sweep": ("@ball.npz -o a.jsonl --cage @cage.obj", ShotSpec, EditSpec),
    "bake": ("@ball.npz -o a.npz", ShotSpec, EditSpec),
    "fit": ("@scene -o a.npz", FitSceneSpec, FitSpec),
    "evaluate": ("@ball.npz @scene", SceneSpec),
}
HELP = pathlib.Path(__file__).parents[2] / "data" / "help"


@pytest.mark.parametrize("command", COMMANDS)
def test_a_wrong_value_of_a_flag_is_refused_in_one_line(files, tmp_path, monkeypatch, capsys, command):
    monkeypatch.chdir(tmp_path)
    text, tried = (HELP / f"{command}.txt").read_text(), set()
    needed, *kinds = COMMANDS[command]
    for option, value in ((options_of(kind)[name], value) for kind in kinds for name, value in wrong_values(kind)):
        flag = (option.flag or "none").split()[0]
        any_text = option.values.schema.get("type") in ("boolean", "string")
        if any_text or not re.search(rf"^  {flag}\b", text, re.MULTILINE):
            continue
        tried.add(flag)
        value = ",".join(map(str, value)) if isinstance(value, list) else value
        assert run(files, command, *needed.split(), f"{flag}={value}") == 2, (flag, value)
        said = capsys.readouterr().err
        assert re.fullmatch(rf"warpcage: error: .*{flag[2:].replace('-', '.')}.*\n", said), said
    assert len(tried) >= {"render": 8, "animate": 14, "sweep": 7}.get(command, 1) and list(tmp_path.iterdir()) == []


#: Lines of job files by kind, and the specs of their keys.
CAMERA = {"eye": [3, 0, 0], "target": [0, 0, 0], "width": 40, "height": 30}
LINES = {
    "frame": ({"field": "f.npz", "cage": "c.obj", "posed": "p.obj", "camera": CAMERA}, ShotSpec, EditSpec),
    "fit": ({"scene": "s"}, FitSceneSpec),
    "evaluate": ({"scene": "s", "field": "f.npz"}, SceneSpec),
}


@pytest.mark.parametrize("kind", LINES)
def test_a_wrong_value_in_a_job_file_is_refused_with_its_line(tmp_path, kind):
    line, *kinds = LINES[kind]
    path, header = tmp_path / "jobs.jsonl", {"format": "warpcage jobs", "version": 4}
    for name, value in (tried := wrong_values(*kinds, only=Item.kinds[kind].known().__contains__)):
        path.write_text(f"{json.dumps(header)}\n{json.dumps(line | {'id': 'a', 'kind': kind, name: value})}\n")
        refused(JobFile(path).check, str(path), "line 2", repr(name))
        if kind == "frame":  # a default of several kinds takes what any of them takes
            path.write_text(json.dumps(header | {"defaults": {name: value}}) + "\n")
            refused(lambda: JobFile(path), str(path), "line 1", repr(name))
    assert len(tried) >= {"frame": 30}.get(kind, 6)


def test_a_wrong_value_in_an_edits_file_is_refused_with_its_edit(tmp_path):
    path = tmp_path / "it.edits.json"
    write_edits_file(path, [EditSpec("a.obj", "b.obj")] * 2)
    whole = json.loads(path.read_text())
    for name, value in wrong_values(EditSpec):
        path.write_text(json.dumps(whole | {"edits": [whole["edits"][0], whole["edits"][1] | {name: value}]}))
        refused(lambda: read_edits_file(path), str(path), f"edit 2: {name!r}")


VIEW = View((2.5, -2.0, 1.5), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 40.0)


def document(edit, **settings):
    return Document((edit,), Selection(1), Settings(**settings), VIEW, Timeline())


def exported(document, field, **film):
    """The first frame of the editor's film."""
    return in_bytes(next(film_pictures(document, field, Film(40, 40, **film))))


def in_bytes(rgb):
    return np.rint(255 * np.clip(rgb, 0, 1)).astype(np.uint8)


def test_a_wrong_value_of_a_setting_is_refused_by_the_editor():
    box = Cage.box((-1, -1, -1), (1, 1, 1))
    for name, value in wrong_values(Settings, only=Settings().to_json().__contains__):
        refused(lambda: run_command(document(new_edit(1, box, "it")), {"do": "settings", name: value}), name)  # noqa: B023


class Stopped(Exception):
    pass


@given(fit=specs(FitSpec), scene=specs(FitSceneSpec))
def test_flags_of_a_fit_reach_the_scene_and_the_fit(files, fit, scene):
    read, fitted = {}, {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("warpcage.studio.cli.shared.load_scene", lambda path, **given: read.update(given))
        patch.setattr("warpcage.studio.cli.scenes.fit", lambda path, **given: fitted.update(given) or stop())
        fit = dataclasses.replace(fit, max_memory=None, steps=None, most_splats=None)  # of splats
        with pytest.raises(Stopped):
            run(files, "fit", "@scene", "-o", "@new.npz", "--device", "cpu", "--quiet", *argv_of(fit), *argv_of(scene))
    for name in options_of(FitSpec):
        assert fitted.get(name, getattr(FitSpec(), name)) == getattr(fit, name) or not getattr(fit, name), name
    assert all(read[name] == getattr(scene, name) for name in ("split", "format", "downscale", "cameras"))
    assert read["orient"] == ("up" if scene.straighten else None)


def stop():
    raise Stopped


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = write_files(tmp_path_factory.mktemp("specs"))
    surrounded_ball("cpu", "layers").save(folder / "layers.npz")
    splats_in_box("cpu", count=400, scales=(-3.5, -2.8), degree=1).save(folder / "splats.ply")
    CameraFile([view_camera(VIEW, 40, 40)]).save(folder / "camera.json")
    Cage.box((-0.7, -0.7, 0.0), (0.7, 0.7, 0.7)).save(folder / "top.obj")
    Cage.box((-0.7, -0.7, -0.7), (0.7, 0.7, 0.45)).save(folder / "most.obj")  # the rest is a fragment
    return folder


#: What all pictures here have.
USUAL = {"coordinates": "mean_value", "resolution": 24}

#: A value of each option of a shot that changes a picture, and the field of that picture.
SHOWN = {
    "background": ("ball.npz", "black"),
    "supersampling": ("ball.npz", 3),
    "coordinates": ("ball.npz", "maximum_likelihood"),
    "resolution": ("ball.npz", 9),
    "density": ("ball.npz", "paper"),
    "overlay": ("ball.npz", True),
    "scene_scale": ("ball.npz", 2.0),
    "antialias": ("splats.ply", True),
    "map": ("splats.ply", "backward"),
    "fill": ("layers.npz", True),
}


def test_all_options_of_a_shot_have_a_check_of_their_picture():
    assert SHOWN.keys() | {"disparity_scale"} == options_of(ShotSpec).keys()  # that of films of depth


def made_by(files, path, out):
    """The only picture of a run of a job file."""
    assert run_with(path, out).complete
    (picture,) = out.rglob("*.png")
    return iio.imread(picture)


@pytest.mark.parametrize("name", [None, *SHOWN])
def test_an_option_shows_alike_whatever_makes_the_picture(files, tmp_path, name):
    field, value = SHOWN.get(name, ("ball.npz", None))
    usual = USUAL | ({} if name == "fill" else {"background": "white"})
    spec = ShotSpec(**usual | ({} if name is None else {name: value}))
    common = [f"@{field}", "--quiet", "--device", "cpu", *argv_of(spec)]
    camera = ["--camera", "@camera.json", *DEFORMED]

    def rendered(output, *arguments):
        succeed(files, "render", f"@{field}", "--device", "cpu", *camera, *arguments, "-o", tmp_path / output)
        return iio.imread(tmp_path / output)

    expected = rendered("flags.png", *argv_of(spec))
    assert np.array_equal(rendered("usual.png", *argv_of(ShotSpec(**usual))), expected) == (name is None)

    line = {"id": "job", "field": str(files / field), "camera": f"{files / 'camera.json'}#0"}
    edit = {"cage": str(files / "cage.obj"), "posed": str(files / "posed.obj")}
    write_jobs(tmp_path / "jobs.jsonl", [line | edit | spec.item_keys(deformed=True)])
    found = {"job": made_by(files, tmp_path / "jobs.jsonl", tmp_path / "jobs")}

    film = ["animate", *common, *camera, "--frames", 1, "--motion", "hold", "--turn", 0]
    succeed(files, *film, "-o", tmp_path / "film")
    succeed(files, *film, "--jobs", tmp_path / "film.jsonl")
    found["film"] = iio.imread(tmp_path / "film" / "frame_0000.png")
    found["jobs of a film"] = made_by(files, tmp_path / "film.jsonl", tmp_path / "film jobs")

    if name not in ("fill", "overlay"):
        sweep = ["sweep", *common, "--poses", "@posed.obj", "--cameras", "@camera.json", "--cage", "@cage.obj"]
        succeed(files, *sweep, "--no-alpha", "--no-depth", "-o", tmp_path / "sweep.jsonl")
        found["sweep"] = made_by(files, tmp_path / "sweep.jsonl", tmp_path / "sweep")

    scene, rest = load_field(files / field, device="cpu", scene_scale=spec.scene_scale), Cage.load(files / "cage.obj")
    posed = rest.match(Cage.load(files / "posed.obj"))
    if name != "overlay":
        looks = {each.name for each in dataclasses.fields(RenderOptions)} & options_of(ShotSpec).keys()
        options = {each: getattr(spec, each) for each in looks - {"scene_scale"}}
        deformer = Deformer(scene, rest, **spec.deformer_options(0)).pose(posed)
        fill, view = options.pop("fill"), CameraFile.load(files / "camera.json")[0].camera
        frame = deformer.render(view, **options)
        found["library"] = in_bytes((warpcage.fill_unseen(frame, scene, view) if fill else frame).rgb)
    settings = {each: getattr(spec, each) for each in options_of(ShotSpec).keys() & {*usual, name} - {"scene_scale"}}
    shown = document(new_edit(1, rest, "it", posed=posed.vertices), **settings)
    found["editor"] = exported(shown, scene, overlay=spec.overlay)
    for maker, picture in found.items():
        np.testing.assert_array_equal(picture, expected, maker)


#: An edit by each of its options.
EDITS = {
    "posed": EditSpec("top.obj", "translate:0.5:0:0.3"),
    "keep": EditSpec("top.obj", "translate:0.5:0:0.3", keep=True),
    "remove": EditSpec("most.obj", remove=True),
    "falloff": EditSpec("top.obj", "translate:0.5:0:0.3", falloff=0.3),
    "held": EditSpec("top.obj", "translate:0.5:0:0.3", falloff=0.3, held=(0, 1, 2, 3)),
    "fragments": EditSpec("most.obj", remove=True, fragments=1.2),
}


@pytest.fixture(scope="module")
def pictures_of_edits(files):
    """By the library, and by the editor, which shows the same."""
    field, camera = load_field(files / "ball.npz", device="cpu"), CameraFile.load(files / "camera.json")[0].camera
    made = {}
    for name, spec in EDITS.items():
        rest = Cage.load(files / spec.cage)
        posed = None if spec.remove else rest.translate([0.5, 0, 0.3])
        changes = {"falloff": spec.falloff or 0.0, "fragments": spec.fragments or 0.0, "held": spec.held}
        deformer = Deformer(field, CageEdit(rest, keep_source=spec.keep, remove=spec.remove, **changes), **USUAL)
        made[name] = in_bytes(deformer.pose(posed).render(camera, background="white").rgb)
        kind = "remove" if spec.remove else "copy" if spec.keep else "move"
        edit = new_edit(1, rest, "it", kind, posed=None if posed is None else posed.vertices)
        if spec.held == "cut":  # the editor names no single walls
            shown = document(dataclasses.replace(edit, **changes), background="white", **USUAL)
            np.testing.assert_array_equal(exported(shown, field), made[name])
    return made


def test_each_option_of_an_edit_has_a_picture_of_its_own(pictures_of_edits):
    assert pictures_of_edits.keys() | {"cage", "up", "object"} == options_of(EditSpec).keys()
    assert len({picture.tobytes() for picture in pictures_of_edits.values()}) == len(EDITS)


@pytest.mark.parametrize("name", EDITS)
@pytest.mark.nightly
def test_an_option_of_an_edit_shows_alike_whatever_makes_the_picture(files, pictures_of_edits, tmp_path, name):
    edit, usual = EDITS[name], ShotSpec(background="white", **USUAL)
    text = [f"@{edit.cage}", edit.posed, *(each for each in ("keep", "remove") if getattr(edit, each))]
    widths = {each: getattr(edit, each) for each in ("falloff", "fragments") if getattr(edit, each)}
    held = {} if edit.held == "cut" else {"held": edit.held_text}
    text += [f"{each}={value}" for each, value in (widths | held).items()]
    write_edits_file(tmp_path / "it.json", [dataclasses.replace(edit, cage=str(files / edit.cage))])
    ways = [["--edit", ":".join(filter(None, text))], ["--edits", tmp_path / "it.json"]]
    if not held:  # widths of all edits of a command
        flags = [word for each, value in widths.items() for word in (f"--{each}", value)]
        ways.append(["--edit", ":".join(filter(None, text[: len(text) - len(widths)])), *flags])
    render = ["render", "@ball.npz", "--device", "cpu", "--camera", "@camera.json", *argv_of(usual)]
    for way in ways:
        succeed(files, *render, *way, "-o", tmp_path / "flags.png")
        np.testing.assert_array_equal(iio.imread(tmp_path / "flags.png"), pictures_of_edits[name])
    whole = edit.to_json() | {"cage": str(files / edit.cage)}
    line = {"id": "job", "field": str(files / "ball.npz"), "camera": f"{files / 'camera.json'}#0"}
    for number, keys in enumerate((whole, {"edits": [whole]})):
        write_jobs(tmp_path / f"{number}.jsonl", [line | usual.item_keys(deformed=True) | keys])
        made = made_by(files, tmp_path / f"{number}.jsonl", tmp_path / f"out {number}")
        np.testing.assert_array_equal(made, pictures_of_edits[name])
