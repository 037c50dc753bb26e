"""Whole sentences of messages stand in tests/support/messages.py and nowhere else in the tests."""

import ast
import pathlib
import re

import pytest
from messages import MESSAGES

TESTS = pathlib.Path(__file__).parents[1]
TABLE = TESTS / "support" / "messages.py"
LONGEST = 39  #: Letters of a pattern that a test may write itself.


def module(path):
    return ast.parse(path.read_text(encoding="utf-8"))


FILES = {path.relative_to(TESTS).as_posix(): module(path) for path in sorted(TESTS.rglob("*.py")) if path != TABLE}


def letters(node):
    """How many letters of text a literal holds, without the values of an f-string."""
    parts = node.values if isinstance(node, ast.JoinedStr) else [node]
    return sum(len(part.value) for part in parts if isinstance(part, ast.Constant) and isinstance(part.value, str))


def literals(node):
    """Texts below a node, each f-string as one of them; docstrings are none."""
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return
    if isinstance(node, ast.JoinedStr) or isinstance(node, ast.Constant) and isinstance(node.value, str):
        yield node
        return
    for child in ast.iter_child_nodes(node):
        yield from literals(child)


def patterns(tree):
    """Texts given as `match`, and where `match` is given by name, all texts that the name can stand for: those of the
    test, of its cases and of the tables that the cases are made of."""
    tables = {name.id: node.value for node in tree.body if isinstance(node, ast.Assign) for name in node.targets
              if isinstance(name, ast.Name)}
    for test in tree.body:
        given = [word.value for call in ast.walk(test) if isinstance(call, ast.Call) for word in call.keywords
                 if word.arg == "match"]
        names = {node.id for value in given for node in ast.walk(value) if isinstance(node, ast.Name)} - {"MESSAGES"}
        for value in given:
            yield from literals(value)
        if names:
            ...


def test_sentences_stand_in_the_table():
    pass
