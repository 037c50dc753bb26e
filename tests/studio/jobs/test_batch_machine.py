"""The scheduler under whatever may happen, at any step of a run: its code is that of real runs, the clock is not."""

import collections
import threading

import numpy as np
import pytest
from batch_simulation import Conditions, SimulatedEngine
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from warpcage.studio.jobs import Answer, ChunkQueue, Dispatcher, Driver

LIMIT = 30.0  # seconds that an item may take
MAX_WAITS = 5000  # of the driver, until a run that nothing happens to any more has ended

NOTHING = Answer("", "", 0, None)

names = st.sampled_from("012")
places = st.integers(0, 35)


class SteppedEngine(SimulatedEngine):
    """Lets its driver go on when a test says so, and counts what items are to be blamed for."""

    def __init__(self, conditions):
        super().__init__(conditions)
        self.go, self.waiting = threading.Semaphore(0), threading.Semaphore(0)
        self.late: list[Answer] = []  # again, or too late
        self.newest = NOTHING  # the newest answer
        self.blamed, self.packed = collections.Counter(), collections.Counter()
        self.failed_at: dict[int, str] = {}  # workers at which items failed that are to be made elsewhere
        self.packs: dict[int, int] = {}  # shards by the numbers of chunks that pack them
        self.pack_errors, self.full, self.stopped = 0, False, False

    def wait(self, timeout):
        self.waiting.release()
        self.go.acquire()
        self.newest = NOTHING
        answers, self.late = self.late or super().wait(timeout), []
        for self.newest in answers:
            if self.newest.method == "run" and self.newest.error is None:
                self.newest.found.halt = "no space left" if self.full else None
                if self.newest.number in self.packs and self.pack_errors:
                    self.newest.found.pack_error = "no tar today"
                    self.pack_errors -= 1
                elif self.newest.number in self.packs:
                    self.packed[self.packs[self.newest.number]] += 1
        return answers

    def submit(self, worker, method, *given):
        assert not (self.stopped and method in ("run", "begin")), "a chunk is sent after the end"
        if method in ("run", "begin"):
            (chunk,) = given
            assert self.starts[worker] and len(self.works.get(worker, [])) < 2
            if chunk.shard is not None:
                self.packs[chunk.number] = chunk.shard
                assert chunk.attempts[0] <= self.conditions.retries
            else:
                assert list(chunk.attempts) == [self.blamed[item] for item in chunk.items]
                at_home = any(self.failed_at.pop(item, "") == worker for item in chunk.items)
                assert not at_home or self.places() == 1, "an item is tried again where it failed"
        super().submit(worker, method, *given)

    def report(self, work, settled):
        report = super().report(work, settled)
        self.blamed.update(item for item, _ in [*report.errors, *report.failed])
        self.failed_at |= dict.fromkeys([item for item, _ in report.errors], work.worker)
        return report

    def bury(self, worker, death):
        """The item that is late is to blame, else the newest that was begun and whose files are not there."""
        super().bury(worker, death)
        answer, (death, works) = self.newest, self.dead[worker]
        writing = self.conditions.write_seconds
        begun = [
            item
            for work in works
            for item, start, end in zip(work.items, work.starts, work.ends, strict=True)
            if start < death < end + writing
        ]
        if answer.worker == worker and answer.method == "oldest" and answer.found and answer.found[1] > LIMIT:
            begun = [item for item in begun if item == answer.found[0]]
        elif answer.worker == worker and answer.method == "run" and answer.found:
            begun = []
        for item in begun[-1:]:
            self.blamed[item] += 1
            self.failed_at[item] = worker


class Run(RuleBasedStateMachine):
    """A run of some items by three workers, to which something happens between any two answers."""

    @initialize(
        count=st.integers(1, 36),
        sizes=st.integers(1, 12),
        seconds=st.sampled_from([0.05, 0.5, 3.0]),
        write_seconds=st.sampled_from([0.0, 2.0]),
        retries=st.integers(0, 2),
        sharded=st.booleans(),
    )
    def begin(self, count, sizes, seconds, write_seconds, retries, sharded):
        """sizes: items of a group, which is a shard where they are packed."""
        self.count, self.retries, groups = count, retries, np.arange(count) // sizes
        self.bad, self.poison, self.error = set(), set(), None
        self.engine = SteppedEngine(
            Conditions(
                item_seconds=seconds * (1.0 + np.arange(count) % 3),
                groups=groups,
                speeds=np.ones(3),
                load_seconds=0.5,
                write_seconds=write_seconds,
                overlapping=True,
                poison=self.poison,
                bad=self.bad,
                retries=retries,
            )
        )
        chunks = ChunkQueue(np.arange(count), groups, aim=5.0, whole=sharded)
        self.shards = dict(collections.Counter(groups.tolist())) if sharded else None
        self.dispatcher = Dispatcher(chunks, retries=retries, shards=self.shards)
        for name in "012":
            self.dispatcher.add_worker(name)
        self.engine.places = lambda: self.dispatcher.workers
        self.driver = Driver(self.dispatcher, self.engine, self.engine, item_timeout=LIMIT)
        self.thread = threading.Thread(target=self.drive, daemon=True)
        self.thread.start()
        self.engine.waiting.acquire()

    def drive(self):
        try:
            self.driver.run()
        except BaseException as error:
            self.error = error
        self.ended = True
        self.engine.waiting.release()

    ended = False
    running = precondition(lambda self: not self.ended)
    unstopped = precondition(lambda self: not self.ended and not self.engine.stopped)

    @rule(answers=st.integers(1, 6))
    def go_on(self, answers):
        for _ in range(answers):
            if not self.ended:
                self.engine.go.release()
                self.engine.waiting.acquire()
        if self.error is not None and not self.given_up:
            raise self.error

    @property
    def given_up(self):
        """Whether all workers died again and again before they made anything."""
        return "no worker is left" in str(self.error) and not self.dispatcher.workers

    @unstopped
    @rule(workers=st.sets(names, min_size=1, max_size=2))
    def workers_or_their_machine_die(self, workers):
        for name in workers:
            self.engine.kill(name)

    @unstopped
    @rule(name=names, silent=st.booleans())
    def a_worker_hangs(self, name, silent):
        if self.engine.works.get(name):
            self.engine.hang(name)
            self.engine.silent |= {name} if silent else set()

    @unstopped
    @rule(name=names, factor=st.sampled_from([5.0, 60.0]))
    def a_worker_becomes_slow(self, name, factor):
        self.engine.slow(name, factor)

    @unstopped
    @rule(name=names)
    def a_device_is_lost(self, name):
        if self.engine.works.get(name):
            self.engine.broken.add(name)

    @unstopped
    @rule(item=places, times=st.integers(1, 3))
    def an_item_fails(self, item, times):
        self.engine.failing[item % self.count] += times

    @unstopped
    @rule(item=places)
    def an_item_is_bad(self, item):
        if item % self.count not in self.engine.blamed:
            self.bad.add(item % self.count)

    @unstopped
    @rule(item=places)
    def an_item_kills_its_workers(self, item):
        self.poison.add(item % self.count)

    @unstopped
    @rule(name=names, share=st.sampled_from([0.3, 1.0]), seconds=st.sampled_from([0.0005, 20.0]))
    def a_chunk_is_shortened(self, name, share, seconds):
        """The answer may come after the report of the chunk, which says that those items are left, too."""
        self.engine.reply_seconds = seconds
        for work in self.engine.works.get(name, []):
            if name not in self.engine.killed:
                self.engine.submit(name, "recall", work.chunk.number, share)

    @running
    @rule(name=names, number=st.integers(1, 9), answer=st.sampled_from([("begin", None), ("recall", [0])]))
    def a_worker_answers_twice_or_too_late(self, name, number, answer):
        chunks = [work.chunk.number for work in self.engine.works.get(name, []) if not work.begun]
        if self.engine.starts.get(name) and number not in chunks:
            self.engine.late = [Answer(name, answer[0], number, answer[1])]

    @precondition(lambda self: not self.ended and self.shards)
    @rule(times=st.integers(1, 3))
    def a_shard_cannot_be_packed(self, times):
        self.engine.pack_errors += times

    @unstopped
    @rule(how=st.sampled_from(["asked to", "no room"]))
    def it_is_stopped(self, how):
        if how == "asked to":
            self.driver.stop()
            self.engine.stopped = True
        self.engine.full = how == "no room"

    @invariant()
    def each_item_is_somewhere_once(self):
        if not hasattr(self, "engine"):
            return
        made, failures = self.engine.made, self.dispatcher.failures
        assert made.max() <= 1 and not made[list(failures)].any(), "made twice"
        assert self.dispatcher.done == made.sum(), "what is made and what is counted differ"
        assert self.dispatcher.done + len(failures) + self.dispatcher.left == self.count, "lost"
        held = [item for works in self.engine.works.values() for work in works for item in work.items]
        assert len(held) == len(set(held)) and not made[held].any() and not failures.keys() & set(held), "two have it"
        for item, count in self.engine.blamed.items():
            assert count <= self.retries + 1 and (count <= self.retries or item in failures or item in self.bad)

    def teardown(self):
        """What is not stopped makes all but what was to be blamed too often, now that nothing happens any more."""
        if not hasattr(self, "engine"):
            return
        for _ in range(MAX_WAITS):
            if not self.ended:
                self.go_on(1)
        assert self.ended, "it does not end"
        self.each_item_is_somewhere_once()
        assert not any(self.engine.works.values()), "what is begun is not waited for"
        failures, blamed = self.dispatcher.failures, self.engine.blamed
        assert all(item in self.bad or blamed[item] == self.retries + 1 for item in failures)
        if not self.given_up and not self.dispatcher.stopped:
            assert self.dispatcher.left == 0
            unpacked = [shard for shard, _ in self.dispatcher.unpacked]
            packed = {**self.engine.packed, **dict.fromkeys(unpacked, 1)}
            assert packed == dict.fromkeys(self.shards or (), 1) and len(set(unpacked)) == len(unpacked)


@pytest.mark.scaled
def test_whatever_happens_nothing_is_lost_or_made_twice():
    examples = 8 * settings.default.max_examples  # each takes a fiftieth of a second
    run_state_machine_as_test(Run, settings=settings(max_examples=examples))


def test_a_shard_that_is_packed_by_a_worker_whose_device_is_lost_is_packed_again():
    """The other chunk of that worker says that the device is lost."""
    run = Run()
    run.begin(count=4, sizes=1, seconds=0.05, write_seconds=2.0, retries=1, sharded=True)
    run.go_on(4)
    run.a_device_is_lost("0")
    run.teardown()
    assert not run.dispatcher.left and sum(run.engine.packed.values()) == 4
