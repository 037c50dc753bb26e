"""Ray cast meshes that carry colour and light along."""

import numpy as np
import pytest
from ground_truth import CarriedMesh, chair_model, subdivided_model
from refusals import refused

from warpcage import Camera
from warpcage.demo import render_mesh_views

EYE = np.array([1.8, -1.6, 1.1])


def view(eye=EYE, **options):
    return Camera.look_at(eye, (0, 0, 0), fov_degrees=40, width=40, height=40, **options)


def test_at_rest_without_texture_it_is_the_picture_of_the_plain_ray_caster(device):
    model = chair_model()
    rgba, depth = CarriedMesh(*model, texture=(0.0, 1.0), device=device).render([view()], samples=2)
    expected = render_mesh_views(*model, [view()], samples=2, device=device)
    # the origins of float32 differ: a ray may just miss a silhouette in one of them
    assert np.mean(np.abs(rgba - expected).max(axis=-1) > 2e-3) < 0.005
    assert (np.isfinite(depth) == (rgba[..., 3] == 1)).all()


def test_a_rigid_pose_is_what_the_counter_moved_camera_sees(device):
    turn, up = 1.1, 0.4
    spin = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    tilt = np.array([[1, 0, 0], [0, np.cos(up), -np.sin(up)], [0, np.sin(up), np.cos(up)]])
    rotation, offset = spin @ tilt, np.array([0.3, -0.2, 0.5])
    mesh = CarriedMesh(*chair_model(), device=device)
    camera = view()
    move = np.eye(4)
    move[:3, :3], move[:3, 3] = rotation, offset
    matrices = np.broadcast_to(rotation.T, (len(mesh.vertices), 3, 3))
    moved = camera.moved(move)
    rgba, depth = mesh.render([moved], posed=mesh.vertices @ rotation.T + offset, view_matrices=matrices, samples=2)
    expected, expected_depth = mesh.render([camera], samples=2)
    assert np.mean(np.abs(rgba - expected).max(axis=-1) > 2e-3) < 0.005
    both = np.isfinite(depth) & np.isfinite(expected_depth)
    assert both.sum() > 100 and np.median(np.abs(depth[both] - expected_depth[both])) < 1e-5
    # were the directions left as they are, the highlights would not turn with it
    unturned, _ = mesh.render([moved], posed=mesh.vertices @ rotation.T + offset, samples=2)
    assert np.abs(unturned - expected)[..., :3].max() > 0.03
    # nor if the lights stayed where they are
    relit, _ = mesh.render([moved], posed=mesh.vertices @ rotation.T + offset, light_stays=True, samples=2)
    assert np.abs(relit - expected)[..., :3].max() > 0.05


def test_lights_that_stay_light_a_moved_mesh_as_if_it_had_been_there(device):
    vertices, faces, colors = chair_model()
    turned = vertices @ np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    mesh = CarriedMesh(vertices, faces, colors, texture=(0.0, 1.0), device=device)
    relit, _ = mesh.render([view()], posed=turned, light_stays=True, samples=2)
    expected = render_mesh_views(turned, faces, colors, [view()], samples=2, device=device)
    # reach and offset of the light follow the size of the mesh's box, which a turn leaves nearly as it is
    assert np.mean(np.abs(relit - expected).max(axis=-1) > 2e-2) < 0.01


def test_texture_is_of_the_place_at_rest(device):
    mesh = CarriedMesh(*chair_model(), texture=(0.6, 9.0), device=device)
    plain, _ = CarriedMesh(*chair_model(), texture=(0.0, 9.0), device=device).render([view()])
    rest, _ = mesh.render([view()])
    assert np.abs(rest - plain).max() > 0.05
    shift = np.eye(4)
    shift[:3, 3] = 3.0
    moved, _ = mesh.render([view().moved(shift)], posed=mesh.vertices + 3.0)
    assert np.mean(np.abs(moved - rest).max(axis=-1) > 2e-3) < 0.005


@pytest.mark.parametrize("name", ["bricks", "animal", "chair"])
def test_models_are_closed_and_face_out(name):
    import trimesh

    vertices, faces, colors = subdivided_model(name, 0.3)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight and mesh.volume > 0.05
    assert colors.shape == faces.shape and colors.min() >= 0 and colors.max() <= 1
    assert np.linalg.norm(vertices[faces] - vertices[np.roll(faces, 1, axis=1)], axis=2).max() <= 0.3 + 1e-9
    assert np.abs(vertices.min(axis=0) + vertices.max(axis=0)).max() < 1e-6
    assert 1.7 < np.ptp(vertices, axis=0).max() < 2.4


def test_refuses_what_does_not_fit():
    vertices, faces, colors = chair_model()
    refused(lambda: CarriedMesh(vertices, faces, colors[:-1]), match="colours")
    mesh = CarriedMesh(vertices, faces, colors)
    refused(lambda: mesh.render([view()], posed=vertices[:-1]), match="posed")
    refused(lambda: subdivided_model("teapot", 0.1), match="not known")


def test_points_are_shaded_as_they_are_seen(device):
    """By a camera that looks at each, where nothing is between: with texture, shadow and highlight."""
    mesh = CarriedMesh(*chair_model(), highlight=0.8, shininess=6.0, device=device)
    rng = np.random.default_rng(0)
    faces = rng.integers(0, len(mesh.faces), 200)
    corners = rng.dirichlet((2, 2, 2), 200)
    points = np.einsum("nc,nck->nk", corners, mesh.vertices[mesh.faces[faces]])
    cameras = [Camera.look_at(EYE, point, fov_degrees=1, width=1, height=1) for point in points]
    rgba, depth = (part.reshape(200, -1) for part in mesh.render(cameras, samples=1))
    away = points - EYE
    distance = np.linalg.norm(away, axis=1)
    towards = away / distance[:, None]
    colors = mesh.shade(faces, corners[:, :2], np.stack([towards, -towards], axis=1))
    seen = np.abs(depth[:, 0] - distance) < 1e-4
    wrong = np.abs(colors[:, 0] - rgba[:, :3])[seen].max(axis=1) > 5e-3
    assert seen.sum() > 40 and wrong.mean() < 0.05  # beside the rim of a shadow, or where faces touch
    assert np.abs(colors[:, 1] - colors[:, 0]).max() > 0.1  # from the other side it is another colour


def test_distances_are_those_of_a_union_of_boxes(device):
    """Two boxes through each other: walls of one in the other are inside."""
    import trimesh

    boxes = [trimesh.creation.box((2, 1, 1)), trimesh.creation.box((1, 2, 1))]
    both = trimesh.util.concatenate(boxes)
    mesh = CarriedMesh(both.vertices + 5.0, both.faces, np.full(both.faces.shape, 0.5), device=device)
    points = np.random.default_rng(2).uniform(-1.5, 1.5, (400, 3))
    found = mesh.signed_distances(points + 5.0)
    sides = np.abs(points)[:, None] - np.array([[1.0, 0.5, 0.5], [0.5, 1.0, 0.5]])
    beyond = np.linalg.norm(np.maximum(sides, 0), axis=2)
    nearest = np.abs(beyond + np.minimum(sides.max(axis=2), 0)).min(axis=1)  # of both boxes' walls
    outside = (beyond > 0).all(axis=1)
    assert np.abs(found - np.where(outside, nearest, -nearest)).max() < 1e-5
    assert 50 < outside.sum() < 390
