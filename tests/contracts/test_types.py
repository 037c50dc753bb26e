"""Types for callers: typical calls are taken by type checkers, wrong ones are not, and signatures are seen."""

import dataclasses
import inspect
import json
import os
import pathlib
import re
import subprocess
import sys

import golden_names
import pytest

import warpcage
from warpcage.fitting.options import FitNames
from warpcage.fitting.splats.options import SplatFitNames

ROOT = pathlib.Path(__file__).parents[2]
CALLS, PROGRAM, WRONG = (ROOT / "tests" / "typed" / name for name in ("calls.py", "program.py", "wrong_calls.py"))


def pyright(*paths):
    """What is said of lines with errors, by file."""
    pytest.importorskip("pyright")
    command = [sys.executable, "-m", "pyright", "--outputjson", "--pythonpath", sys.executable, *map(str, paths)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    said = [each for each in json.loads(done.stdout)["generalDiagnostics"] if each["severity"] == "error"]
    lines = [(pathlib.Path(each["file"]).name, each["range"]["start"]["line"] + 1, each["message"]) for each in said]
    return [{number: text for name, number, text in lines if name == path.name} for path in paths]


def mypy(*paths):
    """As `pyright`."""
    pytest.importorskip("mypy")
    command = [sys.executable, "-m", "mypy", "--strict", "--follow-imports=silent", *map(str, paths)]
    done = subprocess.run(command, cwd=ROOT, env=os.environ | {"MYPYPATH": str(ROOT)}, capture_output=True, text=True)
    assert done.returncode in (0, 1), done.stdout + done.stderr
    lines = [re.findall(rf"\b{path.name}:(\d+): error: (.*)", done.stdout) for path in paths]
    return [{int(number): text for number, text in found} for found in lines]


def lines_with(mark, path):
    return {number for number, line in enumerate(path.read_text().splitlines(), 1) if mark in line.rpartition("`")[2]}


def test_pyright_knows_the_calls_and_every_public_name(tmp_path):
    """Under its strict rules a caller is told of no unknown type, whatever public name it touches."""
    lines = {"": "# pyright: strict\nimport warpcage"}
    for name, scene_object in golden_names.public_objects():
        owner, _, member = name.partition(".")
        needs_parameter = getattr(getattr(warpcage, owner), "__parameters__", ()) and owner != "Deformer"
        kind = f"warpcage.{owner}" + ("[warpcage.Cage]" if needs_parameter else "")
        members = [member] if member else []
        if inspect.isclass(scene_object) and not member:
            members = ["__init__", *golden_names.documented(scene_object)]
        lines |= {f"{owner}.{each}": f"def {owner}_{each}(it: {kind}): return it.{each}" for each in members}
        lines |= {} if members else {name: f"print(warpcage.{name})"}
    assert len(lines) > 400
    (tmp_path / "names.py").write_text("\n".join(lines.values()))
    named = [*lines][:1] + [*lines]  # the first takes two lines
    calls, program, wrong, names = pyright(CALLS, PROGRAM, WRONG, tmp_path / "names.py")
    assert calls == program == {} and {named[number - 1]: text for number, text in names.items()} == {}
    marked = lines_with("# wrong", WRONG)
    assert len(marked) > 10 and set(wrong) == marked


def test_mypy_knows_the_calls():
    calls, program, wrong = mypy(CALLS, PROGRAM, WRONG)
    assert calls == program == {} and set(wrong) == lines_with("# wrong", WRONG)


@pytest.mark.parametrize(
    ("names", "options"), [(FitNames, warpcage.FitOptions), (SplatFitNames, warpcage.SplatFitOptions)]
)
def test_names_of_options_are_those_of_their_classes(names, options):
    fields = {field.name: field.type for field in dataclasses.fields(options)}
    types = {name: getattr(kind, "__forward_arg__", kind) for name, kind in names.__annotations__.items()}
    assert {name: types[name] for name in fields} == fields
    called = set(inspect.signature(warpcage.fit).parameters) | {"weights"}
    assert set(types) - set(fields) <= called
