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
    from warpcage.kernels.view import pictures

    wp.config.use_precompiled_headers = False  # which take longer to make than a small module
    reports.on_compiling = lambda: print("first")
    load_modules([pictures], "cpu")
    assert (reports.on_compiling is None) == {said}
    reports.on_compiling = lambda: print("second")
    source, joined = wp.array([1.0, 2.0, 3.0, 6.0], dtype=float, device="cpu"), wp.zeros(1, float, device="cpu")
    launch(pictures.average_values, 1, [2, 1, source], [joined], device="cpu")
    assert joined.numpy()[0] == 3.0
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
