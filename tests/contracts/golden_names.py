"""The public names with their parameters, and the help of every command, as data that tests compare."""

import contextlib
import inspect
import io
import os
import re
from unittest import mock

import warpcage
from warpcage.studio.cli import main

#: How parameters are given: by place or name, by name, by place, and any number of them.
KINDS = {
    "POSITIONAL_OR_KEYWORD": "",
    "KEYWORD_ONLY": "*",
    "POSITIONAL_ONLY": "/",
    "VAR_POSITIONAL": "args",
    "VAR_KEYWORD": "kwargs",
}

#: Of words of help that are not commands.
PROGRAM = "warpcage"


def callable_of(item):
    """The function that callers give arguments to, and whether its first one is `self` or `cls`."""
    if inspect.isclass(item):
        return item.__init__, True
    function = getattr(item, "__func__", item)
    first = next(iter(inspect.signature(function).parameters), "")
    return function, first in ("self", "cls")


def public_objects():
    """(name, object) of all public names, and of the members of classes among them."""
    for name in warpcage.__all__:
        item = getattr(warpcage, name)
        yield name, item
        if inspect.isclass(item):
            members = {}
            for base in reversed(item.__mro__):
                if base.__module__.startswith("warpcage"):
                    members |= {member: value for member, value in vars(base).items() if not member.startswith("_")}
            yield from ((f"{name}.{member}", value) for member, value in members.items())


def documented(item):
    """The names that the docstring of a class gives to its attributes."""
    text = inspect.cleandoc(item.__doc__ or "")
    block = re.search(r"^Attributes:\n((?:    .*\n|\n)+)", text + "\n", re.MULTILINE)
    return re.findall(r"^    (\w+): ", block[1], re.MULTILINE) if block else []


def described(item):
    """Parameters of what can be called, with kinds and defaults; and attributes that a class promises."""
    if not (inspect.isclass(item) or inspect.isfunction(getattr(item, "__func__", item))):
        return {}
    function, bound = callable_of(item)
    parameters = list(inspect.signature(function).parameters.values())[1 if bound else 0 :]
    rows = [
        [each.name, KINDS[each.kind.name], *([] if each.default is each.empty else [repr(each.default)])]
        for each in parameters
    ]
    if not inspect.isclass(item):
        return {"parameters": rows}
    return {"parameters": rows, "attributes": documented(item)}


def public_names():
    return {name: described(item) for name, item in public_objects()}


def help_text(command=""):
    """What --help all of a command says, in 240 columns."""
    said = io.StringIO()
    with mock.patch.dict(os.environ, {"COLUMNS": "240", "NO_COLOR": "1"}), contextlib.redirect_stdout(said):
        with contextlib.suppress(SystemExit):
            main([*([command] if command else []), "--help", "all"])
    return said.getvalue()


def commands():
    """The commands, in the order of the help."""
    listed = re.search(r"^  command\n((?:    .*\n)+)", help_text(), re.MULTILINE)
    return re.findall(r"^    ([\w-]+)", listed[1], re.MULTILINE)


def plain_help(text):
    """Help without what differs between versions of Python: line breaks, the heading of options, repeated metavars."""
    text = text.replace("optional arguments:", "options:")
    text = " ".join(text.split())
    return re.sub(r"(?<!\S)(-\w) ([^,\]]+?), (--[\w-]+) \2(?![\w-])", r"\1, \3 \2", text)
