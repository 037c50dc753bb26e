"""What version 0.1.0 offered is still there: every public name, and every parameter by its name."""

import inspect
import json
import pathlib

import golden_names
import pytest

import warpcage

GOLDEN = json.loads((pathlib.Path(__file__).parent.parent / "data" / "public_names.json").read_text(encoding="utf-8"))
NAMED = ("", "*")  # kinds of parameters that are given by name

THINGS = dict(golden_names.public_things())
CALLED = [name for name, was in GOLDEN.items() if was]


def refusals(thing, was):
    """What a call with all parameters of then, as of then, is refused for; empty where it is taken."""
    function, bound = golden_names.callable_of(thing)
    needed = [name for name, kind, *default in was["parameters"] if not default and kind == ""]
    named = [name for name, kind, *_ in was["parameters"] if kind in NAMED and name not in needed]
    first = ["self"] if bound else []
    said = []
    for follow in (True, False):  # what accepts old words may wrap a function that does not
        signature = inspect.signature(function, follow_wrapped=follow)
        try:
            signature.bind(*first, *needed, **dict.fromkeys(named))
            signature.bind(*first, **dict.fromkeys([*needed, *named]))
            signature.bind(*first, *needed)
            return []
        except TypeError as error:
            said.append(str(error))
    return said


def changed_defaults(thing, was):
    """Parameters that are still there with another default."""
    function, _ = golden_names.callable_of(thing)
    parameters = inspect.signature(function).parameters
    then = {name: default[0] if default else None for name, _, *default in was["parameters"] if name in parameters}
    now = {name: parameters[name].default for name in then}
    texts = {name: None if value is inspect.Parameter.empty else repr(value) for name, value in now.items()}
    return {name: (then[name], texts[name]) for name in then if then[name] != texts[name]}


def test_public_names_stay():
    names = {name for name in GOLDEN if "." not in name}
    assert names <= set(warpcage.__all__) and names <= set(dir(warpcage))


@pytest.mark.parametrize("name", [name for name in GOLDEN if "." in name])
def test_members_stay(name):
    """Of a class and its bases; a dataclass has those without a default on objects alone."""
    owner, member = name.split(".")
    thing = getattr(warpcage, owner)
    assert hasattr(thing, member) or member in getattr(thing, "__dataclass_fields__", {})


@pytest.mark.parametrize("name", CALLED)
def test_parameters_are_still_taken(name):
    thing = THINGS[name] if name in THINGS else getattr(warpcage, name)
    assert refusals(thing, GOLDEN[name]) == []
    assert changed_defaults(thing, GOLDEN[name]) == {}


@pytest.mark.parametrize("name", [name for name, was in GOLDEN.items() if was.get("attributes")])
def test_attributes_stay_documented_or_defined(name):
    thing, attributes = THINGS[name], GOLDEN[name]["attributes"]
    lost = set(attributes) - set(golden_names.documented(thing))
    described = "\n" + inspect.getdoc(thing)
    assert [each for each in lost if not hasattr(thing, each) and f"\n    {each}: " not in described] == []


def test_the_check_finds_what_is_lost():
    was = {"parameters": [["points", ""], ["device", "", "None"]]}

    def renamed(points, *, place=None): ...

    def needs_more(points, extra, device=None): ...

    def takes_old_words(points, *, place=None, **old): ...

    def changed(points, *, device="cpu"): ...

    assert refusals(renamed, was) and refusals(needs_more, was)
    assert not refusals(takes_old_words, was) and not refusals(changed, was)
    assert changed_defaults(changed, was) == {"device": ("None", "'cpu'")}
