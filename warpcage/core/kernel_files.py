"""The kernel files as text: their names (`folder/stem`), what each one needs, and copies that work without warpcage."""

# A copy has the kernel files in folders as here, and in `host/` the modules that launch them, in packages as in
# warpcage: both import each other by `from ..x import y`, but host code finds its kernels one level up. Which modules
# are copied follows from the imports of the call in the README.md of a kernel folder.

from __future__ import annotations

import ast
import contextlib
import difflib
import functools
import importlib.metadata
import keyword
import os
import pathlib
import posixpath
import re
from collections.abc import Iterable

from ..coordinate_kinds import COORDINATE_KINDS
from ..errors import InputError
from ..kernels import __path__ as kernel_folders
from .checks import warn_renamed
from .files import atomic_path

FOLDER = pathlib.Path(kernel_folders[0])
ROOT_DOCSTRING = '"""Kernels of warpcage (Apache License 2.0), copied with `warpcage kernels copy`."""\n'
HOST_DOCSTRING = '"""Modules of warpcage that launch the kernels beside this folder (Apache License 2.0)."""\n'

_PACKAGE = pathlib.Path(__file__).parents[1]
_COPY = "my_kernels"  #: the name of a copy in the READMEs of kernel folders
_LONE = "\n\nKernels alone. "  #: behind the title of a README without a call, which gives way to one with it

_FORMER = {  # kernel files by the names that they, or parts of them, had before: this version understands these
    "core/loads": "core/entries",
    "core/shared": "core/warp_memory",
    "demo/mesh_raycast": "reference/mesh_raycast reference/mesh_distance",
    "edits/bake": "deform/bake",
    "edits/cell_tables": "deform/cells deform/settled_cells",
    "edits/extension": "deform/carry deform/carry_cells deform/falloff",
    "edits/fine_cells": "deform/fine_cells",
    "edits/inverse": "deform/posed_places",
    "edits/nodes": "deform/map_nodes deform/map_cells",
    "edits/structs": "deform/flat_edits deform/crumbs",
    "edits/trace": "deform/edits deform/points deform/points_precise edits/points_exact",
    "field/colors": "field/shades",
    "field/grid": "field/samples",
    "field/march": "field/render_shaded field/render",
    "field/march_cpu": "field/render_cpu field/cpu_samples",
    "field/occupancy": "field/skip field/matter_cells",
    "field/refine": "field/halves",
    "fitting/batches": "fitting/pictures fitting/active_tiles fitting/shuffle",
    "fitting/slopes": "field/slopes",
    "lattice/cage_map": "lattice/weights",
    "lattice/gaps": "lattice/narrow_gaps lattice/gap_sides",
    "mesh/triangle": "mesh/walls",
    "render/march": "deform/march_single deform/matter_rows",
    "render/march_cpu": "deform/render_cpu deform/cpu_map",
    "render/march_exact": "deform/march",
    "render/march_stack": "deform/march_several",
    "render/rays": "deform/ray_parts deform/pictures",
    "render/shading": "deform/carried_shades",
    "render/views": (
        "deform/render deform/render_plain deform/render_precise deform/render_single deform/render_sides "
        "deform/render_part deform/render_part_sides deform/shaded_single deform/shaded_sides deform/shaded_large "
        "deform/shaded_part deform/shaded_part_sides deform/march_pixels"
    ),
    "render/volume": "deform/laid_shades",
    "splats/bind": "splats/mean_value_rows splats/green_rows",
    "splats/composite": "splats/composite_slopes",
    "splats/composite_cpu": "splats/composite_tiles splats/composite_slopes_tiles",
    "splats/fit": "splats/adam splats/density splats/picture_slopes splats/parameters",
    "splats/pose": "splats/follow splats/invert splats/jacobian",
    "splats/splats": "splats/inside",
    "splats/split": "splats/splits splats/fade",
    "view/pictures": "view/downsample view/colour_bytes view/preview",
}
MOVED = {old: new for new, names in _FORMER.items() for old in names.split()}


def kernel_names() -> list[str]:
    """Names of all kernel files, sorted, such as "coordinates/mean_value"."""
    paths = (path.relative_to(FOLDER).with_suffix("") for path in FOLDER.glob("*/*.py"))
    return sorted(path.as_posix() for path in paths if path.name != "__init__")


def find_kernel(text: str) -> str:
    """The full name of a kernel file, given so, with a dot for the slash, or as a stem that one folder alone has."""
    names = kernel_names()
    wanted = text.replace(".", "/")
    found = [name for name in names if wanted in (name, _stem(name))]
    if not found:
        found = sorted({new for old, new in MOVED.items() if wanted in (old, _stem(old))})
        if len(found) == 1:
            warn_renamed(f"the kernel file {text!r}", f"a part of {found[0]!r}")
    if len(found) > 1:
        raise InputError(f"several kernel files are called {text!r}: {', '.join(found)}")
    if not found:
        close = difflib.get_close_matches(_stem(wanted), map(_stem, names), cutoff=0.5)
        candidates = [name for stem in close for name in names if _stem(name) == stem]
        advice = f": did you mean {' or '.join(candidates)}?" if candidates else ""
        raise InputError(f"there is no kernel file {text!r}{advice or '; `warpcage kernels list` shows them all'}")
    return found[0]


def kernel_source(name: str) -> str:
    """The text of a kernel file."""
    return (FOLDER / f"{name}.py").read_text(encoding="utf-8")


@functools.cache
def kernel_summary(name: str) -> str:
    """The first sentence, or line, of a kernel file's docstring."""
    return (ast.get_docstring(ast.parse(kernel_source(name))) or "").partition("\n")[0]


def kernel_groups() -> list[str]:
    """The folders of kernel files, sorted, such as "coordinates"."""
    return sorted({name.partition("/")[0] for name in kernel_names()})


def kernel_call(group: str) -> str:
    """The Python code in the README.md of a kernel folder, for a copy called `my_kernels`."""
    return _readme(group).partition("```python\n")[2].partition("```")[0]


def _readme(group: str) -> str:
    return (FOLDER / group / "README.md").read_text(encoding="utf-8")


def _lone_readme(group: str, names: list[str]) -> str:
    """The README.md of kernel files without the modules that launch them: what their kernels do."""
    title, _, _ = _readme(group).partition("\n")
    text = f"{title}{_LONE}Without `--alone` what runs them comes along, with an example.\n"
    for name in names:
        text += f"\n`{_stem(name)}.py`: {kernel_summary(name)}\n\n"
        for function, is_kernel, line in _described(name):  # kernels, and what the call takes
            if is_kernel or f"import {function}\n" in kernel_call(group):
                text += line
    return text


@functools.cache
def _described(name: str) -> list[tuple[str, bool, str]]:
    """The functions of a kernel file: their names, whether they are kernels, and their lines in a README."""
    found = []
    for node in ast.walk(ast.parse(kernel_source(name))):
        if isinstance(node, ast.FunctionDef):
            is_kernel = any("wp.kernel" in ast.unparse(each) for each in node.decorator_list)
            parameters = ", ".join(each.arg for each in node.args.args)
            line = f"- `{node.name}({parameters})`: {' '.join((ast.get_docstring(node) or '').split())}\n"
            found.append((node.name, is_kernel, line))
    return found


def _call_imports(group: str) -> set[str]:
    """The modules that the call of a kernel folder imports: "kernels/lattice/gaps", "lattice/position_map"."""
    found = set()
    for node in ast.walk(ast.parse(kernel_call(group))):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith(f"{_COPY}."):
            path = node.module.split(".")[1:]
            base = path[1:] if path[0] == "host" else ["kernels", *path]
            found |= _imported(base, [alias.name for alias in node.names])
    return found


def _kernel_name(module: str) -> str:
    return module.removeprefix("kernels/")


def _module_file(module: str) -> pathlib.Path | None:
    """The file of a module of the package, which is named by its path in it; packages are named by their folder."""
    base = FOLDER / _kernel_name(module) if module.startswith("kernels/") else _PACKAGE / module
    files = (base.with_suffix(".py"), base / "__init__.py")
    return next((path for path in files if path.is_file()), None)


def _imported(base: list[str], names: list[str]) -> set[str]:
    """The modules that `from base import names` needs: those names that are modules, else the base."""
    modules = ("/".join([*base, name]) for name in names)
    return {module if _module_file(module) else "/".join(base) for module in modules}


@functools.cache
def _imports(module: str) -> frozenset[str]:
    """The modules that a module imports as it runs; those for type checkers alone are none of them."""
    file = _module_file(module)
    assert file is not None, module
    inside = module.split("/")[: None if file.name == "__init__.py" else -1]
    found: set[str] = set()
    waiting: list[ast.AST] = [ast.parse(file.read_text(encoding="utf-8"))]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            waiting += node.orelse
        elif isinstance(node, ast.ImportFrom) and node.level:
            base = [*inside[: len(inside) - node.level + 1], *(node.module or "").split(".")]
            found |= _imported(list(filter(None, base)), [alias.name for alias in node.names])
        else:
            found |= _kind_modules(node)
            waiting += ast.iter_child_nodes(node)
    return frozenset(found)


def _kind_modules(node: ast.AST) -> set[str]:
    """The modules that a call of `CoordinateKind.load` or `kernel_modules` imports, of all kinds."""
    kinds = COORDINATE_KINDS.values()
    match node:
        case ast.Call(func=ast.Attribute(attr="load"), args=[ast.Constant(value=str(field))]):
            paths = [path for kind in kinds if ":" in (path := str(getattr(kind, field, "")))]
        case ast.Call(func=ast.Attribute(attr="kernel_modules")):
            paths = [path for kind in kinds for path in kind.modules]
        case _:
            return set()
    return {path.partition(":")[0].replace(".", "/") for path in paths}


def _closure(modules: Iterable[str]) -> set[str]:
    """The modules, and all that they need; Python also runs the packages that host modules lie in."""
    needed: set[str] = set()
    waiting = set(modules)
    while waiting:
        module = waiting.pop()
        needed.add(module)
        found = set(_imports(module))
        if not module.startswith("kernels/"):
            found |= {parent.as_posix() for parent in pathlib.PurePosixPath(module).parents} - {"."}
        waiting |= found - needed
    return needed


@functools.cache
def native_files(name: str) -> frozenset[str]:
    """The files of C++ that a kernel file reads, and those that they include, such as "field/cpu_samples.h"."""
    named = [(name, each) for each in re.findall(r'native_source\(__file__, "(.+?)"\)', kernel_source(name))]
    found: set[str] = set()
    while named:
        user, each = named.pop()
        path = posixpath.normpath(posixpath.join(posixpath.dirname(user), each))
        if path not in found:
            found.add(path)
            named += [(path, other) for other in re.findall(r'^#include "(.+)"$', native_text(path), re.MULTILINE)]
    return frozenset(found)


def native_text(path: str) -> str:
    """The text of a file of C++, named by its folder and its name."""
    return (FOLDER / path).read_text(encoding="utf-8")


def copy_kernel(name: str, destination: str | os.PathLike[str], *, alone: bool = False) -> list[pathlib.Path]:
    """Copy a kernel file, or all of a folder, with what it needs, the modules that launch it (alone: without those) and
    a README into a package that imports without warpcage. Paths, sorted; all or nothing is copied."""
    # Files that are there with the same text stay, and so do every `__init__.py` and every README with a call.
    destination = pathlib.Path(destination)
    _check_package_name(destination)
    group = name.partition("/")[0]
    wanted = [f"kernels/{each}" for each in kernel_names() if name in (each, group) and each.startswith(f"{group}/")]
    modules = _closure([*wanted, *(() if alone else _call_imports(group))])
    names = sorted(_kernel_name(module) for module in modules if module.startswith("kernels/"))
    texts = {destination / f"{each}.py": kernel_source(each) for each in names}  # imports are relative: folders stay
    texts |= {destination / each: native_text(each) for each in frozenset().union(*map(native_files, names))}
    host = sorted(module for module in modules if not module.startswith("kernels/"))
    texts |= {destination / "host" / path: text for path, text in map(_host_file, host)}
    texts |= {destination / path.name: path.read_text(encoding="utf-8") for path in _license_files()}
    for path, text in texts.items():
        if path.exists() and path.read_text(encoding="utf-8") != text:
            raise InputError(f"{str(path)!r} is there with other contents: nothing is copied over it")

    kept = {destination / "__init__.py": ROOT_DOCSTRING}
    for folder in sorted({each.partition("/")[0] for each in names}):
        kept[destination / folder / "__init__.py"] = (FOLDER / folder / "__init__.py").read_text(encoding="utf-8")
    if host:
        kept[destination / "host" / "__init__.py"] = HOST_DOCSTRING
    new = {path: text for path, text in (kept | texts).items() if not path.exists()}
    readme = destination / group / "README.md"
    if not readme.exists() or _LONE in readme.read_text(encoding="utf-8"):
        new[readme] = _copied_readme(group, destination, names, alone=alone)  # the last, as it may be there
    _write_whole(new)
    return sorted(texts)


def _copied_readme(group: str, destination: pathlib.Path, names: list[str], *, alone: bool) -> str:
    """The README.md of a kernel folder in a copy of kernel files, beside those of the folder that are there."""
    text = _readme(group)
    there = [each for each in kernel_names() if each in names or (destination / f"{each}.py").exists()]
    if alone and not {_kernel_name(module) for module in _call_imports(group)} <= {*there}:
        text = _lone_readme(group, [each for each in there if each.startswith(f"{group}/")])
    launches = (FOLDER / "README.md").read_text(encoding="utf-8").partition("\n## ")[2]
    return f"{text.replace(_COPY, destination.resolve().name)}\n## {launches}"


def _host_file(module: str) -> tuple[str, str]:
    """Path and text of a module in `host/`, which finds kernels in the folder above."""
    file = _module_file(module)
    assert file is not None, module
    text = file.read_text(encoding="utf-8")
    text = re.sub(r"^(\s*from \.+)kernels\.", r"\1.", text, flags=re.MULTILINE)
    text = text.replace('"kernels.', '".')  # of coordinate_kinds
    return f"{module}/__init__.py" if file.name == "__init__.py" else f"{module}.py", text


def _license_files() -> list[pathlib.Path]:
    """LICENSE and NOTICE of a checkout, or as they were installed."""
    names = ("LICENSE", "NOTICE")
    beside = [_PACKAGE.parent / name for name in names]
    if (_PACKAGE.parent / "setup.py").is_file():
        return beside
    installed = importlib.metadata.files("warpcage") or []
    return [pathlib.Path(str(path.locate())) for path in installed if path.name in names]


def _stem(name: str) -> str:
    return name.rpartition("/")[2]


def _check_package_name(folder: pathlib.Path) -> None:
    name = folder.resolve().name
    if not name.isidentifier() or keyword.iskeyword(name) or name == "warp":
        raise InputError(
            f"Python cannot import a copy from a folder called {name!r}: give a name of letters, digits and "
            "underscores, such as 'my_kernels'"
        )
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{str(folder)!r} is a file: give a folder for the copy")


def _write_whole(texts: dict[pathlib.Path, str]) -> None:
    """Write new files. After an error those written, and the folders made for them, are removed."""
    parents = {parent for path in texts for parent in path.parents}
    made = sorted((parent for parent in parents if not parent.exists()), reverse=True)  # the deepest first
    written = []
    try:
        for path, text in texts.items():
            with atomic_path(path) as temporary:
                temporary.write_text(text, encoding="utf-8")
            written.append(path)
    except BaseException:
        for path in written:
            path.unlink(missing_ok=True)
        for folder in made:
            with contextlib.suppress(OSError):  # not made yet, or somebody has put a file there meanwhile
                folder.rmdir()
        raise
