import json

import numpy as np
import pytest
import trimesh
from oracles import shuffled_cage
from refusals import refused

from warpcage import Cage
from warpcage.studio.cli import main


def rod(segments=12):
    return Cage.box([0, 0, 0], [1, 1, 4], segments=(1, 1, segments))


@pytest.mark.parametrize(
    ("pose", "volume", "stretch"),
    [
        (lambda c: c, 1.0, (1, 1)),
        (lambda c: c.rotate(30, axis=[1, 2, 3]).translate([5, 6, 7]), 1.0, (1, 1)),
        (lambda c: c.scale([0.5, 2.0, 3.0]), 3.0, (0.5, 3)),
        (lambda c: c.stretch(2.0), 2.0, (1, 2)),
    ],
)
def test_affine_poses_have_their_stretch_everywhere(pose, volume, stretch):
    report = rod().check(pose=pose(rod())).pose
    assert report.volume_ratio == pytest.approx(volume)
    assert (report.least_stretch, report.largest_stretch) == pytest.approx(stretch, rel=0.02)
    assert report.inverted_share == report.outside_share == 0.0 and report.intersecting_faces == ()
    assert report.usable and report.sample_count > 500


def test_a_fold_and_a_pose_turned_inside_out_are_told():
    tight = rod(16).check(pose=rod(16).bend(200, limits=(0.25, 0.5)))
    assert len(tight.pose.intersecting_faces) > 10 and tight.pose.inverted_share > 0.05 and tight.usable
    assert "turned inside out" in str(tight) and "bring the vertices there apart" in str(tight)
    mirrored = rod().with_vertices(rod().vertices * [-1, 1, 1])
    report = rod().check(pose=mirrored)
    assert not report.usable and not report.pose.usable and "looks inward" in str(report)
    assert "the cage looks inward" not in str(report)  # the pose does
    assert json.loads(json.dumps(report.as_dict()))["pose"]["usable"] is False


def test_a_gentle_bend_stretches_by_its_curvature():
    # outer and inner line at half a side from the middle: 1 +- 0.5 * angle / length
    report = rod(40).check(pose=rod(40).bend(40)).pose
    reach = 0.5 * np.deg2rad(40) / 4
    assert report.largest_stretch == pytest.approx(1 + reach, abs=0.03)
    assert report.least_stretch == pytest.approx(1 - reach, abs=0.03)


def test_poses_are_matched_first_or_refused():
    cage = rod()
    assert cage.check(pose=shuffled_cage(cage.bend(30))).pose.inverted_share == 0.0
    refused(lambda: cage.check(pose=Cage.box([0, 0, 0], [1, 1, 1])), match="the pose has")


def test_leaks_are_named_by_face():
    cage = Cage.box([0, 0, 0], [1, 1, 1])
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.4).apply_translation([0.5, 0.5, 0.9])
    report = cage.check(mesh=mesh)
    top = np.flatnonzero((cage.vertices[cage.faces][..., 2] == 1).all(axis=1))
    assert 0.4 < report.mesh_enclosed < 0.8
    assert {face for face, _ in report.leaking_faces} == set(top.tolist())
    assert sum(count for _, count in report.leaking_faces) == round((1 - report.mesh_enclosed) * len(mesh.vertices))
    assert "leaks nearest to faces" in str(report) and cage.check().leaking_faces == ()


def test_cost_counts_the_lattice():
    report = Cage.box([0, 0, 0], [1, 1, 1]).check()
    assert report.cost["nodes"] == 134**3 and report.cost["inside_nodes"] == 128**3
    assert report.cost["face_terms"] == 12 * 128**3 and report.cost["weight_bytes"] == 8 * 4 * 128**3
    from warpcage.lattice import CageLattice

    assert rod().check().cost["nodes"] == pytest.approx(CageLattice(rod(), 128).node_count, rel=0.1)


def test_command_line(tmp_path, capsys):
    cage = rod()
    cage.save(tmp_path / "cage.obj")
    shuffled_cage(cage.bend(40)).save(tmp_path / "posed.glb")
    Cage(cage.vertices, cage.faces[1:]).save(tmp_path / "open.off")
    trimesh.creation.box([0.5, 0.5, 3]).apply_translation([0.5, 0.5, 2]).export(tmp_path / "inside.ply")
    arguments = ["--object", str(tmp_path / "inside.ply"), "--posed", str(tmp_path / "posed.glb")]

    assert main(["check", str(tmp_path / "cage.obj"), *arguments]) == 0
    text = capsys.readouterr().out
    assert "100.000 %" in text and "pose: stretch" in text and text.strip().endswith("yes")
    assert main(["check", str(tmp_path / "cage.obj"), "--json", *arguments]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["usable"] and report["mesh_enclosed"] == 1.0 and report["pose"]["inverted_share"] == 0.0
    assert report["cost"]["resolution"] == 128 and report["file"].endswith("cage.obj")

    assert main(["check", str(tmp_path / "open.off")]) == 1
    assert "fill the holes" in capsys.readouterr().out
    assert main(["check", str(tmp_path / "open.off"), "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["usable"] is False
    assert main(["check", str(tmp_path / "open.off"), "--repair", str(tmp_path / "mended.ply")]) == 0
    assert "repair: closed a hole of 3 edges" in capsys.readouterr().out
    Cage.load(tmp_path / "mended.ply").require_usable()
    assert main(["check", str(tmp_path / "nothing.obj")]) == 2
    assert main(["check", str(tmp_path / "cage.obj"), "--posed", str(tmp_path / "inside.ply")]) == 2
    assert "the pose has" in capsys.readouterr().err
