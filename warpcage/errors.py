"""The exceptions of warpcage: each is an `Error` and the class of Python's for such a mistake."""


class Error(Exception):
    """Base of all errors that warpcage raises: what is wrong, where, and what would be right, in one line."""


class InputError(Error, ValueError):
    """A value, the contents of a file, or a combination of them that cannot be used."""


class MissingFileError(Error, FileNotFoundError):
    """A file or a folder that is not there."""


class UseError(Error, TypeError):
    """An object that cannot be used in this way."""


class StateError(Error, RuntimeError):
    """Work that cannot go on, though no value is wrong."""


class MissingPackageError(Error, ImportError):
    """A package that is not installed."""


class Cancelled(Error):
    """Work that its caller cancelled: `progress` returned False. No unfinished file stays; the device can be used."""


class FileError(Error, OSError):
    """An error of the system, also of Python's class for it, such as PermissionError: see `file_error`."""

    def __reduce__(self):
        return _file_error, (type(self).__bases__[-1], self.args, self.filename)


_KINDS: dict[type[OSError], type[FileError]] = {}


def _file_error(kind: type[OSError], args: tuple, filename: object) -> FileError:
    if kind not in _KINDS:
        _KINDS[kind] = type(kind.__name__, (FileError, kind), {"__module__": __name__})
    return _KINDS[kind](*args, *([] if filename is None else [filename]))


def file_error(error: OSError) -> OSError:
    """An error of the system as an instance of its class and of `Error`."""
    if isinstance(error, Error) or type(error).__module__ != "builtins":
        return error
    return _file_error(type(error), error.args, error.filename)
