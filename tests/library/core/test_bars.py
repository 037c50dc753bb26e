"""Bars of long work: on a terminal as tqdm draws them, elsewhere one line a stage, so that logs can be read."""

import contextlib
import os
import re
import struct
import subprocess
import sys

import pytest

from warpcage.core import reports
from warpcage.studio.cli import main

STAGES = """
from warpcage.core import reports
with reports.bar(3, "frames", done=1) as bar:
    for share in ("20 dB", "21 dB"):
        bar.update(1)
        bar.set_postfix_str(share)
assert list(reports.bar(2, "poses", iterable=range(2))) == [0, 1]
with reports.bar(None, "cameras") as bar:
    bar.update(5)
    reports.say_above_bar("too dark")
with reports.bar(4, "check", stays=False) as bar:
    bar.update(4)
with reports.bar(4, "hidden", shown=False) as bar:
    bar.update(4)
"""


def test_a_log_has_one_line_of_each_stage():
    done = subprocess.run([sys.executable, "-c", STAGES], capture_output=True, timeout=120)
    assert done.returncode == 0, done.stderr
    lines = [re.sub(r"\d\d:\d\d", "TIME", line) for line in done.stderr.decode().split("\n")]
    assert lines == [
        "frames: 3/3 in TIME, 21 dB",
        "poses: 2/2 in TIME",
        "warpcage: warning: too dark",
        "cameras: 5 in TIME",
        "",
    ]


def test_a_log_has_a_line_each_ten_seconds(monkeypatch, capsys):
    """Of what is done, of how much, and the time left; a bar that is not shown has none."""
    now = [0.0]
    monkeypatch.setattr("tqdm.std.time", lambda: now[0])
    for shown in (True, False):
        with reports.bar(60, "fit", shown=shown) as bar:
            for _ in range(30):
                now[0] += 1.0
                bar.update(1)
    assert capsys.readouterr().err.splitlines() == [
        "fit: 10/60, about 50 s left",
        "fit: 20/60, about 40 s left",
        "fit: 30/60, about 30 s left",
        "fit: 30/60 in 00:30",
    ]
    with reports.bar(20, "fit") as bar:
        now[0] += 11.0
        bar.set_postfix_str("31 dB, about 5 s left", refresh=False)
        bar.update(10)
    assert capsys.readouterr().err.startswith("fit: 10/20, 31 dB, about 5 s left\n")  # not printed twice


def test_a_terminal_has_bars():
    fcntl, termios = pytest.importorskip("fcntl"), pytest.importorskip("termios")  # not on Windows
    ours, theirs = os.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))  # it has no width of its own
    child = subprocess.Popen([sys.executable, "-c", STAGES], stderr=theirs)
    os.close(theirs)
    shown = b""
    while True:
        try:
            part = os.read(ours, 65536)
        except OSError:  # the other end is closed
            break
        if not part:
            break
        shown += part
    os.close(ours)
    assert child.wait(timeout=60) == 0
    assert b"\r" in shown and b"100%" in shown and b"warpcage: warning: too dark" in shown and b"hidden" not in shown


@pytest.mark.parametrize(
    "command",
    ["fit scene -o new.npz --resolution 16 --epochs 1", "animate ball.npz -o turn --frames 3 --size 16 --turn 90"],
)
def test_commands_leave_logs_that_can_be_read(command, files, monkeypatch, capsys):
    monkeypatch.chdir(files)
    assert main([*command.split(), "--device", "cpu"]) == 0
    said = capsys.readouterr().err
    assert "\r" not in said and len(re.findall(rf"^{command.split()[0]}: \d+/\d+ in ", said, re.MULTILINE)) == 1


def test_an_error_of_a_progress_function_ends_work_that_catches_errors():
    calls = []

    def progress(*values):
        calls.append(values)
        raise ValueError("enough")

    @reports.reports_progress
    def work(progress=False):
        for number in range(5):
            with contextlib.suppress(ValueError):
                reports.report_progress(progress, number, 5, "work")

    with pytest.raises(ValueError, match="enough"):
        work(progress=progress)
    assert calls == [(0, 5, "work")]
