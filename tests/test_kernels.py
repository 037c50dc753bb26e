"""Every kernel module stands alone, loads on every device present, and compiles for CUDA without a GPU."""

import ast
import importlib
import pathlib

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
    docstring = ast.get_docstring(ast.parse(source))
    assert docstring and "Siblings" in docstring


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
