"""What stands in .github and CITATION.cff can be read, and its steps name what there is."""

import pathlib
import re
import subprocess
import sys

import pytest

yaml = pytest.importorskip("yaml")

ROOT = pathlib.Path(__file__).resolve().parents[2]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


def steps(path):
    jobs = yaml.safe_load(path.read_text(encoding="utf-8"))["jobs"]
    return [step for job in jobs.values() for step in job["steps"]]


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_steps_of_workflows_name_what_there_is(path):
    extras = set(re.findall(r'"(\w+)": [A-Z]+\b', (ROOT / "setup.py").read_text(encoding="utf-8")))
    found = steps(path)
    assert found and all(("run" in step) != ("uses" in step) for step in found)
    for step in found:
        assert re.fullmatch(r"[\w-]+/[\w-]+@(v\d+|release/v1)", step.get("uses", "a/b@v1"))
        words = step.get("run", "")
        assert all((ROOT / name).is_file() for name in re.findall(r"\.ci/\w+|\bwarpcage/[\w./]+", words))
        assert set(re.findall(r"-e \"\.\[(\w+)\]\"", words)) <= extras
    permissions = yaml.safe_load(path.read_text(encoding="utf-8"))["permissions"]
    assert permissions["contents"] == "read"  # no step writes into the repository


def test_forms_of_issues_have_what_github_asks_for():
    forms = [path for path in (ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml") if path.stem != "config"]
    assert len(forms) == 2
    for path in forms:
        form = yaml.safe_load(path.read_text(encoding="utf-8"))
        assert {"name", "description", "body"} <= set(form)
        assert all(part["type"] == "textarea" and part["attributes"]["label"] for part in form["body"])


def test_the_citation_is_that_of_the_paper():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert {"cff-version", "message", "title", "authors"} <= set(citation)
    paper = citation["preferred-citation"]
    assert paper["title"] == "Deforming Radiance Fields with Cages" and paper["year"] == 2022
    assert [author["family-names"] for author in paper["authors"]] == ["Xu", "Harada"]


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="no history to compare with")
@pytest.mark.parametrize("version", ["0.0.1", pytest.param("99.0.0", marks=pytest.mark.nightly)])
def test_the_script_of_releases_compares_with_the_last_one_and_counts_notes(version):
    """Of the commit that this checkout is of, what changed since can only be what is not committed."""
    command = [sys.executable, str(ROOT / ".ci" / "release"), version, "--since", "HEAD"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    if version == "0.0.1":
        assert done.returncode == 1 and re.match("the version must be X.Y.Z, later than .*, got 0.0.1", done.stderr)
        return
    went, came, stay = map(
        int, re.search(r"(\d+) went, (\d+) came, (\d+) stay\n(\d+) bullets", done.stdout).groups()[:3]
    )
    assert stay > 1000 and went + came < stay
    bullets = int(re.search(r"(\d+) bullets in the notes", done.stdout)[1])
    assert (done.returncode == 0) == (0 < bullets <= 60)
