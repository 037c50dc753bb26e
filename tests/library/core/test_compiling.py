"""A line says that kernels are compiled: once, on a terminal, and only where they are."""

import io
import os
import subprocess
import sys
import textwrap

import pytest

from warpcage.core import reports
from warpcage.studio.cli import main

PROGRAM = """
    import warp as wp
    from warpcage.core import reports
    from warpcage.core.devices import launch
    from warpcage.core.modules import load_modules
    from warpcage.kernels.field import refine

    reports.on_compiling = lambda: print("first")
    load_modules([refine], "cpu")
    assert (reports.on_compiling is None) == {said}
    reports.on_compiling = lambda: print("second")
    ones, singles = (wp.full((4, 3), value, dtype=kind, device="cpu") for value, kind in ((1, wp.float16), (0, float)))
    launch(refine.widen_rows, 4, [ones], [singles], device="cpu")
    assert (singles.numpy() == 1).all()
"""


def test_it_is_said_once_and_only_where_something_is_compiled(tmp_path):
    """By a process with an empty cache, and by the next one."""
    surroundings = os.environ | {"WARP_CACHE_PATH": str(tmp_path)}
    for said in (True, False):
        program = textwrap.dedent(PROGRAM).format(said=said)
        done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=surroundings)
        assert done.returncode == 0, done.stderr
        assert ("first\n" in done.stdout) == said and "second" not in done.stdout


class Terminal(io.StringIO):
    """What somebody looks at."""

    def isatty(self):
        return True


@pytest.mark.parametrize(("stream", "options", "watched"), [
    (Terminal, (), True), (Terminal, ("--quiet",), False), (io.StringIO, (), False),
])  # fmt: skip
def test_a_command_says_it_before_a_terminal(monkeypatch, stream, options, watched):
    monkeypatch.setattr(reports, "on_compiling", None)
    monkeypatch.setattr(sys, "stderr", stream())
    assert main(["render", "nothing.npz", "-o", "a.png", *options]) == 2  # there is no such file
    assert (reports.on_compiling is not None) == watched
    reports.report_compiling()
    assert ("compiling kernels" in sys.stderr.getvalue()) == watched and reports.on_compiling is None
