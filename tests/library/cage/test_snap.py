"""Walls of a local cage move to gaps in the matter."""

import numpy as np
import pytest
from fields import boxes, make_field, plain
from refusals import refused

from warpcage import Cage
from warpcage.cage import cut_matter, snap_to_gaps
from warpcage.studio.cli import main

#: Two blocks with a gap between them, x from 0.0 to 0.15, and a plate below both.
BLOCKS = (([-0.8, -0.4, -0.3], [0.0, 0.4, 0.5]), ([0.15, -0.4, -0.3], [0.8, 0.4, 0.5]))
PLATE = ([-0.9, -0.6, -0.9], [0.9, 0.6, -0.6])


@pytest.fixture
def field(device):
    return make_field(boxes(*BLOCKS, PLATE), plain([0.8, 0.3, 0.1]), device=device)


def test_a_wall_goes_to_the_gap_next_to_it(field):
    for start in (-0.1, 0.3):  # in the one block, and in the other
        cage = Cage.box([start, -0.7, -0.45], [0.95, 0.7, 0.7], segments=2)
        snapped = snap_to_gaps(cage, field, 0.25)
        low, high = snapped.bounds
        assert -0.03 < low[0] < 0.18 and cut_matter(snapped, field) < 0.1 * cut_matter(cage, field)
        np.testing.assert_array_equal(low[1:], cage.bounds[0, 1:])
        np.testing.assert_array_equal(high, cage.bounds[1])
        # walls stay flat, with their middle vertices on them
        assert np.isclose(snapped.vertices[:, 0], low[0]).sum() == np.isclose(cage.vertices[:, 0], start).sum()
        np.testing.assert_array_equal(snapped.faces, cage.faces)


def test_turned_cages_and_walls_without_a_gap(field):
    cage = Cage.box([0.3, -0.7, -0.75], [0.95, 0.7, 0.7], segments=2)  # its bottom cuts the plate wherever it goes
    snapped = snap_to_gaps(cage, field, 0.1)
    assert snapped.bounds[0, 2] == -0.75
    assert snapped.bounds[0, 0] == 0.3  # no gap in reach: where it was
    turned = cage.rotate(10, axis="z", center=[0.3, 0, 0])
    assert cut_matter(snap_to_gaps(turned, field, 0.3), field) < 0.6 * cut_matter(turned, field)
    free = Cage.box([-0.95, -0.7, -0.95], [0.95, 0.7, 0.7])
    np.testing.assert_array_equal(snap_to_gaps(free, field, 0.1).vertices, free.vertices)


def test_bad_snaps_are_refused(field):
    cage = Cage.box([0.3, -0.7, -0.45], [0.4, 0.7, 0.7])
    refused(lambda: snap_to_gaps(cage, field, 0.0), match="reach must be")
    refused(lambda: snap_to_gaps(Cage(cage.vertices, cage.faces[1:]), field, 0.1), match="the cage to snap")


def test_snap_on_the_command_line(tmp_path, capsys):
    make_field(boxes(*BLOCKS, PLATE), plain([0.8, 0.3, 0.1])).save(tmp_path / "blocks.npz")
    Cage.box([-0.1, -0.7, -0.45], [0.95, 0.7, 0.7], segments=2).save(tmp_path / "box.obj")
    arguments = [
        "cage",
        str(tmp_path / "blocks.npz"),
        "-o",
        str(tmp_path / "snapped.obj"),
        "--snap",
        str(tmp_path / "box.obj"),
    ]
    assert main([*arguments, "--reach", "0.25"]) == 0
    said = capsys.readouterr().out
    assert "% less" in said
    assert -0.03 < Cage.load(tmp_path / "snapped.obj").bounds[0, 0] < 0.18
    assert main(arguments) == 2 and "--snap needs --reach" in capsys.readouterr().err
    assert main([*arguments, "--reach", "0.1", "--box"]) == 2
