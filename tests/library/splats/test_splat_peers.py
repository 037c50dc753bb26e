"""Files of splats between warpcage and PlayCanvas' splat-transform: each reads the other's, as the same splats.

They are skipped where there is no such program: npm install -g @playcanvas/splat-transform (2.7.1 was tried).
"""

import shutil
import subprocess

import numpy as np
import pytest
from refusals import refused
from splat_scenes import field_of, loaded, some_splats

PROGRAM = shutil.which("splat-transform")
pytestmark = pytest.mark.skipif(PROGRAM is None, reason="splat-transform is not installed")

#: Largest differences: places, logarithms of scales, shapes, opacities, first and further harmonics.
BOUNDS = {
    ".ply": (0.0, 0.0, 1e-6, 1e-6, 0.0, 0.0),
    ".compressed.ply": (5e-3, 4e-3, 2e-2, 3e-3, 8e-3, 2e-2),
    ".splat": (0.0, 1e-6, 4e-2, 3e-3, 8e-3, None),
    ".spz": (1.3e-4, 3.2e-2, 7e-2, 3e-3, 1.4e-2, 4e-3),
    ".sog": (2e-4, 3e-2, 7e-2, 4e-3, 6e-3, 6e-3),
    ".glb": (0.0, 1e-6, 1e-6, 1e-6, 1e-6, 1e-6),
}


def transform(*arguments):
    """Let the program write a file of another."""
    call = [PROGRAM, "-q", "-w", "-g", "cpu", *map(str, arguments)]
    run = subprocess.run(call, capture_output=True, text=True, timeout=300)
    assert run.returncode == 0, run.stderr


def assert_same(field, other, bounds, share=1.0):
    """Fields are the same splats in any order, within the errors of a format; share: of the further harmonics."""
    place, scale, shape, opacity, color, further = bounds
    distance = np.linalg.norm(field.contents.centers[:, None] - other.contents.centers[None], axis=2)
    rows = distance.argmin(axis=1)
    assert sorted(rows) == list(range(len(field)))
    other = other.chosen(rows)
    old, new = field.contents, other.contents
    assert np.abs(old.centers - new.centers).max() <= place
    assert np.abs(np.sort(old.log_scales, axis=1) - np.sort(new.log_scales, axis=1)).max() <= scale
    size = (field.scales**2).max(axis=1)[:, None, None]
    assert np.abs((field.covariances - other.covariances) / size).max() <= shape
    assert np.abs(field.opacities - other.opacities).max() <= opacity
    assert np.abs(old.harmonics[:, 0] - new.harmonics[:, 0]).max() <= color
    if further is None:
        assert new.harmonics.shape[1] == 1
    else:
        assert np.quantile(np.abs(old.harmonics[:, 1:] - new.harmonics[:, 1:]), share) <= further


@pytest.mark.parametrize("ending, version", [(each, None) for each in BOUNDS if each != ".glb"] + [(".spz", 4)])
def test_the_program_reads_what_we_write(ending, version, tmp_path):
    field = field_of(some_splats())
    field.save(tmp_path / f"ours{ending}", version=version)
    transform(tmp_path / f"ours{ending}", tmp_path / "theirs.ply")
    assert_same(field, loaded(tmp_path / "theirs.ply"), BOUNDS[ending])


@pytest.mark.parametrize(
    "name, arguments",
    [(f"a{ending}", ()) for ending in (".compressed.ply", ".sog", ".glb")]
    + [("meta.json", ()), ("a.spz", ("--spz-version", "3")), ("a.spz", ("--spz-version", "4"))],
)
def test_we_read_what_the_program_writes(name, arguments, tmp_path):
    field = field_of(some_splats())
    field.save(tmp_path / "ours.ply")
    transform(*arguments, tmp_path / "ours.ply", tmp_path / name)
    ending = ".sog" if name == "meta.json" else name[1:]
    # it packs further harmonics of SPZ in 5 and 4 bits, and those of SOG in clusters, few of which have several splats
    bounds = (*BOUNDS[ending][:5], 0.07) if ending == ".spz" else BOUNDS[ending]
    share = 0.5 if ending == ".sog" else 1.0
    assert_same(field, loaded(tmp_path if name == "meta.json" else tmp_path / name), bounds, share)


@pytest.mark.parametrize("ending", [".ply", ".compressed.ply", ".spz", ".glb"])
def test_opaque_and_clear_splats_and_long_quaternions_stay(ending, tmp_path):
    """Its files have infinite logits for bytes of 0 and 255, and quaternions of any length."""
    contents = some_splats(60, 1)
    contents.logits[:5] = np.inf, -np.inf, 30.0, -30.0, 6.5
    contents.quaternions[:] *= np.geomspace(1e-3, 1e3, 60, dtype=np.float32)[:, None]
    field = field_of(contents)
    field.save(tmp_path / "ours.ply")
    transform(tmp_path / "ours.ply", tmp_path / f"theirs{ending}")
    if ending != ".glb":  # which it only writes
        field.save(tmp_path / f"ours{ending}")
        transform(tmp_path / f"ours{ending}", tmp_path / "back.ply")
        assert_same(field, loaded(tmp_path / "back.ply"), BOUNDS[ending])
    bounds = (*BOUNDS[ending][:5], 0.07) if ending == ".spz" else BOUNDS[ending]
    assert_same(field, loaded(tmp_path / f"theirs{ending}"), bounds)


def test_what_it_mirrors_is_no_splats(tmp_path):
    """A scale below 0 makes sizes that are no numbers."""
    field_of(some_splats(60)).save(tmp_path / "ours.ply")
    transform(tmp_path / "ours.ply", "-s", "-1", tmp_path / "theirs.ply")
    refused(lambda: loaded(tmp_path / "theirs.ply"), match="log_scales that are not finite")
