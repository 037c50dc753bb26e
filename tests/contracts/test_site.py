"""The site of docs is built without a warning, refers to every public name, and loads nothing from elsewhere."""

import json
import os
import pathlib
import re
import subprocess
import sys

import pytest

import warpcage

ROOT = pathlib.Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    for name in ("mkdocs", "material", "mkdocstrings"):
        pytest.importorskip(name)
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    built = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
    assert built.returncode == 0, built.stdout + built.stderr
    return folder


def test_every_public_name_and_page_can_be_found(site):
    index = json.loads((site / "search" / "search_index.json").read_text(encoding="utf-8"))
    places = {entry["location"] for entry in index["docs"]}
    for name in warpcage.__all__:
        assert any(re.fullmatch(rf"reference/\w+\.html#warpcage\.[\w.]+\.{name}", place) for place in places), name
    assert any(place.endswith("#warpcage.cage.cage.Cage.bend") for place in places)  # of its base
    pages = {f"docs/{path.stem}.html" for path in (ROOT / "docs").glob("*.md")}
    assert pages | {"index.html", "CHANGELOG.html", "CONTRIBUTING.html"} <= places


def test_no_page_shows_the_marks_of_docstrings(site):
    pages = list((site / "reference").glob("*.html"))
    assert len(pages) > 10 and "Example:</p>" in "".join(path.read_text(encoding="utf-8") for path in pages)
    assert not [path.name for path in pages if "::</p>" in path.read_text(encoding="utf-8")]


def test_no_page_loads_anything_from_elsewhere(site):
    pages = list(site.rglob("*.html"))
    assert len(pages) > 40
    for page in pages:
        text = page.read_text(encoding="utf-8")
        loaded = re.findall(r"<(?:script|img|iframe)[^>]*\bsrc=[\"']?(https?:[^\"' >]*)", text)
        loaded += re.findall(r"<link[^>]*\brel=[\"']?(?:stylesheet|preconnect)[^>]*href=[\"']?(https?:[^\"' >]*)", text)
        assert not loaded, (page, loaded)


def test_every_page_of_docs_is_in_the_navigation(site):
    home = (site / "docs" / "splats.html").read_text(encoding="utf-8")
    listed = set(re.findall(r'href="([\w]+)\.html"', home))
    tabs = re.findall(r'<li class="md-tabs__item.*?</li>', home, re.DOTALL)
    assert [re.sub("<.*?>", "", tab).strip() for tab in tabs] == [
        "Start", "How to", "Explanation", "Reference", "Results", "Changelog"
    ]  # fmt: skip
    assert listed >= {path.stem for path in (ROOT / "docs").glob("*.md")} - {"splats"}
