"""What of the tests runs when: `pytest -m quick`, `pytest`, `pytest -m nightly`, and `pytest -m cuda` on a GPU.

A test without a marker runs in a plain `pytest`. Those marked `nightly` run at night alone; those marked `scaled` run
in both, small by day and large at night: by the fixture `at_night`, and by the number of examples of Hypothesis.
"""

import secrets

import pytest
from hypothesis import HealthCheck, settings

MARKERS = {
    "quick": "pure Python and small kernels: all of these end within 90 seconds, once kernels are compiled",
    "nightly": "runs at night and before releases alone: python -m pytest -m nightly",
    "scaled": "small in each run, large at night: see the fixture `at_night`",
    "cuda": "runs on a GPU; tests over devices are marked by themselves",
}

#: Folders of tests that are quick, but for some files.
QUICK = "core coordinates field films lattice mesh scene splats view".split()
NOT_QUICK = (
    "test_background test_clean_splats test_frames test_kernels test_objects test_position_map test_selection_files"
    " test_slots test_splat_objects"
).split()

#: Drawn examples of each property, by day and at night.
EXAMPLES, EXAMPLES_AT_NIGHT = 15, 150


def is_nightly(config):
    words = config.option.markexpr.replace("(", " ").split()
    return "nightly" in words and "not nightly" not in " ".join(words)


@pytest.hookimpl(tryfirst=True)  # before Hypothesis reads its seed
def pytest_configure(config):
    for name, meaning in MARKERS.items():
        config.addinivalue_line("markers", f"{name}: {meaning}")
    common = {"deadline": None, "database": None, "suppress_health_check": list(HealthCheck)}
    settings.register_profile("day", max_examples=EXAMPLES, **common)
    settings.register_profile("night", max_examples=EXAMPLES_AT_NIGHT, **common)
    settings.load_profile("night" if is_nightly(config) else "day")
    if not config.option.hypothesis_seed and not hasattr(config, "workerinput"):
        config.option.hypothesis_seed = str(secrets.randbelow(2**32))  # which workers are given, too


@pytest.hookimpl(tryfirst=True)  # before tests are chosen by their markers
def pytest_collection_modifyitems(config, items):
    night = is_nightly(config)
    for item in items:
        if "cuda" in item.name or "cuda" in item.path.stem:
            item.add_marker("cuda")
        if night and item.get_closest_marker("scaled"):
            item.add_marker("nightly")
        if item.path.parent.name in QUICK and item.path.stem not in NOT_QUICK:
            item.add_marker("quick")
    if not night:
        left = [item for item in items if item.get_closest_marker("nightly")]
        if left:
            config.hook.pytest_deselected(items=left)
            items[:] = [item for item in items if not item.get_closest_marker("nightly")]


def pytest_terminal_summary(terminalreporter, config):
    terminalreporter.write_line(f"examples were drawn by --hypothesis-seed={config.option.hypothesis_seed}")


@pytest.fixture(scope="session")
def at_night(pytestconfig):
    """Whether tests marked `scaled` are to be large."""
    return is_nightly(pytestconfig)
