"""Tests of what a machine lacks are skipped and say so: Warp's compiler for the CPU, or packages of the base install.

Only where one of them is missing: elsewhere an error that names them is an error.
"""

import importlib.util
import pathlib

import pytest
import warp as wp

COMPILER = "Warp's compiler for the CPU"

#: What stands in an error where each is missing: packages of the base install that some machines with a GPU lack.
TRACES = {
    COMPILER: "wp_compile_cpp",
    **{name: f"No module named '{name}'" for name in ("av", "pymeshlab", "skimage", "imageio")},
}


def is_missing(name):
    if name == COMPILER:
        return not list((pathlib.Path(wp.__file__).parent / "bin").glob("*warp-clang*"))
    return importlib.util.find_spec(name) is None


MISSING = [name for name in TRACES if is_missing(name)]


def require(name):
    """Skip a test that shows by more than an exception that something is missing: that starts a process, say."""
    if name in MISSING:
        pytest.skip(f"{name} is not on this machine")


def lacks(error):
    """What an error lacks, among what is missing; None for another error."""
    while error is not None:
        found = [name for name in MISSING if TRACES[name] in str(error)]
        if found:
            return found[0]
        error = error.__cause__ or error.__context__
    return None


def skip_what_is_missing():
    """A hook around a test or its fixtures: errors of what is missing become skips."""
    try:
        return (yield)
    except Exception as error:
        lacking = lacks(error)
        if lacking is None:
            raise
        pytest.skip(f"{lacking} is not on this machine")


if MISSING:

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_setup():
        return (yield from skip_what_is_missing())

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call():
        return (yield from skip_what_is_missing())
