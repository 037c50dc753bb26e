"""Who makes what: chunks, deaths, retries and stragglers, under a virtual clock. The code is that of real runs."""

import numpy as np
import pytest
from batch_simulation import Conditions, SimulatedEngine

from warpcage.studio.jobs import ChunkQueue, ChunkReport, Dispatcher, Driver


def simulated(count=2000, workers=8, group_count=5, retries=2, aim=10.0, progress=None, **options):
    """A run; returns dispatcher, engine and the seconds that it took. `progress` is called with driver and engine."""
    groups = np.sort(np.random.default_rng(3).integers(0, group_count, count))
    options.setdefault("item_seconds", np.full(count, 0.5))
    options.setdefault("speeds", np.ones(workers))
    engine = SimulatedEngine(Conditions(groups=groups, **options))
    dispatcher = Dispatcher(ChunkQueue(np.arange(count), groups, aim=aim), retries=retries)
    for number in range(workers):
        dispatcher.add_worker(str(number))

    driver = Driver(dispatcher, engine, engine, progress=lambda: progress and progress(driver, engine))
    driver.run()
    return dispatcher, engine, engine.now()


def test_a_run_that_is_stopped_ends_what_is_begun_and_no_more():
    stopped = []

    def look(driver, engine):
        if engine.now() >= 40 and not stopped:
            stopped.append(engine.now())
            driver.stop()

    dispatcher, engine, seconds = simulated(progress=look)
    assert seconds < stopped[0] + 0.6  # an item takes half a second
    assert 0 < dispatcher.done == engine.made.sum() < 2000 and engine.made.max() == 1
    assert dispatcher.left == 2000 - dispatcher.done


def test_every_item_is_made_once():
    dispatcher, engine, seconds = simulated()
    assert (engine.made == 1).all() and dispatcher.done == 2000 and not dispatcher.left
    assert seconds < 1.1 * (2000 * 0.5 / 8) + 2  # all are at work nearly all of the time


@pytest.mark.parametrize("write_seconds", [0.0, 2.0])
@pytest.mark.parametrize("seed", [*range(3), *(pytest.param(seed, marks=pytest.mark.nightly) for seed in range(3, 12))])
def test_nothing_is_lost_or_made_twice_whatever_happens(seed, write_seconds):
    """By many workers, with files that take longer than most items: they have several chunks, and die with all."""
    random = np.random.default_rng(seed)
    count, workers = int(random.integers(1, 3000)), int(random.integers(2, 40))
    some = random.permutation(count)
    poison, bad = frozenset(some[:3].tolist()), frozenset(some[3:9].tolist())
    dispatcher, engine, _ = simulated(
        count,
        workers,
        int(random.integers(1, count + 1)),
        item_seconds=random.gamma(2.0, 0.5, count),
        speeds=random.choice([1.0, 1.0, 1.0, 12.0], workers),
        load_seconds=random.choice([0.0, 3.0]),
        write_seconds=write_seconds,
        overlapping=True,
        deaths_per_hour=60.0,
        flaky=0.05,
        stalls=(0.05, 50.0),
        poison=poison,
        bad=bad,
        seed=seed,
        retries=6,
    )
    failed = set(dispatcher.failures)
    assert poison | bad <= failed and len(failed - poison - bad) <= 2
    others = np.ones(count, bool)
    others[list(failed)] = False
    assert (engine.made[others] == 1).all() and not engine.made[~others].any()
    assert dispatcher.done + len(dispatcher.failures) == count and not dispatcher.left
    assert all("bad input" in dispatcher.failures[item] for item in bad)
    assert all("7 times" in dispatcher.failures[item] for item in poison)


def test_workers_stay_with_what_they_have_loaded():
    loads = []
    for group_count in (8, 80):
        _, engine, _ = simulated(4000, 8, group_count, load_seconds=1.0)
        loads.append(engine.worked - 0.5 * 4000)
    assert loads[0] < 2.5 * 8 and loads[1] < 1.3 * 80  # seconds, one a load


def test_small_groups_go_together():
    _dispatcher, engine, _ = simulated(20_000, 4, 20_000, item_seconds=np.full(20_000, 0.001))
    assert engine.chunks < 400 and (engine.made == 1).all()


def test_chunks_follow_what_items_take():
    """Ten seconds a chunk: a few slow items, or many quick ones, at most 256, as the first is; and few at the end."""
    sizes = {}
    for seconds in (0.01, 1.0, 30.0):
        taken = []
        chunks = ChunkQueue(np.arange(100_000), np.zeros(100_000))
        for _ in range(50):
            taken.append(len(chunks.take(0, 10)[0]))
            chunks.note(0, seconds)
        sizes[seconds] = taken
    assert {taken[0] for taken in sizes.values()} == {256} and set(sizes[0.01][1:]) == {256}
    assert set(sizes[1.0][1:]) == {10} and set(sizes[30.0][1:]) == {1}
    for seconds, first in ((0.1, 13), (0.001, 50)):
        chunks = ChunkQueue(np.arange(100), np.zeros(100))
        chunks.note(0, seconds)
        taken = []
        while chunks.left:
            taken.append(len(chunks.take(0, 2)[0]))
        assert taken[0] == first and taken[-1] == 1 and sum(taken) == 100 and taken == sorted(taken, reverse=True)


def test_the_last_chunks_are_as_short_as_all_can_have_and_no_shorter():
    """A worker waits for its files at the end of each: few chunks, whose last ones end together."""
    count, workers = 2000, 2
    chunks = ChunkQueue(np.arange(count), np.zeros(count), aim=2.0)
    chunks.note(0, 0.01)
    free, taken = [0.0] * workers, []
    while chunks.left:
        name = int(np.argmin(free))
        taken.append(len(chunks.take(0, workers)[0]))
        free[name] += 0.07 + 0.01 * taken[-1]
    assert len(taken) < 40 and max(free) - min(free) < 0.1
    assert all(size >= 50 for size in taken[:-8])


def test_a_chunk_of_which_nothing_is_known_ends_with_its_time():
    """An hour an item or a millisecond: what is not begun within the seconds of a chunk goes to others."""
    for seconds, made in ((3600.0, 1), (1.0, 10), (0.01, 250)):
        chunks = ChunkQueue(np.arange(1000), np.zeros(1000), aim=9.5)
        dispatcher, engine = (
            Dispatcher(chunks),
            SimulatedEngine(
                Conditions(np.full(1000, seconds), np.zeros(1000), np.ones(2), load_seconds=min(seconds, 0.5))
            ),
        )
        dispatcher.add_worker("0")
        chunk = dispatcher.next_chunk("0", 0.0)
        assert len(chunk.items) == 250 and chunk.seconds == 9.5
        engine.submit("0", "run", chunk)
        report = engine.wait(1e6)[0].found
        assert report.loading and report.done == list(range(made)) and report.left == list(range(made, 250))
        dispatcher.reported("0", report)
        following = dispatcher.next_chunk("0", 1e6)
        assert following.seconds is None and following.items[0] == made and dispatcher.left == 1000 - made


def test_one_item_alone_says_little_beside_a_chunk_and_what_was_loaded_nothing():
    """The first item loads its field until its chunk's time is over; one that is made alone waits for its files."""
    dispatcher = Dispatcher(ChunkQueue(np.arange(10_000), np.zeros(10_000), aim=2.0))
    dispatcher.add_worker("a")
    sizes = []
    for step in range(6):
        chunk = dispatcher.next_chunk("a", 0.0)
        made = chunk.items if step else chunk.items[:1]
        sizes.append(len(made))
        each = 4.0 if not step else 0.1 if len(made) == 1 else 0.01
        report = ChunkReport(list(made), [each] * len(made), left=list(chunk.items[len(made) :]), loading=not step)
        dispatcher.reported("a", report)
    assert sizes[:2] == [1, 1] and sizes[2] in (19, 20) and sizes[-1] >= 150
    before = dispatcher.chunks.seconds(0)
    chunk = dispatcher.next_chunk("a", 0.0)
    dispatcher.reported("a", ChunkReport(done=chunk.items[:1], seconds=[5.0], left=chunk.items[1:], loading=True))
    assert dispatcher.chunks.seconds(0) == before


def test_what_is_thought_of_items_stays_near_the_truth():
    """However many chunks there are, and however much what they take varies."""
    random, workers = np.random.default_rng(0), 20
    dispatcher = Dispatcher(ChunkQueue(np.arange(60_000), np.zeros(60_000), largest=1))
    for number in range(workers):
        dispatcher.add_worker(str(number))
    for turn in range(50_000):
        name = str(turn % workers)
        chunk = dispatcher.next_chunk(name, 0.0)
        slow = 6.0 if name == "3" else 1.0
        dispatcher.reported(name, ChunkReport(done=chunk.items, seconds=[slow * random.lognormal(0.0, 1.0)]))
        assert turn <= 1000 or turn % 100 != 3 or 0.3 < dispatcher.chunks.seconds(0) < 30
    assert dispatcher.done == 50_000


def test_a_straggler_gives_back_what_it_has_not_begun():
    """One of eight is sixty times slower: it costs the items that it has begun."""
    count = 800
    seconds, speeds = np.full(count, 1.0), np.ones(8)
    _, engine, alone = simulated(count, 8, 1, item_seconds=seconds)
    speeds[0] = 60.0  # from the beginning: that is unknown until its first item is made
    dispatcher, engine, slow = simulated(count, 8, 1, item_seconds=seconds, speeds=speeds)
    assert (engine.made == 1).all() and dispatcher.done == count
    assert slow < 60 + 1.25 * count / 7 and alone < 1.1 * count / 8 + 2


def test_a_worker_is_asked_again_for_what_it_still_holds():
    """Once its first answer is there, and not before."""
    dispatcher = Dispatcher(ChunkQueue(np.arange(40), np.zeros(40), aim=100.0, whole=True))
    dispatcher.chunks.note(0, 1.0)
    dispatcher.add_worker("a")
    chunk = dispatcher.next_chunk("a", 0.0)
    for back in (chunk.items[20:], chunk.items[10:20]):
        assert dispatcher.recalls(1, 1.0) == [("a", chunk.number, 0.5)] and dispatcher.recalls(1, 2.0) == []
        dispatcher.returned("a", chunk.number, back)
        dispatcher.add_worker(f"b{back[0]}")
        assert list(dispatcher.next_chunk(f"b{back[0]}", 2.0).items) == back
        dispatcher.reported(f"b{back[0]}", ChunkReport(done=back, seconds=[1.0] * len(back)))
    assert dispatcher.done == 30 and dispatcher.left == 10


def test_a_chunk_that_ends_while_it_is_asked_back_is_counted_once():
    for report_first in (True, False):
        dispatcher = Dispatcher(ChunkQueue(np.arange(40), np.zeros(40), aim=100.0))
        dispatcher.chunks.note(0, 1.0)
        for name in "ab":
            dispatcher.add_worker(name)
        chunk = dispatcher.next_chunk("a", 0.0)
        made, back = chunk.items[:2], chunk.items[2:]
        answers = [
            lambda d=dispatcher, made=made, back=back: d.reported(
                "a", ChunkReport(done=made, seconds=[1, 1], left=back)
            ),
            lambda d=dispatcher, chunk=chunk, back=back: d.returned("a", chunk.number, back),
        ]
        for answer in answers if report_first else reversed(answers):
            answer()
        assert dispatcher.left == 38 == dispatcher.chunks.left
