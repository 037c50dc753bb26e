"""The editor as callers see it: a page for a field and its cages, served from a thread."""

from __future__ import annotations

import asyncio
import atexit
import dataclasses
import html
import os
import pathlib
import signal
import threading
import warnings
from collections.abc import Sequence

from ...cage.cage import Cage
from ...core.checks import checked_whole, require_type
from ...core.files import PathLike
from ...core.names import extra_line
from ...edits.stage_file import is_stage
from ...errors import InputError, MissingPackageError
from ...field.voxel_field import VoxelField
from ...render.surface_mesh import load_object
from ...splats.splat_field import AnyField, SplatField, load_field
from ..films.document import Document
from ..films.session.scene import read_fields
from ..films.session.session_file import file_stamp, object_name, read_kept, session_path
from .objects import stage_field, with_stage
from .session import Session, new_document, view_of_box
from .steps.history import read_history

#: Cells of a new session's lattices along the longest side of a cage, on a CPU and on CUDA.
RESOLUTION_CPU, RESOLUTION_CUDA = 64, 128


class Editor:
    """A running editor; use it in a `with` block, or call `close`. In a notebook the object shows the page.
    Pages load files of `folder` and make theirs there; port 0 takes a free one."""

    def __init__(
        self,
        session: Session,
        folder: pathlib.Path,
        host: str = "127.0.0.1",
        port: int = 0,
        allowed_hosts: Sequence[str] = (),
    ):
        require_libraries()
        from .server import Server

        self.session, self._path = session, session.path  # session: what is edited, with its history
        self._loop = asyncio.new_event_loop()
        self.server = Server(session, folder, host, port, tuple(allowed_hosts))
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._loop.run_forever, name="warpcage-editor", daemon=True)
        self._thread.start()
        try:
            self.url = asyncio.run_coroutine_threadsafe(self.server.start(), self._loop).result()  # with the token
        except BaseException:
            self._end_loop()
            raise
        atexit.register(session.save_changes)  # for a program that ends without `close`

    @property
    def document(self) -> Document:
        """What is edited, as it is now. It never changes; look again for what comes later."""
        return self.session.document

    @property
    def session_path(self) -> pathlib.Path | None:
        """The file that the session is kept in. It is another one where a program wrote the first one meanwhile."""
        return self.session.path

    @property
    def posed(self) -> list[Cage]:
        """The posed cages, one per edit, each in the coordinates of its object."""
        return [edit.posed_cage for edit in self.document.edits]

    def wait(self) -> None:
        """Wait until the editor is closed; an interrupt (Ctrl+C) raises KeyboardInterrupt."""
        # Raised inside a callback, such as a destructor, a KeyboardInterrupt would be lost: it is raised here instead.
        # The handler takes no lock, as it may run while this thread holds that of the event.
        interrupts: list[int] = []
        own = threading.current_thread() is threading.main_thread()  # the only thread that can set handlers
        own = own and signal.getsignal(signal.SIGINT) is signal.default_int_handler
        if own:
            signal.signal(signal.SIGINT, lambda number, _: interrupts.append(number))
        try:
            while not self._closed.wait(0.2) and not interrupts:
                pass
        finally:
            if own:
                signal.signal(signal.SIGINT, signal.default_int_handler)
        if interrupts:
            raise KeyboardInterrupt

    def close(self) -> None:
        """Save the session and end the server. Calling it again does nothing."""
        if self._closed.is_set():
            return
        self._closed.set()
        try:
            asyncio.run_coroutine_threadsafe(self.server.stop(), self._loop).result()
        finally:
            self._end_loop()
            atexit.unregister(self.session.save_changes)
            self.session.save_changes()
        if self.session.save_error is not None:
            warnings.warn(f"the session could not be saved: {self.session.save_error}", stacklevel=2)
        if self.session.path != self._path:
            text = f"{self._path} was changed by another program: this session is kept in {self.session.path}"
            warnings.warn(text, stacklevel=2)

    def _end_loop(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def __enter__(self) -> Editor:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"Editor({self.url!r})" if not self._closed.is_set() else "Editor(closed)"

    def _repr_html_(self) -> str:
        """The page in a notebook's cell."""
        if self._closed.is_set():
            return "<p>This editor was closed.</p>"
        address = html.escape(self.url.replace("127.0.0.1", "localhost"))
        return f'<iframe src="{address}" width="100%" height="720" style="border:0" allow="fullscreen"></iframe>'


def require_libraries() -> None:
    """Raise ImportError where a package of the extra `edit` is not installed."""
    try:
        import aiohttp  # noqa: F401
        import simplejpeg  # noqa: F401
    except ImportError as error:
        raise MissingPackageError(f"the editor needs {error.name}: {extra_line('edit')}") from None


def edit(
    field: AnyField | PathLike,
    cage: Cage | Sequence[Cage] | None = None,
    *,
    session: PathLike | None = None,
    field_path: PathLike | None = None,
    scene_scale: float = 1.0,
    host: str = "127.0.0.1",
    port: int = 0,
    allowed_hosts: Sequence[str] = (),
) -> Editor:
    """Open the editor: a page in which a person poses cages and sees the deformed scene follow.

    Args:
        field: The field, of voxels or of splats, or its file; then the session is kept beside it, as
            `NAME.session.json`. The file may be that of a stage (.stage.json), whose objects are all shown.
        cage: The cage at rest, or several, one per edit. None goes on with the session that is there, or begins
            without a cage.
        session: The session's file. None is the one beside the field's file; a field from memory is not kept.
        field_path: The file of a field that was loaded already, for the command line that the page offers.
        scene_scale: The factor that the field's file is loaded with, or was; see `VoxelField.load`.
        host: Address to listen on. The default is reached from this machine only.
        port: Port to listen on; 0 takes a free one.
        allowed_hosts: Further host names under which the page may be opened, such as that of a proxy.

    Returns:
        The running editor; `url` is its address, `posed` are the posed cages, `close` ends it.

    Raises:
        FileNotFoundError: If there is no such field.
        ValueError: For a field or a session that cannot be read, a session that is there while cages are given, or a
            cage that cannot be used.
        OSError: If the port is taken.
        ImportError: If a package of the extra `edit` is not installed.

    Example:
        >>> with warpcage.edit("lego.npz", warpcage.Cage.load("cage.obj")) as editor:  # doctest: +SKIP
        ...     print(editor.url)
        ...     input("Open the address, pose the cage, then press Enter. ")
        ...     posed = editor.posed[0]
    """
    require_libraries()
    checked_whole(port, "the port", 0, 65535)
    if not isinstance(host, str) or isinstance(allowed_hosts, str):
        raise InputError("host must be an address, and allowed_hosts a list of names")
    if isinstance(field, VoxelField | SplatField):
        path, loaded = None, field
    elif isinstance(field, str | os.PathLike):
        path = pathlib.Path(field)
        loaded = load_field(stage_field(path) if is_stage(path) else path, scene_scale=scene_scale)
    else:
        raise InputError(f"the editor needs a VoxelField, a SplatField or the file of one, got {type(field).__name__}")
    given = field_path if path is None else path
    stage = pathlib.Path(given) if given is not None and is_stage(given) else None
    if stage is not None:
        given = stage_field(stage)
    cages = [] if cage is None else [cage] if isinstance(cage, Cage) else list(cage)
    kept = session_path(path) if session is None and path is not None else session
    kept = None if kept is None else pathlib.Path(kept)
    for number, one in enumerate(cages, start=1):
        require_type(one, Cage, f"cage {number} of the editor must be")
        one.require_usable(f"cage {number}")
    stamp, steps, exports = None if kept is None else file_stamp(kept), None, ()
    if kept is not None and stamp is not None:
        if cages:
            raise InputError(
                f"{kept} holds a session of this field already: leave the cage out to go on with it, or name another "
                "file for the session"
            )
        document, steps, exports = read_kept(kept, loaded)
    else:
        resolution = RESOLUTION_CPU if loaded.device.is_cpu else RESOLUTION_CUDA
        document = new_document(loaded, cages, resolution, "scene" if given is None else object_name(given))
    folder = (kept.parent if kept is not None else pathlib.Path.cwd()).resolve()
    if stage is not None and stamp is None:
        if cages:
            raise InputError("the objects of a stage file have cages of their own: leave the cages out")
        document = with_stage(document, stage.resolve(), folder)
    fields = read_fields(document, loaded, folder)
    if stage is not None and stamp is None:
        up = document.objects[0].place.rotation @ loaded.up
        document = dataclasses.replace(document, view=view_of_box(fields.bounds(document), up))
    history, lost = read_history(steps, fields, lambda file: load_object(folder / file, device=loaded.device))
    held = Session(fields, document, kept, given, stamp, scene_scale, history, lost, exports)
    return Editor(held, folder, host, port, allowed_hosts)
