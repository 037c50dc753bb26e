"""The site of docs is built without a warning, refers to every public name, and loads nothing from elsewhere."""

import json
import os
import pathlib
import re
import subprocess
import sys

import pytest

import warpcage

pytestmark = pytest.mark.nightly  # it takes seconds to build, and is built strictly at each push (.github/workflows)

ROOT = pathlib.Path(__file__).resolve().parents[2]


def built(folder):
    for name in ("mkdocs", "material", "mkdocstrings"):
        pytest.importorskip(name)
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return {path.relative_to(folder).as_posix(): path.read_text(encoding="utf-8") for path in folder.rglob("*.html")}


def test_the_site_is_whole(tmp_path):
    pages = built(tmp_path)
    assert len(pages) > 40
    docs = {path.stem for path in (ROOT / "docs").glob("*.md")}

    # every public name and page can be found
    index = json.loads((tmp_path / "search" / "search_index.json").read_text(encoding="utf-8"))
    places = {entry["location"] for entry in index["docs"]}
    for name in warpcage.__all__:
        assert any(re.fullmatch(rf"reference/\w+\.html#warpcage\.[\w.]+\.{name}", place) for place in places), name
    assert any(place.endswith("#warpcage.cage.cage.Cage.bend") for place in places)  # of its base
    docs -= {"README"}
    others = {"index.html", "docs/index.html", "CHANGELOG.html", "CONTRIBUTING.html"}
    assert {f"docs/{name}.html" for name in docs} | others <= places

    # no page shows the marks of docstrings
    reference = {name: text for name, text in pages.items() if name.startswith("reference/")}
    assert len(reference) > 10 and "Example:</p>" in "".join(reference.values())
    assert not [name for name, text in reference.items() if "::</p>" in text]

    # no page loads anything from elsewhere
    for name, text in pages.items():
        loaded = re.findall(r"<(?:script|img|iframe)[^>]*\bsrc=[\"']?(https?:[^\"' >]*)", text)
        loaded += re.findall(r"<link[^>]*\brel=[\"']?(?:stylesheet|preconnect)[^>]*href=[\"']?(https?:[^\"' >]*)", text)
        assert not loaded, (name, loaded)

    # every page of docs is in the navigation, once
    home = pages["docs/splats.html"]
    tabs = re.findall(r'<li class="md-tabs__item.*?</li>', home, re.DOTALL)
    assert [re.sub("<.*?>", "", tab).strip() for tab in tabs] == [
        *("Start", "Tutorials", "How-to guides", "Reference", "Explanation", "Notes", "Changelog")
    ]
    listed = re.findall(
        r"^\| \[\w+\]\((\w+)\.md\)", (ROOT / "docs/README.md").read_text(encoding="utf-8"), re.MULTILINE
    )
    assert sorted(listed) == sorted(docs) and set(re.findall(r'href="([\w]+)\.html"', home)) >= docs - {"splats"}
