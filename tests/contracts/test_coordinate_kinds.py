"""Kinds of coordinates are looked up by name in one place: what is none is refused, and nothing guesses."""

import inspect

import numpy as np
import pytest
from fields import BOX, shiny_field
from ground_truth import InverseMap
from refusals import refused
from splat_scenes import one_splat

from warpcage import Deformer, PositionMap, deform_points
from warpcage.coordinate_kinds import COORDINATE_KINDS
from warpcage.core import COORDINATES

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
    message = refused(lambda: TAKERS[taker](kind, device))
    assert message.startswith("coordinates must be one of") and "\n" not in message
    assert all(name in message for name in COORDINATES)


@pytest.mark.parametrize("kind", COORDINATE_KINDS.values(), ids=lambda kind: kind.name)
def test_all_that_a_kind_names_is_there(kind):
    named = {field: value for field, value in vars(kind).items() if isinstance(value, str) and ":" in value}
    assert {"move_points", "solver"} <= named.keys() and kind.label and kind.help
    assert ("map_points" in named) == kind.is_closed_form and kind.is_precise <= kind.is_closed_form
    assert all(kind.load(field) is not None for field in named)
    assert len(kind.kernel_modules()) == len(kind.modules)
    if kind.adjoint is not None:
        assert kind.load("adjoint").custom_grad_func is not None
    for field in {"bind_points", "adjoint"} - named.keys():
        assert f"{kind.name} coordinates have no {field}" in refused(lambda field=field: kind.load(field))


def test_the_defaults_are_said_once_and_in_both_docstrings():
    """A field is posed as the paper has it; points may lie outside of a cage, where one kind alone is defined."""
    takers = Deformer, PositionMap, deform_points
    defaults = [inspect.signature(taker).parameters["coordinates"].default for taker in takers]
    assert defaults == ["harmonic", "harmonic", "mean_value"]
    assert "`deform_points`" in Deformer.__doc__ and "Deformer" in deform_points.__doc__
    point = np.array([[0.7, 0.5, 0.35]])
    twisted = BOX.twist(70)
    mean_value, harmonic = (deform_points(point, BOX, twisted, kind) for kind in ("mean_value", "harmonic"))
    assert np.array_equal(deform_points(point, BOX, twisted), mean_value)
    assert np.abs(mean_value - harmonic).max() > 1e-3 * BOX.size
