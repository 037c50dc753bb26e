"""Pages of figures are what their scripts make of the results that lie beside them: nobody writes into them."""

import pathlib
import runpy
import sys

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[1]

#: Script of benchmarks -> page of docs.
PAGES = {
    "page": "results",
    "fits_page": "fits",
    "captures_page": "captures",
    "splats_page": "splats_views",
    "frames_page": "frames",
    "select_page": "select",
}


@pytest.mark.parametrize("script", PAGES)
def test_a_page_is_what_its_script_makes(script, tmp_path, monkeypatch, capsys):
    (tmp_path / "pictures").symlink_to(ROOT / "docs" / "pictures")
    page = tmp_path / "page.md"
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    monkeypatch.setattr(sys, "argv", [script, "--results", str(ROOT / "docs" / "results"), "--page", str(page)])
    runpy.run_path(str(ROOT / "benchmarks" / f"{script}.py"), run_name="__main__")
    there = ROOT / "docs" / f"{PAGES[script]}.md"
    assert page.read_text(encoding="utf-8") == there.read_text(encoding="utf-8"), f"run benchmarks/{script}.py again"
    assert "left out" not in capsys.readouterr().out


def test_memory_of_a_fit_is_told_from_that_of_those_before(monkeypatch):
    """Peaks of a process only rise: a fit's own is known where it rose."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    memory = runpy.run_path(str(ROOT / "benchmarks" / "fits_page.py"))["memory"]
    assert memory({"memory": 3_812_345_678, "memory_before": 91_000_000}) == "3.81"
    assert memory({"memory": 5_062_268_859, "memory_before": 5_062_268_859}) == "≤ 5.06"
    assert memory({"memory": 5_062_268_859}) == "≤ 5.06"  # read after the evaluation, by an earlier script
    assert memory({"memory": None, "memory_before": None}) == "–"
