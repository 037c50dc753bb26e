"""Kernel files: each imports Warp and the files it names alone, can be copied out of warpcage, loads on every device
present, and compiles for CUDA without a GPU; the call of a folder's README runs in a copy without warpcage."""

import ast
import functools
import pathlib
import re
import subprocess
import sys
import threading

import compiled
import numpy as np
import pytest
import warp as wp
from compiled import warp_modules
from messages import MESSAGES
from refusals import refused

import warpcage
from warpcage.core import (
    FOLDER,
    MOVED,
    copy_kernel,
    find_kernel,
    kernel_call,
    kernel_groups,
    kernel_names,
    kernel_source,
    kernel_summary,
    native_files,
)
from warpcage.kernels.coordinates.mean_value import map_mean_value
from warpcage.kernels.mesh.fans import prepare_fans
from warpcage.kernels.render.views import view_kernel
from warpcage.studio.cli import main

NAMES = kernel_names()
GROUPS = kernel_groups()
WITH_KERNELS = [name for name in NAMES if "@wp.kernel" in kernel_source(name)]


#: Runs a file where the packages of the environment that are named cannot be imported, on a tape that has the launches
#: of its own kernels alone in the end.
REFUSING = """\
import runpy
import sys

import warp as wp


class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in self.names:
            raise ImportError(f"{{name}} is refused")


sys.meta_path.insert(0, Refuse())
sys.path.insert(0, ".")
for call, Refuse.names in {calls}:
    with wp.Tape() as tape:
        runpy.run_path(call, run_name="__main__")
    assert {{launch[0].module.name for launch in tape.launches}} <= {{"__main__"}}, call
assert "my_kernels" in sys.modules and "warpcage" not in sys.modules
"""

#: What `pip install` of these names brings, as modules.
OPTIONAL = {"scipy": "scipy", "trimesh": "trimesh", "imageio": "imageio", "pillow": "PIL", "scikit-image": "skimage",
            "tqdm": "tqdm", "pymeshlab": "pymeshlab", "av": "av", "packaging": "packaging"}  # fmt: skip


def copied(name, folder, *options):
    assert main(["kernels", "copy", name, str(folder / "my_kernels"), *options]) == 0
    return {
        path.relative_to(folder / "my_kernels").as_posix()
        for path in (folder / "my_kernels").rglob("*")
        if path.is_file()
    }


def run_imports(tree):
    """The relative imports that a module runs, as level, module and names."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.ImportFrom) and node.level:
            yield node.level, node.module or "", [alias.name for alias in node.names]
        elif not (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)):
            yield from run_imports(node)


@functools.cache  # copies of groups have most files in common
def checked_imports(text):
    assert not re.search(r"^\s*(from|import) warpcage", text, re.MULTILINE)
    return list(run_imports(ast.parse(text)))


def run_program(folder, text):
    (folder / "program.py").write_text(text, encoding="utf-8")
    run = [sys.executable, "program.py"]
    done = subprocess.run(run, cwd=folder, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr


def require_complete(root):
    """Every relative import of every file in a copy finds its file, in a package all the way down."""
    for path in root.rglob("*.py"):
        assert all((root / each / "__init__.py").is_file() for each in path.relative_to(root).parents)
        for level, module, names in checked_imports(path.read_text(encoding="utf-8")):
            base = path.parents[level - 1].joinpath(*module.split("."))
            assert base.with_suffix(".py").is_file() or base.is_dir(), (path, module)
            if base.is_dir():
                init = (base / "__init__.py").read_text(encoding="utf-8")
                assert all((base / f"{name}.py").is_file() or name in init for name in names), (path, module, names)


def test_every_file_is_in_a_folder():
    assert [path.name for path in FOLDER.glob("*.py")] == ["__init__.py"]
    assert set(NAMES) == {
        path.relative_to(FOLDER).with_suffix("").as_posix()
        for path in FOLDER.rglob("*.py")
        if path.name != "__init__.py"
    }
    assert {"coordinates/mean_value", "mesh/fans", "field/grid"} <= set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_imports_only_warp_and_siblings_and_says_what_it_is_for(name):
    # those that keep what factories of functions and kernels have made, and one that reads the C++ of kernels
    allowed = {"import warp as wp", "import functools", "from typing import Any"}
    if name == "core/variants":
        allowed |= {"import inspect", "import threading", "from pathlib import Path"}
    for node in ast.walk(ast.parse(kernel_source(name))):
        if isinstance(node, ast.ImportFrom) and node.level:
            assert node.level in (1, 2) and node.module is not None
        elif isinstance(node, ast.Import | ast.ImportFrom):
            assert ast.unparse(node) in allowed
    assert kernel_summary(name) and "Needs:" not in kernel_source(name)  # which its imports say


@pytest.mark.parametrize("name", NAMES)
def test_a_copy_is_complete(name, tmp_path):
    paths = copy_kernel(name, tmp_path / "lifted", alone=True)
    files = {path.relative_to(tmp_path / "lifted").as_posix() for path in paths}
    kernels = {each.removesuffix(".py") for each in files if each.endswith(".py")}
    assert files == {f"{each}.py" for each in kernels}.union(["LICENSE", "NOTICE"], *map(native_files, kernels))
    require_complete(tmp_path / "lifted")
    imported = {name}  # and nothing is copied that no kernel file imports
    for path in (tmp_path / "lifted").rglob("*.py"):
        for level, module, names in checked_imports(path.read_text(encoding="utf-8")):
            base = path.parents[level - 1].joinpath(*module.split(".")).relative_to(tmp_path / "lifted").as_posix()
            imported |= {base, *(f"{base}/{each}" for each in names)}
    assert kernels <= imported


def test_copies_work_without_warpcage(tmp_path):
    """A few that need many files, each in a package of its own, and the march of a CPU, whose C++ includes that of
    another folder: it is compiled, or has the hash of what was."""
    program = "import sys\nsys.modules['warpcage'] = None  # so that importing it fails\nimport warp as wp\n"
    for name in ("render/views", "fitting/loss_warps", "lattice/harmonic_coarse", "lattice/side_values"):
        package = f"with_{name.partition('/')[2]}"
        assert main(["kernels", "copy", name, str(tmp_path / package), "--alone"]) == 0
        program += f"import {package}.{name.replace('/', '.')}\n"
    names = {
        "field/cpp/basis_of_direction.h",
        "field/cpp/cell_place.h",
        "field/cpp/cpu_samples.h",
        "render/march_cpu.h",
    }
    assert set(native_files("render/march_cpu")) == names
    paths = copy_kernel("render/march_cpu", tmp_path / "lifted", alone=True)
    assert {tmp_path / "lifted" / name for name in names} < set(paths)
    program += "from lifted.render import march_cpu\nassert wp.load_module(march_cpu, device='cpu') is not False\n"
    run_program(tmp_path, program)


@pytest.mark.parametrize("path", sorted(FOLDER.rglob("*.h")), ids=lambda path: path.name)
def test_a_kernel_reads_every_file_of_native_code(path):
    assert any(path.relative_to(FOLDER).as_posix() in native_files(name) for name in NAMES)


def test_names_of_kernel_files():
    for text in ("mean_value", "coordinates/mean_value", "coordinates.mean_value"):
        assert find_kernel(text) == "coordinates/mean_value"
    refused(lambda: find_kernel("mean_valu"), match=MESSAGES["core.kernel_meant"])
    refused(lambda: find_kernel("march"), match=MESSAGES["core.kernel_of_several"])
    refused(lambda: find_kernel("zzz"), match="'zzz'; `warpcage kernels list`")


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
    text = capsys.readouterr().out
    assert [line.split()[0] for line in text.splitlines()] == NAMES
    assert re.search("^coordinates/mean_value +Mean value coordinates", text, re.MULTILINE)


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
    refused(lambda: copy_kernel("coordinates/mean_value", tmp_path / "lifted"), error=OSError)
    assert [path.name for path in (tmp_path / "lifted").iterdir()] == ["mesh"]


@pytest.mark.parametrize("name", WITH_KERNELS)
def test_loads_and_no_loop_is_around_kernels(name, device):
    """Warp's loop for launches of fewer threads than items keeps registers through all of a kernel."""
    for module in warp_modules(name):
        wp.load_module(module, device=device)
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
    assert declared[0].module.name == "warpcage.kernels.render.views.shaded" and declared[0].module in modules


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
    """What compiled.json does not know as compiled: `python tests/support/compiled.py` writes it anew."""
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


# -- Groups: kernels with host code, a licence and a README


def refused_of(group, folder):
    """What a copied group runs without: warpcage, and what its README does not name of what `pip install` brings."""
    readme = (folder / "my_kernels" / group / "README.md").read_text(encoding="utf-8")
    allowed = set(" ".join(re.findall(r"`pip install\s([^`]+)`", readme)).split())
    assert "warp-lang" in allowed or "warpcage" in allowed
    others = () if "warpcage" in allowed else [module for name, module in OPTIONAL.items() if name not in allowed]
    return {"warpcage", *others}


def run_calls(groups, folder):
    """Copy groups and run their calls in one process: those that need least first."""
    for group in groups:
        copied(group, folder)
        (folder / f"call_{group}.py").write_text(kernel_call(group), encoding="utf-8")
    calls = sorted(
        ((f"call_{group}.py", refused_of(group, folder)) for group in groups), key=lambda call: -len(call[1])
    )
    run_program(folder, REFUSING.format(calls=calls))


def test_copied_groups_run_without_warpcage(tmp_path):
    """In one process, which compiles once what they share; at night each has one of its own."""
    run_calls(GROUPS, tmp_path)


@pytest.mark.nightly
@pytest.mark.parametrize("group", GROUPS)
def test_a_copied_group_runs_without_warpcage(group, tmp_path):
    run_calls([group], tmp_path)


def test_copied_groups_are_complete(tmp_path):
    """Kernels, the licence, and whatever a module in a copy imports; nothing names warpcage in an import."""
    for group in GROUPS:
        files = copied(group, tmp_path / group)
        assert {f"{name}.py" for name in kernel_names() if name.startswith(f"{group}/")} <= files
        assert {"LICENSE", "NOTICE", "__init__.py", f"{group}/README.md"} <= files
        assert "import warpcage" not in kernel_call(group) and "from warpcage" not in kernel_call(group)
        require_complete(tmp_path / group / "my_kernels")


def test_host_code_is_what_the_call_needs(tmp_path):
    """Nothing where kernels call the functions themselves; for maps the lattice, the meshes, and what they stand on."""
    for group in ("core", "coordinates", "view"):
        assert not any(file.startswith("host/") for file in copied(group, tmp_path / group))
    host = {file.removeprefix("host/") for file in copied("lattice", tmp_path) if file.startswith("host/")} - {
        "__init__.py"
    }
    packages = {"core", "lattice", "mesh"}
    assert {file.partition("/")[0] for file in host} == {
        *packages,
        "coordinate_kinds.py",
        "easings.py",
        "errors.py",
        "package.py",
    }
    assert {"lattice/harmonic.py", "lattice/solver.py", "lattice/position_map.py"} <= host


def test_a_file_comes_with_what_runs_it_or_alone(tmp_path, capsys):
    files = copied("harmonic", tmp_path)
    assert {"lattice/harmonic_coarse.py", "host/lattice/harmonic.py", "lattice/README.md"} <= files
    modules = sum(each.startswith("host/") and each != "host/__init__.py" for each in files)
    assert f"host: {modules} modules" in capsys.readouterr().out
    alone = copied("harmonic", tmp_path / "other", "--alone")
    assert {"lattice/harmonic.py", "lattice/README.md", "LICENSE"} <= alone and not any(
        "host/" in each for each in alone
    )
    assert "coordinates/green.py" not in copied("mean_value", tmp_path / "third", "--alone")  # which the call imports
    text = (tmp_path / "third" / "my_kernels" / "coordinates" / "README.md").read_text(encoding="utf-8")
    assert "coordinates.green" not in text and "- `mean_value_position(x, vertices, faces, fans, targets" in text


@pytest.mark.parametrize("options", [(), ("--alone",)])
@pytest.mark.parametrize("group", GROUPS)
def test_readmes_say_how_kernels_are_launched(group, options, tmp_path):
    """What `first`, `span` and structs are, and where cages are to be; alone, what each kernel takes."""
    alone = {"lattice": "harmonic", "render": "views"}.get(group, group) if options else group
    files = copied(alone, tmp_path, *options)
    text = (tmp_path / "my_kernels" / group / "README.md").read_text(encoding="utf-8")
    for said in ("`first`", "`span`", "Structs", "Near the origin", "record_tape=False"):
        assert said in text
    assert text.startswith((FOLDER / group / "README.md").read_text(encoding="utf-8").partition("\n")[0])
    if options and alone == "harmonic":
        assert "- `relax_laplace(first, span, level, color, system)`: Half a Gauss-Seidel sweep" in text
    assert ("my_kernels.host" in text) == any("host/" in each for each in files)


def test_a_readme_with_a_call_takes_the_place_of_one_without(tmp_path):
    """Which knows all kernel files of its folder that were copied; one of somebody's own stays."""
    readme = tmp_path / "my_kernels" / "lattice" / "README.md"
    for name, said in (
        ("lattice/nodes", "`nodes.py`: "),
        ("harmonic", "`nodes.py`: "),
        ("harmonic", "`harmonic.py`: "),
    ):
        copied(name, tmp_path, "--alone")
        assert said in readme.read_text(encoding="utf-8")
    copied("lattice", tmp_path)
    assert kernel_call("lattice") in readme.read_text(encoding="utf-8")
    readme.write_text("# mine\n", encoding="utf-8")
    copied("lattice", tmp_path)
    assert readme.read_text(encoding="utf-8") == "# mine\n"


#: Imports all modules of a copy below the working folder, without warpcage, and all names of its packages.
IMPORTING = """\
import importlib, pathlib, sys
import warp as wp

sys.modules["warpcage"] = None  # so that importing it fails
sys.path.insert(0, ".")
wp.init()
before = dict(vars(wp.config))
for path in sorted(pathlib.Path("sim").rglob("*.py")):
    module = importlib.import_module(".".join(path.with_suffix("").parts).removesuffix(".__init__"))
    if path.name == "__init__.py":
        for name in dir(module):
            getattr(module, name)
        exec(f"from {module.__name__} import *")
assert dict(vars(wp.config)) == before and before["log_level"] == wp.LOG_INFO
assert not [name for name in sys.modules if name.startswith("warpcage") and sys.modules[name]]
"""


def test_a_copy_is_imported_by_any_name_and_leaves_the_settings_of_warp(tmp_path):
    """In somebody's package: each module, and each name that its packages offer."""
    for group in ("lattice", "splats"):
        assert main(["kernels", "copy", group, str(tmp_path / "sim" / "vendor" / f"our_{group}")]) == 0
    for folder in ("sim", "sim/vendor"):
        (tmp_path / folder / "__init__.py").touch()
    run_program(tmp_path, IMPORTING)


@pytest.mark.parametrize(
    ("segments", "offset", "error"),
    [(0, 0, 1e-6), (0, 100, 5e-5), (0, 1000, 5e-4), (3, 0, 1e-6), (3, 100, 2e-4), (3, 1000, 2e-3)],
)
def test_what_cages_far_from_the_origin_cost(segments, offset, error, device):
    """As the README.md of copies says: in kernels, as shares of the cage's size, of an octahedron and of a box.
    What the package launches costs nothing of it."""
    upper = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2]])
    cage = warpcage.Cage(
        np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]]) / 2,
        np.concatenate([upper, np.where(upper == 2, 5, upper)[:, ::-1]]),
    )
    if segments:
        cage = warpcage.Cage.box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5), segments=segments)
    assert len(cage.faces) == (108 if segments else 8)
    points = np.random.default_rng(0).uniform(-0.15, 0.15, (2000, 3))
    away, turn = np.array([1.0, 0.7, -0.3]) * offset, np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    near = [points, cage.vertices, cage.vertices @ turn.T]
    places, vertices, targets = (wp.array(x + away, dtype=wp.vec3, device=device) for x in near)
    faces = wp.array(cage.faces, dtype=wp.vec3i, device=device)
    fans = wp.empty(2 * len(cage.faces), dtype=wp.vec4, device=device)
    wp.launch(prepare_fans, len(cage.faces), [0, vertices, faces, 1.0], [fans], device=device)
    moved = wp.empty(len(points), dtype=wp.vec3, device=device)
    inputs, threads = [0, places, vertices, faces, fans, targets, 1.0], map_mean_value.module.options["block_dim"]
    wp.launch(map_mean_value, len(points), inputs, [moved], device=device, block_dim=threads)
    expected = points @ turn.T + away
    assert (error / 10 if offset else 0) < np.abs(moved.numpy() - expected).max() < 2 * error
    rest, posed = (cage.with_vertices(x + away) for x in near[1:])
    assert np.abs(warpcage.deform_points(points + away, rest, posed, device=device) - expected).max() < 1e-6


def test_a_copied_readme_names_the_copy(tmp_path):
    assert main(["kernels", "copy", "mesh", str(tmp_path / "borrowed")]) == 0
    text = (tmp_path / "borrowed" / "mesh" / "README.md").read_text(encoding="utf-8")
    assert text.startswith(
        (FOLDER / "mesh" / "README.md").read_text(encoding="utf-8").replace("my_kernels", "borrowed")
    )
    assert "from borrowed.host.mesh.queries import" in text
