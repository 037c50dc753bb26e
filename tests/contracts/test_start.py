"""How commands start: what they import, and what Warp says."""

import pathlib
import subprocess
import sys

import pytest
from runs import write_files

ROOT = pathlib.Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return write_files(tmp_path_factory.mktemp("start"))


def started(*words, cwd=None, environment=None):
    return subprocess.run([sys.executable, *map(str, words)], cwd=cwd, env=environment, capture_output=True, text=True)


@pytest.mark.parametrize("command", ["", "render", "animate", "pose", "cage"])
def test_help_imports_nothing_heavy(command):
    heavy = ["numpy", "warp", "trimesh", "scipy", "av", "imageio", "skimage", "tqdm"]
    program = (
        "import sys\nfrom warpcage.cli import main\n"
        f"try: main({[command] if command else []} + ['--help'])\n"
        f"except SystemExit: print([name for name in {heavy} if name in sys.modules])"
    )
    assert started("-c", program).stdout.splitlines()[-1] == "[]"


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
