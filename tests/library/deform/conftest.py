"""What tests of deformed scenes share."""

import pytest

from warpcage.deform import exact


@pytest.fixture(autouse=True)
def coarse_guide(request, monkeypatch):
    """Closed forms skip what is empty by a lattice of few cells, which takes most of the time of a small picture."""
    if request.path.name != "test_deformed_precise.py":
        monkeypatch.setattr(exact, "GUIDE_RESOLUTION", 32)
