"""A film that plays: the session moves along it in real time."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable

from ...films.session import timeline
from ..session import Session

_log = logging.getLogger(__name__)

#: The shortest time between two pictures of a film that plays, and the longest that one is waited for, seconds.
MIN_SECONDS, MAX_SECONDS = 1.0 / 240.0, 1.0


class Player:
    """Moves a session along its film in real time, leaving out moments that no picture can be made of in time.
    All in the thread of the server's loop. `notify`: called when it begins or ends to play."""

    def __init__(self, session: Session, notify: Callable[[], None]):
        self._session, self._notify = session, notify
        self._task: asyncio.Task | None = None
        self._shown = asyncio.Event()

    @property
    def playing(self) -> bool:
        """Whether the film plays."""
        return self._task is not None

    def play(self) -> None:
        """Play from where the timeline stands, or from the start where no key lies ahead."""
        self.stop()
        self._task = asyncio.create_task(self._play())
        self._notify()

    def stop(self) -> None:
        """Stand still."""
        if self._task is not None:
            self._task.cancel()
            self._task = None
            self._notify()

    def picture_shown(self) -> None:
        """A picture is there: the next moment may come."""
        self._shown.set()

    async def _play(self) -> None:
        try:
            await self._go_on()
        except ValueError as error:
            _log.warning("the film stops: %s", error)
        except Exception:
            _log.exception("the film stops")
        self._task = None
        self._notify()

    async def _go_on(self) -> None:
        loop, session = asyncio.get_running_loop(), self._session
        film, begin = session.document.timeline, session.document.time
        if begin >= film.length or (film.keys and begin >= film.keys[-1].time):
            begin = 0.0
        started = loop.time()
        while True:
            elapsed, film = begin + loop.time() - started, session.document.timeline
            self._shown.clear()
            session.scrub(timeline.looped_time(film, elapsed))
            if film.length <= 0.0 or (film.loop == "once" and elapsed >= film.length):
                return
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._shown.wait(), MAX_SECONDS)
            await asyncio.sleep(MIN_SECONDS)
