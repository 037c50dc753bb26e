"""Long work of the editor: order, progress, cancelling, failures."""

import threading

import pytest
from messages import MESSAGES

from warpcage.core import atomic_path
from warpcage.studio.editor import MAX_JOBS, MAX_UNFINISHED, Jobs, Outcome

WAIT = 20.0


def finished(jobs):
    assert jobs.wait(WAIT)
    return jobs.section()


def test_a_job_reports_its_progress_and_its_result():
    sections = []
    jobs = Jobs(lambda: sections.append(jobs.section()))

    def work(progress):
        for k in range(4):
            progress(k / 4, f"step {k}")
        return Outcome("four steps", "/download/steps")

    number = jobs.start("Steps", "count", work)
    (job,) = finished(jobs)
    assert job == {"id": number, "name": "Steps", "share": 1.0, "text": "", "state": "done",
                   "download": "/download/steps", "result": "four steps"}  # fmt: skip
    steps = [(entry[0]["share"], entry[0]["text"]) for entry in sections if entry[0]["text"].startswith("step")]
    assert [step for k, step in enumerate(steps) if k == 0 or step != steps[k - 1]] == [
        (k / 4, f"step {k}") for k in range(4)
    ]
    assert sections[-1][0]["state"] == "done"
    jobs.clear(number)
    assert jobs.section() == [] and sections[-1] == []


def test_a_listener_gets_each_percent_once():
    calls = []
    jobs = Jobs(lambda: calls.append(1))
    jobs.start("many", "count", lambda progress: [progress(k / 10000, "works") for k in range(10000)] and None)
    finished(jobs)
    assert 100 <= len(calls) <= 105


def test_one_at_a_time_of_each_kind_in_their_order():
    jobs, running, most, order = Jobs(), {"a": 0, "b": 0}, {"a": 0, "b": 0}, []
    both, go = threading.Barrier(2), threading.Event()

    def work(kind, name, meets):
        def run(progress):
            running[kind] += 1
            most[kind] = max(most[kind], running[kind])
            if meets:
                both.wait(WAIT)  # the first of each kind run side by side
                assert go.wait(WAIT)
            order.append(name)
            running[kind] -= 1

        return run

    for k in range(3):
        jobs.start(f"a{k}", "a", work("a", f"a{k}", k == 0))
    jobs.start("b0", "b", work("b", "b0", True))
    assert [job["text"] for job in jobs.section()][1:3] == ["waits for the one before"] * 2
    go.set()
    assert all(job["state"] == "done" for job in finished(jobs))
    assert most == {"a": 1, "b": 1} and [name for name in order if name[0] == "a"] == ["a0", "a1", "a2"]


def test_a_cancelled_job_stops_at_its_next_progress_and_leaves_nothing_half_written(tmp_path):
    jobs, begun, go = Jobs(), threading.Event(), threading.Event()

    def work(progress):
        with atomic_path(tmp_path / "film.mp4") as temporary:
            temporary.write_bytes(b"half")
            begun.set()
            assert go.wait(WAIT)
            progress(0.5)
            raise AssertionError("not reached")

    number = jobs.start("film", "export", work)
    second = jobs.start("waits", "export", lambda progress: Outcome("ran"))
    third = jobs.start("runs", "export", lambda progress: Outcome("ran"))
    assert begun.wait(WAIT)
    jobs.cancel(second)
    assert jobs.job(second).state == "cancelled"  # at once: it had not begun
    jobs.cancel(number)
    assert (jobs.job(number).state, jobs.job(number).text) == ("running", "is being cancelled")
    with pytest.raises(ValueError, match="still running: cancel it first"):
        jobs.clear(number)
    go.set()
    states = {job["id"]: job["state"] for job in finished(jobs)}
    assert states == {number: "cancelled", second: "cancelled", third: "done"}
    assert list(tmp_path.iterdir()) == []
    jobs.cancel(third)  # finished: it stays what it is
    assert jobs.job(third).state == "done"


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (ValueError("the cage\n  is open"), "the cage is open"),
        (OSError(28, "No space left on device", "film.mp4"), "no space left on device 'film.mp4'"),
        (MemoryError(), "not enough memory"),
        (KeyError("rest"), "KeyError: 'rest'"),
        (SystemExit(3), "SystemExit: 3"),
    ],
)
def test_a_failed_job_says_why_in_one_line(error, line):
    def work(progress):
        raise error

    jobs = Jobs()
    jobs.start("fails", "any", work)
    jobs.start("next", "any", lambda progress: None)
    first, second = finished(jobs)
    assert (first["state"], first["result"], first["share"]) == ("failed", line, None)
    assert second["state"] == "done"


def test_a_listener_that_fails_does_not_stop_the_work():
    def listener():
        raise RuntimeError("a broken listener")

    jobs = Jobs(listener)
    jobs.start("works", "any", lambda progress: progress(0.5) or Outcome("done"))
    assert finished(jobs)[0]["result"] == "done"


def test_the_number_of_jobs_is_bounded():
    jobs, go = Jobs(), threading.Event()
    for k in range(MAX_UNFINISHED):
        jobs.start(f"{k}", "same", lambda progress: go.wait(WAIT) and None)
    with pytest.raises(ValueError, match=MESSAGES["editor.jobs_unfinished"]):
        jobs.start("more", "same", lambda progress: None)
    go.set()
    finished(jobs)
    for k in range(MAX_JOBS):
        jobs.start(f"later {k}", "same", lambda progress: None)
        assert jobs.wait(WAIT)
    section = jobs.section()
    assert len(section) == MAX_JOBS and section[0]["name"] == "later 0"
    with pytest.raises(ValueError, match=MESSAGES["editor.no_job"]):
        jobs.cancel(1)


def test_closing_cancels_all_and_waits():
    jobs, begun = Jobs(), threading.Event()

    def work(progress):
        begun.set()
        while True:
            progress(None, "works")

    jobs.start("endless", "a", work)
    jobs.start("waits", "a", work)
    assert begun.wait(WAIT) and jobs.close(WAIT)
    assert [job["state"] for job in jobs.section()] == ["cancelled", "cancelled"]
    with pytest.raises(ValueError, match="closing"):
        jobs.start("late", "a", work)
