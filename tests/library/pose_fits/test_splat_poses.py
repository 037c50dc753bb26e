"""Poses of splats found from pictures, whose views are drawn at once."""

import numpy as np
import pytest
from fields import BOX
from splat_scenes import ball_of_splats, splats_in_box

from warpcage import Deformer, PoseTargets, deform_points, fit_pose, turntable
from warpcage.gradients import frame_gradient
from warpcage.pose_fits.targets import PictureLoss

CAMERAS = turntable((0, 0, 0), 2.6, 25, 3, width=40, height=28)  # tiles of 16 pixels end beyond both sides


@pytest.mark.parametrize("limit", ["none", "splats", "tiles"])
def test_views_together_have_the_sum_of_their_gradients(limit, device, monkeypatch):
    """Those of frames that are drawn one by one, whether all views, two of them, or one are drawn at once."""
    field = splats_in_box(device, scales=(-3.2, -2.6))
    deformer = Deformer(field, BOX, coordinates="mean_value").pose(BOX.bend(25, axis="x", towards="z"))
    frames = [deformer.render(camera, background="white") for camera in CAMERAS]
    if limit == "splats":
        monkeypatch.setattr("warpcage.gradients.splats.MAX_DRAWN", 2 * field.splat_count)
    if limit == "tiles":
        monkeypatch.setattr("warpcage.splats.fit.MAX_ENTRIES", int(1.5 * field.renderer.entry_count))
    random = np.random.default_rng(0)
    images, alphas = (np.clip(random.normal(0.5, 0.3, (3, 28, 40, *more)), 0, 1) for more in ((3,), ()))
    targets = PoseTargets(CAMERAS, images=images, alphas=alphas, depths=random.uniform(2, 3, (3, 28, 40)))
    loss = PictureLoss(targets, 40, 0.7, BOX.size, deformer.device, field=field)
    drawn = {
        name: part.numpy().reshape(3, 28, 40, *part.numpy().shape[1:]) for name, part in loss.frames(deformer).items()
    }
    for name, part in drawn.items():
        np.testing.assert_allclose(part, [getattr(frame, name) for frame in frames], atol=2e-5)
    slopes = {
        name: part.numpy().reshape(3, 28, 40, *part.numpy().shape[1:])
        for name, part in loss.compared(loss.frames(deformer))[1].items()
    }
    expected = 0.0
    for number, camera in enumerate(CAMERAS):
        rgb, alpha, depth = (slopes[name][number] for name in ("rgb", "alpha", "depth"))
        given = {"alpha_gradient": alpha, "depth_gradient": depth, "background": "white", "by_vertices": True}
        expected = expected + frame_gradient(deformer, camera, rgb, **given).vertices.numpy()
    found = loss(deformer)[1]
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


def test_a_bend_of_splats_is_found_again(device):
    field, posed = ball_of_splats().to(device), BOX.bend(20, axis="x", towards="z")
    deformer = Deformer(field, BOX, coordinates="mean_value")
    seen = turntable((0, 0, 0), 2.6, 25, 3, width=24, height=24)
    frames = [deformer.posed(posed).render(camera, background="white") for camera in seen]
    targets = PoseTargets(seen, images=[frame.rgb for frame in frames], alphas=[frame.alpha for frame in frames])
    found = fit_pose(deformer, targets, restarts=0)
    start, off = (
        np.sqrt(((deform_points(field.contents.centers, BOX, cage) - truth) ** 2).sum(-1).mean()) / BOX.size
        for cage, truth in ((cage, deform_points(field.contents.centers, BOX, posed)) for cage in (BOX, found.cage))
    )
    assert start > 0.05 and off < 0.006
