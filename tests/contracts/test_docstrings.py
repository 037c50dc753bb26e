"""Every public name is annotated, and its docstring describes every parameter, in one form."""

import dataclasses
import inspect
import pathlib
import re
import textwrap

import pytest

import warpcage

SECTION = re.compile(r"^(Args|Attributes|Returns|Yields|Raises|Example|Note|Limitations|References):\s*$")
ENTRY = re.compile(r"^    (\*{0,2}\w+): \S")


def sections(docstring):
    """The lines below each heading of a docstring, by heading; what comes before the first is under ""."""
    found, heading = {"": []}, ""
    for line in inspect.cleandoc(docstring or "").splitlines():
        match = SECTION.match(line)
        if match:
            heading = match[1]
            assert heading not in found, f"two sections {heading}"
            found[heading] = []
        else:
            found[heading].append(line)
    return found


def entries(lines):
    """The names that a section describes, each on a line of its own."""
    return [match[1].lstrip("*") for match in map(ENTRY.match, lines) if match]


def public_names():
    """(name, what it is, its own attribute of a class or None) of all that users call."""
    for name in warpcage.__all__:
        thing = getattr(warpcage, name)
        yield name, thing
        if not inspect.isclass(thing):
            continue
        for base in reversed(thing.__mro__):
            if not base.__module__.startswith("warpcage"):
                continue
            for member, value in vars(base).items():
                if not member.startswith("_") and (
                    inspect.isfunction(value) or isinstance(value, property | classmethod | staticmethod)
                ):
                    yield f"{name}.{member}", value


NAMES = dict(public_names())


def signature_of(thing):
    """The function whose parameters callers give, without self and cls."""
    function = thing.__init__ if inspect.isclass(thing) else getattr(thing, "__func__", thing)
    signature = inspect.signature(function)
    parameters = list(signature.parameters.values())
    bound = inspect.isclass(thing) or (parameters and parameters[0].name in ("self", "cls"))
    return parameters[1 if bound else 0 :], signature.return_annotation


def complaints(thing):
    """What is wrong with a name, one line each."""
    docstring = inspect.getdoc(thing) if not inspect.isclass(thing) else thing.__doc__
    if not docstring:
        return ["it has no docstring"]
    summary = inspect.cleandoc(docstring).splitlines()[0]
    found = [] if summary.endswith((".", ":")) else [f"its summary {summary!r} is not one line that ends"]
    if isinstance(thing, property):
        return found + ([] if "return" in thing.fget.__annotations__ else ["its value is not annotated"])

    if inspect.isclass(thing) and issubclass(thing, Exception):  # made of a message alone
        return found
    parameters, result = signature_of(thing)
    parts = sections(docstring)
    described = entries(parts.get("Args", ()))
    if dataclasses.is_dataclass(thing):  # whose fields are attributes too
        described += entries(parts.get("Attributes", ()))
    names = [parameter.name for parameter in parameters]
    found += [f"{name} is not described" for name in names if name not in described]
    takes_more = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters)
    found += [f"{name} is described, but no parameter" for name in described if name not in names and not takes_more]
    found += [f"{each.name} is not annotated" for each in parameters if each.annotation is each.empty]
    if inspect.isclass(thing):
        return found
    if result is inspect.Signature.empty:
        found.append("what it returns is not annotated")
    elif parameters and result not in (None, "None") and not {"Returns", "Yields"} & set(parts):
        found.append("what it returns is not described")  # without parameters the summary says it, as for properties
    return found


@pytest.mark.parametrize("name", list(NAMES))
def test_every_parameter_is_described_and_annotated(name):
    assert complaints(NAMES[name]) == []


def test_the_check_finds_what_is_missing():
    def vague(points, *, device: str = "cpu", **options):
        """Summary without an end

        Args:
            points: (n, 3) points.
            devices: Misspelt.
        """

    assert complaints(vague) == [
        "its summary 'Summary without an end' is not one line that ends",
        "device is not described",
        "options is not described",
        "points is not annotated",
        "options is not annotated",
        "what it returns is not annotated",
    ]


def test_sections_are_told_apart():
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


PAGES = sorted((pathlib.Path(__file__).parents[2] / "docs").glob("*.md"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_tests_that_pages_name_exist(page):
    """Promises name the tests that hold them: `test_file` or `test_file::test_name`."""
    sources = {path.stem: path for path in pathlib.Path(__file__).parents[1].rglob("test_*.py")}
    for file, _, test in re.findall(r"`(test_\w+)(\.py)?(?:::(test_\w+))?`", page.read_text(encoding="utf-8")):
        assert file in sources, f"{page.name} names {file}.py"
        if test:
            assert f"def {test}(" in sources[file].read_text(encoding="utf-8"), f"{page.name} names {file}::{test}"


def test_the_page_of_promises_names_tests():
    page = next(page for page in PAGES if page.name == "reliability.md")
    assert len(re.findall(r"`test_\w+(?:::test_\w+)?`", page.read_text(encoding="utf-8"))) > 20
