"""Standard output and error that never turn success into failure: closed, without a reader, or ASCII alone."""

from __future__ import annotations

import contextlib
import errno
import os
import sys
from collections.abc import Callable, Iterator
from typing import Any, TextIO

#: What a stream reports that nobody reads any more.
_GONE = (errno.EPIPE, errno.EBADF)


class SteadyStream:
    """A text stream whose messages are always written; all other attributes are those of the stream it writes to."""

    def __init__(self, stream: TextIO):
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write text, and return its length."""
        encoding = self._stream.encoding or "utf-8"
        try:
            text.encode(encoding, self._stream.errors or "strict")
        except UnicodeEncodeError:
            # Characters that the encoding lacks become escapes.
            text = text.encode(encoding, "backslashreplace").decode(encoding)
        self._attempt(self._stream.write, text)
        return len(text)

    def flush(self) -> None:
        """Hand over what is buffered."""
        self._attempt(self._stream.flush)

    def _attempt(self, action: Callable[..., Any], *arguments: str) -> None:
        try:
            action(*arguments)
        except OSError as error:
            # what is still buffered goes nowhere, or the interpreter would fail at it again at its end
            with contextlib.suppress(OSError), open(os.devnull, "wb") as nowhere:
                os.dup2(nowhere.fileno(), self._stream.fileno())
            # What nobody reads any more is dropped. Other errors, such as a full disk, are raised once.
            if error.errno not in _GONE:
                raise


@contextlib.contextmanager
def steady_streams() -> Iterator[None]:
    """Make sys.stdout and sys.stderr steady for a while."""
    # Those that are closed are opened on nothing. Otherwise the next file that is opened would get one of them, and
    # what libraries print would end in it.
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free: this one
    before = sys.stdout, sys.stderr
    with open(os.devnull, "w", encoding="utf-8") as nowhere:
        # a stream is None where its descriptor was closed when Python started
        sys.stdout, sys.stderr = (SteadyStream(stream or nowhere) for stream in before)
        try:
            yield
        finally:
            for stream in (sys.stdout, sys.stderr):
                with contextlib.suppress(OSError):
                    stream.flush()
            sys.stdout, sys.stderr = before
