"""Parts of a job: made beside each other into one folder, and joined by a run of the whole job."""

import json

import pytest
from makers import Making
from refusals import refused
from runs import RECORDS, left_over, pictures, records, write_frames, write_records

from warpcage import run_jobs
from warpcage.studio.cli import main
from warpcage.studio.jobs import OutputFolder, Part


def run_part(path, out, part=None, maker=None):
    return run_jobs(path, out, device="cpu", retries=0, part=part, make=maker)


@pytest.mark.parametrize(
    ("total", "count", "unit"), [(12, 3, 1), (13, 4, 1), (3, 8, 1), (0, 2, 1), (23, 3, 5), (4, 3, 5)]
)
def test_parts_have_each_item_once_and_keep_shards_whole(total, count, unit):
    ranges = [Part(number, count).range(total, unit) for number in range(1, count + 1)]
    assert [item for each in ranges for item in each] == list(range(total))
    sizes = [-(-len(each) // unit) for each in ranges]
    assert max(sizes) - min(sizes) <= 1 and all(each.start % unit == 0 for each in ranges if len(each))


@pytest.mark.parametrize("text", ["0/4", "5/4", "3", "a/b", "1/0", "-1/4", "1.5/4", "", "1/4/2"])
def test_parts_that_there_are_not(text):
    refused(lambda: Part.named(text), match="part")


def test_parts_make_what_one_run_makes(tmp_path, capsys):
    path, out = write_frames(tmp_path / "job", 7), tmp_path / "out"
    argv = ["run", str(path), "--device", "cpu", "--quiet", "-o"]
    assert main([*argv, str(tmp_path / "whole")]) == 0
    for part, made in (("2/3", 2), ("1/3", 2)):
        assert main([*argv, str(out), "--part", part]) == 0
        assert f"wrote {out}: {made} items" in capsys.readouterr().out
        assert not (out / "manifest.jsonl").exists()
    assert main([*argv, str(out), "--part", "1/3"]) == 0  # again
    assert "0 items, 2 were there already" in capsys.readouterr().out
    assert main([*argv, str(out)]) == 0  # what the third would have made
    assert "3 items" in capsys.readouterr().out
    assert pictures(out) == pictures(tmp_path / "whole") and len(records(out)) == 7 and left_over(out) == []
    assert main([*argv, str(out), "--part", "3/3"]) == 0  # it looks into the manifest too
    assert "0 items, 3 were there already" in capsys.readouterr().out
    for wrong in (["--part", "4/3"], ["--part", "1/3", "--dry-run"]):
        assert main([*argv, str(out), *wrong]) == 2
        assert "part" in capsys.readouterr().err


def test_parts_run_beside_each_other_but_not_beside_the_whole(tmp_path):
    path, out = write_frames(tmp_path / "job", 4), tmp_path / "out"
    OutputFolder(out).prepare()
    with OutputFolder(out, Part(1, 2)).driven():
        assert run_part(path, out, Part(2, 2), Making).made == 2
        for part in (None, Part(1, 2)):
            with pytest.raises(ValueError, match="another run writes to"):
                run_part(path, out, part, Making)
    with OutputFolder(out).driven(), pytest.raises(ValueError, match="another run writes to"):
        run_part(path, out, Part(2, 2), Making)
    assert run_part(path, out, maker=Making).made == 2 and len(records(out)) == 4


def test_a_part_leaves_what_others_are_writing(tmp_path):
    path, out = write_frames(tmp_path / "job", 4), tmp_path / "out"
    other = out / ".warpcage" / "parts" / "of-another.png"
    other.parent.mkdir(parents=True)
    other.write_bytes(b"half")
    assert run_part(path, out, Part(1, 2), Making).made == 2
    assert other.exists()
    assert run_part(path, out, maker=Making).made == 2 and not other.exists()


def test_a_part_that_was_ended_goes_on(tmp_path):
    path, out = write_frames(tmp_path / "job", 8), tmp_path / "out"

    class Ends(Making):
        def before(self, item):
            if item.id.endswith("6"):
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_part(path, out, Part(2, 2), Ends)
    report = run_part(path, out, Part(2, 2), Making)
    assert (report.total, report.kept, report.made) == (4, 2, 2)


def test_parts_of_shards_and_of_folders(tmp_path):
    path, out = write_records(tmp_path / "job", 12, RECORDS), tmp_path / "out"
    whole = run_jobs(path, tmp_path / "whole", device="cpu")
    made = [run_part(path, out, Part(number, 2)).made for number in (1, 2)]
    assert sum(made) == whole.made == 12 and made[0] % 5 == 0
    assert run_part(path, out).kept == 12 and pictures(out) == pictures(tmp_path / "whole")
    path = write_records(tmp_path / "job", 4, {"kind": "folder"}, "folder.jsonl")
    out = tmp_path / "folder"
    for number in (1, 2):
        assert run_part(path, out, Part(number, 2)).complete
        assert not (out / "transforms.json").exists()
    assert run_part(path, out).kept == 4
    assert len(json.loads((out / "transforms.json").read_text())["frames"]) == 4
