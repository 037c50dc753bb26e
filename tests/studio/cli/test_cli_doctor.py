"""`warpcage doctor` on a whole machine, and on broken ones: each fault is one line that says what to do."""

import os
import re
import subprocess
import sys

import pytest

from warpcage.coordinates import coordinates
from warpcage.studio.cli import main


def put_packages(folder, needs, modules=()):
    """Writes what a warpcage that needs `needs` leaves where it is installed, and texts of modules."""
    info = folder / "warpcage-0.0.1.dist-info"
    info.mkdir()
    heads = ["Metadata-Version: 2.1", "Name: warpcage", "Version: 0.0.1"]
    heads += [f"Requires-Dist: {need}" for need in needs]
    (info / "METADATA").write_text("\n".join(heads) + "\n", encoding="utf-8")
    for name, text in dict(modules).items():
        (folder / f"{name}.py").write_text(text, encoding="utf-8")


def lines_by_state(said):
    """Lines that doctor printed, by their state."""
    lines = {"ok": [], "note": [], "broken": []}
    for line in said.splitlines()[:-1]:
        state, what = re.match(r"(ok|note|broken) +(\S.*)", line).groups()
        lines[state].append(what)
    last = said.splitlines()[-1]
    assert last == (f"{len(lines['broken'])} problem to fix" if lines["broken"] else "warpcage works here")
    return lines


def started_doctor(tmp_path, *needs, **environment):
    """Exit status, and lines of doctor by their state, of a process on a machine whose warpcage needs `needs`."""
    put_packages(tmp_path, needs)
    paths = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    command = [sys.executable, "-m", "warpcage", "doctor", "--device", "cpu"]
    variables = {**os.environ, "PYTHONPATH": paths, **environment}
    done = subprocess.run(command, env=variables, cwd=tmp_path, capture_output=True, text=True, timeout=240)
    assert done.stderr == ""
    return done.returncode, lines_by_state(done.stdout)


@pytest.fixture
def doctor(tmp_path, monkeypatch, capsys):
    """The same in this process; modules: texts of stand-ins for installed ones."""

    def call(*needs, **modules):
        put_packages(tmp_path, needs, modules)
        monkeypatch.syspath_prepend(tmp_path)
        for name in modules:
            monkeypatch.setitem(sys.modules, name, None)  # so that what was there comes back
            monkeypatch.delitem(sys.modules, name)
        status, said = main(["doctor", "--device", "cpu"]), capsys.readouterr()
        assert said.err == ""
        return status, lines_by_state(said.out)

    return call


NUMPY = "numpy>=1.26"


def test_a_whole_machine(tmp_path):
    status, lines = started_doctor(
        tmp_path, NUMPY, 'no-such-package>=2; extra == "cluster"', 'numpy>=1; extra == "exr"'
    )
    assert status == 0 and lines["broken"] == []
    said = {line.split()[0] for line in lines["ok"]}
    assert said >= {"warpcage", "python", "packages", "warp", "cpu", "films", "[exr]", "self-test"}
    (missing,) = [line for line in lines["note"] if line.startswith("[cluster]")]
    assert "no-such-package>=2" in missing and "[cluster]'" in missing


CODECS = {"libx264", "prores_ks", "libvpx-vp9", "h264", "hevc"}


def without_codec(name):
    return {"av": f"__version__ = '1'\ncodecs_available = {CODECS - {name}!r}\n"}


#: What is missing on a machine: packages that it needs, modules in place of installed ones, and what is said of it.
FAULTS = {
    "another version": ((NUMPY, "warp-lang>=99"), {}, "warp-lang .* another version.*: pip install 'warp-lang>=99'"),
    "missing": ((NUMPY, "no-such-package>=2"), {}, "no-such-package is not installed: pip install 'no-such-"),
    "old": (("no-such-package; python_version < '3'", "numpy>=99"), {}, "numpy .*: pip install 'numpy>=99'"),
    "libx264": ((NUMPY,), without_codec("libx264"), r"libx264.*no \.mp4 is written.*pip install --force-reinstall av"),
    "hevc": ((NUMPY,), without_codec("hevc"), "hevc.*videos of phones are not read.*pip install --force-reinstall av"),
    "no libraries": ((NUMPY,), {"av": "raise ImportError('libavcodec.so.61: cannot open it')\n"},
                     "libavcodec.so.61.*pip install --force-reinstall av$"),
}  # fmt: skip


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.nightly] * (name in ("another version", "hevc"))) for name in FAULTS]
)
def test_a_fault_is_one_line_that_says_what_to_do(doctor, name):
    needs, modules, said = FAULTS[name]
    status, lines = doctor(*needs, **modules)
    (broken,) = lines["broken"]
    assert status == 1 and re.search(said, broken), lines
    tried = any(line.startswith("self-test") for line in lines["ok"])
    assert tried == bool(modules)  # films alone are not written; of wrong packages it is not known what it would show


def test_what_one_step_alone_needs_is_only_noted(doctor):
    status, lines = doctor("pymeshlab>=9999")
    assert status == 0 and any("cages cannot be generated" in line for line in lines["note"])


def test_no_writable_cache(tmp_path):
    (tmp_path / "file").write_text("no folder", encoding="utf-8")
    status, lines = started_doctor(tmp_path, NUMPY, WARP_CACHE_PATH=str(tmp_path / "file" / "cache"))
    (broken,) = lines["broken"]
    assert status == 1 and "set WARP_CACHE_PATH to a folder that can" in broken


def test_warp_that_gives_wrong_numbers(doctor, monkeypatch):
    """A stand-in for a broken driver: the coordinates of all points are off."""
    right = coordinates.deform_points
    monkeypatch.setattr(coordinates, "deform_points", lambda *given, **more: right(*given, **more) + 0.01)
    status, lines = doctor(NUMPY)
    (broken,) = lines["broken"]
    assert status == 1 and broken.startswith("self-test") and "0.01 in points on cpu" in broken


def test_the_demo_is_the_example_of_the_whole_way(tmp_path, monkeypatch):
    import warpcage.examples.render_lego as example

    argv = []
    monkeypatch.setattr(example, "main", lambda given: argv.append(vars(example.parse_arguments(given))))
    assert (
        main(["demo", "--device", "cpu", "-o", str(tmp_path / "here")]) == 0 and main(["demo", "--device", "cpu"]) == 0
    )
    assert [each["out"] for each in argv] == [str(tmp_path / "here"), "warpcage_demo"]
    assert all(each["data"] is None and each["device"] == "cpu" and not each["no_video"] for each in argv)


@pytest.mark.parametrize(
    "line, argv", [("warpcage re", {"render "}), ("warpcage fit scene --quality ", {"fast", "standard", "high"})]
)
def test_a_shell_completes_arguments(tmp_path, line, argv):
    pytest.importorskip("argcomplete")
    variables = {"_ARGCOMPLETE": "1", "_ARGCOMPLETE_STDOUT_FILENAME": str(tmp_path / "argv"), "COMP_LINE": line}
    subprocess.run([sys.executable, "-m", "warpcage"], env={**os.environ, **variables, "COMP_POINT": str(len(line))})
    assert set((tmp_path / "argv").read_text().split("\013")) == argv
