"""Encoding beside rendering: order, what may wait, errors and interrupts of either side, and the same files."""

import os
import re
import signal
import threading
import weakref
from unittest import mock

import numpy as np
import pytest
from messages import MESSAGES
from refusals import refused
from runs import DEFORMED, SMALL, run, succeed

import warpcage.studio.films.video as film
from warpcage.studio.films import SPARE, BackgroundWriter, stream
from warpcage.studio.films import render as commands
from warpcage.studio.films.render import Look
from warpcage.studio.films.video import write_film

#: Seconds until a test that hangs fails.
PATIENCE = 60.0


class Sized:
    """An item of a size, whose end can be seen."""

    def __init__(self, number, nbytes=0):
        self.number, self.nbytes = number, nbytes


def test_items_come_in_order_however_long_each_takes():
    first = threading.Event()

    def prepare(number):
        if number == 0:
            assert first.wait(PATIENCE)  # until a later one is ready
        else:
            first.set()
        return number * number

    got = []
    stream(range(50), prepare, got.extend, threads=3)
    assert got == [number * number for number in range(50)]


def test_items_are_taken_while_those_before_are_consumed():
    """The consumer of the first waits until the second was taken: one after the other would wait for ever."""
    second = threading.Event()

    def items():
        yield 0
        second.set()
        yield 1

    def consume(numbers):
        assert next(numbers) == 0 and second.wait(PATIENCE)
        assert list(numbers) == [1]

    stream(items(), lambda number: number, consume)


@pytest.mark.parametrize(("threads", "nbytes", "room", "most"), [(2, 0, 10, 2 + SPARE), (2, 6, 10, 1), (3, 5, 10, 2)])
def test_few_items_wait_for_a_slow_consumer(threads, nbytes, room, most):
    alive, seen, taken = weakref.WeakSet(), [], []

    def items():
        for number in range(60):
            item = Sized(number, nbytes)
            alive.add(item)
            taken.append(number)
            yield item
            del item

    def consume(numbers):
        for number in numbers:
            threading.Event().wait(0.002)  # a slow one: the others have all the time to run ahead
            seen.append((taken[-1] - number, len(alive)))

    stream(items(), lambda item: item.number, consume, threads=threads, room=room)
    assert len(seen) == 60
    # one more is taken, and waits at the gate
    assert max(ahead for ahead, _ in seen) <= most and max(held for _, held in seen) <= most + 1


@pytest.mark.parametrize("where", ["items", "prepare", "consume"])
@pytest.mark.parametrize("error", [ValueError("no"), KeyboardInterrupt()])
def test_the_first_error_is_raised_and_the_consumer_ends(where, error):
    ended, taken, threads = [], [], threading.active_count()

    def fail(place, number):
        if place == where and number == 5:
            raise error
        return number

    def items():
        for number in range(1000):
            taken.append(number)
            yield fail("items", number)

    def consume(numbers):
        try:
            for number in numbers:
                fail("consume", number)
            ended.append("whole")
        except BaseException:
            ended.append("error")
            raise

    with pytest.raises(type(error)) as caught:
        stream(items(), lambda number: fail("prepare", number), consume, threads=2)
    assert caught.value is error and ended == ["error"] and len(taken) < 20
    assert threading.active_count() == threads


def test_an_interrupt_while_the_end_is_written_waits_for_the_consumer():
    begun, ended = threading.Event(), []

    def consume(numbers):
        list(numbers)
        begun.set()
        os.kill(os.getpid(), signal.SIGINT)
        threading.Event().wait(0.05)
        ended.append("end")

    with pytest.raises(KeyboardInterrupt):
        stream(range(3), lambda number: number, consume)
        begun.wait(PATIENCE)
    assert ended == ["end"]


def test_tasks_run_beside_the_block_and_are_done_at_its_end():
    done, second = [], threading.Event()

    def first():
        assert second.wait(PATIENCE)
        done.append(1)

    with BackgroundWriter(threads=2) as beside:
        beside.run(first)
        second.set()  # the block goes on meanwhile
        for number in range(20):
            beside.run(lambda number=number: done.append(number))
    assert len(done) == 21


def test_few_tasks_are_under_way():
    go, begun, handed = threading.Event(), threading.Semaphore(0), []

    def task():
        begun.release()
        assert go.wait(PATIENCE)

    def hand_over():
        with BackgroundWriter(threads=2, room=100) as beside:
            for number in range(10):
                beside.run(task, 30)
                handed.append(number)

    thread = threading.Thread(target=hand_over)
    thread.start()
    assert begun.acquire(timeout=PATIENCE) and begun.acquire(timeout=PATIENCE)
    thread.join(0.05)
    assert len(handed) <= 3  # of 30 bytes each
    go.set()
    thread.join(PATIENCE)
    assert len(handed) == 10


@pytest.mark.parametrize("where", ["task", "block"])
def test_after_an_error_no_task_begins(where):
    done, threads = [], threading.active_count()

    def task(number):
        if where == "task" and number == 3:
            raise OSError("full")
        done.append(number)

    with pytest.raises(OSError, match="full"), BackgroundWriter(threads=1) as beside:
        for number in range(1000):
            beside.run(lambda number=number: task(number))
            if where == "block" and number == 3:
                raise OSError("full")
    assert len(done) < 10 and done == list(range(len(done)))
    assert threading.active_count() == threads


# Films and folders


def moving(count=9, channels=3, size=(34, 47)):
    """A square that moves, all in one array: each frame is written over the one before."""
    frame = np.zeros((*size, channels), np.float32)
    for index in range(count):
        frame[...] = 0.1
        frame[5:20, 3 * index : 3 * index + 12] = np.linspace(0.2, 0.9, channels)
        yield frame


def in_turn(items, prepare, consume):
    consume(map(prepare, items))


@pytest.mark.parametrize(("name", "channels"), [("a.mp4", 3), ("a.gif", 3), ("a.mov", 4), ("a.webm", 4), ("b.mov", 3)])
def test_films_are_those_that_one_thread_writes(tmp_path, monkeypatch, name, channels):
    (tmp_path / "alone").mkdir()
    paths = [tmp_path / name, tmp_path / "alone" / name]
    for path in paths:
        write_film(path, moving(channels=channels, size=(64, 64)), 10)  # multiples of what x264 repeats exactly
        monkeypatch.setattr(film, "stream", in_turn)
    one, two = (np.frombuffer(path.read_bytes(), np.uint8) for path in paths)
    assert one.shape == two.shape
    assert (one != two).sum() <= (16 if name.endswith("webm") else 0)  # its track has a random number, twice


def test_a_gif_that_memory_cannot_hold_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(film, "GIF_LOOK", 4 * 34 * 47 * 3)
    monkeypatch.setattr("warpcage.core.memory.LITTLE", 0)
    monkeypatch.setattr("warpcage.core.memory.free_host_bytes", lambda: 9 * 3 * 34 * 47)
    write_film(tmp_path / "a.gif", moving(9), 10)
    refused(lambda: write_film(tmp_path / "b.gif", moving(30), 10), match=MESSAGES["view.gif_held"])
    assert [path.name for path in tmp_path.iterdir()] == ["a.gif"]


ANIMATE = ("animate", "@ball.npz", *DEFORMED, *SMALL, "--frames", 8, "--quiet", "-o")


def count_frames(monkeypatch, before):
    """A list that grows by each frame that is rendered; before: what is done before some of them, by number."""
    render, count = Look.render, []

    def counted(self, *arguments, **options):
        count.append(1)
        before.get(len(count), lambda: None)()
        return render(self, *arguments, **options)

    monkeypatch.setattr(Look, "render", counted)
    return count


@pytest.mark.parametrize(
    ("output", "error"),
    [(name, kind) for name in ("film.mp4", "frames") for kind in (KeyboardInterrupt, MemoryError)]
    + [("film.gif", MemoryError), ("film.webm", KeyboardInterrupt)],
)
def test_a_film_that_ends_in_the_middle_leaves_nothing_half_written(
    files, tmp_path, capsys, monkeypatch, output, error
):
    with monkeypatch.context() as patch:
        count = count_frames(patch, {5: mock.Mock(side_effect=error("too little"))})
        assert run(files, *ANIMATE, tmp_path / output) == (130 if error is KeyboardInterrupt else 2)
    assert capsys.readouterr().err.count("\n") == 1
    left = sorted(path.name for path in tmp_path.rglob("*") if path.is_file())
    assert len(count) == 5 and not [name for name in left if name.startswith(".")]
    if output != "frames":
        assert left == []
        return
    succeed(files, *ANIMATE, tmp_path / output)  # goes on
    succeed(files, *ANIMATE, tmp_path / "whole")
    for path in (tmp_path / "whole").iterdir():
        assert (tmp_path / output / path.name).read_bytes() == path.read_bytes()


def test_a_film_that_cannot_be_encoded_ends_the_rendering(files, tmp_path, capsys, monkeypatch):
    def full(frame):
        raise OSError(28, "No space left on device")

    count = count_frames(monkeypatch, {})
    monkeypatch.setattr(film, "even_frame", full)
    monkeypatch.setattr("warpcage.studio.films.overlap.SPARE", 0)
    monkeypatch.setattr("warpcage.studio.films.overlap.PREPARING_THREADS", 1)
    assert run(files, *ANIMATE, tmp_path / "film.mp4") == 2
    assert re.fullmatch(MESSAGES["core.no_space"] + "\n", capsys.readouterr().err)
    assert list(tmp_path.iterdir()) == [] and len(count) < 8


def test_a_picture_is_written_while_the_next_are_rendered(files, tmp_path, monkeypatch):
    """The first picture's file waits until the third frame was rendered."""
    write, third = commands.write_picture, threading.Event()
    count_frames(monkeypatch, {3: third.set})

    def waits(path, image, depth, **options):
        assert third.wait(PATIENCE)
        write(path, image, depth, **options)

    monkeypatch.setattr(commands, "write_picture", waits)
    succeed(files, *ANIMATE, tmp_path / "frames")
    assert len(list((tmp_path / "frames").glob("*.png"))) == 8


def test_a_picture_that_cannot_be_written_costs_itself_alone(files, tmp_path, capsys, monkeypatch):
    write = commands.write_picture

    def fails(path, image, depth, **options):
        if path.name == "frame_0002.png":
            raise OSError(28, "No space left on device", str(path))
        write(path, image, depth, **options)

    with monkeypatch.context() as patch:
        patch.setattr(commands, "write_picture", fails)
        assert run(files, *ANIMATE, tmp_path / "frames") == 2
    assert "no space left on device" in capsys.readouterr().err
    there = sorted((tmp_path / "frames").glob("*"))
    assert "frame_0001.png" in {path.name for path in there} and "frame_0002.png" not in {path.name for path in there}
    stamps = {path: path.stat().st_mtime_ns for path in there if path.suffix == ".png"}
    succeed(files, *ANIMATE, tmp_path / "frames")
    assert {path: path.stat().st_mtime_ns for path in stamps} == stamps
    assert len(list((tmp_path / "frames").glob("frame_*.png"))) == 8
