"""Makers of items that hang, kill their worker, or find the disk full; processes import them by name."""

import concurrent.futures
import os
import re
import signal
import threading
import time

from runs import Making, number_of


class Late(Making):
    """Files are there a while after the next items were begun. Item 23 kills its worker in the midst of that."""

    def __init__(self, base, out, device):
        super().__init__(base, out, device)
        self.pool = concurrent.futures.ThreadPoolExecutor(40)

    def submit(self, item, out=None):
        if number_of(item) == 23 and not (self.out / ".warpcage" / "died").exists():
            (self.out / ".warpcage" / "died").write_text("")
            os.kill(os.getpid(), signal.SIGKILL)

        def write():
            time.sleep(0.3)
            return Making.submit(self, item, out).result()

        time.sleep(0.01)
        return self.pool.submit(write)


def count_made(out):
    return sum(path.is_file() and ".warpcage" not in path.parts for path in out.rglob("*.png"))


class Waiting(Making):
    def before(self, item):
        end = time.monotonic() + 60
        while number_of(item) == 0 and count_made(self.out) < 59 and time.monotonic() < end:
            time.sleep(0.05)


class Endless(Making):
    """Item 5 is never made."""

    def before(self, item):
        if number_of(item) == 5:
            threading.Event().wait()


class Unwritten(Making):
    """The files of item 5 are never written, while others are made."""

    def submit(self, item, out=None):
        done = super().submit(item, out)
        return concurrent.futures.Future() if number_of(item) == 5 else done


class Deaf(Making):
    """Item 3 keeps the interpreter to itself: no other thread of its process runs, nor answers."""

    def before(self, item):
        if number_of(item) == 3:
            re.match("(a+)+$", "a" * 60 + "b")


class Full(Making):
    """A disk that is full from the tenth item on."""

    def before(self, item):
        if number_of(item) >= 10:
            os.write(os.open("/dev/full", os.O_WRONLY), b"x")


class Hostless(Making):
    def __init__(self, base, out, device):
        raise RuntimeError("no driver of the GPU")
