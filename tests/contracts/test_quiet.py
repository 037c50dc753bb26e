"""The library is quiet: nothing on standard output, a logger instead, and one way to ask for more."""

import logging
import os
import subprocess
import sys

import numpy as np

import warpcage
from warpcage.core import modules, reports
from warpcage.studio.cli import main

#: Most of what a program does first: a pose and a frame, a cage; and a command.
PROGRAM = """
import sys, numpy as np, warpcage
from warpcage.studio.cli import main
field = warpcage.VoxelField.from_dense(np.full((6, 6, 6), 5.0), np.zeros((6, 6, 6, 9, 3)), [[-1] * 3, [1] * 3])
field.save("field.npz")
cage = warpcage.Cage.box([-0.9] * 3, [0.9] * 3)
deformer = warpcage.Deformer(field, cage, resolution=8).pose(cage.twist(20))
deformer.render(warpcage.Camera.look_at([3, 1, 1], [0, 0, 0], width=8, height=8))
warpcage.harmonic_coordinates(np.zeros((1, 3)), cage, 8)
warpcage.Cage.from_field(field, 30).save("cage.obj")
sys.exit(main("render field.npz -o a.png --size 8 --device cpu".split()))
"""

POINT = "import warpcage as w; w.mean_value_coordinates([[0, 0, 0]], w.Cage.box([-1, -1, -1], [1, 1, 1]))"


def started(tmp_path, program, **environment):
    command = [sys.executable, "-c", program]
    return subprocess.run(command, cwd=tmp_path, env=os.environ | environment, capture_output=True, text=True)


def test_nothing_is_printed_unless_it_is_asked_for(tmp_path):
    """Of a command, one line."""
    done = started(tmp_path, PROGRAM, WARPCAGE_LOG="")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.count("\n") == 1 and "a.png" in done.stdout


def test_a_variable_shows_the_logger_on_stderr_and_leaves_warp_as_it_is_for_debug(tmp_path):
    """Of any case."""
    done = started(tmp_path, PROGRAM, WARPCAGE_LOG="Debug")
    assert done.returncode == 0 and "Warp 1." in done.stdout
    for line in ("Warp 1.", "loads kernels on ", "vertices, volume ", "wrote cage.obj"):
        assert line in done.stderr
    done = started(tmp_path, POINT, WARPCAGE_LOG="INFO")
    assert (done.returncode, done.stdout) == (0, "") and "Warp 1." in done.stderr and "loads kernels on " in done.stderr


def test_another_level_takes_one_line(monkeypatch, capsys):
    monkeypatch.setenv("WARPCAGE_LOG", "loud")
    assert main(["info"]) == 2
    said = "warpcage: error: WARPCAGE_LOG must be one of debug, info, warning, error, got 'loud'\n"
    assert capsys.readouterr() == ("", said)


def test_a_command_says_what_it_loads_where_it_is_asked(files, tmp_path, capsys):
    words = ["render", str(files / "ball.npz"), "-o", str(tmp_path / "a.png"), "--size", "8", "--device", "cpu"]
    assert main(words) == 0
    quiet = capsys.readouterr()
    try:
        modules.loaded_places.clear()
        assert main([*words, "--verbose"]) == 0
    finally:
        reports.show_log(reports.requested_level())
    loud = capsys.readouterr()
    assert quiet.err == "" and loud.out == quiet.out and quiet.out.count("\n") == 1
    assert "loads kernels on cpu: warpcage.kernels" in loud.err


def test_a_program_takes_the_logger_as_any_other(caplog, capfd):
    with caplog.at_level(logging.INFO):
        modules.loaded_places.clear()
        warpcage.mean_value_coordinates(np.zeros((1, 3)), warpcage.Cage.box([-1] * 3, [1] * 3), device="cpu")
    assert "warpcage.core.modules" in {record.name for record in caplog.records} and capfd.readouterr().out == ""


def test_other_lines_of_native_code_come_through(tmp_path):
    program = (
        "import os, warpcage.core.reports as s\ns.has_driver = lambda: False\n"
        "with s.without_driver_note():\n    os.write(2, s.NOTE + b' GPU.\\n' + b'another line\\n')\n"
        "os.write(2, b'after\\n')"
    )
    assert started(tmp_path, program).stderr == "another line\nafter\n"
