"""What Warp says where a command starts."""

import pathlib
import subprocess
import sys

ROOT = pathlib.Path(__file__).resolve().parents[2]


def started(*words, cwd=None, environment=None):
    return subprocess.run([sys.executable, *map(str, words)], cwd=cwd, env=environment, capture_output=True, text=True)


def test_warp_says_nothing_unless_it_is_asked(files, tmp_path):
    words = ["-m", "warpcage", "render", files / "ball.npz", "-o", tmp_path / "a.png", "--size", 8, "--device", "cpu"]
    quiet = started(*words)
    assert quiet.returncode == 0 and quiet.stderr == "" and quiet.stdout.count("\n") == 1, quiet.stderr
    loud = started(*words, "--verbose")
    assert loud.returncode == 0 and loud.stdout == quiet.stdout
    assert "Warp 1." in loud.stderr and "loads kernels on cpu: warpcage.kernels" in loud.stderr


def test_other_lines_of_native_code_come_through():
    program = (
        "import os, warpcage.core.reports as s\ns.has_driver = lambda: False\n"
        "with s.without_driver_note():\n    os.write(2, s.NOTE + b' GPU.\\n' + b'another line\\n')\n"
        "os.write(2, b'after\\n')"
    )
    assert started("-c", program).stderr == "another line\nafter\n"
