"""Old names work with a warning for a release; docs/old_names.md lists them all, with what replaces them."""

import ast
import pathlib
import re

from warpcage.core.kernel_files import MOVED as MOVED_KERNELS
from warpcage.package import MOVED, WITHOUT_OLD_NAMES, renamed_line

ROOT = pathlib.Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "old_names.md"


def declared():
    """(old, new, where) of each old name in the code; `where` is the function that takes an old argument."""
    yield from ((old, new, "") for old, new in (MOVED | MOVED_KERNELS).items())
    for path in sorted((ROOT / "warpcage").rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        if not any(name in text for name in ("device_by_name", "renamed(", "OldName")):
            continue
        for node in ast.walk(ast.parse(text)):
            for each in getattr(node, "decorator_list", ()):
                if ast.unparse(each) == "device_by_name":
                    yield "device", "device=", node.name
                elif isinstance(each, ast.Call) and ast.unparse(each.func) == "renamed":
                    where = "SplatField" if node.name == "__init__" else node.name
                    yield from ((f"{name.value.value}=", f"{name.arg}=", where) for name in each.keywords)
            match node:
                case ast.Call(
                    func=ast.Name(id="warn_renamed"), args=[ast.Constant(value=old), ast.Constant(value=new)]
                ):
                    yield old, new, ""
                case ast.Dict():
                    for name, entry in zip(node.keys, node.values, strict=True):
                        if isinstance(entry, ast.Dict) and "OldName" in ast.unparse(entry):
                            yield f"--{name.value}", f"--{entry.values[0].value}", ""


def test_every_old_name_is_in_the_table():
    rows = re.findall(r"^\| ([^-].*) \| (.*) \| (\S+) \|$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert {release for _, _, release in rows} == {WITHOUT_OLD_NAMES}
    listed = [({*re.findall(r"`(.+?)`", old)}, {*re.findall(r"`(.+?)`", new)}) for old, new, _ in rows]
    found = [*declared()]
    assert {"--crumbs", "SplatDeformer", "centre=", "device", "field/shades"} <= {old for old, _, _ in found}
    for old, new, where in found:
        row = next((names for names, now in listed if old in names and new in now), set())
        assert {name.rpartition(".")[2] for name in row} >= {where} - {""} and row, (old, new, where)
    # and the table has no others
    names = {old for old, _, _ in found} | {where for _, _, where in found}
    extra = {name for row, _ in listed for name in row if not {name, name.rpartition(".")[2]} & names}
    assert extra == {"--edit", "VoxelField.render_by"}


def test_warnings_name_the_release():
    assert renamed_line("old", "new") == f"old is new now: the old name goes with warpcage {WITHOUT_OLD_NAMES}"
    for path in sorted((ROOT / "warpcage").rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        assert "next version" not in text and (path.name == "package.py" or " goes with warpcage 0" not in text), path
