"""One command from its arguments to an exit status: parser, signals, streams, and one line for what ends it."""

from __future__ import annotations

import argparse
import contextlib
import errno
import functools
import importlib
import os
import re
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Collection, Iterator
from types import FrameType
from typing import Any, NoReturn, TextIO

from ...core import reports
from ...core.names import error_line, extra_line
from ...errors import InputError, MissingPackageError
from ...package import PausedCollection
from .arguments import cages, fields, info, render, runs, scenes  # noqa: F401  (they bring their commands)
from .arguments.options import COMMANDS, package_version

ORDER = (  # of commands in their help
    "capture fit select clean mesh cage check edit pose fit-pose edits render animate sweep run bake evaluate info "
    "demo doctor kernels".split()
)

#: What `--help` of a long command shows beside its arguments; `--help all` shows all options.
_FIRST = {
    "render": "--output --cage --posed --edits --view --camera --size --background --transparent --masks",
    "animate": "--output --cage --posed --edits --frames --fps --motion --turn --size --background",
    "fit": "--output --downscale --quality --resolution --epochs --steps --split-masks --refine-cameras --as --quiet",
    "select": "--output --preview --point --pixel --in-box --sphere --plane --floaters --camera --view",
    "clean": "--output --preview --floaters --parts --largest-scale --views --least-views --camera --view --size",
    "mesh": "--output --cage --posed --edits --frames --threshold --colors --faces --texture --selection",
    "cage": "--output --vertices --margin --method --box --cylinder --segments --selection --seed --floaters",
    "pose": "--output --bend --twist --scale --rotate --translate --axis --towards --key --at",
    "sweep": "--output --cage --poses --cameras --size --views --seeds --records --image --background",
    "bake": "--output --cage --posed --edits --selection --voxels --format --frames --coordinates --device",
}

EXAMPLE = """\
example, from pictures to a bent object:
  warpcage fit data/lego --downscale 2 -o lego.npz
  warpcage cage lego.npz -o cage.obj
  warpcage pose cage.obj -o posed.obj --bend 40 --axis x --towards z
  warpcage render lego.npz --cage cage.obj --posed posed.obj -o bent.png
  warpcage animate lego.npz --cage cage.obj --posed posed.obj -o bend.mp4
"""


def build_parser(chosen: Collection[str] | None = None) -> argparse.ArgumentParser:
    """The parser of all commands. `command` of what it reads is the name of the chosen one, or None.
    chosen: which get their options, as others need none; None: all."""
    parser = _Parser(
        prog="warpcage",
        description="Fit a radiance field to pictures, put a cage around it, pose the cage, render the deformed scene.",
        epilog=EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action=_Version, help="print the version and exit")
    commands = parser.add_subparsers(dest="command", metavar="command", parser_class=_Parser)
    for name in ORDER:
        command = COMMANDS[name]
        subparser = commands.add_parser(
            name,
            help=command.help,
            description=command.help[0].upper() + command.help[1:] + ".",
            epilog="example:\n" + command.example,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            add_help=name not in _FIRST,
        )
        if name in _FIRST:
            text = "show the usual options and exit; --help all: show all of them"
            subparser.add_argument("-h", "--help", action=_Help, first=_FIRST[name].split(), metavar="all", help=text)
        if chosen is None or name in chosen:
            command.add_arguments(subparser)
        subparser.add_argument("--verbose", action="store_true", help="also say what is loaded and tried")
    return parser


#: What argparse says of wrong arguments, and what is said instead.
_PLAIN = {
    "^unrecognized arguments: (?=-)": "unknown option: ",
    "^argument command: invalid choice: ": "unknown command: ",
    "^argument (?=-)": "option ",
}


class _Parser(argparse.ArgumentParser):
    """Reports wrong arguments in one line, as every other bad input is reported."""

    def error(self, message: str) -> NoReturn:
        for said, plain in _PLAIN.items():
            message = re.sub(said, plain, message)
        raise InputError(f"{message} (see {self.prog} --help)")

    def keep_help_of(self, options: list[str]) -> None:
        """Show arguments, these options and examples alone in the help."""
        hidden = 0
        for action in self._actions:
            if action.option_strings and not {*action.option_strings} & {*options}:
                hidden += action.help != argparse.SUPPRESS
                action.help = argparse.SUPPRESS
        places = " ".join(str(action.metavar or action.dest) for action in self._actions if not action.option_strings)
        self.usage = f"{self.prog} {places} -o OUTPUT [options]"
        examples = (self.epilog or "").partition("\n\n")[0].strip()
        self.epilog = f"{examples}\n\n{hidden} more options: {self.prog} --help all"


class _Help(argparse.Action):
    """Prints the help of some options, or of all where "all" follows."""

    def __init__(self, option_strings: list[str], dest: str, *, first: list[str], **options: Any):
        super().__init__(option_strings, argparse.SUPPRESS, nargs="?", default=argparse.SUPPRESS, **options)
        self._first = [*first, *option_strings]

    def __call__(self, parser, namespace, values, option_string=None):
        if values != "all" and isinstance(parser, _Parser):
            parser.keep_help_of(self._first)
        parser.print_help()
        parser.exit()


class _Version(argparse.Action):
    """Prints the version, which is looked up only then."""

    def __init__(self, option_strings: list[str], dest: str, **options: Any):
        super().__init__(option_strings, dest, nargs=0, **options)

    def __call__(self, parser, namespace, values, option_string=None):
        print(f"warpcage {package_version()}")
        parser.exit()


class Ended(KeyboardInterrupt):
    """A signal asks the program to end; whatever cleans up after an interrupt does so here too."""

    def __init__(self, number: int):
        super().__init__()
        self.status = 128 + number  # what shells give to a program that the signal killed


@contextlib.contextmanager
def ended_by_signals() -> Iterator[None]:
    """Raise Ended where SIGTERM or SIGHUP would kill the process. A signal that is ignored stays so (nohup)."""
    # What is raised in a destructor, such as that of Warp's arrays, is lost: the signal is sent again.
    if threading.current_thread() is not threading.main_thread():
        yield  # Python handles signals in the main thread alone
        return

    def end(number: int, frame: FrameType | None) -> None:
        raise Ended(number)

    def lost(what: Any) -> None:
        if not issubclass(what.exc_type, KeyboardInterrupt):
            return report(what)
        number = what.exc_value.status - 128 if isinstance(what.exc_value, Ended) else signal.SIGINT
        threading.Timer(0.01, os.kill, (os.getpid(), number)).start()  # once the destructor has ended

    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = {}
    report, sys.unraisablehook = sys.unraisablehook, lost
    try:
        for number in numbers:
            if signal.getsignal(number) not in (signal.SIG_IGN, None):
                before[number] = signal.signal(number, end)
        yield
    finally:
        sys.unraisablehook = report
        for number, handler in before.items():
            signal.signal(number, handler)


#: Errors of a stream whose reader is gone.
_GONE = (errno.EPIPE, errno.EBADF)


class SteadyStream:
    """A text stream whose messages are always written; all other attributes are those of the stream it writes to."""

    def __init__(self, stream: TextIO):
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        encoding = self._stream.encoding or "utf-8"
        try:
            text.encode(encoding, self._stream.errors or "strict")
        except UnicodeEncodeError:
            text = text.encode(encoding, "backslashreplace").decode(encoding)
        self._attempt(self._stream.write, text)
        return len(text)

    def flush(self) -> None:
        self._attempt(self._stream.flush)

    def _attempt(self, action: Callable[..., Any], *arguments: str) -> None:
        try:
            action(*arguments)
        except OSError as error:
            # what is still buffered goes nowhere, or the interpreter would fail at it again at its end
            with contextlib.suppress(OSError), open(os.devnull, "wb") as nowhere:
                os.dup2(nowhere.fileno(), self._stream.fileno())
            if error.errno not in _GONE:  # others, such as a full disk, are raised once
                raise


@contextlib.contextmanager
def steady_streams() -> Iterator[None]:
    """Make sys.stdout and sys.stderr steady for a while."""
    # Closed ones are opened on nothing: the next file would get one of them, and what libraries print would end in it.
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


#: What may go wrong with input, memory, numbers, modules that are not installed, and Warp. Anything else is a mistake
#: in warpcage, whose traceback is needed.
EXPECTED = (ValueError, OSError, MemoryError, OverflowError, ImportError, RuntimeError)


def run(argv: list[str] | None) -> int:
    """Run one command; see `warpcage.studio.cli.main`."""
    with steady_streams(), ended_by_signals():
        try:
            status = _run_command(argv)
            sys.stdout.flush()
            return status
        except Ended as end:
            return _said("terminated", end.status)
        except KeyboardInterrupt:
            return _said("interrupted", 130)
        except Exception as error:
            # Warp raises plain Exceptions where a kernel cannot be built or loaded
            if not isinstance(error, EXPECTED) and type(error) is not Exception:
                raise
            return _said(f"error: {_line(error)}", 2)


def _line(error: Exception | str) -> str:
    """An error or a warning in one line, with what a user can do about it."""
    text = error_line(error)
    if isinstance(error, OverflowError):
        return f"a number is too large{': ' if str(error) else ''}{text if str(error) else ''}"
    if isinstance(error, ImportError) and not isinstance(error, MissingPackageError) and str(error):
        return f"{text}: install warpcage again with all that it needs ({extra_line()})"
    return text


def _run_command(argv: list[str] | None) -> int:
    parser = build_parser(None if "_ARGCOMPLETE" in os.environ else sys.argv[1:] if argv is None else argv)
    if "_ARGCOMPLETE" in os.environ:  # a shell asks for completions
        importlib.import_module("argcomplete").autocomplete(parser)
    with warnings.catch_warnings():
        warnings.showwarning = _show_warning
        arguments = parser.parse_args(argv)
        if arguments.command is None:
            parser.print_help()
            return 2
        quiet = getattr(arguments, "quiet", False)
        reports.show_log("info" if arguments.verbose and not quiet else reports.requested_level())
        watched = sys.stderr.isatty() and not quiet
        compiling = "compiling kernels, once on this machine, which may take a minute"
        reports.on_compiling = functools.partial(reports.say, compiling) if watched else None
        with _reporting_folders(arguments, quiet), _early_workers(arguments):
            return _command(arguments.command)(arguments) or 0


@contextlib.contextmanager
def _reporting_folders(arguments: argparse.Namespace, quiet: bool) -> Iterator[None]:
    """Print which folders a command made for its files; where it fails, those that stayed empty go again."""
    given = [os.path.dirname(value) for value in vars(arguments).values() if isinstance(value, str | os.PathLike)]
    missing = {folder: _missing(folder) for folder in given if folder and not os.path.isdir(folder)}
    try:
        yield
    except BaseException:
        for folder in (each for folders in missing.values() for each in folders):
            with contextlib.suppress(OSError, ValueError):  # not made, or not empty
                os.rmdir(folder)
        raise
    for folder in missing:
        if os.path.isdir(folder) and not quiet:
            reports.say(f"made folder {folder}")


def _missing(folder: str) -> list[str]:
    """A folder and those above it that are not there, the deepest first."""
    folders = []
    while folder and not os.path.isdir(folder):
        folders.append(folder)
        folder = os.path.dirname(folder)
    return folders


def _early_workers(arguments: argparse.Namespace) -> contextlib.AbstractContextManager[None]:
    """Workers of this machine start beside the program, one core is left to that: for `with`."""
    given = vars(arguments)
    workers = given.get("workers") or 1
    if workers == 1 or given.get("cluster") is not None or given.get("dry_run"):
        return contextlib.nullcontext()
    from ..jobs.engines.serving import early_processes  # here, as most commands need nothing of it

    return early_processes(workers, min(workers, (os.cpu_count() or 1) - 1), arguments.device)


def _command(name: str) -> Callable[[argparse.Namespace], int | None]:
    """What runs a command."""
    with PausedCollection(frozen=True):
        module = importlib.import_module(f".{COMMANDS[name].module}", __package__)
    return getattr(module, f"run_{name.replace('-', '_')}")


def _said(what: str, status: int) -> int:
    reports.say(what)
    return status


def _show_warning(message, category, filename, lineno, file=None, line=None):
    """Print a warning as one line, without the place in the source."""
    reports.say(f"warning: {_line(message)}")
