"""Kinds of coordinates are looked up by name in one place: what is none is refused, and nothing guesses."""

import ast
import inspect
import pathlib

import numpy as np
import pytest
from fields import BOX, shiny_field
from splat_scenes import one_splat

import warpcage
from warpcage import Deformer, PositionMap, SplatDeformer, deform_points
from warpcage.core import COORDINATES
from warpcage.reference import InverseMap

PACKAGE = pathlib.Path(warpcage.__file__).parent

POINT = np.zeros((1, 3))

TAKERS = {
    "deform_points": lambda kind, device: deform_points(POINT, BOX, BOX, kind, device=device),
    "Deformer": lambda kind, device: Deformer(shiny_field(device, resolution=8), BOX, coordinates=kind),
    "precise": lambda kind, device: Deformer(shiny_field(device, resolution=8), BOX, coordinates=kind, resolution=None),
    "splats": lambda kind, device: Deformer(one_splat(device), BOX, coordinates=kind),
    "PositionMap": lambda kind, device: PositionMap(BOX, coordinates=kind, device=device),
    "weights": lambda kind, device: PositionMap(BOX, coordinates=kind, store="weights", device=device),
    "InverseMap": lambda kind, device: InverseMap(BOX, BOX, kind, device=device),
}


@pytest.mark.parametrize("kind", ["mvc", "Harmonic", "mean value", "", None, 2, ["green"], b"green"], ids=repr)
@pytest.mark.parametrize("taker", TAKERS)
def test_other_names_are_refused_with_those_that_there_are(taker, kind, device):
    with pytest.raises(ValueError) as caught:
        TAKERS[taker](kind, device)
    message = str(caught.value)
    assert message.startswith("coordinates must be one of") and "\n" not in message
    assert all(name in message for name in COORDINATES)


@pytest.mark.parametrize("file", ["warpcage", "kernels"])
def test_no_else_takes_a_kind_for_another(file):
    """Where code asks `== "green"`, what is left over is no kind by name: a table of kinds (`chosen`) says it."""
    folder = PACKAGE if file == "warpcage" else PACKAGE.parent / "kernels"
    paths = sorted(folder.rglob("*.py"))
    assert len(paths) > 40
    guesses = [f"{path}:{node.lineno}" for path in paths for node in ast.walk(_parsed(path)) if _guesses(node)]
    assert not guesses, guesses


def _parsed(path):
    return ast.parse(path.read_text(encoding="utf-8"))


def _guesses(node):
    """Whether a branch, by the name of a kind, has an `else` that is no further name."""
    if not isinstance(node, ast.If | ast.IfExp) or not _asks_kind(node.test) or not node.orelse:
        return False
    rest = node.orelse if isinstance(node.orelse, list) else [node.orelse]
    return not (len(rest) == 1 and isinstance(rest[0], ast.If | ast.IfExp) and _asks_kind(rest[0].test))


def _asks_kind(test):
    return isinstance(test, ast.Compare) and any(
        isinstance(each, ast.Constant) and each.value in COORDINATES for each in [test.left, *test.comparators]
    )


@pytest.mark.parametrize(
    ("text", "guesses"),
    [
        ('x = 1 if kind == "green" else 2', True),
        ('if kind == "green":\n    x = 1\nelse:\n    x = 2', True),
        ('if kind == "green":\n    x = 1\nelif kind == "harmonic":\n    x = 2', False),
        ('if kind != "harmonic":\n    x = 1', False),
        ('x = chosen(kind, "coordinates", green=1, mean_value=2)', False),
    ],
)
def test_what_that_test_takes_for_a_guess(text, guesses):
    assert any(_guesses(node) for node in ast.walk(ast.parse(text))) == guesses


def test_the_defaults_are_said_once_and_in_both_docstrings():
    """A field is posed as the paper has it; points may lie outside of a cage, where one kind alone is defined."""
    takers = Deformer, SplatDeformer, PositionMap, deform_points
    defaults = [inspect.signature(taker).parameters["coordinates"].default for taker in takers]
    assert defaults == ["harmonic", "harmonic", "harmonic", "mean_value"]
    assert "`deform_points`" in Deformer.__doc__ and "Deformer" in deform_points.__doc__
    point = np.array([[0.7, 0.5, 0.35]])
    twisted = BOX.twist(70)
    mean_value, harmonic = (deform_points(point, BOX, twisted, kind) for kind in ("mean_value", "harmonic"))
    assert np.array_equal(deform_points(point, BOX, twisted), mean_value)
    assert np.abs(mean_value - harmonic).max() > 1e-3 * BOX.size
