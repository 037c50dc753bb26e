"""Kernel files: each imports Warp and the files it names alone, can be lifted out of warpcage, loads on every device
present, and compiles for CUDA without a GPU."""

import ast
import functools
import importlib
import pathlib
import re
import subprocess
import sys

import pytest
import warp as wp

import warpcage
from warpcage.cli import main
from warpcage.core.kernel_files import (
    FOLDER,
    all_needs,
    copy_kernel,
    direct_needs,
    find_kernel,
    kernel_names,
    kernel_source,
    kernel_summary,
)

NAMES = kernel_names()
WITH_KERNELS = [name for name in NAMES if "@wp.kernel" in kernel_source(name)]


def module_of(name):
    return importlib.import_module(f"warpcage.kernels.{name.replace('/', '.')}")


def named_needs(name):
    """What a file's docstring says that it needs."""
    docstring = ast.get_docstring(ast.parse(kernel_source(name)))
    listed = re.search(r"^Needs:\s+([\w/,\s]+)\.$", docstring, re.MULTILINE)[1]
    return set() if listed == "none" else set(re.split(r",\s+", listed))


@functools.cache  # most copies hold the same files
def relative_imports(text):
    """Level and module of the relative imports in the text of a file."""
    nodes = ast.walk(ast.parse(text))
    return [(node.level, node.module) for node in nodes if isinstance(node, ast.ImportFrom) and node.level]


def test_every_file_is_in_a_folder():
    assert [path.name for path in FOLDER.glob("*.py")] == ["__init__.py"]
    assert set(NAMES) == {
        path.relative_to(FOLDER).with_suffix("").as_posix()
        for path in FOLDER.rglob("*.py")
        if path.name != "__init__.py"
    }
    assert {"coordinates/mean_value", "mesh/fans", "field/grid"} <= set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_imports_only_warp_and_siblings(name):
    for node in ast.walk(ast.parse(kernel_source(name))):
        if isinstance(node, ast.Import):
            assert [(a.name, a.asname) for a in node.names] == [("warp", "wp")]
        elif isinstance(node, ast.ImportFrom) and node.module == "typing":
            assert [a.name for a in node.names] == ["Any"]  # Warp's mark of a generic argument
        elif isinstance(node, ast.ImportFrom):
            assert node.level in (1, 2) and node.module is not None
    assert direct_needs(name) <= set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_names_the_files_that_it_imports(name):
    assert named_needs(name) == direct_needs(name)
    assert kernel_summary(name)


@pytest.mark.parametrize("name", NAMES)
def test_a_copy_is_complete(name, tmp_path):
    """Every relative import of every copied file finds its file in the copy, in a package all the way down."""
    paths = copy_kernel(name, tmp_path / "lifted")
    assert {path.relative_to(tmp_path / "lifted").with_suffix("").as_posix() for path in paths} == {
        name,
        *all_needs(name),
    }
    assert all(
        (path.parent / "__init__.py").is_file() and (path.parent.parent / "__init__.py").is_file() for path in paths
    )
    for path in (tmp_path / "lifted").rglob("*.py"):
        for level, module in relative_imports(path.read_text(encoding="utf-8")):
            assert path.parents[level - 1].joinpath(f"{module.replace('.', '/')}.py").is_file()


def test_copies_import_without_warpcage(tmp_path):
    """A few that need many files, each in a package of its own."""
    names = ["deform/render_single", "fitting/loss_warps", "lattice/harmonic_coarse", "lattice/side_values"]
    program = "import sys\nsys.modules['warpcage'] = None  # so that importing it fails\n"
    for name in names:
        package = f"with_{name.partition('/')[2]}"
        assert main(["kernels", "copy", name, str(tmp_path / package)]) == 0
        program += f"import {package}.{name.replace('/', '.')}\n"
    (tmp_path / "program.py").write_text(program, encoding="utf-8")
    done = subprocess.run([sys.executable, "program.py"], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr


def test_names_of_kernel_files():
    for text in ("mean_value", "coordinates/mean_value", "coordinates.mean_value"):
        assert find_kernel(text) == "coordinates/mean_value"
    with pytest.raises(ValueError, match="'mean_valu'.*did you mean coordinates/mean_value"):
        find_kernel("mean_valu")
    with pytest.raises(ValueError, match="several.*'render': deform/render, field/render"):
        find_kernel("render")
    with pytest.raises(ValueError, match="'zzz'; `warpcage kernels list`"):
        find_kernel("zzz")


def test_kernels_list(capsys):
    assert main(["kernels", "list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == NAMES
    assert any(re.match("coordinates/mean_value +Mean value coordinates", line) for line in lines)


def test_kernels_copy(tmp_path, capsys):
    folder = tmp_path / "lifted"
    assert main(["kernels", "copy", "mean_value", str(folder)]) == 0
    assert "from lifted.coordinates.mean_value import" in capsys.readouterr().out
    copy = folder / "coordinates" / "mean_value.py"
    assert copy.read_text(encoding="utf-8") == kernel_source("coordinates/mean_value")

    # once more changes nothing, and another file joins what is there
    (folder / "__init__.py").write_text("# mine\n")
    assert main(["kernels", "copy", "mean_value", str(folder)]) == 0
    assert main(["kernels", "copy", "mesh/containment", str(folder)]) == 0
    assert (folder / "__init__.py").read_text() == "# mine\n" and (folder / "mesh" / "containment.py").is_file()

    # a file of other contents is kept, and nothing is copied beside it
    copy.write_text("# changed\n")
    (folder / "mesh" / "triangle.py").unlink()
    capsys.readouterr()
    assert main(["kernels", "copy", "mean_value", str(folder)]) == 2
    said = capsys.readouterr().err
    assert "mean_value.py" in said and said.count("\n") == 1
    assert copy.read_text() == "# changed\n" and not (folder / "mesh" / "triangle.py").exists()


def test_kernels_copy_refuses_what_would_not_import(tmp_path, capsys):
    (tmp_path / "file").write_text("text")
    for name in ("my-kernels", "class", "warp", "file", "file/below"):
        assert main(["kernels", "copy", "mean_value", str(tmp_path / name)]) == 2
        assert capsys.readouterr().err.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_copy_is_whole_or_not_at_all(tmp_path):
    (tmp_path / "lifted").mkdir()
    (tmp_path / "lifted" / "mesh").write_text("a file where a folder belongs")
    with pytest.raises(OSError):
        copy_kernel("coordinates/mean_value", tmp_path / "lifted")
    assert [path.name for path in (tmp_path / "lifted").iterdir()] == ["mesh"]


@pytest.mark.parametrize("name", WITH_KERNELS)
def test_loads(name, device):
    wp.load_module(module_of(name), device=device)


@pytest.mark.parametrize("name", WITH_KERNELS)
def test_no_loop_is_around_kernels(name):
    """Warp's loop for launches of fewer threads than items, which keeps registers through all of a kernel."""
    module = wp.get_module(module_of(name).__name__)
    assert module.options["default_grid_stride"] is False
    assert not any(kernel.options.get("grid_stride") for kernel in module.kernels.values())


@pytest.mark.parametrize("arch", [75, 90])
@pytest.mark.parametrize("name", WITH_KERNELS)
def test_compiles_for_cuda_without_a_gpu(name, arch, tmp_path, monkeypatch):
    """To PTX for the oldest architecture, as Warp makes it for those its toolkit does not know, else to a binary.

    At level 2, which takes half the time of level 3: whether a file compiles is the same. `test_loads` compiles each
    at the level that users get, where there is a GPU.
    """
    module = module_of(name)
    wp.get_module(
        module.__name__
    ).get_module_identifier()  # its name in the cache, of the level that users get, is kept
    monkeypatch.setattr(wp.config, "optimization_level", 2)
    wp.compile_aot_module(module, arch=arch, module_dir=str(tmp_path), use_ptx=arch == 75)
    suffix = ".ptx" if arch == 75 else ".cubin"
    binaries = [path for path in tmp_path.rglob("*") if path.suffix == suffix]
    assert binaries and all(path.stat().st_size > 1000 for path in binaries)


def test_no_kernel_is_defined_outside_the_folder():
    package = pathlib.Path(warpcage.__file__).parent
    paths = [path for path in package.rglob("*.py") if path.relative_to(package).parts[0] != "kernels"]
    assert len(paths) > 50
    for path in paths:
        source = path.read_text(encoding="utf-8")
        assert "@wp.kernel" not in source and "@wp.func" not in source and "@wp.struct" not in source, path
