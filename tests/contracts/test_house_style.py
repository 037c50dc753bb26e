"""Docstrings, names, messages, imports, help and tables of docs keep the rules of the house, and each rule finds what
breaks it. The rules are in tests/support/house_style.py."""

import ast
import gc
import textwrap

import docs_rules  # noqa: F401  (adds its rules)
import golden_names
import house_style
import pytest
from house_style import (
    asks_kind,
    attributes,
    changed_defaults,
    docstring_complaints,
    entries,
    imports,
    refusals,
    sections,
)


@pytest.fixture(scope="module", autouse=True)
def trees():
    """They are many small objects, which Python would look through for garbage again and again."""
    gc.disable()
    yield
    house_style.parsed.cache_clear(), house_style.nodes.cache_clear()
    gc.enable()


@pytest.mark.parametrize("name", house_style.RULES)
def test_rules_are_kept(name):
    found = list(house_style.RULES[name]())
    assert found == [], house_style.RULES[name].__doc__


def test_all_files_are_looked_through():
    counts = [len(house_style.python_files(folder)) for folder in (house_style.PACKAGE, house_style.KERNELS)]
    assert counts[0] > 200 and counts[1] > 40 and len(house_style.python_files(house_style.TESTS)) > 150
    assert len(house_style.RULES) == 19 and len(house_style.GOLDEN) > 300


def test_missing_words_of_docstrings_are_found():
    def vague(points, *, device: str = "cpu", **options):
        """Summary without an end

        Args:
            points: (n, 3) points.
            devices: Misspelt.
        """

    assert docstring_complaints(vague) == [
        "its summary 'Summary without an end' is not one line that ends",
        "device is not described",
        "options is not described",
        "points is not annotated",
        "options is not annotated",
        "what it returns is not annotated",
    ]


def test_sections_of_docstrings_are_told_apart():
    text = textwrap.dedent(
        """\
        Summary.

        Args:
            one: The first, whose text: goes on
                note: on the next line.
            **options: Others.

        Returns:
            value: not an entry.
        """
    )
    parts = sections(text)
    assert entries(parts["Args"]) == ["one", "options"] and list(parts) == ["", "Args", "Returns"]


def test_a_constant_of_two_values_is_found():
    text = "A = 1\nB: int = 2\nB = 3\nname = 1\nname = 2\n"
    assert list(house_style.constants_have_one_value({"kernels/x.py": ast.parse(text)})) == ["kernels/x.py: B"]


def test_long_docstrings_of_what_is_not_public_are_found():
    long = '"""One.\n\n    Args:\n        more.\n    """'
    text = f"""
def inner(value):
    {long}

class Base:
    {long}

    def open(self):
        {long}

    def _shut(self):
        {long}

class Cage(Base):
    {long}

    def bend(self):
        {long}

    if True:
        def _hidden(self):
            def nested():
                {long}
"""
    found = house_style.internal_docstrings_have_one_sentence({"warpcage/cage/cage.py": ast.parse(text)})
    private = "inner", "Base", "Base._shut", "Cage._hidden.nested"
    assert list(found) == [f"warpcage/cage/cage.py: {name}" for name in private]


def test_patterns_of_messages_are_found():
    test = "WORDS = {'a': 'of a table'}\ndef test_a():\n    '''A docstring.'''\n    raises(match=WORDS['a'])\n"
    assert list(house_style.patterns(ast.parse(test))) == ["a", "a", "a", "of a table"]
    assert "as  is" in house_style.patterns(ast.parse("def test_b():\n    raises(A, match=f'as {it} is')"))


def test_imports_are_found_in_text():
    text = "from warpcage.studio.films.video import (\n    write_gif,\n    write_video as video,\n)\n"
    text += "import warpcage\nwarpcage.fit(1)"
    assert imports(text) == [("warpcage.studio.films.video", ["write_gif", "write_video"]), ("warpcage", [])]
    assert attributes(text) == {"fit"}


def test_lost_parameters_and_changed_defaults_are_found():
    was = {"parameters": [["points", ""], ["device", "", "None"]]}

    def renamed(points, *, place=None): ...

    def needs_more(points, extra, device=None): ...

    def takes_old_words(points, *, place=None, **old): ...

    def changed(points, *, device="cpu"): ...

    assert refusals(renamed, was) and refusals(needs_more, was)
    assert not refusals(takes_old_words, was) and not refusals(changed, was)
    assert changed_defaults(changed, was) == {"device": ("None", "'cpu'")}


def test_what_versions_of_python_write_as_help_is_the_same_once_it_is_plain():
    old = "usage: a [-h] [-o FILE]\n\noptional arguments:\n  -o FILE, --output FILE\n        where it goes"
    new = "usage: a [-h]\n         [-o FILE]\n\noptions:\n  -o, --output FILE  where it goes"
    assert golden_names.plain_help(old) == golden_names.plain_help(new)
    two = "  -p X Y, --pixel X Y  a place"
    assert golden_names.plain_help(two) == "-p, --pixel X Y a place"


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("x = 1 if kind == 'green' else 2", True),
        ("if 'harmonic' in kinds:\n    pass", True),
        ("if kind.is_closed_form:\n    pass", False),
        ("if color == 'red':\n    pass", False),
    ],
)
def test_comparisons_with_a_kind_of_coordinates_are_found(text, found):
    assert any(asks_kind(node) for node in ast.walk(ast.parse(text))) == found
