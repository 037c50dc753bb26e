"""Every kernel module stands alone, loads on every device present, and compiles for CUDA without a GPU."""

import ast
import importlib
import pathlib
import re
import shutil
import subprocess
import sys

import pytest
import warp as wp

import warpcage.kernels

FOLDER = pathlib.Path(warpcage.kernels.__file__).parent
NAMES = sorted(path.stem for path in FOLDER.glob("*.py") if path.stem != "__init__")


def module_of(name):
    return importlib.import_module(f"warpcage.kernels.{name}")


def has_kernels(name):
    return "@wp.kernel" in (FOLDER / f"{name}.py").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", NAMES)
def test_imports_only_warp_and_siblings(name):
    source = (FOLDER / f"{name}.py").read_text(encoding="utf-8")
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            assert [(a.name, a.asname) for a in node.names] == [("warp", "wp")]
        elif isinstance(node, ast.ImportFrom) and node.module == "typing":
            assert [a.name for a in node.names] == ["Any"]  # Warp's mark of a generic argument
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 1 and (node.module is None or node.module in NAMES)


def named_siblings(name):
    """What a file's docstring says that it needs."""
    docstring = ast.get_docstring(ast.parse((FOLDER / f"{name}.py").read_text(encoding="utf-8")))
    listed = re.search(r"^Siblings: ([\w,\s]+)", docstring, re.MULTILINE)[1]
    return set(re.findall(r"\w+", listed)) - {"none"}


@pytest.mark.parametrize("name", NAMES)
def test_names_the_siblings_that_it_imports(name):
    nodes = ast.walk(ast.parse((FOLDER / f"{name}.py").read_text(encoding="utf-8")))
    relative = [node for node in nodes if isinstance(node, ast.ImportFrom) and node.level]
    imported = [[node.module] if node.module else [alias.name for alias in node.names] for node in relative]
    assert named_siblings(name) == {module for modules in imported for module in modules}


def test_copied_files_import_without_warpcage(tmp_path):
    """A few with many siblings, each in a package of its own with the ones it names and those that they name."""
    names = ["deformed_single", "field_loss_warps", "harmonic_coarse", "map_sides"]
    for name in names:
        needed, waiting = set(), [name]
        while waiting:
            needed |= (found := {waiting.pop()})
            waiting += set().union(*map(named_siblings, found)) - needed
        (tmp_path / f"with_{name}").mkdir()
        for file in needed:
            shutil.copy(FOLDER / f"{file}.py", tmp_path / f"with_{name}")
    program = "import sys\nsys.modules['warpcage'] = None  # so that importing it fails\n"
    program += "\n".join(f"import with_{name}.{name}" for name in names)
    (tmp_path / "program.py").write_text(program, encoding="utf-8")
    done = subprocess.run([sys.executable, "program.py"], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", [name for name in NAMES if has_kernels(name)])
def test_loads(name, device):
    wp.load_module(module_of(name), device=device)


@pytest.mark.parametrize("arch", [75, 90])
@pytest.mark.parametrize("name", [name for name in NAMES if has_kernels(name)])
def test_compiles_for_cuda_without_a_gpu(name, arch, tmp_path):
    wp.compile_aot_module(module_of(name), arch=arch, module_dir=str(tmp_path))
    binaries = [path for path in tmp_path.rglob("*") if path.suffix in (".cubin", ".ptx")]
    assert binaries and all(path.stat().st_size > 1000 for path in binaries)


def test_no_kernel_is_defined_outside_the_folder():
    package = pathlib.Path(warpcage.__file__).parent
    for path in package.rglob("*.py"):
        if FOLDER not in path.parents:
            source = path.read_text(encoding="utf-8")
            assert "@wp.kernel" not in source and "@wp.func" not in source and "@wp.struct" not in source, path
