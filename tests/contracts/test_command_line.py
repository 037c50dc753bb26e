"""The help of every command is that of version 0.1.0, on every version of Python."""

import pathlib

import golden_names
import pytest

HELP = pathlib.Path(__file__).parent.parent / "data" / "help"
COMMANDS = [path.stem for path in sorted(HELP.glob("*.txt")) if path.stem != golden_names.PROGRAM]


def test_the_program_has_these_commands_and_no_others():
    assert sorted(golden_names.commands()) == COMMANDS and len(COMMANDS) > 10


@pytest.mark.parametrize("command", [golden_names.PROGRAM, *COMMANDS])
def test_help_is_what_it_was(command):
    expected = (HELP / f"{command}.txt").read_text(encoding="utf-8")
    text = golden_names.help_text("" if command == golden_names.PROGRAM else command)
    assert golden_names.plain_help(text) == golden_names.plain_help(expected)


def test_what_versions_of_python_write_is_the_same_once_it_is_plain():
    old = "usage: a [-h] [-o FILE]\n\noptional arguments:\n  -o FILE, --output FILE\n        where it goes"
    new = "usage: a [-h]\n         [-o FILE]\n\noptions:\n  -o, --output FILE  where it goes"
    assert golden_names.plain_help(old) == golden_names.plain_help(new)
    two = "  -p X Y, --pixel X Y  a place"
    assert golden_names.plain_help(two) == "-p, --pixel X Y a place"
