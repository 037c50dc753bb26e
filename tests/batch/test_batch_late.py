"""Items that take too long: which is under way for how long, and when workers are asked. With processes: the kills."""

import concurrent.futures
import contextlib
import threading
import time
import types

import pytest
from messages import MESSAGES
from runs import Making, write_frames

import warpcage
from warpcage.batch import Chunk, ChunkRunner, JobFile, OutputFolder


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return write_frames(tmp_path_factory.mktemp("jobs") / "job", 12).parent


@pytest.mark.parametrize("seconds", [0, -1.0, float("nan"), "soon"])
def test_limits_of_time_that_cannot_be_are_refused(files, tmp_path, seconds):
    with pytest.raises(ValueError, match=MESSAGES["batch.item_timeout"]):
        warpcage.run_jobs(files / "jobs.jsonl", tmp_path / "out", item_timeout=seconds)


class Held(Making):
    """Ends items and the writing of their files when a test says so."""

    def __init__(self, out):
        super().__init__("", out, "cpu")
        self.begun, self.go, self.written = threading.Semaphore(0), threading.Semaphore(0), []

    def submit(self, item, out=None):
        self.begun.release()
        assert self.go.acquire(timeout=60)
        self.written.append(concurrent.futures.Future())
        return self.written[-1]


def test_the_item_that_is_under_way_for_longest_is_known(files, tmp_path):
    """From its beginning until its files are written, whatever was begun later."""
    maker, folder = Held(tmp_path), OutputFolder(tmp_path / "out")
    folder.prepare()
    with JobFile(files / "jobs.jsonl") as job, contextlib.closing(folder.new_notes("a")) as notes:
        runner = ChunkRunner(maker, job.reader.item, lambda item: "", notes, {})
        lines = [(job.data(index), job.line(index)) for index in (3, 7)]
        assert runner.oldest(1) is None
        working = threading.Thread(target=runner.run, args=[Chunk(1, [3, 7], [0, 0], 0, lines=lines)])
        working.start()
        assert maker.begun.acquire(timeout=60)
        index, first = runner.oldest(1)
        assert index == 3 and runner.oldest(2) is None
        assert runner.oldest(1)[1] >= first >= 0.0
        maker.go.release()
        assert maker.begun.acquire(timeout=60)  # of the second; the files of the first are being written
        assert runner.oldest(1)[0] == 3
        maker.written[0].set_result({"a": 1})
        assert runner.oldest(1)[0] == 7
        maker.go.release()
        while len(maker.written) < 2:
            time.sleep(0.01)
        maker.written[1].set_result({"b": 1})
        working.join(60)
        assert runner.oldest(1) is None and runner.report.done == [3, 7]


class Timed(Making):
    """Makes items within seconds of a clock that stands else; their files are there at once."""

    def __init__(self, clock, seconds):
        super().__init__("", ".", "cpu")
        self.clock, self.left = clock, iter(seconds)

    def submit(self, item, out=None):
        self.clock.passed += next(self.left)
        made = concurrent.futures.Future()
        made.set_result({item.id: 1})
        return made


def test_a_chunk_ends_with_its_time_and_loading_is_told_apart(files, tmp_path, monkeypatch):
    """The first item loads: what it takes is not what others take."""
    clock = types.SimpleNamespace(passed=0.0, perf_counter=lambda: clock.passed)
    monkeypatch.setattr("warpcage.batch.chunk_runner.time", clock)
    folder = OutputFolder(tmp_path / "out")
    folder.prepare()

    with JobFile(files / "jobs.jsonl") as job, contextlib.closing(folder.new_notes("a")) as notes:
        maker = Timed(clock, [2.0, 0.25, 0.25, 0.25, 5.0, 0.25, 8.0, 0.25])
        runner = ChunkRunner(maker, job.reader.item, lambda item: "", notes, {})

        def run(number, indices, seconds):
            lines = [(job.data(index), job.line(index)) for index in indices]
            return runner.run(Chunk(number, indices, [0] * len(indices), 0, seconds=seconds, lines=lines))

        first = run(1, [0, 1, 2, 3, 4, 5, 6], 7.9)
        assert first.loading and first.done == [0, 1, 2, 3, 4, 5] and first.left == [6]
        assert first.seconds == [2.0, 0.25, 0.25, 0.25, 5.0, 0.25]
        alone = run(2, [6], 1.0)
        assert alone.done == [6] and alone.seconds == [8.0] and not alone.loading and runner.recall(2, 1.0) == []
