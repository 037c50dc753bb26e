"""Whole sentences of messages stand in tests/support/messages.py, and nowhere else in the tests."""

import ast
import pathlib
import re

from messages import MESSAGES

TESTS = pathlib.Path(__file__).parents[1]
TABLE = TESTS / "support" / "messages.py"
SENTENCE = 40  # letters of a pattern, from which on it belongs in the table


def parsed(path):
    return ast.parse(path.read_text(encoding="utf-8"))


FILES = {str(path.relative_to(TESTS)): parsed(path) for path in sorted(TESTS.rglob("*.py")) if path != TABLE}


def texts(node):
    """All texts of the source below a node but docstrings, an f-string without its values."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return [node.value]
    if isinstance(node, ast.JoinedStr):
        return ["".join(text for part in node.values if isinstance(part, ast.Constant) for text in texts(part))]
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return []
    return [text for child in ast.iter_child_nodes(node) for text in texts(child)]


def names(node):
    return {each.id for each in ast.walk(node) if isinstance(each, ast.Name)} - {"MESSAGES"}


def patterns(file):
    """All that `match` may be in a file: where it is not written there, any text of its test or of a table that the
    test names."""
    tables = {name: node.value for node in file.body if isinstance(node, ast.Assign) for name in names(node.targets[0])}
    found = []
    for test in file.body:
        words = [word for word in ast.walk(test) if isinstance(word, ast.keyword) and word.arg == "match"]
        found += [text for word in words for text in texts(word)]
        if any(names(word) for word in words):
            found += texts(test)
            found += [text for name in names(test) & tables.keys() for text in texts(tables[name])]
    return found


def test_sentences_stand_in_the_table_alone():
    for name, file in FILES.items():
        assert [pattern for pattern in patterns(file) if len(pattern) >= SENTENCE] == [], name


def test_the_table_is_in_order_and_holds_nothing_twice():
    (table,) = (node.value for node in parsed(TABLE).body if isinstance(node, ast.Assign))
    keys = [ast.literal_eval(key) for key in table.keys]
    assert keys == sorted(set(keys)) and len(set(MESSAGES.values())) == len(keys)
    assert all(re.compile(pattern) and key.count(".") == 1 for key, pattern in MESSAGES.items())


def test_all_of_the_table_is_used():
    used = {
        each.slice.value
        for file in FILES.values()
        for each in ast.walk(file)
        if isinstance(each, ast.Subscript) and isinstance(each.value, ast.Name) and each.value.id == "MESSAGES"
    }
    assert used == set(MESSAGES)
