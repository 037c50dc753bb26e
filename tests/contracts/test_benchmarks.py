"""Benchmarks that no quick run starts can be started all the same: each is imported, and says what it takes."""

import pathlib
import re
import subprocess
import sys

ROOT = pathlib.Path(__file__).resolve().parents[2]

PROGRAM = """
import contextlib, io, re, runpy, sys
sys.path.insert(0, "benchmarks")
main = runpy.run_path("benchmarks/__main__.py", run_name="benchmarks")["main"]

def said(*words):
    with contextlib.redirect_stdout(io.StringIO()) as text, contextlib.suppress(SystemExit):
        assert main(list(words)) in (0, 2)
    return text.getvalue()

def names(text):
    return re.findall("^  ([a-z][a-z0-9-]*)  ", text, re.MULTILINE)

for suite in names(said()):
    commands = names(said(suite, "--help")) if "COMMAND" in said(suite, "--help") else [None]
    for command in commands:
        words = [suite, *filter(None, [command]), "--help"]
        assert said(*words).startswith("usage: python benchmarks " + " ".join(words[:-1])), words
        print(*words[:-1])
"""


def test_every_benchmark_says_what_it_takes():
    done = subprocess.run([sys.executable, "-c", PROGRAM], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    readme = (ROOT / "benchmarks" / "README.md").read_text(encoding="utf-8")
    assert done.stdout.count("\n") > 30
    for line in done.stdout.splitlines():
        assert all(re.search(rf"`{word}`", readme) for word in line.split()), f"benchmarks/README.md lacks {line}"


def test_every_quick_run_is_one_that_there_is():
    command = [sys.executable, "benchmarks/run_all.py", "--quick", "--list"]
    some, every = (
        subprocess.run([*command, *more], cwd=ROOT, capture_output=True, text=True) for more in ([], ["--all"])
    )
    assert some.returncode == every.returncode == 0
    assert 10 < len(some.stdout.splitlines()) < len(every.stdout.splitlines()) < 60
