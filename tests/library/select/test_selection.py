import os
import pathlib
import re

import numpy as np
import pytest
from fields import GridField, nodes
from messages import MESSAGES
from refusals import refused

from warpcage import Cage, Camera, select_nodes
from warpcage.field import extract_mesh

DTU = pathlib.Path(os.environ.get("WARPCAGE_DATA", "../shared/data")) / "dtu_scan24_half"


def room(count=32):
    """A ball and a block on a floor that both touch nothing of, and three floaters."""
    x = nodes(count)
    ball = np.linalg.norm(x - [-0.4, 0, 0], axis=-1) < 0.3
    block = (np.abs(x - [0.5, 0, 0]) < [0.2, 0.3, 0.3]).all(axis=-1)
    floor = x[..., 2] < -0.8
    density = 50.0 * (ball | block | floor)
    density[1, 1, -2] = density[5, 20, -3] = density[20, 5, -2] = 50.0
    return GridField(density), {"ball": ball, "block": block, "floor": floor}


def test_box_seed_parts_and_floaters():
    field, truth = room()
    chosen = select_nodes(field, box=[[-0.9, -0.5, -0.5], [0.0, 0.5, 0.5]])
    assert np.array_equal(chosen.mask, truth["ball"]) and "outside the box" in chosen.notes[0]
    assert np.array_equal(select_nodes(field, seed=[0.5, 0, 0]).mask, truth["block"])
    assert np.array_equal(select_nodes(field, parts=1).mask, truth["floor"])
    near = select_nodes(field, seed=[0.5, 0, 0], reach=0.2).mask
    assert near.any() and (near & truth["block"]).sum() == near.sum() < truth["block"].sum()
    clean = select_nodes(field, floaters=0.01)
    assert np.array_equal(clean.mask, truth["ball"] | truth["block"] | truth["floor"])
    assert isinstance(clean.notes, tuple) and len(clean.notes) == 1
    assert re.fullmatch(MESSAGES["field.floaters"], clean.notes[0])
    everything = select_nodes(field)
    assert everything.notes == () and len(everything.points) == np.count_nonzero(field.densities)


def test_a_selection_stands_in_for_its_field():
    field, truth = room()
    chosen = select_nodes(field, seed=[-0.4, 0, 0])
    cage = Cage.from_field(chosen, 42)
    report = cage.check(field=chosen)
    assert report.field_enclosed == 1.0 and report.part_count == 1
    assert any("seed point" in note for note in report.notes) and "seed point" in str(report)
    assert cage.bounds[1, 0] < 0.25 and cage.check(field=field).field_enclosed < 0.5
    assert extract_mesh(chosen).bounds[1, 0] < 0.0
    weights = np.where(truth["ball"], 0.5, 0.0)
    seen = select_nodes(GridField(field.densities, weights=weights), floaters=0.5)
    assert np.array_equal(seen.mask, truth["ball"]) and np.array_equal(seen.node_weights() > 0, truth["ball"])


def test_masks_of_several_views_cut_the_object_out():
    field, truth = room()
    views = [
        Camera.look_at(eye, (0, 0, 0), width=64, height=48, fov_degrees=50)
        for eye in ((4, 0, 0), (0, -3, 2.5), (-3, -3, 1))
    ]
    centers = nodes(32)
    masks = []
    for camera in views:
        mask = np.zeros((48, 64))
        pixels, _ = camera.project(centers[truth["block"]])
        column, row = np.floor(pixels).astype(int).T
        for i, j in np.ndindex(3, 3):  # without holes between the projected nodes
            mask[np.clip(row + i - 1, 0, 47), np.clip(column + j - 1, 0, 63)] = 255
        masks.append(mask)
    chosen = select_nodes(field, cameras=views, masks=masks)
    assert chosen.mask[truth["block"]].all() and not chosen.mask[truth["ball"]].any()
    assert chosen.mask.sum() < 1.6 * truth["block"].sum()
    one = select_nodes(field, cameras=views[:1], masks=masks[:1])
    assert chosen.mask.sum() < one.mask.sum()


@pytest.mark.skipif(not DTU.is_dir(), reason=f"no DTU data in {DTU} (set WARPCAGE_DATA)")
def test_the_object_of_dtu_scan_24_by_its_masks():
    from warpcage.view import read_image

    bundle = np.load(DTU / "cameras_sphere.npz")
    names = sorted((DTU / "mask").glob("*.png"))[::2]
    cameras, masks, projections = [], [], []
    for name in names:
        mask = read_image(name)[..., 0]
        number = int(name.stem)
        p = (bundle[f"world_mat_{number}"] @ bundle[f"scale_mat_{number}"])[:3]
        # RQ by a QR of the reversed matrix
        q, r = np.linalg.qr(np.flipud(p[:, :3]).T)
        k, rotation = np.fliplr(np.flipud(r.T)), np.flipud(q.T)
        sign = np.diag(np.sign(np.diag(k)))
        k, rotation = k @ sign, sign @ rotation
        if np.linalg.det(rotation) < 0:
            rotation = -rotation
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation.T, -np.linalg.solve(p[:, :3], p[:, 3])
        k = k / k[2, 2]
        cameras.append(Camera(k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5, mask.shape[1], mask.shape[0], pose))
        masks.append(mask)
        projections.append(p)
    solid = GridField(np.full((40, 40, 40), 50.0))
    chosen = select_nodes(solid, cameras=cameras, masks=masks, floaters=0.02)
    assert 0.005 < chosen.mask.mean() < 0.5 and "outside the masks" in chosen.notes[0]
    outside = 0
    for p, mask in zip(projections, masks, strict=True):
        u, v, w = p @ np.vstack([chosen.points.T, np.ones(len(chosen.points))])
        column, row = np.round(u / w).astype(int), np.round(v / w).astype(int)  # pixel centres at whole numbers
        falls = (column >= 0) & (column < mask.shape[1]) & (row >= 0) & (row < mask.shape[0])
        outside += np.count_nonzero(mask[row[falls], column[falls]] < 0.5)
    assert outside <= 0.002 * len(chosen.points) * len(masks)  # two ways to round to a pixel
    cage = Cage.from_field(chosen, 100)
    report = cage.check(field=chosen)
    assert report.usable and report.field_enclosed == 1.0 and report.intersecting_faces == ()
    assert cage.volume < 0.9 * 8.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"box": [[0, 0, 0], [0, 1, 1]]}, "box must be"),
        ({"box": [[0.9, 0.9, 0.9], [0.95, 0.95, 0.95]]}, "outside the box"),
        ({"seed": [0, 0, np.nan]}, "seed must be"),
        ({"seed": [0.0, -0.9, 0.9]}, "near the seed point"),
        ({"reach": 1.0}, "needs a seed"),
        ({"seed": [0.5, 0, 0], "reach": 0.0}, "reach must be positive"),
        ({"parts": 0}, "parts must be"),
        ({"floaters": 1.0}, "floaters must be"),
        ({"masks": [np.ones((4, 4))]}, "go together"),
        ({"masks": [np.ones((4, 4))], "cameras": []}, "one mask per camera"),
        ({"masks": [np.ones((4, 4))], "cameras": [Camera.look_at((0, -4, 0), (0, 0, 0), width=8, height=4)]},
         "mask 0 must be (4, 8)"),
        ({"masks": [np.zeros((4, 8))], "cameras": [Camera.look_at((0, -4, 0), (0, 0, 0), width=8, height=4)]},
         "outside the masks"),
        ({"threshold": 1e9}, "shows nothing"),
    ],
)  # fmt: skip
def test_refusals(options, message):
    refused(lambda: select_nodes(room()[0], **options), message)
