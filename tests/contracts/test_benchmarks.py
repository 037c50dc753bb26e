"""Every benchmark can be started, also those that no quick run starts; tables of pages are what their commands make."""

import pathlib
import re
import runpy
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[2]

PAGES = "results blender fit_pose fits fits_of_captures trends captures splats_views frames select batch_scale".split()

PROGRAM = """
import contextlib, io, re, runpy, sys
sys.path.insert(0, "benchmarks")
main = runpy.run_path("benchmarks/__main__.py", run_name="benchmarks")["main"]

def output(*arguments):
    with contextlib.redirect_stdout(io.StringIO()) as text, contextlib.suppress(SystemExit):
        assert main(list(arguments)) in (0, 2)
    return text.getvalue()

def names(text):
    return re.findall("^  ([a-z][a-z0-9-]*)  ", text, re.MULTILINE)

for suite in names(output()):
    commands = names(output(suite, "--help")) if "COMMAND" in output(suite, "--help") else [None]
    for command in commands:
        arguments = [suite, *filter(None, [command]), "--help"]
        assert output(*arguments).startswith("usage: python benchmarks " + " ".join(arguments[:-1])), arguments
        print(*arguments[:-1])
"""


def test_every_benchmark_says_what_it_takes():
    done = subprocess.run([sys.executable, "-c", PROGRAM], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    readme = (ROOT / "benchmarks" / "README.md").read_text(encoding="utf-8")
    assert done.stdout.count("\n") > 30
    for line in done.stdout.splitlines():
        assert all(re.search(rf"`{name}`", readme) for name in line.split()), f"benchmarks/README.md lacks {line}"


def test_every_quick_run_is_one_that_there_is():
    command = [sys.executable, "benchmarks/run_all.py", "--quick", "--list"]
    some, every = (
        subprocess.run([*command, *more], cwd=ROOT, capture_output=True, text=True) for more in ([], ["--all"])
    )
    assert some.returncode == every.returncode == 0
    assert 10 < len(some.stdout.splitlines()) < len(every.stdout.splitlines()) < 60


@pytest.mark.parametrize("name", PAGES)
def test_a_page_is_what_its_command_makes(name, tmp_path, monkeypatch, capsys):
    page, command = tmp_path / "page.md", ["pages", name.replace("_", "-")]
    arguments = [*command, "--results", str(ROOT / "docs" / "results"), "--page", str(page)]
    monkeypatch.setattr(sys, "argv", ["benchmarks", *arguments])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(ROOT / "benchmarks"), run_name="__main__")
    assert not ended.value.code
    there = ROOT / "docs" / f"{name}.md"
    again = f"run python benchmarks {' '.join(command)} again"
    assert page.read_text(encoding="utf-8") == there.read_text(encoding="utf-8"), again
    assert "left out" not in capsys.readouterr().out


def test_memory_of_a_fit_is_distinguished_from_that_of_those_before(monkeypatch):
    """Peaks of a process only rise: a fit's own is known where it rose."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    from pages.pages import memory

    assert memory({"memory": 3_812_345_678, "memory_before": 91_000_000}) == "3.81"
    assert memory({"memory": 5_062_268_859, "memory_before": 5_062_268_859}) == "≤ 5.06"
    assert memory({"memory": 5_062_268_859}) == "≤ 5.06"  # read after the evaluation, by an earlier script
    assert memory({"memory": None, "memory_before": None}) == "–"
