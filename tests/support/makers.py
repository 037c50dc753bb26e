"""Makers of items without rendering, that fail, hang, kill their worker, or find the disk full. Processes import them
by name: nothing is imported here that takes time."""

import concurrent.futures
import ctypes
import os
import pathlib
import signal
import threading
import time


class Making:
    """A maker of files without rendering, which runs what it is given before each item."""

    def __init__(self, base, out, device):
        self.out = pathlib.Path(out)

    def before(self, item):
        """What happens first."""

    def submit(self, item, out=None):
        out = out or self.out
        done = concurrent.futures.Future()
        try:
            self.before(item)
            sizes = {}
            for path in item.outputs.values():
                (out / path).parent.mkdir(parents=True, exist_ok=True)
                (out / path).write_text(item.id)
                sizes[path] = len(item.id)
            done.set_result(sizes)
        except Exception as error:
            done.set_exception(error)
        return done

    def close(self):
        pass


def number_of(item):
    return int(item.id[-4:])


class Moody(Making):
    """Items whose number ends in 3 fail twice, in 5 always, in 7 by their input."""

    tried: dict = {}

    def before(self, item):
        count = self.tried[item.id] = self.tried.get(item.id, 0) + 1
        if item.id.endswith("7"):
            raise ValueError("its number ends in 7")
        if item.id.endswith("5") or (item.id.endswith("3") and count < 3):
            raise RuntimeError(f"no luck at try {count}")


class Deadly(Making):
    """Item 5 kills its worker, at once or while files of others may be written."""

    def before(self, item):
        time.sleep(0.01)
        if number_of(item) == 5:
            os.kill(os.getpid(), signal.SIGKILL)


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
            ctypes.PyDLL(None).sleep(60)


class Full(Making):
    """A disk that is full from the tenth item on."""

    def before(self, item):
        if number_of(item) >= 10:
            os.write(os.open("/dev/full", os.O_WRONLY), b"x")


class Hostless(Making):
    def __init__(self, base, out, device):
        raise RuntimeError("no driver of the GPU")
