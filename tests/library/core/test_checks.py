"""What callers give is checked in one place each: what passes, and what the one line says of what does not."""

import fractions

import numpy as np
import pytest
from messages import MESSAGES
from refusals import refused

from warpcage.core import (
    axis_index,
    checked_bounds,
    checked_number,
    checked_positive,
    checked_step,
    checked_vector,
    checked_whole,
    warn_caller,
)
from warpcage.core.checks import Cuts, checked_flag, real_array
from warpcage.fitting.options import checked_options
from warpcage.view.frame import parse_background


@pytest.mark.parametrize("value", [2, 2.0, np.float32(2), np.int64(2), np.array(2.0)])
def test_numbers_of_any_kind_become_floats(value):
    for found in (checked_number(value, "it"), checked_positive(value, "it"), checked_number(value, "it", 0, 3)):
        assert type(found) is float and found == 2.0
    assert checked_step(value, 9.0) == 2.0 and checked_step(None, 9.0) == 9.0


@pytest.mark.parametrize(
    "value", ["2", b"2", None, True, np.True_, 2j, [2.0], [1, [2]], np.nan, np.inf, -np.inf, 10**400]
)
def test_what_is_no_finite_number_is_refused(value):
    checks = [
        (lambda: checked_number(value, "it"), "it must be one finite number, got "),
        (lambda: checked_positive(value, "it"), "it must be positive and finite, got "),
        (lambda: checked_number(value, "it", 0.0), "must be a finite number of at least 0, "),
    ]
    if value is not None:
        checks.append((lambda: checked_step(value, 1.0), MESSAGES["core.step_positive"]))
    for check, message in checks:
        refused(check, match=message)


def test_flags_are_those_of_python_or_numpy():
    for value in (True, np.True_):
        assert checked_flag(value, "it") is True and checked_flag(not value, "it") is False
        assert checked_options({"refine_cameras": value}).refine_cameras is True
    for value in ("false", 1, None, [True]):
        refused(lambda value=value: checked_flag(value, "it"), match="it must be true or false, got ")


@pytest.mark.parametrize("color", [[True, False, True], [0.5, True, 0], np.ones(3, bool), (0, 0, np.False_)])
def test_a_color_is_numbers(color):
    refused(lambda: parse_background(color), match="background must be a colour name")


def test_ranges():
    assert checked_number(0, "it", 0.0) == 0.0 and checked_whole(np.int32(3), "count", 3, 3) == 3
    assert checked_vector([1, 2, 3], "place").tolist() == [1.0, 2.0, 3.0]
    assert [axis_index(axis) for axis in "xyz"] == [0, 1, 2]
    box = checked_bounds([[0, 0, 0], [1, 2, 3]])
    assert box.dtype == np.float64 and not box.flags.writeable
    for check, message in (
        (lambda: checked_positive(0, "it"), "it must be positive and finite, got 0"),
        (lambda: checked_number(-1e-9, "it", 0.0), "of at least 0, got -1e-09"),
        (lambda: checked_number(4, "it", 1.5, 3), "it must be a number from 1.5 to 3, got 4"),
        (lambda: checked_whole(2, "count", 3), "count must be a whole number of at least 3, got 2"),
        (lambda: checked_whole(5, "count", 3, 4), "count must be a whole number from 3 to 4, got 5"),
        (lambda: checked_whole(3.0, "count", 3), "got 3.0"),
        (lambda: checked_whole(True, "count", 0), "got True"),
        (lambda: checked_vector([1, 2], "place"), "place must be 3 finite numbers, got"),
        (lambda: axis_index("xy"), "axis must be 'x', 'y' or 'z', got 'xy'"),
        (lambda: axis_index(0), "axis must be 'x', 'y' or 'z', got 0"),
        (lambda: checked_bounds([[0, 0, 0], [1, 0, 1]]), "lower below upper"),
        (lambda: checked_bounds([[0, 0, 0], [1, np.nan, 1]]), "finite"),
    ):
        refused(check, message)


def test_warnings_point_at_the_caller():
    with pytest.warns(UserWarning, match="mind the gap") as caught:
        warn_caller("mind the gap")
    assert caught[0].filename == __file__


def test_what_is_no_number_hides_no_cut():
    cuts = Cuts()
    cut = cuts.clip("values", np.array([np.nan, 5.0, -3.0, 0.5], np.float32), 0.0, 1.0, 0.0)
    np.testing.assert_array_equal(cut, [np.nan, 1.0, 0.0, 0.5])
    assert cuts.text() == "cut to what its format holds: 2 of 4 values beyond 0 to 1, by up to 4"


def test_arrays_of_numbers_hold_numbers_alone():
    """NumPy makes NaN of None, and a number of text, where an array holds objects."""
    assert real_array([1, fractions.Fraction(1, 2), 10**30], "it").tolist() == [1.0, 0.5, 1e30]
    given = np.ones(3, np.float32)
    assert real_array(given, "it", np.float32) is given and real_array([], "it").shape == (0,)
    for wrong in (None, [1.0, None], [[1, 2], [None, 4]], np.array([1, "2"], object), ["1"], [1j], [1, [2]]):
        with pytest.raises(ValueError, match="it must be real numbers, got "):
            real_array(wrong, "it")
