"""The tables of formats in docs are whole: every format that is known, what is done with it, tests that are there."""

import functools
import pathlib
import re

import pytest

from warpcage.mesh import mesh_formats
from warpcage.scene import scene_formats
from warpcage.splats import splat_formats

ROOT = pathlib.Path(__file__).resolve().parents[2]


def rows(page, head):
    """The rows of the table that begins with a line, by cells."""
    lines = iter((ROOT / "docs" / page).read_text(encoding="utf-8").splitlines())
    next(line for line in lines if line.startswith(head))
    next(lines)
    found = []
    for line in lines:
        if not line.startswith("|"):
            return found
        found.append([cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]])
    return found


TABLES = {
    "splats.md": "| file | read | written |",
    "captures.md": "| format | what it looks like |",
    "blender.md": "| format | read | several objects | written |",
}


@functools.cache
def known_tests():
    """The names of all files of tests, and of their tests after "::"."""
    found = set()
    for path in (ROOT / "tests").rglob("test_*.py"):
        names = re.findall(r"^def (test_\w+)", path.read_text(encoding="utf-8"), re.MULTILINE)
        found |= {path.stem, *(f"{path.stem}::{name}" for name in names)}
    return found


@pytest.mark.parametrize("page", TABLES)
def test_tests_that_tables_name_are_there(page):
    table = rows(page, TABLES[page])
    for cells in table:
        named = re.findall(r"`((?:test_\w+)?(?:::\w+)?)`", cells[-1])
        assert named, cells[0]
        file = ""
        for name in named:  # `::test_b` is of the file before it
            file = name.partition("::")[0] or file
            assert f"{file}::{name.partition('::')[2]}".removesuffix("::") in known_tests(), (cells[0], name)


@pytest.mark.parametrize("format", splat_formats(), ids=lambda format: " ".join(format.endings))
def test_splat_formats_stand_in_the_table(format):
    """By each ending; a SOG folder by its meta.json."""
    for ending in format.endings:
        found = [cells for cells in rows("splats.md", TABLES["splats.md"]) if f"`{ending}`" in cells[0]]
        assert len(found) == 1, ending
        file, read, written = found[0][:3]
        assert bool(format.read) == (read != "no"), file
        assert not format.write or written != "no", file
        if all(each.write is None for each in splat_formats() if any(f"`{end}`" in file for end in each.endings)):
            assert written == "no", file


@pytest.mark.parametrize("format", scene_formats(), ids=lambda format: format.name)
def test_scene_formats_stand_in_the_table(format):
    names = [name for cells in rows("captures.md", TABLES["captures.md"]) for name in re.findall(r"`(\w+)`", cells[0])]
    assert names.count(format.name) == 1


@pytest.mark.parametrize("format", mesh_formats(), ids=lambda format: format.name)
def test_mesh_formats_stand_in_the_table(format):
    for ending in format.endings:
        found = [cells for cells in rows("blender.md", TABLES["blender.md"]) if f"`{ending}`" in cells[0]]
        assert len(found) == 1 and bool(format.write) == (found[0][3] == "yes"), ending
