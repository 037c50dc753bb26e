"""Types for callers: typical calls are taken by type checkers, wrong ones are not, and signatures are seen."""

import dataclasses
import importlib.util
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
from warpcage.deform.posed import DeformerOptions
from warpcage.fitting.options import FitNames
from warpcage.fitting.splats.options import SplatFitNames

ROOT = pathlib.Path(__file__).parents[2]
CALLS, WRONG = (ROOT / "tests" / "typed" / name for name in ("calls.py", "wrong_calls.py"))


def pyright(path):
    """Lines with errors, and what is said of them."""
    command = [sys.executable, "-m", "pyright", "--outputjson", "--pythonpath", sys.executable, str(path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    found = json.loads(done.stdout)["generalDiagnostics"]
    return {each["range"]["start"]["line"] + 1: each["message"] for each in found if each["severity"] == "error"}


def mypy(path):
    """As `pyright`."""
    command = [sys.executable, "-m", "mypy", "--strict", "--follow-imports=silent", str(path)]
    done = subprocess.run(command, cwd=ROOT, env=os.environ | {"MYPYPATH": str(ROOT)}, capture_output=True, text=True)
    assert done.returncode in (0, 1), done.stdout + done.stderr
    return {int(line): text for line, text in re.findall(rf"{path.name}:(\d+): error: (.*)", done.stdout)}


def lines_with(mark, path):
    return {number for number, line in enumerate(path.read_text().splitlines(), 1) if mark in line.rpartition("`")[2]}


@pytest.mark.parametrize("checker", [pyright, mypy], ids=["pyright", "mypy"])
def test_type_checkers_know_the_calls(checker):
    if importlib.util.find_spec(checker.__name__) is None:
        pytest.skip(f"{checker.__name__} is not installed")
    # of a class with both, mypy asks __init__ alone what a call gives, and not __new__
    unseen = lines_with("# mypy sees", CALLS), lines_with("# mypy sees", WRONG)
    calls, wrong = unseen if checker is mypy else (set(), set())
    assert set(checker(CALLS)) == calls
    marked = lines_with("# wrong", WRONG)
    assert len(marked) > 10 and set(checker(WRONG)) == marked - wrong


def test_public_names_are_fully_typed(tmp_path):
    """A caller under pyright's strict rules is told of no unknown type, whatever public name it touches."""
    if importlib.util.find_spec("pyright") is None:
        pytest.skip("pyright is not installed")
    lines = {"": "# pyright: strict\nimport warpcage"}
    for name, thing in golden_names.public_things():
        owner, _, member = name.partition(".")
        kind = f"warpcage.{owner}" + ("[warpcage.Cage]" if hasattr(getattr(warpcage, owner), "__parameters__") else "")
        members = (
            [member] if member else ["__init__", *golden_names.documented(thing)] if inspect.isclass(thing) else []
        )
        lines |= {f"{owner}.{each}": f"def {owner}_{each}(it: {kind}): return it.{each}" for each in members}
        lines |= {} if members else {name: f"print(warpcage.{name})"}
    assert len(lines) > 400
    (tmp_path / "names.py").write_text("\n".join(lines.values()))
    named = [*lines][:1] + [*lines]  # the first takes two lines
    assert {named[number - 1]: text for number, text in pyright(tmp_path / "names.py").items()} == {}


@pytest.mark.parametrize("kind", [warpcage.Deformer, warpcage.SplatDeformer])
def test_the_signature_of_a_deformer_is_seen(kind):
    names = list(inspect.signature(kind).parameters)
    assert names[:2] == ["field", "rest"] and set(names[2:]) == set(DeformerOptions.__annotations__)


@pytest.mark.parametrize(
    ("names", "options"), [(FitNames, warpcage.FitOptions), (SplatFitNames, warpcage.SplatFitOptions)]
)
def test_names_of_options_are_those_of_their_classes(names, options):
    fields = {field.name: field.type for field in dataclasses.fields(options)}
    types = {name: getattr(kind, "__forward_arg__", kind) for name, kind in names.__annotations__.items()}
    assert {name: types[name] for name in fields} == fields
    called = set(inspect.signature(warpcage.fit).parameters) | {"weights"}
    assert set(types) - set(fields) <= called
