"""What examples, README and docs import can be imported, from where they say, and is still the same kind of thing."""

import ast
import importlib
import importlib.util
import inspect
import pathlib
import re
import textwrap

import pytest

ROOT = pathlib.Path(__file__).parent.parent.parent

#: The paths that users copy from examples and docs: these do not move. What each name is, by its module.
FIXED = {
    "warpcage.batch.items": {"EvaluateItem": "class", "FitItem": "class", "FrameItem": "class", "Item": "class"},
    "warpcage.batch.job_file": {"JobFile": "class", "write_jobs": "function"},
    "warpcage.batch.run": {"run_jobs": "function"},
    "warpcage.batch.sweeps": {"GivenSource": "class", "RandomSource": "class", "write_sweep": "function"},
    "warpcage.batch.webdataset": {"read_shard": "function", "shard_path": "function"},
    "warpcage.batch.worker": {"Worker": "class"},
    "warpcage.cage.motion": {"gltf_poses": "function"},
    "warpcage.cage.snap": {"snap_to_gaps": "function"},
    "warpcage.cage.walls": {"cut_faces": "function"},
    "warpcage.cli": {"main": "function"},
    "warpcage.core.devices": {"launch": "function", "resolve_device": "function"},
    "warpcage.core.files": {"atomic_path": "function"},
    "warpcage.core.names": {"meant": "function"},
    "warpcage.core.locks": {"device_turn": "function"},
    "warpcage.core.threads": {"cpu_threads": "function", "limit_threads": "function"},
    "warpcage.editor.demo": {"demo_files": "function"},
    "warpcage.field.planes": {"Plane": "class", "find_planes": "function"},
    "warpcage.fitting.evaluation": {"evaluate": "function", "mean_psnr": "function"},
    "warpcage.mesh": {"MeshFormat": "class", "write_shown_mesh": "function"},
    "warpcage.reference.brick_scene": {"write_brick_scene": "function"},
    "warpcage.reference.bricks": {"brick_model": "function"},
    "warpcage.reference.cage_scenes": {"CAGE_SCENES": "dict", "scene_field": "function"},
    "warpcage.reference.raycast": {"render_mesh_views": "function"},
    "warpcage.reference.viewpoints": {"reference_cameras": "function", "spread_eyes": "function"},
    "warpcage.scene": {"SceneFormat": "class", "View": "class", "held_out": "function", "make_scene": "function"},
    "warpcage.splats": {"SplatContents": "class", "SplatFormat": "class"},
    "warpcage.view.camera": {"Camera": "class", "framing_orbit": "function"},
    "warpcage.view.exr": {"write_exr": "function"},
    "warpcage.view.film": {"write_film": "function", "write_gif": "function", "write_video": "function"},
    "warpcage.view.frame_parts": {"mask_picture": "function"},
    "warpcage.view.motion": {"pose_weights": "function"},
    "warpcage.view.opacity": {"rgba_picture": "function"},
    "warpcage.view.overlay": {"draw_cage": "function"},
    "warpcage.view.pictures": {
        "color_disparity": "function",
        "contact_sheet": "function",
        "disparity_range": "function",
        "read_image": "function",
        "to_uint8": "function",
        "write_png": "function",
    },
}

#: Of those, the ones that are public names too: one object, wherever it is taken from.
PUBLIC = {
    "Camera": "warpcage.view.camera",
    "evaluate": "warpcage.fitting.evaluation",
    "mean_psnr": "warpcage.fitting.evaluation",
    "run_jobs": "warpcage.batch.run",
}


def kind_of(thing):
    """What a thing is, in a word."""
    if inspect.isclass(thing) or inspect.ismodule(thing):
        return "class" if inspect.isclass(thing) else "module"
    return "function" if callable(thing) else type(thing).__name__


def code_blocks(page):
    """The Python of a page of docs."""
    return [textwrap.dedent(block) for block in re.findall(r"```python\n(.*?)```", page.read_text("utf-8"), re.DOTALL)]


def sources():
    """(where, text) of all that users copy."""
    for path in sorted((ROOT / "examples").rglob("*")):
        if path.suffix in (".py", ".sh", ".sbatch", ".yaml", ".yml", ".md"):
            yield path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8")
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        for number, block in enumerate(code_blocks(page), 1):
            yield f"{page.relative_to(ROOT).as_posix()}, block {number}", block


def imports(text):
    """(module, names) of the lines that import of warpcage; names are empty for `import MODULE`."""
    found = []
    for match in re.finditer(r"^[ \t>.]*from (warpcage[\w.]*) import (\([^)]*\)|[^\n#;]*)", text, re.MULTILINE):
        names = [name.split(" as ")[0].strip() for name in match[2].strip("() \n").split(",")]
        found.append((match[1], [name for name in names if name]))
    found += [(name, []) for name in re.findall(r"^[ \t>.]*import (warpcage[\w.]*)", text, re.MULTILINE)]
    return found


def attributes(text):
    """What is taken of `warpcage` by dots: "Cage", "view.film.write_film"."""
    try:
        tree = ast.parse(text)
    except SyntaxError:  # a part of a program, or none
        return set(re.findall(r"\bwarpcage\.([A-Za-z_]\w*)\(", text))
    chains = set()
    for node in ast.walk(tree):
        names = []
        while isinstance(node, ast.Attribute):
            names.append(node.attr)
            node = node.value
        if names and isinstance(node, ast.Name) and node.id == "warpcage":
            chains.add(names[-1])
    return chains


SOURCES = dict(sources())
USING = {where: text for where, text in SOURCES.items() if imports(text) or attributes(text)}


@pytest.mark.parametrize("module", FIXED)
def test_paths_that_users_know_stay(module):
    found = importlib.import_module(module)
    assert {name: kind_of(getattr(found, name)) for name in FIXED[module]} == FIXED[module]


@pytest.mark.parametrize("name", PUBLIC)
def test_a_name_is_one_object_wherever_it_is_taken_from(name):
    public = getattr(importlib.import_module("warpcage"), name)
    assert getattr(importlib.import_module(PUBLIC[name]), name) is public


@pytest.mark.parametrize("where", USING)
def test_imports_of_examples_and_pages_work(where):
    for module, names in imports(USING[where]):
        found = importlib.import_module(module)
        for name in names:
            assert hasattr(found, name) or importlib.import_module(f"{module}.{name}")
    warpcage = importlib.import_module("warpcage")
    assert [name for name in attributes(USING[where]) if not hasattr(warpcage, name)] == []


def test_all_that_examples_and_pages_import_is_in_the_list():
    """So that a path that a new example names is one that stays."""
    used = {(module, name) for text in USING.values() for module, names in imports(text) for name in names}
    deep = {(module, name) for module, name in used if module != "warpcage"}
    assert len(deep) > 20
    assert sorted(f"{module}.{name}" for module, name in deep if name not in FIXED.get(module, ())) == []


def test_the_program_starts_by_both_names():
    for name in ("warpcage.__main__", "warpcage.cli.__main__"):
        assert importlib.util.find_spec(name) is not None


def test_imports_are_found_in_text():
    text = "from warpcage.view.film import (\n    write_gif,\n    write_video as video,\n)\n"
    text += "import warpcage\nwarpcage.fit(1)"
    assert imports(text) == [("warpcage.view.film", ["write_gif", "write_video"]), ("warpcage", [])]
    assert attributes(text) == {"fit"}
