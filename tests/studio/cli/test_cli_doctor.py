"""`warpcage doctor` on a whole machine, and on broken ones: each fault is one line that says what to do."""

import os
import re
import subprocess
import sys

import pytest


def doctor(tmp_path, *needs, environment=(), **modules):
    """Exit status, and lines of doctor by their state, on a machine whose warpcage needs `needs`; modules: texts of
    stand-ins for installed ones."""
    info = tmp_path / "warpcage-0.0.1.dist-info"
    info.mkdir()
    heads = ["Metadata-Version: 2.1", "Name: warpcage", "Version: 0.0.1"]
    heads += [f"Requires-Dist: {need}" for need in needs]
    (info / "METADATA").write_text("\n".join(heads) + "\n", encoding="utf-8")
    for name, text in modules.items():
        (tmp_path / f"{name}.py").write_text(text, encoding="utf-8")
    paths = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    command = [sys.executable, "-m", "warpcage", "doctor", "--device", "cpu"]
    variables = {**os.environ, "PYTHONPATH": paths, **dict(environment)}
    done = subprocess.run(command, env=variables, cwd=tmp_path, capture_output=True, text=True, timeout=240)
    assert done.stderr == ""
    lines = {"ok": [], "note": [], "broken": []}
    for line in done.stdout.splitlines()[:-1]:
        state, what = re.match(r"(ok|note|broken) +(\S.*)", line).groups()
        lines[state].append(what)
    last = done.stdout.splitlines()[-1]
    assert last == (f"{len(lines['broken'])} problem to fix" if lines["broken"] else "warpcage works here")
    return done.returncode, lines


NUMPY = "numpy>=1.26"


def test_a_whole_machine(tmp_path):
    status, lines = doctor(tmp_path, NUMPY, 'no-such-package>=2; extra == "cluster"', 'numpy>=1; extra == "exr"')
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
def test_a_fault_is_one_line_that_says_what_to_do(tmp_path, name):
    needs, modules, said = FAULTS[name]
    status, lines = doctor(tmp_path, *needs, **modules)
    (broken,) = lines["broken"]
    assert status == 1 and re.search(said, broken), lines
    tried = any(line.startswith("self-test") for line in lines["ok"])
    assert tried == bool(modules)  # films alone are not written; of wrong packages it is not known what it would show


def test_what_one_step_alone_needs_is_only_noted(tmp_path):
    status, lines = doctor(tmp_path, "pymeshlab>=9999")
    assert status == 0 and any("cages cannot be generated" in line for line in lines["note"])


def test_no_writable_cache(tmp_path):
    (tmp_path / "file").write_text("no folder", encoding="utf-8")
    status, lines = doctor(tmp_path, NUMPY, environment={"WARP_CACHE_PATH": str(tmp_path / "file" / "cache")})
    (broken,) = lines["broken"]
    assert status == 1 and "set WARP_CACHE_PATH to a folder that can" in broken


def test_warp_that_gives_wrong_numbers(tmp_path):
    """A stand-in for a broken driver: the coordinates of all points are off."""
    (tmp_path / "sitecustomize.py").write_text(
        "import warpcage.coordinates.coordinates as c\nright = c.deform_points\n"
        "c.deform_points = lambda *a, **k: right(*a, **k) + 0.01\n",
        encoding="utf-8",
    )
    status, lines = doctor(tmp_path, NUMPY)
    (broken,) = lines["broken"]
    assert status == 1 and broken.startswith("self-test") and "0.01 in points on cpu" in broken


def test_the_demo_is_the_example_of_the_whole_way(tmp_path, monkeypatch):
    import warpcage.examples.render_lego as example
    from warpcage.studio.cli import main

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
