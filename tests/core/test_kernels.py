"""Kernel files: each imports Warp and the files it names alone, can be lifted out of warpcage, loads on every device
present, and compiles for CUDA without a GPU."""

import ast
import functools
import pathlib
import re
import subprocess
import sys
import threading

import compiled
import pytest
import warp as wp
from compiled import warp_modules
from messages import MESSAGES

import warpcage
from warpcage.cli import main
from warpcage.core import (
    FOLDER,
    MOVED,
    all_needs,
    copy_kernel,
    direct_needs,
    find_kernel,
    kernel_names,
    kernel_source,
    kernel_summary,
    native_files,
)
from warpcage.kernels.render.views import view_kernel

NAMES = kernel_names()
WITH_KERNELS = [name for name in NAMES if "@wp.kernel" in kernel_source(name)]


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
            plain = [(a.name, a.asname) for a in node.names]
            # those that keep what factories of functions and kernels have made
            kept = {("functools", None)} | {
                (module, None) for module in ("inspect", "threading") if name == "core/variants"
            }
            assert plain == [("warp", "wp")] or set(plain) <= kept
        elif isinstance(node, ast.ImportFrom) and node.module == "typing":
            assert [a.name for a in node.names] == ["Any"]  # Warp's mark of a generic argument
        elif isinstance(node, ast.ImportFrom) and node.module == "pathlib":
            assert name == "core/variants"  # which reads the C++ of kernels
        elif isinstance(node, ast.ImportFrom):
            assert node.level in (1, 2) and node.module is not None
    assert direct_needs(name) <= set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_says_what_it_is_for(name):
    assert kernel_summary(name) and "Needs:" not in kernel_source(name)  # which its imports say


@pytest.mark.parametrize("name", NAMES)
def test_a_copy_is_complete(name, tmp_path):
    """Every relative import of every copied file finds its file in the copy, in a package all the way down."""
    paths = copy_kernel(name, tmp_path / "lifted", alone=True)
    files = {path.relative_to(tmp_path / "lifted").as_posix() for path in paths}
    needed = {name, *all_needs(name)}
    assert files == {f"{each}.py" for each in needed}.union(["LICENSE", "NOTICE"], *map(native_files, needed))
    assert all(
        (path.parent / "__init__.py").is_file() and (path.parent.parent / "__init__.py").is_file()
        for path in paths
        if path.suffix == ".py"
    )
    for path in (tmp_path / "lifted").rglob("*.py"):
        for level, module in relative_imports(path.read_text(encoding="utf-8")):
            assert path.parents[level - 1].joinpath(f"{module.replace('.', '/')}.py").is_file()


def test_copies_import_without_warpcage(tmp_path):
    """A few that need many files, each in a package of its own."""
    names = ["render/views", "fitting/loss_warps", "lattice/harmonic_coarse", "lattice/side_values"]
    program = "import sys\nsys.modules['warpcage'] = None  # so that importing it fails\n"
    for name in names:
        package = f"with_{name.partition('/')[2]}"
        assert main(["kernels", "copy", name, str(tmp_path / package), "--alone"]) == 0
        program += f"import {package}.{name.replace('/', '.')}\n"
    (tmp_path / "program.py").write_text(program, encoding="utf-8")
    done = subprocess.run([sys.executable, "program.py"], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr


def test_a_copy_compiles_without_warpcage(tmp_path):
    """The march of a CPU, whose C++ includes that of another folder."""
    names = [
        "field/cpp/basis_of_direction.h",
        "field/cpp/cell_place.h",
        "field/cpp/cpu_samples.h",
        "render/march_cpu.h",
    ]
    assert sorted(native_files("render/march_cpu")) == names
    paths = copy_kernel("render/march_cpu", tmp_path / "lifted", alone=True)
    assert {tmp_path / "lifted" / name for name in names} < set(paths)
    program = (
        "import sys\nsys.modules['warpcage'] = None\nimport warp as wp\n"
        f"wp.config.kernel_cache_dir = {str(tmp_path / 'cache')!r}\n"
        "from lifted.render import march_cpu\nassert wp.load_module(march_cpu, device='cpu') is not False\n"
    )
    (tmp_path / "program.py").write_text(program, encoding="utf-8")
    done = subprocess.run([sys.executable, "program.py"], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert list((tmp_path / "cache").rglob("*.o"))


@pytest.mark.parametrize("path", sorted(FOLDER.rglob("*.h")), ids=lambda path: path.name)
def test_a_kernel_reads_every_file_of_native_code(path):
    assert any(path.relative_to(FOLDER).as_posix() in native_files(name) for name in NAMES)


def test_names_of_kernel_files():
    for text in ("mean_value", "coordinates/mean_value", "coordinates.mean_value"):
        assert find_kernel(text) == "coordinates/mean_value"
    with pytest.raises(ValueError, match=MESSAGES["core.kernel_meant"]):
        find_kernel("mean_valu")
    with pytest.raises(ValueError, match=MESSAGES["core.kernel_of_several"]):
        find_kernel("march")
    with pytest.raises(ValueError, match="'zzz'; `warpcage kernels list`"):
        find_kernel("zzz")


def test_names_of_kernel_files_that_became_parts_of_others(tmp_path, capsys):
    for text in ("deform/render_single", "deform.render_single", "render_single"):
        with pytest.warns(UserWarning, match=MESSAGES["core.kernel_part"].format(name=text, file="render/views")):
            assert find_kernel(text) == "render/views"
    assert set(MOVED.values()) <= set(NAMES)
    assert main(["kernels", "copy", "render_shaded", str(tmp_path / "lifted")]) == 0
    assert (tmp_path / "lifted" / "field" / "march.py").is_file()
    assert MESSAGES["core.kernel_part"].format(name="render_shaded", file="field/march") in capsys.readouterr().err


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
    for module in warp_modules(name):
        wp.load_module(module, device=device)


@pytest.mark.parametrize("name", WITH_KERNELS)
def test_no_loop_is_around_kernels(name):
    """Warp's loop for launches of fewer threads than items, which keeps registers through all of a kernel."""
    for module in warp_modules(name):
        assert module.options["default_grid_stride"] is False and module.options["enable_backward"] is False
        assert not any(kernel.options.get("grid_stride") for kernel in module.kernels.values())


def test_variants_are_declared_once_by_whichever_thread():
    """One kernel for the same values, however they are given, in a module of its own."""
    declared, begin = [], threading.Barrier(4)

    def declare(number):
        begin.wait()
        declared.append(view_kernel(True, False) if number % 2 else view_kernel(shaded=True, has_sides=False))

    view_kernel.cache_clear()
    threads = [threading.Thread(target=declare, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(map(id, declared))) == 1 and list(declared[0].module.kernels.values()) == [declared[0]]
    modules = warp_modules("render/views")
    assert len({module.name for module in modules}) == len(modules) == 11
    assert declared[0].module.name == "warpcage.kernels.render.views.shades" and declared[0].module in modules


def test_no_variant_is_declared_before_it_is_used():
    program = (
        "import sys\nimport warp as wp\nimport warpcage.deform.deformer\nfrom warpcage.kernels.render import views\n"
        "from warpcage.kernels.field import march\n"
        "assert not views.view_kernel.cache_info().currsize and not march.image_kernel.cache_info().currsize\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=300)


def compile_for_cuda(module, arch, folder):
    """To PTX for the oldest architecture, as Warp makes it for those its toolkit does not know, else to a binary."""
    wp.compile_aot_module(module, arch=arch, module_dir=str(folder), use_ptx=arch == 75)
    (binary,) = folder.glob("*.ptx" if arch == 75 else "*.cubin")
    assert binary.stat().st_size > 1000


@pytest.mark.parametrize("name", WITH_KERNELS)
def test_what_changed_compiles_for_cuda_without_a_gpu(name, tmp_path, monkeypatch):
    """What tests/core/compiled.json does not know as compiled: `python tests/support/compiled.py` writes it anew."""
    for module in compiled.left(warp_modules(name)):
        monkeypatch.setattr(wp.config, "optimization_level", 2)  # half the time, and whether it compiles is the same
        compile_for_cuda(module, 90, tmp_path / module.name)


@pytest.mark.nightly
@pytest.mark.parametrize("arch", [75, 90])
@pytest.mark.parametrize("name", WITH_KERNELS)
def test_everything_compiles_for_cuda_without_a_gpu(name, arch, tmp_path):
    for module in warp_modules(name):
        compile_for_cuda(module, arch, tmp_path / module.name)


def test_no_kernel_is_defined_outside_the_folder():
    package = pathlib.Path(warpcage.__file__).parent
    paths = [path for path in package.rglob("*.py") if path.relative_to(package).parts[0] != "kernels"]
    assert len(paths) > 50
    for path in paths:
        source = path.read_text(encoding="utf-8")
        assert "@wp.kernel" not in source and "@wp.func" not in source and "@wp.struct" not in source, path
