"""Pictures and values of a small scene on the CPU are those of version 0.1.0, but for what processors differ in.

To compare two trees on one machine to the bit: see picture_hashes.py.
"""

import numpy as np
import picture_hashes
import pytest

GOLDEN = picture_hashes.read_golden()

#: How far values may be off, as a share of the largest of their array; iterations that decide go further apart.
USUAL, LOOSE = 1e-3, 2e-2
DECIDING = ("fit", "splats, fit", "cages", "bake")

#: Of the values that are compared one by one, how many may be on the other side of an edge.
AT_EDGES = 1


def complaint(found, expected, tolerance):
    """What is wrong with a summary; empty where it fits."""
    if found.shape != expected.shape or found[0] != expected[0]:
        return f"{found[0]:g} values in place of {expected[0]:g}"
    scale = max(abs(float(expected[4])), abs(float(expected[5])), 1e-6)
    if abs(found[1] - expected[1]) > max(1, 0.01 * expected[0]):
        return f"{found[1]:g} finite values in place of {expected[1]:g}"
    if abs(found[2:4] - expected[2:4]).max() > tolerance * scale:
        return f"mean and deviation {found[2:4]} in place of {expected[2:4]}"
    near = np.isclose(found[6:], expected[6:], rtol=0, atol=tolerance * scale)
    return f"{(~near).sum()} values are others" if (~near).sum() > AT_EDGES else ""


@pytest.mark.filterwarnings("ignore:a cage has gaps")
@pytest.mark.parametrize("name", picture_hashes.CASES)
def test_pictures_are_what_they_were(name):
    tolerance = LOOSE if name.startswith(DECIDING) else USUAL
    arrays = picture_hashes.made(name)
    expected = {key.removeprefix(f"{name}: "): each for key, each in GOLDEN.items() if key.startswith(f"{name}: ")}
    assert list(arrays) == list(expected)
    found = {key: complaint(picture_hashes.summary(array), expected[key], tolerance) for key, array in arrays.items()}
    assert {key: text for key, text in found.items() if text} == {}


def test_a_case_shows_what_its_name_says():
    """A scene in which nothing moved, was cleared or was mapped would compare equal whatever is broken."""
    rest, canonical = picture_hashes.made("deformed, at rest"), picture_hashes.made("canonical")
    assert 0.1 < canonical["alpha"].mean() < 0.9
    for name in ("deformed, mean_value", "precise, green", "removed", "copy", "two edits apart", "falloff", "bake"):
        assert abs(picture_hashes.made(name)["rgb"] - rest["rgb"]).max() > 0.1, name
    assert set(np.unique(picture_hashes.made("to_canonical, two edits")["region"])) == {0, 1, 2}
    assert picture_hashes.made("filled")["filled"].max() > 0.1


def test_hashes_differ_with_a_bit_a_type_and_a_shape(monkeypatch):
    values = np.array([1.0, 2.0, 3.0, 4.0], np.float32)
    others = [np.nextafter(values, np.float32(9)), values.astype(np.float64), values.reshape(2, 2), values.copy()]
    found = []
    for array in [values, *others]:
        monkeypatch.setattr(picture_hashes, "made", lambda name, array=array: {"a": array})
        found.append(picture_hashes.hashes("sample")["sample: a"])
    assert len(set(found)) == 4 and found[0] == found[-1]


def test_summaries_tell_other_pictures():
    picture = picture_hashes.made("canonical")["rgb"]
    held = picture_hashes.summary(picture)
    assert complaint(held, held, 1e-6) == ""
    moved = np.roll(picture, 2, axis=1)
    assert complaint(picture_hashes.summary(moved), held, 1e-3)
    assert complaint(picture_hashes.summary(0.99 * picture), held, 1e-3)
    assert complaint(picture_hashes.summary(picture[:-1]), held, 1e-3)
