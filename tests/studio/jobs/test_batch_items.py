"""Job files and their items: what is read, what is refused and how, and files of a million lines."""

import json
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from messages import MESSAGES
from refusals import refused
from runs import without

from warpcage import CageEdit
from warpcage.studio.jobs import EvaluateItem, FitItem, FrameItem, Item, JobFile, write_jobs

HEADER = {"format": "warpcage jobs", "version": 1}
CAMERA = {"eye": [3, 0, 0], "target": [0, 0, 0], "width": 40, "height": 30}
FRAME = {"id": "a", "field": "f.npz", "cage": "c.obj", "posed": "p.obj", "camera": CAMERA}
BARE = without(FRAME, "cage", "posed")
EDIT = {"cage": "c.obj", "posed": "p.obj"}
DRAWN = {"random": {"seed": 3, "number": 12}}
FIT = {"id": "f", "kind": "fit", "scene": "s"}


def written(path, *lines):
    path.write_text("\n".join(each if isinstance(each, str) else json.dumps(each) for each in lines) + "\n", "utf-8")
    return path


# -- what is read


def test_a_file_written_by_hand(tmp_path):
    path = written(
        tmp_path / "jobs.jsonl",
        '{"format": "warpcage jobs", "version": 1, "defaults": {"field": "lego.npz", "cage": "cage.obj",',
        "",
    )
    refused(lambda: JobFile(path), match=MESSAGES["batch.json_breaks_off"])
    path = written(
        path,
        HEADER | {"defaults": {"field": "lego.npz", "cage": "cage.obj", "camera": "cameras.json#front"}},
        "   ",
        {"id": "bent", "posed": "bend:40"},
        "",
        {"id": "shot/row", "posed": "poses.npy#17", "outputs": {"rgb": "{id}.jpg", "depth": "depth/{id}.npy"}},
        {"id": "fit", "kind": "fit", "scene": "data/lego", "options": {"quality": "fast"}, "output": "lego.npz"},
        {"id": "psnr", "kind": "evaluate", "scene": "data/lego", "output": "psnr.json"},
    )
    with JobFile(path) as job:
        job.check()
        bent, row, fit, psnr = job.items()
        assert len(job) == 4 and job.folder == tmp_path and job.line(0) == 3 and job.line(1) == 5
    assert bent.outputs == {"rgb": "bent.png"} and bent.edits[0].posed == "bend:40"
    assert row.outputs == {"rgb": "shot/row.jpg", "depth": "depth/shot/row.npy"}
    assert (bent.group == row.group) and bent.pose != row.pose
    assert isinstance(fit, FitItem) and fit.outputs == {"field": "lego.npz"}
    assert isinstance(psnr, EvaluateItem) and psnr.field == "lego.npz" and psnr.split == "test"


def test_files_of_other_systems(tmp_path):
    path = tmp_path / "jobs.jsonl"
    lines = [json.dumps(each) for each in (HEADER, FRAME | {"id": "größe"}, FRAME | {"id": "b"})]
    path.write_bytes(b"\xef\xbb\xbf" + "\r\n".join(lines).encode())
    assert [item.id for item in JobFile(path)] == ["größe", "b"]


def test_items_survive_json():
    entries = [
        FRAME | {"extra": {"seed": 3}, "size": 80, "background": [0, 0.5, 1], "supersampling": 2, "resolution": 48},
        BARE | {"edits": [EDIT, {"cage": "d.obj", "remove": True, "fragments": 0.1}]},
        BARE | {"edits": [EDIT | {"falloff": 0.1, "held": [3, 5], "up": "y", "keep": True}]},
        BARE,
        FRAME | {"posed": DRAWN},
        FRAME | {"posed": {"random": {"number": 1, "stretch": [0.7, 1.5], "reach": [1, 1], "modes": ["wave", "bend"]}}},
        FRAME | {"moments": [{"camera": "cameras.json#0", "posed": ["p.npy#3"]}, {"camera": CAMERA}, {}]},
        {"id": "f", "kind": "fit", "scene": "s", "options": {"refine_cameras": True}, "background": "black"},
        {"id": "e", "kind": "evaluate", "scene": "s", "field": "f.npz", "tune_cameras": True, "downscale": 2},
    ]
    for entry in entries:
        item = Item.from_json(entry)
        again = Item.from_json(json.loads(json.dumps(item.to_json())))
        assert again.to_json() == item.to_json() and again.order == item.order and type(again) is type(item)


def test_a_file_has_the_first_version_that_has_all_of_its_keys(tmp_path):
    path, usual = tmp_path / "jobs.jsonl", without(FRAME, "id", "posed")
    drawn = usual | {"posed": DRAWN}
    for posed, defaults, version in [("p.obj", usual, 1), (DRAWN, usual, 2), (None, drawn, 2), ("p.obj", drawn, 2)]:
        items = [{"id": "a", "posed": "q.obj"}, {"id": "b", **({"posed": posed} if posed else {})}]
        write_jobs(path, items, defaults=defaults)
        header, *lines = map(json.loads, path.read_text().splitlines())
        assert header["version"] == version and header["defaults"] == defaults and lines == items
        found = JobFile(path).item(1).edits[0].posed
        assert found == "p.obj" if posed == "p.obj" else found["random"]["number"] == 12
    for item, defaults in [(FRAME | {"moments": [{}]}, {}), ({"id": "a"}, FRAME | {"moments": [{}]})]:
        write_jobs(path, [item], defaults=without(defaults, "id"))
        assert JobFile(path).header["version"] == 3
    small, older = EDIT | {"fragments": 0.1}, EDIT | {"crumbs": 0.1}
    for item, defaults in [({"edits": [small]}, {}), ({}, {"edits": [older]}), ({}, small), (older, {})]:
        write_jobs(path, [BARE | item], defaults=defaults)
        assert JobFile(path).header["version"] == 4 and JobFile(path).item(0).edits[0].fragments == 0.1
    edits = {"edits": [EDIT, EDIT | {"posed": DRAWN}]}
    for item, defaults in [(BARE | edits, {}), (FRAME, edits)]:
        write_jobs(path, [item], defaults=defaults)
        assert JobFile(path).header["version"] == 2


def test_drawn_poses_of_one_meaning_are_one_pose():
    def posed(**options):
        return Item.from_json(FRAME | {"posed": {"random": {"number": 12} | options}})

    usual = {"seed": 0, "stretch": [0.5, 2], "reach": [0.3, 1.0]}
    assert posed().to_json() == posed(**usual).to_json() and posed().order == posed(**usual).order
    for other in ({"number": 13}, {"seed": 1}, {"stretch": [0.6, 2]}, {"reach": [0.3, 0.9]}, {"modes": ["bend"]}):
        assert posed(**other).order[0] == posed().order[0] and posed(**other).order[1] != posed().order[1]


def test_the_keys_of_an_edit_are_those_of_a_cage_edit():
    names = set(CageEdit.__dataclass_fields__) - {"cage", "keep_source"} | {"keep"}
    assert names <= set(FrameItem.known())


def test_one_edit_of_the_defaults_gives_way_to_edits_of_an_item(tmp_path):
    edits = [EDIT, EDIT | {"cage": "d.obj"}]
    usual = without(FRAME, "id") | {"falloff": 0.1}
    path = tmp_path / "jobs.jsonl"
    write_jobs(path, [{"id": "one"}, {"id": "two", "edits": edits}, {"id": "three", "posed": "q.obj"}], defaults=usual)
    one, two, three = JobFile(path)
    assert one.edits[0].falloff == 0.1 and three.edits[0].posed == "q.obj" and three.group == one.group
    assert [edit.cage for edit in two.edits] == ["c.obj", "d.obj"] and not two.edits[0].falloff
    write_jobs(path, [{"id": "one"}, {"id": "two", "cage": "e.obj", "posed": "q.obj"}], defaults=usual_edits(edits))
    assert [[edit.cage for edit in item.edits] for item in JobFile(path)] == [["c.obj", "d.obj"], ["e.obj"]]


def usual_edits(edits):
    return without(FRAME, "id", "cage", "posed") | {"edits": edits}


def test_null_takes_a_default_away(tmp_path):
    path = tmp_path / "jobs.jsonl"
    usual = without(FRAME, "id") | {"background": "black"}
    write_jobs(path, [{"id": "a"}, {"id": "b", "background": None}], defaults=usual)
    assert [item.background for item in JobFile(path)] == ["black", None]


def test_items_of_one_group_share_what_is_loaded():
    def order(**more):
        return Item.from_json(FRAME | more).order

    assert order() == order(id="b", camera="c.json#1", background="black", extra=1)
    assert order()[0] == order(posed="q.obj")[0] and order()[1] != order(posed="q.obj")[1]
    for more in ({"field": "g.npz"}, {"cage": "d.obj"}, {"coordinates": "green"}, {"resolution": 32}, {"falloff": 0.1}):
        assert order()[0] != order(**more)[0]


# -- what is refused


def drawn(random):
    return FRAME | {"posed": {"random": random}}


REFUSED = {
    "no id": (without(FRAME, "id"), 'needs an "id"'),
    "an id that leads out": (FRAME | {"id": "../a"}, "'id' must be a relative name"),
    "an absolute id": (FRAME | {"id": "/a"}, "'id' must be a relative name"),
    "a hidden id": (FRAME | {"id": ".warpcage/a"}, "'id' must be a relative name"),
    "an id of spaces": (FRAME | {"id": "a b"}, "'id' must be a relative name"),
    "a long id": (FRAME | {"id": "a" * 300}, "'id' must be a relative name"),
    "a number as id": (FRAME | {"id": 3}, "'id' must be a relative name"),
    "an unknown word": (FRAME | {"posd": "p.obj"}, "has no 'posd', only id, kind, field"),
    "an unknown kind": (FRAME | {"kind": "film"}, "'kind' must be one of frame, fit, evaluate"),
    "no field": (without(FRAME, "field"), "a frame needs a 'field'"),
    "no camera": (without(FRAME, "camera"), "a frame needs a 'camera'"),
    "a camera of nothing": (FRAME | {"camera": {"fx": 1}}, "'camera' lacks 'fy'"),
    "a camera of text": (FRAME | {"camera": CAMERA | {"eye": "here"}}, "'eye' must be 3 numbers, got 'here'"),
    "a camera with a slip": (FRAME | {"camera": CAMERA | {"widthx": 3}}, "'camera' has no 'widthx'"),
    "a cage alone": (without(FRAME, "posed"), "'cage' needs 'posed'"),
    "a pose alone": (without(FRAME, "cage"), "'posed' needs a 'cage'"),
    "keep and remove": (without(FRAME, "posed") | {"keep": True, "remove": True}, "do not go together"),
    "held without falloff": (FRAME | {"held": "still"}, "give it a 'falloff'"),
    "edits beside a cage": (FRAME | {"edits": [EDIT]}, "do not go together"),
    "no edits": (BARE | {"edits": []}, "'edits' must be a list of at least one edit"),
    "an edit with a slip": (
        BARE | {"edits": [EDIT, {"cage": "c.obj", "pose": 1}]},
        "edit 2 of 'edits': it has no 'pose'",
    ),
    "a pose of nothing": (
        FRAME | {"posed": {}},
        '\'posed\' must be an array, or {"random": {"seed": 0, "number": 12}}',
    ),
    "a drawn pose of two": (FRAME | {"posed": {"random": {"number": 1}, "bend": 3}}, "'posed' must be an array, or"),
    "a drawn pose without a number": (drawn({"seed": 1}), "'random' of 'posed' needs a 'number'"),
    "a drawn pose with a slip": (drawn({"number": 1, "sed": 3}), "has no 'sed', only seed"),
    "a number of a pose": (drawn({"number": -1}), "'number' must be a whole number of at least 0"),
    "a stretch of text": (drawn({"number": 1, "stretch": "0.5 2"}), "'stretch' must be 2 numbers"),
    "a stretch without 1": (drawn({"number": 1, "stretch": [1.5, 2]}), "stretch must hold 1"),
    "a mode": (drawn({"number": 1, "modes": ["melt"]}), "must be one of bend, twist"),
    "a mode of text": (drawn({"number": 1, "modes": "bend"}), "'modes' must be a list of some"),
    "precise harmonic": (FRAME | {"resolution": "precise"}, "harmonic coordinates have no closed form"),
    "an ending": (FRAME | {"outputs": {"rgb": "a.tif"}}, "'rgb' of 'outputs' must end in .png"),
    "a part": (FRAME | {"outputs": {"normal": "a.png"}}, "'outputs' has no 'normal', only rgb"),
    "an output that leads out": (FRAME | {"outputs": {"rgb": "../a.png"}}, "must be a relative name"),
    "one file twice": (FRAME | {"outputs": {"rgb": "a.png", "alpha": "a.png"}}, "two of the 'outputs' are one file"),
    "a clear JPEG": (FRAME | {"background": "transparent", "outputs": {"rgb": "a.jpg"}}, "a JPEG has no opacity"),
    "masks of nothing": (BARE | {"outputs": {"masks": "m.png"}}, "needs a deformation"),
    "fill": (FRAME | {"fill": True, "background": "black"}, "cannot be combined with 'background'"),
    "no moments": (FRAME | {"moments": []}, "'moments' must be a list of objects with a 'camera'"),
    "a moment with a slip": (FRAME | {"moments": [{"pose": []}]}, "moment 1 of 'moments' has no 'pose', only camera"),
    "a pose of a moment": (FRAME | {"moments": [{"posed": "p.obj"}]}, "must be a list of a pose for each edit"),
    "a moment of two": (FRAME | {"moments": [{}, {"posed": ["p.obj", None]}]}, "moment 2 of 'moments' needs a pose"),
    "a depth of moments": (FRAME | {"moments": [{}], "outputs": {"depth": "a.exr"}}, "leave 'a.exr' of 'outputs' out"),
    "numbers of moments": (FRAME | {"moments": [{}], "outputs": {"rgb": "a.npy"}}, "leave 'a.npy' of 'outputs' out"),
    "a size": (FRAME | {"size": [3, 4, 5]}, "'size' must be a width"),
    "a fit of nothing": ({"id": "f", "kind": "fit"}, "a fit needs a 'scene'"),
    "options of a fit": ({"id": "f", "kind": "fit", "scene": "s", "options": {"quality": "best"}}, "got 'best'"),
    "a seed": (FIT | {"options": {"seed": -1}}, "seed must be a whole number"),
    "a fit's output": (FIT | {"output": "f.ply"}, "'output' must end in .npz"),
    "a clear fit": (FIT | {"background": "transparent"}, "must be a colour"),
    "an evaluation of nothing": ({"id": "e", "kind": "evaluate", "scene": "s"}, "an evaluation needs a 'field'"),
    "a report": ({"id": "e", "kind": "evaluate", "scene": "s", "field": "f.npz", "output": "e.txt"}, ".json"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_items_are_refused_with_file_and_line(case, tmp_path):
    entry, message = REFUSED[case]
    job = JobFile(written(tmp_path / "jobs.jsonl", HEADER, FRAME | {"id": "first"}, entry))
    assert job.item(0).id == "first"
    assert refused(job.check, message).startswith(f"{tmp_path / 'jobs.jsonl'}, line 3")
    refused(lambda: write_jobs(tmp_path / "new.jsonl", [entry]), match=r"^item 1 \(")
    assert not (tmp_path / "new.jsonl").exists()


LINES = {
    "no header": ([FRAME], "line 1: it is not the header of a job file"),
    "another format": ([{"format": "warpcage poses", "version": 1}], "not 'warpcage jobs'"),
    "a newer version": ([HEADER | {"version": 5}], "line 1: its version is 5, this warpcage reads up to 4: upgrade"),
    "no version": ([without(HEADER, "version")], "its version must be a whole number"),
    "a default with a slip": ([HEADER | {"defaults": {"fieldx": "f"}}], "line 1: 'defaults' has no 'fieldx'"),
    "an id for all": ([HEADER | {"defaults": {"id": "a"}}], "'defaults' has no 'id'"),
    "records": ([HEADER | {"records": {"kind": "zip"}}], "'kind' must be one of folder, webdataset"),
    "a list": ([HEADER, "[1, 2]"], "line 2: it must be a JSON object"),
    "half a line": ([HEADER, FRAME, '{"id": "b", "field'], "line 3: its JSON breaks off or is damaged at column"),
    "NaN": ([HEADER, '{"id": "b", "falloff": NaN}'], "line 2: NaN is not a number in JSON"),
    "brackets": ([HEADER, "[" * 100_000], "line 2: its JSON is nested too deeply"),
    "two of one id": (
        [HEADER, FRAME, FRAME | {"outputs": {"rgb": "b.png"}}],
        "lines 2 and 3: two items have the id 'a'",
    ),
    "capitals": ([HEADER, FRAME, FRAME | {"id": "A"}], "lines 2 and 3: two items have the id 'a'"),
    "one output of two": (
        [HEADER, FRAME, FRAME | {"id": "b"}, FRAME | {"id": "c", "outputs": {"rgb": "a.png"}}],
        "lines 2 and 4: two items have the output 'a.png'",
    ),
}


@pytest.mark.parametrize("case", LINES)
def test_files_are_refused_with_their_line(case, tmp_path):
    lines, message = LINES[case]
    said = refused(lambda: JobFile(written(tmp_path / "jobs.jsonl", *lines)).check())
    assert message in said and said.startswith(str(tmp_path))
    assert len(said) < 1000


def test_files_that_are_none(tmp_path):
    for content in (b"", b"\n \n", b"\xff\xfe\x00", b"\x00" * 100, bytes(range(256))):
        (tmp_path / "jobs.jsonl").write_bytes(content)
        refused(lambda: JobFile(tmp_path / "jobs.jsonl"), match="jobs.jsonl")
    refused(lambda: JobFile(tmp_path / "no.jsonl"), match="job file .* is not there", error=FileNotFoundError)
    refused(lambda: JobFile(tmp_path), match="is a folder", error=FileNotFoundError)
    assert len(JobFile(written(tmp_path / "good.jsonl", HEADER))) == 0


anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)
WORDS = sorted({word for maker in Item.kinds.values() for word in maker.known()})


@settings(max_examples=150, deadline=None)
@given(
    st.sampled_from([FRAME, FIT, {"id": "e", "kind": "evaluate", "scene": "s"}]),
    st.dictionaries(st.sampled_from(WORDS), anything, min_size=1, max_size=4),
    st.dictionaries(st.sampled_from(WORDS), anything, max_size=2),
)
@example(FRAME, {"antialias": None}, {"moments": [None]})
def test_any_keys_make_an_item_or_one_line(entry, argv, defaults):
    try:
        item = Item.from_json(entry | argv, defaults)
    except ValueError as error:
        assert str(error) and "\n" not in str(error) and len(str(error)) < 1000
    else:
        assert Item.from_json(json.loads(json.dumps(item.to_json()))).to_json() == item.to_json()
        assert all(isinstance(part, str) for part in item.order)


# -- long files


def test_a_failure_leaves_the_file_as_it_was(tmp_path):
    path = tmp_path / "jobs.jsonl"
    assert write_jobs(path, ({"id": f"f{i}"} for i in range(3)), defaults=without(FRAME, "id"), extra={"seed": 1}) == 3
    before = path.read_bytes()
    refused(lambda: write_jobs(path, [FRAME, FRAME | {"id": "b b"}]), match=r"item 2 \('b b'\): 'id' must be")
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]
    with JobFile(path) as job:
        assert job.header["extra"] == {"seed": 1}
        refused(lambda: job.item(3), match="has items 0 to 2, got 3")


def test_lines_take_few_bytes_each(tmp_path):
    """In a process of its own, whose greatest memory is measured: lines by their places, no items."""
    path, count = tmp_path / "jobs.jsonl", 300_000
    head = json.dumps(HEADER | {"defaults": without(FRAME, "id")})
    with path.open("w") as file:
        file.write(head + "\n")
        file.writelines(f'{{"id": "f{index}"}}\n' for index in range(count))
    code = (
        "import resource, sys; from warpcage.studio.jobs.job_file import JobFile\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "job = JobFile(sys.argv[1]); print(len(job), job.item(277_777).id, job.line(277_777))\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)"
    )
    done = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True, check=True)
    first, kilobytes = done.stdout.splitlines()
    assert first == f"{count} f277777 277779"
    assert int(kilobytes) < 30_000  # 100 bytes a line


def test_rows_of_a_long_array_are_read_alone(tmp_path):
    from warpcage.core import NpyFile

    values = np.arange(24, dtype=np.float32).reshape(4, 3, 2)
    np.save(tmp_path / "a.npy", values)
    file = NpyFile(tmp_path / "a.npy")
    assert file.shape == values.shape and file.row_bytes == 24
    np.testing.assert_array_equal(file.row(2), values[2])
    np.testing.assert_array_equal(file.read(), values)
    for index in (-1, 4):
        with pytest.raises(ValueError, match="has rows 0 to 3"):
            file.row(index)
    data = (tmp_path / "a.npy").read_bytes()
    (tmp_path / "a.npy").write_bytes(data[:-30])
    refused(lambda: file.row(3), match="was cut off while it was in use")
    for name, content in (("cut", data[:-30]), ("head", data[:20]), ("none", b"text"), ("empty", b"")):
        (tmp_path / f"{name}.npy").write_bytes(content)
        with pytest.raises(ValueError, match=f"{name}.npy"):
            NpyFile(tmp_path / f"{name}.npy")
    np.save(tmp_path / "f.npy", np.asfortranarray(values))
    refused(lambda: NpyFile(tmp_path / "f.npy"), match="holds columns first")
    np.save(tmp_path / "o.npy", np.array([{}], object), allow_pickle=True)
    refused(lambda: NpyFile(tmp_path / "o.npy"), match="pickled objects, which are never opened")
    np.save(tmp_path / "t.npy", np.array(["a"]))
    refused(lambda: NpyFile(tmp_path / "t.npy"), match="must hold numbers")
