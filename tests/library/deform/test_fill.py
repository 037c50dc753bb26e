"""What no picture showed: which pixels are told of, and the smooth continuation that fills them."""

import pickle

import numpy as np
import pytest
from fields import ellipsoid, make_field, plain, surrounded_ball
from refusals import refused
from runs import SMALL, run, succeed

from warpcage import Cage, CageEdit, Camera, Deformer, Frame, fill_unseen
from warpcage.deform import membrane
from warpcage.view import mask_picture, mask_shares, read_image

BOX = Cage.box([-0.6, -0.6, -0.6], [0.6, 0.6, 0.6])
CAMERA = Camera.look_at([0, -4, 0], (0, 0, 0), width=64, height=64, fov_degrees=40)


@pytest.mark.parametrize("around", ["layers", "outer"])
def test_what_is_uncovered_goes_on_from_what_surrounds_it(device, around):
    field, truth = surrounded_ball(device, around), surrounded_ball(device, around, fog=False)
    for edit, pose in ((CageEdit(BOX, remove=True), None), (CageEdit(BOX), BOX.translate([0.5, 0, 0.6]))):
        frame = Deformer(field, edit, resolution=24).pose(pose).render(CAMERA)
        wanted = Deformer(truth, edit, resolution=24).pose(pose).render(CAMERA).rgb
        filled = fill_unseen(frame, field, CAMERA)
        assert np.abs(frame.rgb - wanted).max() > 0.25 and np.abs(filled.rgb - wanted).max() < 0.03
        at_rest, made_up = field.render(CAMERA).alpha, filled.filled
        assert made_up[(at_rest > 0.5) & (frame.alpha < 0.01)].min() > 0.99
        np.testing.assert_array_equal(filled.rgb[made_up == 0.0], frame.rgb[made_up == 0.0])
        far = np.linalg.norm(np.indices((64, 64)) - 31.5, axis=0) > 18
        assert made_up[far].max() == 0.0
        # told of, and marked
        assert mask_shares(frame)["reveal"] > 0.03 and mask_shares(filled)["reveal"] < 0.003
        assert mask_shares(filled)["filled"] > 0.03 and "filled" not in mask_shares(frame)
        violet = mask_picture(filled) - mask_picture(frame)
        assert violet[made_up > 0.9][:, 0].mean() > 0.1
    copy = pickle.loads(pickle.dumps(filled))
    np.testing.assert_array_equal(copy.missing, filled.missing)


def test_nothing_is_filled_where_nothing_moved(device):
    field = surrounded_ball(device)
    frame = Deformer(field, BOX, resolution=24).render(CAMERA)
    filled = fill_unseen(frame, field, CAMERA)
    assert filled.filled.max() == 0.0
    np.testing.assert_array_equal(filled.rgb, frame.rgb)


def test_a_plain_background_misses_nothing(device):
    """Where an emptied place shows one colour nothing is missing; where it shows matter or layers something may be."""
    field = surrounded_ball(device, around=None)
    frame = Deformer(field, CageEdit(BOX, remove=True), resolution=24).render(CAMERA)
    assert frame.reveal.max() > 0.9 and frame.missing.max() < 0.01
    assert fill_unseen(frame, field, CAMERA).filled.max() == 0.0
    layered = Deformer(surrounded_ball(device), CageEdit(BOX, remove=True), resolution=24)
    assert layered.render(CAMERA).missing.max() > 0.9
    assert layered.render(CAMERA, background="white").missing.max() < 0.01

    def two(x):
        return ellipsoid(x, (0, -0.4, 0), (0.3, 0.2, 0.3)) + ellipsoid(x, (0, 0.4, 0), (0.3, 0.2, 0.3))

    front = Cage.box([-0.6, -0.8, -0.6], [0.6, -0.05, 0.6])
    hidden = make_field(two, plain([0.2, 0.5, 0.9]), device=device)
    frame = Deformer(hidden, CageEdit(front, remove=True), resolution=24).render(CAMERA)
    assert frame.missing[32, 32] > 0.9


def test_a_membrane_is_harmonic():
    y, x = np.mgrid[0:70, 0:90] / 50.0
    truth = np.stack([x - 0.5 * y, x * y, x**2 - y**2], axis=-1)
    known = np.ones((70, 90), bool)
    known[20:52, 30:61] = known[5:9, 70:80] = False
    np.testing.assert_allclose(membrane(np.where(known[..., None], truth, 9.0), known), truth, atol=0.02)
    alone = np.zeros((9, 7), bool)
    alone[4, 3] = True
    np.testing.assert_allclose(membrane(np.full((9, 7, 3), 0.25), alone), 0.25)


def test_frames_that_cannot_be_filled_are_refused():
    field = surrounded_ball("cpu")
    refused(lambda: fill_unseen(field.render(CAMERA), field, CAMERA), match="no masks")
    frame = Deformer(field, BOX, resolution=16).render(CAMERA)
    refused(lambda: fill_unseen(frame, field, CAMERA.resized(32, 32)), match="64x64")
    refused(lambda: Frame(1, 1, np.zeros(3), np.zeros(1), np.zeros(1), made=np.zeros(1)), match="no mask 'made'")


def test_fill_on_the_command_line(tmp_path, capsys):
    surrounded_ball("cpu").save(tmp_path / "ball.npz")
    BOX.save(tmp_path / "cage.obj")
    argv = ["@ball.npz", *SMALL, "--eye", 0, -4, 0, "--target", 0, 0, 0, "--edit", "@cage.obj:remove"]
    succeed(tmp_path, "render", *argv, "-o", "@fog.png", "--masks", "@fog_masks.png")
    assert "uncovered, which no camera may have seen" in capsys.readouterr().err
    succeed(tmp_path, "render", *argv, "-o", "@filled.png", "--fill", "--masks", "@masks.png")
    said = capsys.readouterr().err
    assert "made up (violet)" in said and "no camera may" not in said
    fog, filled = (read_image(tmp_path / name) for name in ("fog.png", "filled.png"))
    ragged, even = (np.abs(np.diff(picture[14:26, 14:26], axis=0)).max() for picture in (fog, filled))
    assert ragged > 0.2 > 0.06 > even
    assert run(tmp_path, "render", *argv, "-o", "@x.png", "--fill", "--background", "white") == 2
    assert "--fill continues the field's own background" in capsys.readouterr().err
