"""`warpcage fit-pose`: a pose from a folder of pictures."""

import numpy as np
import pytest
from runs import run, succeed, write_files

from warpcage import Cage, Scene, turntable


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The ball of `write_files`, and pictures of it by formula after a shift: cut out, and whole, darker and redder."""
    folder = write_files(tmp_path_factory.mktemp("fit_pose"))
    images, alphas = zip(*(shifted_ball(camera) for camera in CAMERAS), strict=True)
    Scene(np.stack(images), np.stack(alphas), CAMERAS).save(folder / "moved")
    Scene(np.stack(images) * np.float32([0.9, 0.75, 0.6]), None, CAMERAS).save(folder / "photographs")
    return folder


SHIFT = np.array([0.12, -0.1, 0.08])
CAMERAS = turntable((0, 0, 0), 3.0, 20, 4, width=28, height=24, fov_degrees=40)


def shifted_ball(camera, shift=SHIFT):
    """Colours (h, w, 3) before white and opacities (h, w): red above, blue below."""
    origins, directions = camera.rays()
    origins = origins - shift
    along = (origins * directions).sum(-1)
    rest = along**2 - (origins**2).sum(-1) + 0.36  # half a voxel further out
    alpha = (rest > 0).astype(np.float32)
    height = (origins + (-along - np.sqrt(np.maximum(rest, 0)))[..., None] * directions)[..., 2:]
    color = np.where(height > 0, [0.92, 0.08, 0.08], [0.08, 0.08, 0.92])
    return (alpha[..., None] * color + 1 - alpha[..., None]).astype(np.float32), alpha


@pytest.mark.parametrize("up", [(), ("--cage-up", "y")], ids=["cut out", "whole, y up"])
def test_a_shift_is_found_and_written(files, up, capsys):
    """A cage with y up gives a pose with y up, so that `--cage-up` reads both."""
    pictures = ("@photographs", "--exposure") if up else ("@moved",)
    options = ("--parameters", "rigid", "--restarts", "0", "--quiet", "--device", "cpu")
    Cage.load(files / "cage.obj").save(files / "standing.obj", up="y")
    name = "standing.obj" if up else "cage.obj"
    succeed(
        files, "fit-pose", "@ball.npz", "--cage", f"@{name}", *up, "--pictures", *pictures, "-o", "@found.obj", *options
    )
    said = capsys.readouterr().out
    assert "found.obj: 3 pictures, " in said and "evaluations, loss " in said
    rest, found = (Cage.load(files / each, up="y" if up else "z") for each in (name, "found.obj"))
    np.testing.assert_allclose((found.vertices - rest.vertices).mean(axis=0), SHIFT, atol=0.03)
    assert np.array_equal(found.faces, rest.faces)


def test_a_frame_of_the_pose_is_not_taken_for_another_scene(files, capsys):
    """Pictures of the object in a pose are unlike the field, which is said where no pose is asked for."""
    images = np.stack([shifted_ball(camera, 4 * SHIFT)[0] for camera in CAMERAS])
    Scene(images, None, CAMERAS).save(files / "aside")
    Cage.load(files / "cage.obj").translate(4 * SHIFT).save(files / "there.obj")
    command = ("render", "@ball.npz", "--camera", "@aside:0", "-o", "@frame.png", "--device", "cpu")
    for more, is_said in (((), True), (("--cage", "@cage.obj", "--posed", "@there.obj"), False)):
        succeed(files, *command, *more)
        assert ("do not belong together" in capsys.readouterr().err) is is_said


def test_what_is_missing_is_said_in_one_line(files, capsys):
    command = ("fit-pose", "@ball.npz", "--cage", "@cage.obj")
    for more, message in (
        (("--pictures", "@nothing", "-o", "@new.obj"), "nothing"),
        (("--pictures", "@moved", "-o", "@new.png"), "cage file"),
        (("--pictures", "@moved", "-o", "@new.obj", "--start", "@other.obj"), "26"),
        (("--pictures", "@moved"), "--output"),
        (("--pictures", "@moved", "-o", "@cage.obj"), "is the cage at rest itself"),
    ):
        assert run(files, *command, *more) == 2
        said = capsys.readouterr().err
        assert message in said and said.count("\n") == 1, said
    assert not (files / "new.obj").exists()
