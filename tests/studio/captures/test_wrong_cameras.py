"""Cameras that come out wrong are mended by another way, left out, or refused with the pictures' names."""

import numpy as np
import pytest
from correspondences import FOCAL, correspondences, inside_out, orbit, torn_in_two
from refusals import refused

from warpcage.studio.captures import Solver, doubts, solve

pycolmap = pytest.importorskip("pycolmap", minversion="4.2")

SIZE = (800, 600)
MIDDLE = np.array(SIZE) / 2
COUNT = 14
LABELS = [f"p{k:02d}" for k in range(COUNT)]


def write_database(path, slopes, matches):
    """COLMAP's file of pictures whose features and verified matches are given."""
    database = pycolmap.Database.open(path)
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", FOCAL, *SIZE)
    database.write_camera(camera, use_camera_id=True)
    numbers = []
    for label, part in zip(LABELS, slopes, strict=True):
        numbers.append(database.write_image(pycolmap.Image(name=f"{label}.png", camera_id=1)))
        database.write_keypoints(numbers[-1], (FOCAL * part + MIDDLE).astype(np.float32))
    for (a, b), rows in matches.items():
        geometry = pycolmap.TwoViewGeometry()
        geometry.inlier_matches = rows.astype(np.uint32)
        geometry.config = pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED
        database.write_two_view_geometry(numbers[a], numbers[b], geometry)
    database.close()


def reconstruction(slopes, poses):
    """A model of COLMAP with cameras at these poses, and points that hold them."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", FOCAL, *SIZE)
    model.add_camera_with_trivial_rig(camera)
    for k, (label, part, pose) in enumerate(zip(LABELS, slopes, poses, strict=True), 1):
        image = pycolmap.Image(name=f"{label}.png", image_id=k, camera_id=1, keypoints=FOCAL * part + MIDDLE)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.linalg.inv(pose)[:3]))
    for place in np.random.default_rng(0).uniform(-1, 1, (COUNT // 2, len(slopes[0]), 3)).reshape(-1, 3):
        track, number = pycolmap.Track(), model.num_points3D()
        for image in (1, 2):  # a point for each feature of two pictures after one another
            track.add_element(2 * (number // len(slopes[0])) + image, number % len(slopes[0]))
        model.add_point3D(place, track)
    return model


class MadeSolver(Solver):
    """Its ways find given models, None for none."""

    def __init__(self, folder, at_once, one_by_one):
        super().__init__(folder / "database.db", folder, [f"{x}.png" for x in LABELS], [0] * COUNT, [None], [SIZE])
        self.models, self.asked = {"at once": at_once, "one by one": one_by_one}, []

    def _way(self, name):
        self.asked.append(name)
        return [] if self.models[name] is None else [self.models[name]]

    def map_globally(self, folder):
        return self._way("at once")

    def map(self, folder):
        return self._way("one by one")

    def refine(self, model):
        return model


@pytest.fixture(scope="module")
def scene():
    poses = orbit(COUNT, degrees=90.0)
    return poses, *correspondences(poses, apart=4)


def solved(folder, scene, at_once, one_by_one):
    """The solution and which ways were asked for; the models are given by the poses of their cameras."""
    _poses, slopes, matches = scene
    folder.mkdir(exist_ok=True)
    write_database(folder / "database.db", slopes, matches)
    models = [None if each is None else reconstruction(slopes, each) for each in (at_once, one_by_one)]
    solver = MadeSolver(folder, *models)
    found = solve(solver, folder / "mapping", folder / "in", LABELS, folder / "kept")
    assert (folder / "kept").is_dir()
    return found, solver.asked


def test_right_cameras_are_taken_at_once(tmp_path, scene):
    found, asked = solved(tmp_path, scene, scene[0], scene[0])
    assert asked == ["at once"] and found.score > 0.9 and len(found.found.pictures) == COUNT
    again = MadeSolver(tmp_path, None, None)  # what was found is read again
    kept = solve(again, tmp_path / "mapping", tmp_path / "in", LABELS, tmp_path / "kept")
    assert again.asked == [] and kept.score == found.score


@pytest.mark.parametrize("wrong", [inside_out, lambda poses: torn_in_two(poses, 9), lambda poses: None])
def test_the_other_way_is_taken_where_one_comes_out_wrong(tmp_path, scene, wrong):
    found, asked = solved(tmp_path, scene, wrong(scene[0]), scene[0])
    assert asked == ["at once", "one by one"] and found.score > 0.9
    np.testing.assert_allclose(found.found.poses, scene[0], atol=1e-6)


def test_a_first_solution_is_kept_where_the_second_is_worse(tmp_path, scene):
    poses = scene[0].copy()
    poses[3, :3, 3] += 0.3  # one is wrong: not as good as it could be
    found, asked = solved(tmp_path, scene, poses, inside_out(poses))
    assert asked == ["at once", "one by one"] and len(found.found.pictures) == COUNT - 1


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda poses: torn_in_two(poses, 9), r": 5 .*p09 to p13.* 9 .*p00 to p08"),
        (inside_out, "come out inside out.*least those of p"),
    ],
)
def test_what_comes_out_wrong_both_ways_is_refused(tmp_path, scene, wrong, message):
    refused(lambda: solved(tmp_path, scene, wrong(scene[0]), wrong(scene[0])), match=message)
    assert not (tmp_path / "kept").exists()


def test_a_picture_that_comes_out_wrong_is_left_out(tmp_path, scene):
    poses = scene[0].copy()
    poses[6, :3, 3] += [0.0, 0.0, 1.0]
    found, _ = solved(tmp_path, scene, poses, poses)
    assert found.found.pictures.tolist() == [*range(6), *range(7, COUNT)] and found.agreement.share > 0.9


def test_cameras_that_many_matches_disagree_with_are_named_in_the_report(tmp_path, scene):
    """A fifth of the matches of three pictures is led astray: not refused, and said."""
    poses, slopes, matches = scene
    astray = {pair: rows.copy() for pair, rows in matches.items()}
    for (a, b), rows in astray.items():
        if {a, b} & {4, 5, 6}:
            rows[:25, 1] = (rows[:25, 1] + 7) % 60
    found, _ = solved(tmp_path, (poses, slopes, astray), poses, poses)
    sentences = doubts(found, LABELS)
    assert len(sentences) == 1 and 0.5 < found.agreement.share < 0.9
    assert {"p04", "p05", "p06"} <= set(sentences[0].split("least those of ")[1].split(":")[0].split(", "))
    assert doubts(solved(tmp_path / "b", scene, poses, poses)[0], LABELS) == []
