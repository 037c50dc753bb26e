"""What warpcage raises: each refusal is an `Error`, and what Python calls such a mistake too."""

# Each stands beside the class of Python's that it was before, so that both are caught.


class Error(Exception):
    """A refusal of warpcage: what is wrong, where, and what would be right, in one line."""


class InputError(Error, ValueError):
    """A value, the contents of a file, or a combination of them that cannot be used."""


class MissingFileError(Error, FileNotFoundError):
    """A file or a folder that is not there."""


class UseError(Error, TypeError):
    """A use that an object is not for."""


class StateError(Error, RuntimeError):
    """Work that cannot go on, though no value is wrong."""


class MissingPackageError(Error, ImportError):
    """A package that is not installed."""


class Cancelled(Error):
    """Work that a caller ended: its `progress` returned False. Nothing half-written stays, and the device goes on."""


class FileError(Error, OSError):
    """What the system refuses, beside Python's own class of it, such as PermissionError: see `file_error`."""

    def __reduce__(self):
        return _file_error, (type(self).__bases__[-1], self.args, self.filename)


_KINDS: dict[type[OSError], type[FileError]] = {}


def _file_error(kind: type[OSError], args: tuple, filename: object) -> FileError:
    if kind not in _KINDS:
        _KINDS[kind] = type(kind.__name__, (FileError, kind), {"__module__": __name__})
    return _KINDS[kind](*args, *([] if filename is None else [filename]))


def file_error(error: OSError) -> OSError:
    """An error of the system as an `Error` too: of a class of both, so that either is caught."""
    if isinstance(error, Error) or type(error).__module__ != "builtins":
        return error
    return _file_error(type(error), error.args, error.filename)
