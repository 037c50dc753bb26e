"""Scripts of findings keep their form: header, exact versions, a folder that goes again, no warpcage, a row each."""

import os
import pathlib
import re

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[2]
FOLDER = ROOT / "findings"
FIELDS = ["Finding", "Software", "Expected", "Seen", "Meets", "Here"]
START = ["set -eu", "folder=$(mktemp -d)", "trap 'rm -rf \"$folder\"' EXIT", 'cd "$folder"']
SCRIPTS = sorted(FOLDER.glob("*.sh"))


def parts(path):
    """The fields of a script's header, and its lines behind them."""
    lines = path.read_text(encoding="utf-8").splitlines()
    assert lines[0] == "#!/bin/sh"
    end = next(number for number, line in enumerate(lines) if number and not line.startswith("#"))
    header = "\n".join(line.removeprefix("# ").strip() for line in lines[1:end])
    words = re.split(rf"^({'|'.join(FIELDS)}): ", header, flags=re.MULTILINE)
    assert words[0] == "" and words[1::2] == FIELDS
    values = [" ".join(value.replace("#  ", "").split()) for value in words[2::2]]
    return dict(zip(FIELDS, values, strict=True)), lines[end:]


def test_there_are_findings():
    assert len(SCRIPTS) >= 10


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_a_finding_keeps_its_form(path):
    fields, body = parts(path)
    assert os.access(path, os.X_OK) and body[: len(START)] == START
    assert "warpcage" not in "\n".join(body) and len(body) <= 80
    installs = [line for line in body if re.match(r"venv/bin/pip |npm ", line)]
    packages = [word for line in installs for word in line.split()[2:] if not word.startswith("-")]
    assert packages and all(re.fullmatch(r"@?[\w/.-]+(==|@)\d[\w.]*", word) for word in packages)
    version = re.search(r" (\d\S*)", fields["Software"])[1]
    assert any(re.search(rf"(==|@){re.escape(version)}$", word) for word in packages)
    assert "the behaviour has changed" in "\n".join(body)
    places = re.findall(r"`?([\w/]+\.(?:py|md))`?", fields["Here"])
    assert places and all((ROOT / place).is_file() for place in places), places


def test_the_table_is_what_the_headers_say():
    table = (FOLDER / "README.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| \[(\w+)\]\((\S+)\) \| (.+?) \| (.+?) \| (.+?) \|$", table, re.MULTILINE)
    expected = []
    for path in SCRIPTS:
        fields, _ = parts(path)
        software = fields["Software"].split(" (")[0]
        expected.append((path.stem, path.name, software, fields["Finding"], fields["Here"].rstrip(".")))
    assert rows == expected
