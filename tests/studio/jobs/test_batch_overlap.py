"""Chunks that overlap: items of one are made while files of the one before are being written."""

import concurrent.futures
import contextlib
import dataclasses
import json
import queue
import threading
import time
import types

import numpy as np
import pytest
from makers import Making, number_of
from runs import records, run_with, write_frames

from warpcage.studio.jobs import (
    Chunk,
    ChunkQueue,
    ChunkReport,
    ChunkRunner,
    Dispatcher,
    Driver,
    JobFile,
    OutputFolder,
    ProcessEngine,
    RunJournal,
    RunnerSettings,
    Share,
)
from warpcage.studio.jobs.engines import chunk_runner


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return write_frames(tmp_path_factory.mktemp("jobs") / "job", 12).parent


class Writing(Making):
    """Makes items at once; files are there when a test says so."""

    def __init__(self):
        super().__init__("", ".", "cpu")
        self.futures = {}

    def submit(self, item, out=None):
        self.futures[number_of(item)] = found = concurrent.futures.Future()
        return found

    def write(self, *numbers, error=None):
        for number in numbers:
            if error is None:
                self.futures[number].set_result({f"{number}": 1})
            else:
                self.futures[number].set_exception(error)


@contextlib.contextmanager
def runner_of(files, out, maker, **options):
    folder = OutputFolder(out)
    folder.prepare()
    with JobFile(files / "jobs.jsonl") as job, contextlib.closing(folder.new_notes("a")) as notes:
        runner = ChunkRunner(maker, job.reader, lambda item: "", notes, {}, **options)

        def order(number, *indices):
            lines = [(job.data(index), job.line(index)) for index in indices]
            return Chunk(number, list(indices), [0] * len(indices), 0, lines=lines)

        yield runner, order


def test_items_of_a_chunk_are_made_while_files_of_the_one_before_are_written(files, tmp_path):
    maker = Writing()
    with runner_of(files, tmp_path / "out", maker) as (runner, order):
        runner.begin(order(1, 0, 1))
        runner.begin(order(2, 2, 3, 4))
        assert set(maker.futures) == {0, 1, 2, 3, 4}
        assert runner.oldest()[0] == 0 and runner.recall(1, 1.0) == []
        maker.write(2, 3, 4)  # those of the second chunk are there first
        report = runner.settle(2)
        assert (report.done, report.left) == ([2, 3, 4], []) and runner.oldest()[0] == 0
        maker.write(1)
        maker.write(0, error=ValueError("no"))
        report = runner.settle(1)
        assert (report.done, report.failed, report.left) == ([1], [(0, "no")], []) and runner.oldest() is None
    notes = [json.loads(line) for line in (tmp_path / "out/.warpcage/notes/a.jsonl").read_text().splitlines()]
    assert [note.get("lot") for note in notes[:5]] == [1, 1, 2, 2, 2] and len(notes) == 10


class Held(Making):
    """Ends items and the writing of their files when a test says so."""

    def __init__(self):
        super().__init__("", ".", "cpu")
        self.begun, self.go, self.written = threading.Semaphore(0), threading.Semaphore(0), []

    def submit(self, item, out=None):
        self.begun.release()
        assert self.go.acquire(timeout=60)
        self.written.append(concurrent.futures.Future())
        return self.written[-1]


def test_the_item_that_is_under_way_for_longest_is_known(files, tmp_path):
    """From its beginning until its files are written, whatever was begun later."""
    maker = Held()
    with runner_of(files, tmp_path / "out", maker) as (runner, order):
        assert runner.oldest() is None
        reports = []
        working = threading.Thread(target=lambda: reports.append(runner.run(order(1, 3, 7))))
        working.start()
        assert maker.begun.acquire(timeout=60)
        index, first = runner.oldest()
        assert index == 3 and runner.oldest()[1] >= first >= 0.0
        maker.go.release()
        assert maker.begun.acquire(timeout=60)  # of the second; the files of the first are being written
        assert runner.oldest()[0] == 3
        maker.written[0].set_result({"a": 1})
        assert runner.oldest()[0] == 7
        maker.go.release()
        while len(maker.written) < 2:
            time.sleep(0.01)
        maker.written[1].set_result({"b": 1})
        working.join(60)
        assert runner.oldest() is None and reports[0].done == [3, 7]


def test_a_chunk_ends_with_its_time_and_loading_is_distinguished(files, tmp_path, monkeypatch):
    """The first item loads: what it takes is not what others take."""
    clock = types.SimpleNamespace(passed=0.0, perf_counter=lambda: clock.passed)
    monkeypatch.setattr("warpcage.studio.jobs.engines.chunk_runner.time", clock)
    seconds = iter([2.0, 0.25, 0.25, 0.25, 5.0, 0.25, 8.0, 0.25])

    class Timed(Writing):
        def submit(self, item, out=None):
            clock.passed += next(seconds)
            made = super().submit(item)
            self.write(number_of(item))
            return made

    with runner_of(files, tmp_path / "out", Timed()) as (runner, order):
        first = runner.run(dataclasses.replace(order(1, *range(7)), seconds=7.9))
        assert first.loading and first.done == [0, 1, 2, 3, 4, 5] and first.left == [6]
        assert first.seconds == [2.0, 0.25, 0.25, 0.25, 5.0, 0.25]
        alone = runner.run(dataclasses.replace(order(2, 6), seconds=1.0))
        assert alone.done == [6] and alone.seconds == [8.0] and not alone.loading and runner.recall(2, 1.0) == []


def test_a_device_that_is_lost_ends_the_chunk_that_is_made_too(files, tmp_path):
    """The files of a chunk say it, while the next one is being made: that one begins nothing more."""
    maker = Writing()

    def lost():
        raise RuntimeError("no device")

    with runner_of(files, tmp_path / "out", maker, check_device=lost) as (runner, order):
        runner.begin(order(1, 0))
        maker.write(0, error=RuntimeError("illegal address"))
        assert runner.settle(1).broken == "RuntimeError: no device"
        report = runner.run(order(2, 1, 2))
        assert report.left == [1, 2] and set(maker.futures) == {0}


def test_a_worker_has_two_chunks_and_not_three():
    dispatcher = Dispatcher(ChunkQueue(np.arange(100), np.zeros(100), largest=10))
    dispatcher.add_worker("a")
    first = dispatcher.next_chunk("a", 0.0)
    assert not dispatcher.takes("a") and not dispatcher.begun("a", 99) and dispatcher.begun("a", first.number)
    second = dispatcher.next_chunk("a", 0.1)
    assert not dispatcher.begun("a", second.number) and not dispatcher.takes("a") and dispatcher.left == 100
    dispatcher.reported("a", ChunkReport(done=second.items, seconds=[0.1] * 10), second.number)
    assert dispatcher.takes("a") and dispatcher.left == 90 and not dispatcher.finished
    dispatcher.stop()
    assert not dispatcher.finished  # the files of the first
    dispatcher.reported("a", ChunkReport(done=first.items[:9], seconds=[0.1] * 9, left=first.items[9:]), first.number)
    assert dispatcher.finished and dispatcher.done == 19 and dispatcher.left == 81 == dispatcher.chunks.left


@pytest.mark.parametrize("begun_of_second", [0, 2])
def test_a_worker_dies_with_two_chunks(begun_of_second):
    """What it began last is charged, in whichever chunk that is; the others are made again, and each once."""
    dispatcher = Dispatcher(ChunkQueue(np.arange(40), np.repeat([0, 1], 20), largest=10), retries=2)
    for name in "ab":
        dispatcher.add_worker(name)
    chunks = [dispatcher.next_chunk("a", 0.0)]
    assert dispatcher.begun("a", chunks[0].number)
    chunks.append(dispatcher.next_chunk("a", 0.1))
    done, begun = chunks[0].items[:-3], [*chunks[0].items[-3:], *chunks[1].items[:begun_of_second]]
    assert dispatcher.died("a", ChunkReport(done=done, seconds=[0.1] * len(done)), begun, "killed") == []
    assert [dispatcher.attempts[item] for item in begun] == [0] * (len(begun) - 1) + [1]
    made, alone = list(done), []
    while (chunk := dispatcher.next_chunk("b", 1.0)) is not None:
        made += chunk.items
        alone += chunk.items if len(chunk.items) == 1 else []
        dispatcher.reported("b", ChunkReport(done=list(chunk.items), seconds=[0.1] * len(chunk.items)), chunk.number)
    assert sorted(made) == list(range(40)) and dispatcher.done == 40 and dispatcher.finished
    assert set(begun) <= set(alone)  # so that one that kills its worker is known by that


class Scripted:
    """A process that is asked, and answers, as a test says."""

    def __init__(self, settings, play):
        self.settings, self.play, self.futures = settings, play, {}

    def ask(self, name, *given):
        number = given[0].number if name == "begin" else given[0] if given else None
        future = self.futures[name, number] = concurrent.futures.Future()
        self.play(self, name, *given)
        return future

    def answer(self, name, found, number=None):
        self.futures[name, number].set_result(found)

    def kill(self):
        pass

    def wait(self):
        pass


@pytest.fixture
def driven(files, tmp_path, monkeypatch):
    """Runs a job of twelve frames by one worker, whose first process does what a script says: what was seen so far,
    the process, what it is asked, and what it is given. It returns whether that is all; else the process does well."""
    monkeypatch.setattr("warpcage.studio.jobs.run.TICK", 0.01)
    monkeypatch.setattr("warpcage.studio.jobs.engines.chunk_runner.run_name", lambda: "run")
    folder = OutputFolder(tmp_path / "out")
    folder.prepare()
    seen = types.SimpleNamespace(folder=folder, processes=[], orders=[], lines=[], now=0.0)

    def play_of(script, settings):
        first = settings.notes == "run-0-1"

        def play(process, name, *given):
            if name == "begin":
                seen.orders.append((first, given[0]))
            if first and script(seen, process, name, *given):
                return
            if name == "settle":
                items = next(order.items for _, order in seen.orders if order.number == given[0])
                process.answer(name, ChunkReport(done=items, seconds=[1.0] * len(items)), *given)
            elif name in ("facts", "begin"):
                process.answer(name, {}, *(order.number for order in given))

        return play

    def now():
        seen.now += 0.5  # a look at the clock takes time
        return seen.now

    def run(script, **options):
        def start(settings):
            seen.processes.append(Scripted(settings, play_of(script, settings)))
            return seen.processes[-1]

        host = types.SimpleNamespace(start=start, share=Share(2, 0, 0, 1, "cpu"), patience=1e9, work=lambda: None)
        with JobFile(files / "jobs.jsonl") as job:
            journal = RunJournal(job, folder)
            engine = ProcessEngine(host, RunnerSettings("", job.reader, "", "run"))
            engine.now = now
            seen.dispatcher = Dispatcher(ChunkQueue(np.arange(12), np.zeros(12)))
            seen.dispatcher.add_worker("0")
            assert Driver(seen.dispatcher, engine, journal, warn=seen.lines.append, **options).run() is None
            assert seen.dispatcher.done == 12 and not seen.dispatcher.failures
        return seen

    return run


def note(folder, *lines):
    """Notes of the first process: number of an item, of its chunk, and what became of it."""
    with contextlib.closing(folder.new_notes("run-0-1")) as notes:
        for number, chunk, state in lines:
            more = {"lot": chunk} if state == "started" else {"seconds": 1.0}
            notes.append({"id": f"shot/f{number:04d}", "state": state} | more)


def test_chunks_beside_one_whose_device_is_lost_are_as_they_were_noted(driven):
    def script(seen, process, name, *given):
        if name == "begin" and given[0].number == 2:
            lines = [(0, 1, "started"), (3, 2, "started"), (4, 2, "started"), (3, 2, "done")]
            note(seen.folder, *lines)
            process.answer("settle", ChunkReport(errors=[(0, "x")], left=[1, 2], broken="no device"), 1)
        return name == "settle"

    seen = driven(script)
    assert [order.items for first, order in seen.orders if first] == [[0, 1, 2], [3, 4, 5]]
    again = dict(
        pair for first, order in seen.orders if not first for pair in zip(order.items, order.attempts, strict=True)
    )
    assert again == {0: 1} | {index: 0 for index in range(1, 12) if index != 3}
    assert seen.lines == ["worker 0: no device: it is started again"]


def test_a_worker_whose_item_is_late_is_ended_and_that_item_is_blamed(driven):
    """It is asked once an item can be late; what it had besides is made again."""
    asked = []

    def script(seen, process, name, *given):
        if name == "begin" and given[0].number == 2:
            note(seen.folder, (0, 1, "started"), (1, 1, "started"), (3, 2, "started"))
            seen.now = 95.0
        if name == "oldest":
            asked.append(seen.now)
            process.answer(name, (1, 100.5 if len(asked) > 1 else 59.0))
        return name in ("settle", "oldest")

    seen = driven(script, item_timeout=100.0)
    first, second = asked  # it began 59 s before
    assert 100.0 < first < 110.0 and 41.0 <= second - first < 50.0
    assert "the item took longer than 100 s" in seen.lines[0]
    again = [
        pair for first, order in seen.orders if not first for pair in zip(order.items, order.attempts, strict=True)
    ]
    assert sorted(again) == sorted((index, int(index == 1)) for index in range(12)) and len(seen.lines) == 1
    alone = [order.items for first, order in seen.orders if not first and len(order.items) == 1]
    assert all([index] in alone for index in (0, 1, 3))


def test_a_worker_that_is_asked_and_answers_nothing_is_ended(driven):
    def script(seen, process, name, *given):
        if name == "begin" and given[0].number == 2:
            seen.now = 101.0
        if name == "oldest":
            seen.now += 61.0
        return name in ("settle", "oldest")

    seen = driven(script, item_timeout=100.0)
    assert seen.lines == ["worker 0: its worker was ended: it did not answer for 60 s: it is started again"]


@pytest.mark.parametrize("slow", [0.5, 0.0])
def test_one_worker_alone_makes_the_next_chunk_meanwhile(tmp_path, monkeypatch, slow):
    """Unless its items are slow: who watches wants to know of each chunk before the next one is made."""
    monkeypatch.setattr("warpcage.studio.jobs.engines.processes.SLOW", slow)
    events: queue.SimpleQueue[tuple[str, int]] = queue.SimpleQueue()

    class Told(Making):
        pool = concurrent.futures.ThreadPoolExecutor(40)

        def submit(self, item, out=None):
            events.put(("made", number_of(item)))
            found = Making.submit(self, item, out)
            return self.pool.submit(
                lambda: (time.sleep(0.3), events.put(("there", number_of(item))), found.result())[2]
            )

    report = run_with(write_frames(tmp_path / "job", 20), tmp_path / "out", Told)
    reports = [events.get() for _ in range(40)]
    assert report.complete and len(records(tmp_path / "out")) == 20
    # chunks of 5, 4, 3: the second is made before the files of the first are there
    assert (reports.index(("made", 5)) < reports.index(("there", 0))) == (slow > 0.0)


def test_a_field_that_cannot_be_read_fails_with_its_item_alone(files, tmp_path):
    """A field that cannot be read is the item's own fault, not that of the worker's start."""
    changes = {number: {"field": "broken.npz"} for number in range(4)}
    path = write_frames(tmp_path / "job", 5, changes=changes)
    with JobFile(path) as job:
        settings = RunnerSettings(str(path.parent), job.reader, str(tmp_path / "out"), "run", "cpu")
        OutputFolder(tmp_path / "out").prepare()
        runner = chunk_runner.make_runner(settings)
        order = Chunk(1, [0, 4], [0, 0], 0, lines=[(job.data(index), job.line(index)) for index in (0, 4)])
        report = runner.run(order)
        runner.close()
    assert report.done == [4] and "broken.npz is not an .npz field file" in report.failed[0][1]
