"""Pages of figures are what their commands make of the results that lie beside them: nobody writes into them."""

import pathlib
import runpy
import sys

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[2]

PAGES = ("results", "fits", "fits_of_captures", "trends", "captures", "splats_views", "frames", "select")


@pytest.mark.parametrize("name", PAGES)
def test_a_page_is_what_its_command_makes(name, tmp_path, monkeypatch, capsys):
    (tmp_path / "pictures").symlink_to(ROOT / "docs" / "pictures")
    page, command = tmp_path / "page.md", ["pages", name.replace("_", "-")]
    words = [*command, "--results", str(ROOT / "docs" / "results"), "--page", str(page)]
    monkeypatch.setattr(sys, "argv", ["benchmarks", *words])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(ROOT / "benchmarks"), run_name="__main__")
    assert not ended.value.code
    there = ROOT / "docs" / f"{name}.md"
    again = f"run python benchmarks {' '.join(command)} again"
    assert page.read_text(encoding="utf-8") == there.read_text(encoding="utf-8"), again
    assert "left out" not in capsys.readouterr().out


def test_memory_of_a_fit_is_told_from_that_of_those_before(monkeypatch):
    """Peaks of a process only rise: a fit's own is known where it rose."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    from pages.pages import memory

    assert memory({"memory": 3_812_345_678, "memory_before": 91_000_000}) == "3.81"
    assert memory({"memory": 5_062_268_859, "memory_before": 5_062_268_859}) == "≤ 5.06"
    assert memory({"memory": 5_062_268_859}) == "≤ 5.06"  # read after the evaluation, by an earlier script
    assert memory({"memory": None, "memory_before": None}) == "–"
