"""Internal docstrings that are too long, and the list of those that may be so for now.

python tests/contracts/internal_docstrings.py            # what is wrong now
python tests/contracts/internal_docstrings.py --shrink   # drop from the list what is not too long any more
python tests/contracts/internal_docstrings.py --write    # write the list anew, as the tree is now
"""

import argparse
import ast
import collections
import functools
import pathlib

import warpcage

ROOT = pathlib.Path(__file__).parent.parent.parent

#: The docstrings that may be too long: a room and a name a line. It only shrinks.
LIST = pathlib.Path(__file__).parent / "long_docstrings.txt"

MAX_LINES = 2

Documented = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


@functools.cache
def python_files():
    """(path below the root, tree) of all files of the package and the kernels."""
    paths = [path for top in ("warpcage", "kernels") for path in sorted((ROOT / top).rglob("*.py"))]
    names = [path.relative_to(ROOT).as_posix() for path in paths]
    found = [name for name in names if not name.startswith("warpcage/kernels/")]  # a link to kernels
    return [(name, ast.parse((ROOT / name).read_text(encoding="utf-8"))) for name in found]


def public_classes(trees):
    """Names of the public classes and of all of the package's own classes that they are made from."""
    bases = collections.defaultdict(set)
    for _, tree in trees:
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                bases[node.name] |= {base.id for base in node.bases if isinstance(base, ast.Name)}
    found, new = set(), set(warpcage.__all__)
    while new:
        found |= new
        new = {base for name in new for base in bases[name]} - found
    return found


def documented_nodes(tree):
    """(name with its owners, owner, node) of all that may have a docstring."""

    def walk(node, names):
        for child in ast.iter_child_nodes(node):
            if isinstance(child, Documented):
                owner = node if isinstance(node, ast.ClassDef) else None
                yield ".".join([*names, child.name]), owner, child
                yield from walk(child, [*names, child.name])
            else:
                yield from walk(child, names)

    yield "", None, tree
    yield from walk(tree, [])


def long_docstrings():
    """How often each "room: name" has an internal docstring of more than MAX_LINES lines.

    It does not say in which file, as files of a room are joined and renamed; only modules are named by theirs.
    """
    trees = python_files()
    public, found = public_classes(trees), collections.Counter()
    for path, tree in trees:
        room, _, file = path.rpartition("/")
        for name, owner, node in documented_nodes(tree):
            if ast.get_docstring(node, clean=False) is None:
                continue
            member = owner is not None and owner.name in public and not node.name.startswith("_")
            own = not isinstance(node, ast.Module) and node.name in warpcage.__all__
            lines = node.body[0].end_lineno - node.body[0].lineno + 1
            if lines > MAX_LINES and not (member or own) and not (path == "warpcage/__init__.py" and not name):
                found[f"{room}: {name or file}"] += 1
    return found


def files_with_needs():
    """Kernel files whose docstrings list what they import: the imports say that."""
    found = []
    for path, tree in python_files():
        texts = [ast.get_docstring(node) or "" for _, _, node in documented_nodes(tree)]
        if path.startswith("kernels/") and any("Needs:" in text for text in texts):
            found.append(path)
    return found


def listed():
    """The list, with how often each line stands there."""
    return (
        collections.Counter(LIST.read_text(encoding="utf-8").splitlines()) if LIST.exists() else collections.Counter()
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shrink", action="store_true", help="drop what is not too long any more")
    parser.add_argument("--write", action="store_true", help="write the list anew")
    args = parser.parse_args()
    now, allowed = long_docstrings(), listed()
    if args.write or args.shrink:
        kept = now if args.write else now & allowed
        LIST.write_text("".join(f"{line}\n" for line in sorted(kept.elements())), encoding="utf-8")
        print(f"{kept.total()} lines in {LIST.name}, {allowed.total()} before")
    for title, lines in (("too long", now - listed()), ("not too long any more", listed() - now)):
        for line in sorted(lines.elements()):
            print(f"{title}: {line}")
    for path in files_with_needs():
        print(f"has a list of needs: {path}")


if __name__ == "__main__":
    main()
