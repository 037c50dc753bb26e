"""The package imports from a wheel, from a checkout with or without its link, and says what is missing in one line."""

import contextlib
import importlib.metadata
import importlib.util
import os
import pathlib
import re
import shutil
import subprocess
import sys
import tarfile
import types
import zipfile

import pytest
from messages import MESSAGES

import warpcage
from warpcage.examples import __main__ as examples
from warpcage.package import NEEDED

ROOT = pathlib.Path(__file__).parents[2]
SOURCES = ("setup.py", "pyproject.toml", "README.md", "LICENSE", "NOTICE", "warpcage", "kernels", "examples")
LICENCES = ("LICENSE", "NOTICE")
FOUND = "import warpcage; print(warpcage.__file__); print(warpcage.kernels.__file__); print(warpcage.__version__)"


def run(code, cwd, *paths, options=("-S",)):
    """Python in a folder, with these folders on its path and nothing else that is installed."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    if paths:
        environment["PYTHONPATH"] = os.pathsep.join(map(str, paths))
    command = [sys.executable, *options, "-c", code]
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=120)


def site_folders():
    """Where the dependencies are installed; files ending in .pth there, those of editable installs, are not read."""
    return list(dict.fromkeys(pathlib.Path(importlib.util.find_spec(name).origin).parents[1] for name in NEEDED))


def copied_tree(folder, link):
    """A copy of the sources whose warpcage/kernels is missing, or the text that git leaves of a link on Windows."""
    for name in SOURCES:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name, symlinks=True)
        else:
            shutil.copy2(source, folder / name)
    for name in ("kernels", "examples"):
        place = folder / "warpcage" / name
        if place.is_symlink() or place.is_file():
            place.unlink()
        if link == "text":
            place.write_text(f"../{name}")
    return folder


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """A wheel made from a source distribution, as `python -m build` does, that a copy was packed into, so that nothing
    is left in the checkout; and unpacked, as installers do."""
    setuptools = pytest.importorskip("setuptools")
    if tuple(map(int, setuptools.__version__.split(".")[:2])) < (70, 1):
        pytest.skip(f"setuptools {setuptools.__version__} cannot build a wheel by itself: 70.1 can")
    tree = copied_tree(tmp_path_factory.mktemp("sources"), "missing")
    packed = built(tree, "sdist", setuptools)
    with tarfile.open(packed) as archive:
        sources = [each.name.partition("/")[2] for each in archive.getmembers() if each.isfile()]
        folder = tmp_path_factory.mktemp("unpacked")
        archive.extractall(folder)
    (unpacked,) = folder.iterdir()
    path, installed = built(unpacked, "wheel", setuptools), tmp_path_factory.mktemp("installed")
    with zipfile.ZipFile(path) as archive:
        archive.extractall(installed)
        about = [each for each in archive.namelist() if ".dist-info/" in each]
        files = [each for each in archive.namelist() if each not in about]
    sizes = {each.name: each.stat().st_size for each in (packed, path)}
    return types.SimpleNamespace(
        name=path.name, files=files, about=about, installed=installed, sources=sources, sizes=sizes
    )


def built(tree, kind, setuptools):
    """The distribution of a kind that is made of a folder of sources."""
    code = f"import setuptools.build_meta as build; print(build.build_{kind}('dist'))"
    done = run(code, tree, pathlib.Path(setuptools.__file__).parents[1])
    assert done.returncode == 0, done.stderr
    return tree / "dist" / done.stdout.split()[-1]


def imported_from(cwd, *paths):
    """The folder that `import warpcage` takes the package from, and that of its kernels."""
    found = run(FOUND, cwd, *paths, *site_folders())
    assert found.returncode == 0, found.stderr
    package, kernels, version = found.stdout.split("\n")[:3]
    assert version == warpcage.__version__
    return pathlib.Path(package).parent, pathlib.Path(kernels).parent


def test_a_checkout_imports_with_nothing_of_it_installed(tmp_path):
    tree = copied_tree(tmp_path, "text")
    assert imported_from(tree) == (tree / "warpcage", tree / "kernels")


def test_a_checkout_imports_with_a_wheel_installed(wheel, tmp_path):
    tree = copied_tree(tmp_path, "missing")
    assert imported_from(tree, wheel.installed) == (tree / "warpcage", tree / "kernels")


def test_a_wheel_imports_elsewhere_and_beside_a_clone_of_its_name(wheel, tmp_path):
    """The folder of a clone is no package, so that it does not stand before one."""
    package = wheel.installed / "warpcage"
    assert imported_from(tmp_path, wheel.installed) == (package, package / "kernels")
    (tmp_path / "warpcage").symlink_to(ROOT, target_is_directory=True)
    assert imported_from(tmp_path, wheel.installed) == (package, package / "kernels")


@pytest.mark.nightly
def test_an_installed_wheel_runs_examples_by_name(wheel, tmp_path):
    program = "import runpy, sys; sys.argv[1:] = ['deform_in_a_pipeline']; "
    program += "runpy.run_module('warpcage.examples', run_name='__main__')"
    done = run(program, tmp_path, wheel.installed, *site_folders())
    assert done.returncode == 0 and "own renderer" in done.stdout, done.stderr


def test_examples_are_listed_and_looked_up_by_name(capsys):
    assert examples.main([]) == 0
    names = {line.split()[0] for line in capsys.readouterr().out.splitlines()[2:]}
    assert names == {path.stem for path in (ROOT / "examples").glob("[a-z]*.py")}
    assert examples.main(["deform_mash"]) == 2
    said = capsys.readouterr().err
    assert "did you mean deform_mesh?" in said and said.count("\n") == 1


def test_a_wheel_holds_every_file_once(wheel):
    linked = {ROOT / "warpcage" / name for name in ("kernels", "examples")}
    package = [path for path in (ROOT / "warpcage").rglob("*.py") if linked.isdisjoint(path.parents)]
    expected = [path.relative_to(ROOT).as_posix() for path in package] + ["warpcage/py.typed", "warpcage/__init__.pyi"]
    kernels = [path for pattern in ("*.py", "*.h", "*.md") for path in (ROOT / "kernels").rglob(pattern)]
    expected += [f"warpcage/{path.relative_to(ROOT).as_posix()}" for path in kernels]
    examples = [path for pattern in ("*.py", "clusters/*.*") for path in (ROOT / "examples").glob(pattern)]
    expected += [f"warpcage/{path.relative_to(ROOT).as_posix()}" for path in examples]
    page = sorted((ROOT / "warpcage" / "studio" / "editor" / "page").rglob("*.*"))
    assert {path.suffix for path in page} == {".html", ".css", ".js", ".svg"}
    expected += [path.relative_to(ROOT).as_posix() for path in page]
    assert sorted(wheel.files) == sorted(expected)
    assert wheel.name.startswith(f"warpcage-{warpcage.__version__}-")
    packed = {re.sub("^warpcage/(?=kernels/|examples/)", "", each) for each in expected}
    assert packed | {"setup.py", "pyproject.toml", "README.md", *LICENCES} <= set(wheel.sources)


def test_licences_are_in_wheels_and_both_are_small(wheel):
    assert {path.rpartition("/")[2] for path in wheel.about if "/licenses/" in path} == set(LICENCES)
    assert len(wheel.sizes) == 2 and max(wheel.sizes.values()) < 3_000_000


FAMILIES = "Apache|MIT|BSD|MPL|GPL|ISC|Zlib|CC0"


def installed_licences(name):
    """Families of the licences that an installed package names, empty where it names none."""
    about = importlib.metadata.metadata(name)
    listed = [each for each in about.get_all("Classifier") or [] if each.startswith("License ::")]
    words = about.get("License-Expression") or " ".join(listed) or about.get("License") or ""
    return set(re.findall(rf"\b(?:{FAMILIES})", words))  # a text in full has IMPLIED, which is no MPL


def test_the_notice_lists_every_dependency_with_its_licence(wheel):
    (path,) = (each for each in wheel.about if each.endswith("/METADATA"))
    about = (wheel.installed / path).read_text(encoding="utf-8")
    needs = {name.lower() for name in re.findall(r"^Requires-Dist: ([\w.-]+)", about, re.MULTILINE)}
    notice = (ROOT / "NOTICE").read_text(encoding="utf-8")
    listed = dict(re.findall(r"^  ([\w.-]+) {3,}(\S.*)$", notice.lower(), re.MULTILINE))
    assert set(listed) == needs
    compared = 0
    for name in needs:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found = {each.lower() for each in installed_licences(name)}
            assert found <= set(re.findall(FAMILIES.lower(), listed[name])), name
            compared += bool(found)
    assert compared > 10


def test_missing_dependencies_are_named_in_one_line():
    refused = run("import warpcage", ROOT, options=("-S", "-E"))
    last = refused.stderr.rstrip().split("\n")[-1]
    assert re.fullmatch(MESSAGES["core.dependencies"].format(folder=re.escape(str(ROOT))), last)
    assert refused.returncode == 1 and refused.stderr.count("Traceback") == 1


def test_missing_kernels_are_named_in_one_line(tmp_path):
    tree = copied_tree(tmp_path, "missing")
    shutil.rmtree(tree / "kernels")
    refused = run("import warpcage", tree, *site_folders())
    last = refused.stderr.rstrip().split("\n")[-1]
    assert last.startswith("ImportError: warpcage.kernels is missing: ") and refused.stderr.count("Traceback") == 1
