"""`warpcage kernels copy` of each folder of kernels: a package with host code, a licence and a README, whose call runs
where neither warpcage nor what the README does not name can be imported."""

import ast
import re
import subprocess
import sys

import pytest

from warpcage.cli import main
from warpcage.core import FOLDER, host_modules, kernel_call, kernel_groups, kernel_names

GROUPS = kernel_groups()

#: Runs a file where the packages of the environment that are named cannot be imported.
REFUSING = """\
import runpy
import sys


class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in self.names:
            raise ImportError(f"{{name}} is refused")


sys.meta_path.insert(0, Refuse())
sys.path.insert(0, ".")
for call, Refuse.names in {calls}:
    runpy.run_path(call, run_name="__main__")
assert "my_kernels" in sys.modules and "warpcage" not in sys.modules
"""

#: What `pip install` of these names brings, as modules.
OPTIONAL = {"scipy": "scipy", "trimesh": "trimesh", "imageio": "imageio", "pillow": "PIL", "scikit-image": "skimage",
            "tqdm": "tqdm", "pymeshlab": "pymeshlab", "av": "av", "packaging": "packaging"}  # fmt: skip


def copied(name, folder, *words):
    assert main(["kernels", "copy", name, str(folder / "my_kernels"), *words]) == 0
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
    (folder / "program.py").write_text(REFUSING.format(calls=calls), encoding="utf-8")
    done = subprocess.run([sys.executable, "program.py"], cwd=folder, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr


def test_copied_groups_run_without_warpcage(tmp_path):
    """In one process, which compiles once what they share; at night each has one of its own."""
    run_calls(GROUPS, tmp_path)


@pytest.mark.nightly
@pytest.mark.parametrize("group", GROUPS)
def test_a_copied_group_runs_without_warpcage(group, tmp_path):
    run_calls([group], tmp_path)


@pytest.mark.parametrize("group", GROUPS)
def test_a_copied_group_is_complete(group, tmp_path):
    """Its kernels, the licence, and whatever a module in it imports; nothing names warpcage in an import."""
    files = copied(group, tmp_path)
    assert {f"{name}.py" for name in kernel_names() if name.startswith(f"{group}/")} <= files
    assert {"LICENSE", "NOTICE", "__init__.py", f"{group}/README.md"} <= files
    assert "import warpcage" not in kernel_call(group) and "from warpcage" not in kernel_call(group)
    root = tmp_path / "my_kernels"
    for path in root.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"^\s*(from|import) warpcage", text, re.MULTILINE), path
        for level, module, names in run_imports(ast.parse(text)):
            base = path.parents[level - 1].joinpath(*module.split("."))
            assert base.with_suffix(".py").is_file() or base.is_dir(), (path, module)
            if base.is_dir():
                init = (base / "__init__.py").read_text(encoding="utf-8")
                assert all((base / f"{name}.py").is_file() or name in init for name in names), (path, module, names)


def test_host_code_is_what_the_call_needs():
    """Nothing where kernels call the functions themselves; for maps the lattice, the meshes, and what they stand on."""
    assert not any(map(host_modules, ("core", "coordinates", "view")))
    rooms = {name.partition("/")[0] for name in host_modules("lattice")}
    assert rooms == {"core", "errors", "lattice", "mesh", "package"}
    assert {"lattice/harmonic", "lattice/solver", "lattice/position_map"} <= set(host_modules("lattice"))


def test_a_file_comes_with_what_runs_it_or_alone(tmp_path, capsys):
    files = copied("harmonic", tmp_path)
    assert {"lattice/harmonic_coarse.py", "host/lattice/harmonic.py", "lattice/README.md"} <= files
    modules = sum(each.startswith("host/") and each != "host/__init__.py" for each in files)
    assert f"host: {modules} modules" in capsys.readouterr().out
    alone = copied("harmonic", tmp_path / "other", "--alone")
    assert {"lattice/harmonic.py", "LICENSE"} <= alone and not any(
        "host/" in each or "README" in each for each in alone
    )


def test_a_copied_readme_names_the_copy(tmp_path):
    assert main(["kernels", "copy", "mesh", str(tmp_path / "borrowed")]) == 0
    text = (tmp_path / "borrowed" / "mesh" / "README.md").read_text(encoding="utf-8")
    assert text == (FOLDER / "mesh" / "README.md").read_text(encoding="utf-8").replace("my_kernels", "borrowed")
    assert "from borrowed.host.mesh.queries import" in text
