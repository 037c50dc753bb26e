"""docs/reliability.md names the tests of each promise, and when they run: it is written by hand, and compared here."""

import ast
import functools
import pathlib
import re

import pytest

TESTS = pathlib.Path(__file__).resolve().parents[1]
PAGE = TESTS.parent / "docs" / "reliability.md"
PUSH, BOTH, NIGHT, BENCHMARK = "each push", "each push, more at night", "at night", "a benchmark"


def rows():
    """Promise, when it is tested, and what shows it."""
    lines = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| ")]
    cells = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines if not line.startswith("| ---")]
    return [row for row in cells if row[0] != "promise"]


@functools.cache
def marks_of(file):
    """Of each test of a file, the words of its decorators, with what stands for them in the file."""
    tree = ast.parse(next(TESTS.rglob(f"{file}.py")).read_text(encoding="utf-8"))
    names = {
        target.id: ast.unparse(node.value)
        for node in tree.body
        if isinstance(node, ast.Assign)
        for target in node.targets
        if isinstance(target, ast.Name)
    }

    def text_of(node):
        return " ".join(re.sub(r"\b[A-Z_]{3,}\b", lambda name: names.get(name[0], name[0]), ast.unparse(decorator))
                        for decorator in node.decorator_list)  # fmt: skip

    whole = names.get("pytestmark", "")
    functions = [
        node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)
    ]
    tests = [node for node in functions if node.name.lower().startswith("test")]
    return {node.name: f"{whole} {text_of(node)}" for node in tests}


def when(file, test):
    """When a test runs, or the tests of a file."""
    marks = marks_of(file)
    found = set()
    for text in [marks[test]] if test else marks.values():
        if re.search(r"^\S*mark\.nightly|(?<!marks=)pytest\.mark\.nightly$|^ ?pytest\.mark\.nightly", text.strip()):
            found.add(NIGHT)
        else:
            found.add(BOTH if "nightly" in text or "scaled" in text or "given(" in text else PUSH)
    return found


@pytest.mark.parametrize("row", rows(), ids=lambda row: row[0][:40])
def test_promises_are_held_when_the_page_says(row):
    _, said, shown = row
    found, file = set(), None
    for name, test in re.findall(r"`(?:(test_\w+)(?:\.py)?)?(?:::(test_\w+))?`", shown):
        file = name or file
        if file:
            found |= when(file, test)
    if not found:
        assert said == BENCHMARK and "benchmarks" in shown
        return
    expected = NIGHT if found == {NIGHT} else PUSH if found == {PUSH} else BOTH
    assert said == expected, f"tests of this promise run {expected}"
