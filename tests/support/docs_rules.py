"""The rules of the house about pages of docs: tests that they name, links, tables of formats; see house_style.py."""

import functools
import itertools
import re

from house_style import DOCS, ROOT, TESTS, name_of, rule, text

from warpcage.core import EASINGS
from warpcage.mesh import mesh_formats
from warpcage.scene import scene_formats
from warpcage.splats import splat_formats

TEST_NAME = re.compile(r"`(?:(test_\w+)(?:\.py)?)?(?:::(test_\w+))?`")


@functools.cache
def known_tests():
    """The names of all files of tests, and of their tests after "::"."""
    found = set()
    for path in TESTS.rglob("test_*.py"):
        tests = re.findall(r"^\s*(?:async )?def (test_\w+)\(", text(path), re.MULTILINE)
        found |= {path.stem, *(f"{path.stem}::{name}" for name in tests)}
    return found


def table_rows(page, head):
    """The rows of the table of a page that begins with a line, by cells."""
    lines = iter(text(DOCS / page).splitlines())
    next(line for line in lines if line.startswith(head))
    next(lines)
    rows = itertools.takewhile(lambda line: line.startswith("|"), lines)
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", row)[1:-1]] for row in rows]


@rule
def tests_that_pages_name_exist():
    """Promises name the tests that hold them: `test_file`, `test_file::test_name`, or `::test_name` of that file."""
    for page in sorted(DOCS.glob("*.md")):
        for line in text(page).splitlines():
            file = ""
            for named_file, test in TEST_NAME.findall(line):
                file = named_file or file
                name = f"{file}::{test}" if test else file
                if (named_file or (test and file)) and name not in known_tests():
                    yield f"{page.name} names {name}"
    if len(re.findall(r"`test_\w+(?:::test_\w+)?`", text(DOCS / "reliability.md"))) <= 20:
        yield "the page of promises names no tests"


@rule
def links_of_pages_lead_to_files():
    """And to headings that are there."""
    for page in [*sorted(DOCS.glob("*.md")), *sorted(ROOT.glob("*.md"))]:
        for link, place in re.findall(r"\]\((?!https?:|mailto:)([^)#\s]*)(?:#([^)\s]+))?\)", text(page)):
            target = page.parent / link if link else page
            heads = re.findall(r"^#+ (.*)$", text(target), re.MULTILINE) if place and target.suffix == ".md" else []
            anchors = {re.sub(r"\s+", "-", re.sub(r"[^\w\s-]", "", head).strip().lower()) for head in heads}
            if not target.exists() or (heads and place not in anchors):
                yield f"{name_of(page)}: {link}#{place}"


FORMAT_TABLES = {
    "splats.md": "| file | read | written |",
    "captures.md": "| format | what it looks like |",
    "blender.md": "| format | read | several objects | written |",
}


@rule
def tables_of_formats_are_whole():
    """Every format stands in its table once, or where it is one of splats in docs/cli.md alone, and tests hold rows."""
    tables = {page: table_rows(page, head) for page, head in FORMAT_TABLES.items()}
    for page, table in tables.items():
        yield from (f"{page}: {cells[0]} names no test" for cells in table if "`test_" not in cells[-1])

    def row(page, ending):
        (found,) = (cells for cells in tables[page] if f"`{ending}`" in cells[0])
        return found

    splats = splat_formats()
    described = "".join(cells[0] for cells in tables["splats.md"])  # docs/cli.md, which is generated, has all formats
    for ending, known in [(ending, each) for each in splats for ending in each.endings if f"`{ending}`" in described]:
        file, read, written = row("splats.md", ending)[:3]  # a SOG folder by its meta.json
        alike = [each for each in splats if any(f"`{end}`" in file for end in each.endings)]
        if bool(known.read) != (read != "no") or any(each.write for each in alike) != (written != "no"):
            yield f"splats.md: {ending}"
    named = [name for cells in tables["captures.md"] for name in re.findall(r"`(\w+)`", cells[0])]
    yield from (f"captures.md: {known.name}" for known in scene_formats() if named.count(known.name) != 1)
    for known in mesh_formats():
        written = [row("blender.md", ending)[3] == "yes" for ending in known.endings]
        if any(each != bool(known.write) for each in written):
            yield f"blender.md: {known.endings}"
    rows = table_rows("films.md", "| easing of a key |")
    easings = {name for cells in rows for name in re.findall(r"`([a-z-]+)`", cells[0])}
    yield from (f"films.md: {name}" for name in easings ^ set(EASINGS))
