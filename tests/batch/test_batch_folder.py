"""The output folder of a run: nothing stays of one that made nothing."""

import pytest
from runs import write_frames

import warpcage


def test_nothing_stays_of_a_run_that_made_nothing(tmp_path):
    job, out = write_frames(tmp_path / "job", 2), tmp_path / "new" / "out"

    def refused():
        with pytest.raises(ValueError, match="cuda:99"):
            warpcage.run_jobs(job, out, device="cuda:99")

    refused()
    assert not out.parent.exists()
    out.mkdir(parents=True)
    refused()
    assert out.exists() and not any(out.iterdir())
    (out / "mine.txt").write_text("mine")
    refused()
    assert [path.name for path in out.iterdir()] == ["mine.txt"]


def test_what_was_made_stays_where_a_run_fails(tmp_path):
    job, out = write_frames(tmp_path / "job", 2), tmp_path / "out"
    assert warpcage.run_jobs(job, out, device="cpu").complete
    made = {path: path.read_bytes() for path in out.rglob("*.png")}
    with pytest.raises(ValueError, match="cuda:99"):
        (out / "shot" / "f0000.png").unlink()
        warpcage.run_jobs(job, out, device="cuda:99")
    assert (out / "manifest.jsonl").exists() and (out / "shot" / "f0001.png").exists() and len(made) == 2
