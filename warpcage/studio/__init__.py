"""Programs built on the library: jobs, films, captures, the editor, the command line. The library imports none."""

from ..package import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__, {}, ("captures", "cli", "editor", "films", "jobs"))
