"""`warpcage run` by one worker: what is there is kept, what fails is listed, full disks and interrupts lose nothing."""

import json
import os
import pathlib
import re
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from makers import Making, Moody
from messages import MESSAGES
from refusals import refused
from runs import RECORDS, SUPPORT, command, left_over, pictures, records, run_with, write_frames, write_records

import warpcage
from warpcage.studio.cli import main
from warpcage.studio.jobs import OutputFolder, pack_shard, read_shard, unpaid


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return write_frames(tmp_path_factory.mktemp("jobs") / "job", 12).parent


def started(path, out, *argv):
    """`warpcage run` in this process; returns its exit status."""
    return main(["run", str(path), "-o", str(out), "--device", "cpu", "--quiet", *map(str, argv)])


def test_a_run_makes_all_and_keeps_what_is_there(files, tmp_path, capsys):
    out = tmp_path / "out"
    assert started(files / "jobs.jsonl", out) == 0
    assert "12 items" in capsys.readouterr().out and left_over(out) == []
    found, before = records(out), pictures(out)
    assert sorted(before) == [f"shot/f{place:04d}.png" for place in range(12)]
    for name, record in found.items():
        assert record["state"] == "done" and record["attempts"] == 1 and record["version"] == warpcage.__version__
        assert record["outputs"] == {f"{name}.png": len(before[f"{name}.png"])}
        assert record["seconds"] >= 0 and record["device"] and record["host"] and record["worker"] == "0"
    times = {path: path.stat().st_mtime_ns for path in (out / "shot").iterdir()}
    assert started(files / "jobs.jsonl", out) == 0
    assert "0 items, 12 were there already" in capsys.readouterr().out
    assert times == {path: path.stat().st_mtime_ns for path in (out / "shot").iterdir()} and records(out) == found


def test_what_changed_is_made_again_and_nothing_else(files, tmp_path, capsys):
    folder, out = tmp_path / "job", tmp_path / "out"
    shutil.copytree(files, folder)
    path = folder / "jobs.jsonl"
    assert started(path, out) == 0
    whole = pictures(out)
    (out / "shot" / "f0003.png").unlink()  # lost
    (out / "shot" / "f0004.png").write_bytes(whole["shot/f0004.png"][:-9])  # cut
    poses = np.load(folder / "jobs.npy")
    poses[7] = poses[2]
    write_frames(folder, 12, changes={9: {"background": "black"}})
    np.save(folder / "jobs.npy", poses)
    capsys.readouterr()
    assert main(["run", str(path), "-o", str(out), "--dry-run", "--device", "cpu"]) == 0
    said = capsys.readouterr().out
    assert (
        "12 items: 8 are there already" in said and "4 would be made: 4 frames, in 1 group, 4 of them changed" in said
    )
    assert not (out / "shot" / "f0003.png").exists()
    before = {path: path.stat().st_mtime_ns for path in (out / "shot").iterdir()}
    assert started(path, out) == 0
    made = {each.stem for each in (out / "shot").iterdir() if before.get(each) != each.stat().st_mtime_ns}
    assert made == {"f0003", "f0004", "f0007", "f0009"}
    now = pictures(out)
    assert now["shot/f0007.png"] == whole["shot/f0002.png"] and now["shot/f0009.png"] != whole["shot/f0009.png"]
    assert all(now[name] == whole[name] for name in whole if name[6:10] not in ("0007", "0009"))


def test_bad_items_are_listed_and_the_rest_is_made(files, tmp_path, capsys):
    """A row that is not there, a field that cannot be read, a cage that is not there."""
    changes = {2: {"posed": "jobs.npy#99"}, 5: {"field": "broken.npz"}, 6: {"cage": "none.obj"}}
    path, out = write_frames(files, 12, "bad.jsonl", changes=changes), tmp_path / "out"
    assert started(path, out) == 1
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 4 and said[-1] == "warpcage: error: 3 items failed"
    assert all(f"shot/f000{place}: " in line for place, line in zip((2, 5, 6), said, strict=False))
    found = records(out)
    failed = {name for name, each in found.items() if each["state"] == "failed"}
    assert failed == {f"shot/f000{n}" for n in (2, 5, 6)}
    assert all(found[f"shot/f000{place}"]["attempts"] == 1 for place in changes) and len(pictures(out)) == 9
    missing = re.escape(repr(str(files / "none.obj")))
    assert re.fullmatch(MESSAGES["batch.no_cage_file"].format(path=missing), found["shot/f0006"]["error"])
    write_frames(files, 12, "bad.jsonl")
    assert started(path, out) == 0 and len(pictures(out)) == 12
    assert {each["state"] for each in records(out).values()} == {"done"}


def test_errors_are_tried_again_and_bad_input_is_not(files, tmp_path):
    Moody.tried = {}
    path, out = write_frames(tmp_path / "job", 20), tmp_path / "out"
    report = run_with(path, out, Moody)
    assert sorted(report.failed) == [f"shot/f00{number}" for number in ("05", "07", "15", "17")]
    assert report.failed["shot/f0005"] == "RuntimeError: no luck at try 3"
    found = records(out)
    attempts = {name[-2:]: each["attempts"] for name, each in found.items()}
    assert [attempts[name] for name in ("02", "03", "05", "07", "13")] == [1, 3, 3, 1, 3]
    assert report.made == 16 == sum(each["state"] == "done" for each in found.values())


def test_nothing_stays_of_a_run_that_made_nothing(tmp_path):
    job, out = write_frames(tmp_path / "job", 2), tmp_path / "new" / "out"

    def left_over_of_it():
        refused(lambda: warpcage.run_jobs(job, out, device="cuda:99"), match="cuda:99")
        return sorted(path.name for path in out.iterdir()) if out.exists() else None

    assert left_over_of_it() is None and not out.parent.exists()
    out.mkdir(parents=True)
    assert left_over_of_it() == []
    (out / "mine.txt").write_text("mine")
    assert left_over_of_it() == ["mine.txt"]
    assert run_with(job, out).complete
    (out / "shot" / "f0000.png").unlink()
    assert (
        left_over_of_it() == [".warpcage", "manifest.jsonl", "mine.txt", "shot"]
        and (out / "shot" / "f0001.png").exists()
    )


def test_a_second_driver_is_refused_and_the_first_one_killed_frees_the_folder(files, tmp_path, capsys):
    out = tmp_path / "out"
    OutputFolder(out).prepare()
    program = (
        "import sys, time\nfrom warpcage.studio.jobs.manifest import OutputFolder\n"
        "with OutputFolder(sys.argv[1]).driven():\n    print('here', flush=True)\n    time.sleep(60)"
    )
    other = subprocess.Popen([sys.executable, "-c", program, str(out)], stdout=subprocess.PIPE)
    assert other.stdout.readline() == b"here\n"
    assert started(files / "jobs.jsonl", out) == 2
    assert f"error: another run writes to {str(out)!r}" in capsys.readouterr().err
    assert main(["run", str(files / "jobs.jsonl"), "-o", str(out), "--dry-run", "--device", "cpu"]) == 0
    other.kill()
    other.wait()
    assert started(files / "jobs.jsonl", out) == 0 and len(pictures(out)) == 12


def test_workers_of_a_driver_that_was_killed_are_waited_for(tmp_path, monkeypatch):
    monkeypatch.setattr("warpcage.studio.jobs.manifest.PATIENCE", 0.2)
    folder = OutputFolder(tmp_path / "out")
    folder.prepare()
    with folder.worked_in():
        with pytest.raises(ValueError, match="workers of an earlier run still write"), folder.driven():
            pass
    with folder.driven(), folder.worked_in(), folder.worked_in():
        pass


@pytest.mark.parametrize(
    "sign",
    [
        pytest.param(signal.SIGINT, marks=pytest.mark.nightly),
        signal.SIGKILL,
        pytest.param(signal.SIGTERM, marks=pytest.mark.nightly),
    ],
)
def test_an_ended_run_goes_on_where_it_was(files, tmp_path, sign):
    """By one worker, which is the driver."""
    count = 100 if sign == signal.SIGKILL else 250  # so that some are left when the signal comes
    path, out = write_frames(tmp_path / "job", count), tmp_path / "out"
    argv = command("run", path, "-o", out, "--device", "cpu", "--quiet")
    driver = subprocess.Popen(argv, stderr=subprocess.PIPE, text=True)
    while len(list((out / "shot").glob("*.png") if (out / "shot").exists() else ())) < 10:
        assert driver.poll() is None, driver.stderr.read()
        time.sleep(0.02)
    driver.send_signal(sign)
    said = driver.communicate()[1]
    if sign != signal.SIGKILL:
        assert driver.returncode == 128 + sign and said in ("warpcage: interrupted\n", "warpcage: terminated\n")
        assert left_over(out) == [] and 0 < len(records(out)) < count
        # the last pictures may have been put into their place and not noted yet: they are made again
        assert {f"{name}.png" for name in records(out)} <= set(pictures(out))
    before = {each: each.stat().st_mtime_ns for each in (out / "shot").iterdir()}
    assert started(path, out) == 0
    found = records(out)
    assert len(found) == len(pictures(out)) == count and left_over(out) == []
    again = [each for each, when in before.items() if each.stat().st_mtime_ns != when]
    assert len(again) <= 10  # what was under way, and was not noted yet


class Touching(Making):
    """Changes the job file while it runs."""

    path: pathlib.Path

    def before(self, item):
        with self.path.open("a") as file:
            file.write("\n")


def test_a_job_file_that_changes_while_it_runs_ends_the_run(tmp_path):
    path, out = write_frames(tmp_path / "job", 30), tmp_path / "out"
    Touching.path = path
    refused(lambda: run_with(path, out, Touching), match=r"jobs.jsonl was changed while it ran")
    some = len(records(out))
    assert 0 < some < 30 and left_over(out) == []
    assert run_with(path, out, Making).made == 30 - some


NO_ROOM = """\
import os, pathlib, subprocess, sys
jobs, out = sys.argv[1:3]
pathlib.Path(out).mkdir()
subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={sys.argv[3]}", "tmpfs", out], check=True)
from warpcage.studio.cli import main
status = main(["run", jobs, "-o", out, "--device", "cpu", "--quiet"])
files = [path for path in pathlib.Path(out, "shot").iterdir()]
parts = [path.name for path in pathlib.Path(out).rglob("*") if path.is_file() and "parts" in path.parts]
print(status, len(files), parts)
if status == 1:
    subprocess.run(["mount", "-o", "remount,size=64m", out], check=True)
    print(main(["run", jobs, "-o", out, "--device", "cpu", "--quiet"]))
    print(len(list(pathlib.Path(out, "shot").iterdir())), len(open(out + "/manifest.jsonl").readlines()))
"""


def in_a_namespace(program, *argv):
    """Python as root of a user namespace, which may mount; the test is skipped where there are none."""
    if subprocess.run(["unshare", "-Urm", "true"], capture_output=True).returncode if shutil.which("unshare") else True:
        pytest.skip("user namespaces are not allowed here")
    line = ["unshare", "-Urm", sys.executable, "-c", program, *map(str, argv)]
    return subprocess.run(line, capture_output=True, text=True)


def test_a_full_disk_ends_the_run_and_loses_nothing(tmp_path):
    path = write_frames(tmp_path / "job", 30, outputs={"rgb": "{id}.npy"})
    done = in_a_namespace(NO_ROOM, path, tmp_path / "out", "128k")
    assert done.returncode == 0, done.stderr
    first, again, counts = [line for line in done.stdout.splitlines() if not line.startswith("wrote")]
    status, made, parts = first.split(maxsplit=2)
    assert status == "1" and 5 < int(made) < 30 and parts == "[]" and again == "0" and counts == "30 30"
    said = done.stderr.splitlines()
    assert len(said) == 1 and "no space left on device" in said[0] and "items left" in said[0], done.stderr


READ_ONLY = """\
import pathlib, subprocess, sys
jobs, out = sys.argv[1:3]
from warpcage.studio.cli import main
subprocess.run(["mount", "--bind", out, out], check=True)
subprocess.run(["mount", "-o", "remount,ro,bind", out], check=True)
sys.exit(main(["run", jobs, "-o", out, "--device", "cpu", "--quiet"]))
"""


def test_a_folder_that_is_read_only_is_refused(files, tmp_path):
    (tmp_path / "out").mkdir()
    done = in_a_namespace(READ_ONLY, files / "jobs.jsonl", tmp_path / "out")
    assert done.returncode == 2 and done.stderr.startswith("warpcage: error: read-only file system"), done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.skipif(not pathlib.Path("/dev/full").exists(), reason="no /dev/full")
def test_notes_that_cannot_be_written_end_the_run(files, tmp_path, monkeypatch):
    out = tmp_path / "out"
    OutputFolder(out).prepare()
    monkeypatch.setattr("warpcage.studio.jobs.engines.chunk_runner.run_name", lambda: "run")
    monkeypatch.setattr("warpcage.studio.jobs.run.OutputFolder.merge", lambda folder: None)
    (out / ".warpcage" / "notes" / "run-0-1.jsonl").symlink_to("/dev/full")
    report = run_with(files / "jobs.jsonl", out)
    assert "no space left on device" in report.halt and report.left == 12 and not report.failed


def test_only_clusters_need_ray(files, tmp_path):
    """Processes of this machine do without, and without a guard around the program that starts them."""
    program = (
        "import sys\nsys.modules['ray'] = None\nfrom warpcage.studio.cli import main\n"
        "argv = ['run', sys.argv[1], '--device', 'cpu', '--quiet', '-o', sys.argv[2]]\n"
        "assert main([*argv, '--workers', '2', '--item-timeout', '600']) == 0\n"
        "sys.exit(main([*argv[:-1], sys.argv[2] + 'x', '--cluster', '127.0.0.1:6379']))"
    )
    out = tmp_path / "out"
    line = [sys.executable, "-c", program, str(files / "jobs.jsonl"), str(out)]
    done = subprocess.run(line, capture_output=True, text=True)
    assert done.returncode == 2 and len(pictures(out)) == 12
    said = [line for line in done.stderr.splitlines() if "fewer workers" not in line]
    assert len(said) == 1 and said[0].startswith("warpcage: error: --cluster needs Ray: pip install -e ")


def test_a_dry_run_writes_nothing(files, tmp_path, capsys):
    argv = ["run", str(files / "jobs.jsonl"), "-o", str(tmp_path / "out"), "--dry-run", "--device", "cpu"]
    assert main([*argv, "--workers", "2"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "12 items: 0 are there already and unchanged"
    assert said[1] == "12 would be made: 12 frames, in 1 group" and said[3].endswith("by 2 workers")
    assert re.match(MESSAGES["batch.unpaid"].format(items=12), said[4])
    assert main([*argv, "--workers", "2", "--cluster", "10.0.0.1:6379"]) == 0
    shown = capsys.readouterr().out.splitlines()[3:]  # what starts there is not known here
    assert len(shown) == 1 and re.fullmatch(r"about [\d.]+ \w+ by 2 workers", shown[0])
    assert "one frame takes" in said[2] and "shot/f0000" in said[2] and not (tmp_path / "out").exists()
    bad = write_frames(files, 3, "bad.jsonl", changes={0: {"field": "none.npz"}, 1: {"field": "none.npz"}})
    assert main(["run", str(bad), "-o", str(tmp_path / "out"), "--dry-run", "--device", "cpu"]) == 1
    said = capsys.readouterr().err
    assert "none.npz' is not there" in said and "files that 2 items would read are missing" in said


def test_a_dry_run_sees_what_a_killed_run_noted(files, tmp_path, capsys):
    out = tmp_path / "out"
    assert started(files / "jobs.jsonl", out) == 0
    (out / ".warpcage" / "notes").mkdir(exist_ok=True)
    os.replace(out / "manifest.jsonl", out / ".warpcage" / "notes" / "a.jsonl")
    capsys.readouterr()
    assert main(["run", str(files / "jobs.jsonl"), "-o", str(out), "--dry-run", "--device", "cpu"]) == 0
    assert "12 items: 12 are there already" in capsys.readouterr().out and not (out / "manifest.jsonl").exists()


def test_names_in_any_script(tmp_path):
    path, out = write_frames(tmp_path / "jöb", 3, changes={1: {"id": "ベンチ/ä_01"}}), tmp_path / "öut"
    assert run_with(path, out).complete
    assert (out / "ベンチ" / "ä_01.png").is_file() and "ベンチ/ä_01" in records(out)
    assert "ベンチ" in (out / "manifest.jsonl").read_text(encoding="utf-8")
    assert run_with(path, out).kept == 3


def test_progress_says_how_far_it_is(files, tmp_path):
    states = []
    report = warpcage.studio.jobs.run_jobs(files / "jobs.jsonl", tmp_path / "out", device="cpu", progress=states.append)
    assert report.made == 12 and report.complete and warpcage.run_jobs is warpcage.studio.jobs.run_jobs
    assert states[0].stage == "check" and states[-1].done == 12 and states[-1].total == 12
    done = [state.done for state in states if state.stage == "make"]
    assert done == sorted(done) and len(set(done)) > 2


@pytest.mark.parametrize(
    "options",
    [
        {"workers": 0},
        {"workers": "2"},
        {"retries": -1},
        {"retries": 1.5},
        *({"item_timeout": seconds} for seconds in (0, -1.0, float("nan"), "soon")),
    ],
)
def test_options_that_cannot_be_are_refused(files, tmp_path, options):
    refused(lambda: warpcage.run_jobs(files / "jobs.jsonl", tmp_path, **options), match=next(iter(options)))


def test_shards_are_packed_when_their_items_are_settled(tmp_path):
    path, out = write_records(tmp_path / "job", 12, RECORDS), tmp_path / "out"
    report = run_with(path, out)
    assert report.complete and report.made == 12 and left_over(out) == []
    shards = pictures(out)
    assert sorted(shards) == [f"shard-00000{number}.tar" for number in range(3)]
    keys = [record["__key__"] for name in shards for record in read_shard(out / name)]
    assert keys == [f"shot/f{number:04d}" for number in range(12)]
    assert run_with(path, out).kept == 12 and pictures(out) == shards
    (out / "shard-000001.tar").unlink()
    assert run_with(path, out).made == 5 and pictures(out) == shards


def test_a_shard_is_packed_without_what_failed_and_again_with_it(tmp_path):
    path, out = write_records(tmp_path / "job", 12, RECORDS), tmp_path / "out"
    assert run_with(path, out).complete
    whole = pictures(out)
    shutil.rmtree(out)
    write_records(tmp_path / "job", 12, RECORDS, changes={6: {"cage": "none.obj"}})
    report = run_with(path, out)
    assert report.made == 11 and list(report.failed) == ["shot/f0006"]
    assert len(list(read_shard(out / "shard-000001.tar"))) == 4
    write_records(tmp_path / "job", 12, RECORDS)
    assert run_with(path, out).made == 1 and pictures(out) == whole


#: Runs that end where statements put `kill`, each in a fork of a process that has imported all and started nothing yet.
KILLED = """\
import json, os, pathlib, signal, sys, types
sys.path.insert(0, sys.argv[1])
from runs import run_with
from warpcage.studio.jobs import manifest, webdataset, worker  # which a run imports late
from warpcage.studio.jobs.engines import chunk_runner

kill = lambda *given, **options: os.kill(os.getpid(), signal.SIGKILL)
for path, out, statements in json.load(sys.stdin):
    child = os.fork()
    if not child:
        try:
            exec(statements)
            run_with(pathlib.Path(path), pathlib.Path(out))
        finally:
            os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL, statements
"""

KILLS_OF_SHARDS = {
    "before it is packed": "chunk_runner.pack_shard = kill",
    "while it is packed": "webdataset.add_files = kill",
    "before its files are deleted": "webdataset.shutil = types.SimpleNamespace(rmtree=kill)",
}

KILLS = {
    "between files and their note": """append, count = manifest.Notes.append, []
def fatal(notes, record):
    count.append(record['state'])
    if record['state'] == 'done' and count.count('done') == 5: kill()
    append(notes, record)
manifest.Notes.append = fatal""",
    "in the middle of a note": """class Torn(manifest.Notes):
    count = 0
    def append(self, record):
        Torn.count += 1
        if Torn.count == 12: os.write(self.file.fileno(), b'{"id": "shot'); kill()
        super().append(record)
manifest.Notes = Torn""",
    "before the manifest is replaced": "manifest.atomic_path = kill",
    "before notes are removed": """unlink = pathlib.Path.unlink
pathlib.Path.unlink = lambda path, **more: (kill if path.parent.name == 'notes' else unlink)(path, **more)""",
}


@pytest.fixture(scope="module")
def killed(files, tmp_path_factory):
    """The job file and the folder of each killed run, by its step."""
    folder = tmp_path_factory.mktemp("killed")
    shards = write_records(folder / "job", 12, RECORDS)
    runs = {step: (shards if step in KILLS_OF_SHARDS else files / "jobs.jsonl", folder / step.replace(" ", "_"))
            for step in (KILLS_OF_SHARDS | KILLS)}  # fmt: skip
    given = [(str(runs[step][0]), str(runs[step][1]), text) for step, text in (KILLS_OF_SHARDS | KILLS).items()]
    subprocess.run([sys.executable, "-c", KILLED, SUPPORT], input=json.dumps(given), text=True, check=True)
    return runs


@pytest.fixture(scope="module")
def shards(killed, tmp_path_factory):
    """The shards of a run that nothing ended."""
    out = tmp_path_factory.mktemp("shards")
    assert run_with(killed["while it is packed"][0], out).complete
    return pictures(out)


@pytest.mark.parametrize("step", KILLS_OF_SHARDS)
def test_a_kill_while_a_shard_is_packed_loses_nothing(killed, shards, step):
    path, out = killed[step]
    report = run_with(path, out)
    assert report.complete and report.kept >= 5 and pictures(out) == shards and left_over(out) == []
    assert len(records(out)) == 12


@pytest.mark.parametrize("step", KILLS)
def test_a_kill_at_any_step_loses_nothing(killed, step):
    path, out = killed[step]
    report = run_with(path, out)
    noted = {"between files and their note": 4, "in the middle of a note": 0}.get(step, 12)
    assert report.complete and report.kept >= noted and report.kept + report.made == 12
    assert len(records(out)) == len(pictures(out)) == 12 and left_over(out) == []


def test_a_shard_that_cannot_be_packed_is_reported(tmp_path, monkeypatch):
    path, out = write_records(tmp_path / "job", 12, RECORDS), tmp_path / "out"
    with monkeypatch.context() as patch:

        def fails(folder, shard, records):
            if shard == 1:
                raise RuntimeError("no tar today")
            return pack_shard(folder, shard, records)

        patch.setattr("warpcage.studio.jobs.engines.chunk_runner.pack_shard", fails)
        report = run_with(path, out)
    assert report.failed == {"shard-000001.tar": "RuntimeError: no tar today"} and report.made == 12
    assert run_with(path, out).complete and len(list(out.glob("*.tar"))) == 3 and left_over(out) == []


def test_workers_that_do_not_pay_are_reported_as_soon_as_an_item_is_timed(tmp_path):
    """Processes take longer to start than a few small items take to be made."""
    path, reports = write_frames(tmp_path / "job", 40), []
    report = run_with(path, tmp_path / "out", Making, workers=2, progress=reports.append, warn=reports.append)
    lines = [each for each in reports if isinstance(each, str)]
    assert report.complete and len(lines) == 1
    assert re.match(MESSAGES["batch.unpaid"].format(items=40), lines[0])
    assert 0 < reports[reports.index(lines[0]) - 1].done < 40 == reports[-1].done
    assert unpaid(2, 12, 11.9, 1.4) == (
        "2 workers took 11.9 s to start and 1.4 s for 12 items: fewer workers would have been quicker, they pay for "
        "longer work"
    )
    assert unpaid(2, 12, 1.4, 1.5) is None and unpaid(4, 9, 2.9, 1.0) is None and unpaid(4, 9, 3.1, 1.0) is not None
