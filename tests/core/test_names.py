"""Names that options take: a message ends with the one that was meant."""

import pytest

from warpcage import Cage, deform_points


@pytest.mark.parametrize(
    "given, end",
    [
        ("harmonics", ", did you mean harmonic?"),
        ("mean-value", ", did you mean mean_value?"),
        ("Green", ", did you mean green?"),
        ("biharmonic weights of old", "weights of old'"),
        ("x" * 100_000, "xxx"),
        (3, "got 3"),
    ],
)
def test_the_name_that_is_near_is_said(given, end):
    cage = Cage.box((0, 0, 0), (1, 1, 1))
    with pytest.raises(ValueError) as refused:
        deform_points([[0.5, 0.5, 0.5]], cage, cage, coordinates=given)
    said = str(refused.value)
    assert said.endswith(end) and said.startswith("coordinates must be one of harmonic") and len(said) < 200
