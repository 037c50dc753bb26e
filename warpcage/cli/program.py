"""What happens around a command: its arguments are read, and whatever ends it becomes one line and an exit status."""

from __future__ import annotations

import gc
import importlib
import sys
import types
import warnings

from ..core import stderr
from ..core.names import system_error_line
from . import verbosity
from .parser import build_parser
from .signals import Ended, ended_by_signals
from .streams import steady_streams

#: What may go wrong with input, memory, numbers, modules that are not installed, and Warp. Anything else is a mistake
#: in warpcage, whose traceback is needed.
EXPECTED = (ValueError, OSError, MemoryError, OverflowError, ImportError, RuntimeError)


def run(argv: list[str] | None) -> int:
    """Run one command; see `warpcage.cli.main`."""
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
            return _said(f"error: {one_line(error)}", 2)


def one_line(error: Exception | str) -> str:
    """An error or a warning in one line."""
    if (line := system_error_line(error)) is not None:
        return line
    text = " ".join(str(error).split())
    if isinstance(error, OverflowError):
        return f"a number is too large{': ' if text else ''}{text}"
    if isinstance(error, ImportError):
        return f"{text}: install warpcage again with all that it needs (pip install warpcage)"
    return text or type(error).__name__


def _run_command(argv: list[str] | None) -> int:
    parser = build_parser()
    arguments = parser.parse_args(argv)
    if arguments.command is None:
        parser.print_help()
        return 2
    verbosity.verbose = arguments.verbose
    watched = sys.stderr.isatty() and not getattr(arguments, "quiet", False)
    stderr.say = _tell_of_compiling if watched else None
    with warnings.catch_warnings():
        warnings.showwarning = _show_warning
        return _command(arguments.command).run(arguments) or 0


def _command(name: str) -> types.ModuleType:
    """The module of a command. What it imports stays: looking through it for garbage takes a fifth of the start."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        return importlib.import_module(f".{name}", __package__)
    finally:
        gc.freeze()
        if collecting:
            gc.enable()


def _tell_of_compiling() -> None:
    """Whoever sits before a terminal would wonder."""
    print("warpcage: compiling kernels, once on this machine, which may take a minute", file=sys.stderr)


def _said(what: str, status: int) -> int:
    print(f"warpcage: {what}", file=sys.stderr)
    return status


def _show_warning(message, category, filename, lineno, file=None, line=None):
    """Print a warning as one line, without the place in the source."""
    print(f"warpcage: warning: {one_line(message)}", file=sys.stderr)
