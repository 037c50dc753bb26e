"""Internal docstrings have one sentence on two lines at most; those that do not yet are in a list that only shrinks."""

import ast

import internal_docstrings


def test_no_internal_docstring_is_too_long():
    new = internal_docstrings.long_docstrings() - internal_docstrings.listed()
    assert sorted(new.elements()) == [], "shorten them to one sentence: reasons are comments at their lines"


def test_the_list_only_shrinks():
    settled = internal_docstrings.listed() - internal_docstrings.long_docstrings()
    assert sorted(settled.elements()) == [], "run tests/contracts/internal_docstrings.py --shrink"


def test_kernels_have_no_lists_of_needs():
    assert internal_docstrings.files_with_needs() == [], "the imports of a file say what it needs"


def test_what_is_public_is_told_from_what_is_not(monkeypatch):
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

    def _hidden(self):
        def nested():
            {long}
"""
    monkeypatch.setattr(internal_docstrings, "python_files", lambda: [("warpcage/cage/cage.py", ast.parse(text))])
    found = internal_docstrings.long_docstrings()
    private = "Base._shut", "Cage._hidden.nested"
    assert set(found) == {f"warpcage/cage: {name}" for name in ("inner", "Base", *private)}
