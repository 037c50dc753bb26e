"""The library is quiet: nothing on standard output, a logger instead, and one way to ask for more."""

import os
import subprocess
import sys

#: Most of what a program does first: a fit, a pose and a frame.
PROGRAM = """
import numpy as np, warpcage
field = warpcage.VoxelField.from_dense(np.full((6, 6, 6), 5.0), np.zeros((6, 6, 6, 9, 3)), [[-1] * 3, [1] * 3])
cage = warpcage.Cage.box([-0.9] * 3, [0.9] * 3)
deformer = warpcage.Deformer(field, cage, resolution=8).pose(cage.twist(20))
deformer.render(warpcage.Camera.look_at([3, 1, 1], [0, 0, 0], width=8, height=8))
warpcage.harmonic_coordinates(np.zeros((1, 3)), cage, 8)
warpcage.Cage.from_field(field, 30).save("cage.obj")
"""


def started(tmp_path, **environment):
    return subprocess.run(
        [sys.executable, "-c", PROGRAM], cwd=tmp_path, env=os.environ | environment, capture_output=True, text=True
    )


def test_nothing_is_printed_unless_it_is_asked_for(tmp_path):
    done = started(tmp_path, WARPCAGE_LOG="")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_a_variable_of_any_case_shows_the_logger_on_stderr(tmp_path):
    done = started(tmp_path, WARPCAGE_LOG="INFO")  # that of another test is in small letters
    assert done.returncode == 0 and done.stdout == ""
    for line in ("Warp 1.", "loads kernels on ", "vertices, volume "):
        assert line in done.stderr


def test_debug_says_what_is_written_and_leaves_warp_as_it_is(tmp_path):
    done = started(tmp_path, WARPCAGE_LOG="debug")
    assert done.returncode == 0 and "wrote cage.obj" in done.stderr and "Warp 1." in done.stdout


def test_another_level_takes_one_line(tmp_path):
    done = started(tmp_path, WARPCAGE_LOG="loud")
    assert done.returncode == 1 and done.stdout == ""
    assert done.stderr.splitlines()[-1].endswith("WARPCAGE_LOG must be one of debug, info, warning, error, got 'loud'")


def test_a_program_takes_the_logger_as_any_other(tmp_path):
    program = "import logging\nlogging.basicConfig(level='INFO', format='%(name)s')\n" + PROGRAM
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout == "" and "warpcage.core.modules" in done.stderr.split()
