"""Many frames, fits and evaluations: items of a job file, and the worker that makes them."""

from __future__ import annotations

import importlib

#: What callers use, and the modules that it comes from: loaded when it is first used.
_HOMES = {
    "run_jobs": "run",
    "RunReport": "report",
    "RunProgress": "report",
    "JobFile": "job_file",
    "write_jobs": "job_file",
}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}", name=name)
    found = globals()[name] = getattr(importlib.import_module(f".{_HOMES[name]}", __name__), name)
    return found
