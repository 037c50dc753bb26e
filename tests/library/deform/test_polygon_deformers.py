"""Deformers whose cages are quads: fields, splats and meshes move as points do, mirrored poses by mirrored amounts."""

import numpy as np
import pytest
from fields import make_field, psnr, shiny, shiny_field, view
from polygon_cages import mixed_prism, quad_box, quad_cube, triangulated
from refusals import refused
from splat_scenes import one_splat, splats_in_box

from warpcage import Cage, CageEdit, Deformer, Stage, VoxelField, bake, deform_points
from warpcage.cage import cut_faces, snap_to_gaps
from warpcage.coordinate_kinds import COORDINATE_KINDS

KINDS = tuple(COORDINATE_KINDS)
TOP = (4, 5, 6, 7)


def lifted(cage: Cage, corner: int) -> Cage:
    return cage.move((0.0, 0.0, 0.8), group=[corner])


def bent(cage: Cage, seed: int = 3) -> Cage:
    """A pose that warps each quad."""
    moved = np.random.default_rng(seed).uniform(-1.0, 1.0, cage.vertices.shape)
    return cage.with_vertices(cage.vertices + 0.06 * cage.size * moved)


@pytest.mark.parametrize("resolution", [32, None])
@pytest.mark.parametrize("kind", KINDS)
def test_fields_are_looked_up_where_points_come_from(kind, resolution, device):
    if resolution is None and not COORDINATE_KINDS[kind].is_precise:
        return
    field, cage = shiny_field(device), quad_cube()
    rest = cage.scale(0.9)
    posed = bent(rest)
    deformer = Deformer(field, rest, coordinates=kind, resolution=resolution).pose(posed)
    assert deformer.deformed[0].polygons == rest.polygons
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (200, 3))
    found, _, region = deformer.to_canonical(points, np.broadcast_to([0.6, 0.0, 0.8], points.shape))
    expected = deform_points(points, posed, rest, kind, device=device)
    inside = np.asarray(region) == 2
    assert inside.mean() > 0.9
    tolerance = {None: 1e-5}.get(resolution, 2e-3)
    np.testing.assert_allclose(found[inside], expected[inside], atol=tolerance * rest.size)


@pytest.mark.parametrize("store", ["map", "weights"])
@pytest.mark.parametrize("kind", KINDS)
def test_mirrored_lifts_of_fields_are_mirrored(kind, store, device):
    field, cage = shiny_field(device), quad_cube()
    deformer = Deformer(field, cage, coordinates=kind, resolution=24, store=store)
    place, ahead, heights = np.array([[0.0, 0.0, 0.7]]), np.array([[0.0, 0.0, 1.0]]), []
    for corner in TOP:
        heights.append(deformer.pose(lifted(cage, corner)).to_canonical(place, ahead)[0][0, 2])
    assert np.ptp(heights) < 2e-3 and np.mean(heights) < 0.6  # a lattice lies aside of the cage's middle
    # closed forms have no lattice
    if COORDINATE_KINDS[kind].is_precise and store == "map":
        exact = Deformer(field, cage, coordinates=kind, resolution=None)
        heights = [exact.pose(lifted(cage, corner)).to_canonical(place, ahead)[0][0, 2] for corner in TOP]
        assert np.ptp(heights) < 1e-5


@pytest.mark.parametrize("kind", KINDS)
def test_splats_go_as_points_do(kind, device):
    field = splats_in_box(device, count=60, half=0.5)
    for rest in (quad_box(2, 0.1), mixed_prism()):
        posed = bent(rest)
        moved = Deformer(field, rest, coordinates=kind, resolution=64).pose(posed).posed_splats()
        moved = moved.centers.numpy() + field.center
        centers = np.asarray(field.centers, np.float64)
        inside = rest.contains(centers, device=device)
        assert inside.mean() > 0.5
        expected = deform_points(centers[inside], rest, posed, kind, device=device)
        found = moved[: len(centers)][inside]
        error = np.linalg.norm(found - expected, axis=1) / rest.size
        assert np.median(error) < (1e-3 if kind == "harmonic" else 1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_mirrored_lifts_of_splats_are_mirrored(kind, device):
    cage, field = quad_cube(), one_splat(device, center=(0.0, 0.0, 0.8), scales=(0.01, 0.01, 0.01))
    deformer = Deformer(field, cage, coordinates=kind, resolution=32)
    rises = [deformer.pose(lifted(cage, corner)).posed_splats().centers.numpy()[0, 2] for corner in TOP]
    assert np.ptp(rises) < (2e-4 if kind == "harmonic" else 1e-5) and np.mean(rises) > 0.1


@pytest.mark.parametrize("kind", KINDS)
def test_poses_of_triangles_and_arrays_and_affine_poses_make_the_same_pictures(kind, device):
    field, camera, cage = shiny_field(device), view(), quad_box(2).scale(0.9)
    posed = cage.rotate(40.0).scale(1.1)
    frame = Deformer(field, cage, coordinates=kind, resolution=24).pose(posed).render(camera)
    deformer = Deformer(field, triangulated(cage), coordinates=kind, resolution=24)
    assert psnr(deformer.pose(triangulated(posed)).render(camera).rgb, frame.rgb) > 50
    quads, warped = Deformer(field, cage, coordinates=kind, resolution=24), bent(cage)
    first = quads.pose(warped).render(camera).rgb
    for other in (triangulated(warped, 1), warped.vertices):
        np.testing.assert_array_equal(quads.pose(other).render(camera).rgb, first)
    assert psnr(first, frame.rgb) < 40


@pytest.mark.parametrize("kind", KINDS)
def test_poses_that_cannot_be_used_are_named_by_polygons(kind, device):
    cage = quad_cube()
    deformer = Deformer(shiny_field(device), cage, coordinates=kind, resolution=16).pose(lifted(cage, 7))
    flat = cage.vertices.copy()
    flat[list(cage.polygons[3])] = flat[list(cage.polygons[3])].mean(axis=0) + np.array([[0, 0, 0], [1e-9, 0, 0]] * 2)
    flat[list(cage.polygons[3])] += 1e-3 * np.arange(4)[:, None] * [1.0, 0.0, 0.0]
    refused(lambda: deformer.pose(flat), match="without area, the first [0-5]:")
    assert deformer.deformed[0].vertices[7, 2] == pytest.approx(1.8)  # the pose before stays


def test_baked_fields_and_views_of_poses(device):
    field, cage = shiny_field(device), quad_box(2).scale(0.9)
    deformer = Deformer(field, cage, coordinates="mean_value", resolution=24).pose(bent(cage))
    frame = deformer.render(view())
    assert psnr(bake(deformer, resolution=64).render(view()).rgb, frame.rgb) > 25


# -- Walls


def bar(device):
    return make_field(lambda x: 30.0 * (np.abs(x) < [0.9, 0.45, 0.45]).all(axis=-1), shiny, device=device)


def half_box() -> Cage:
    """Quads around the right half of a bar along x: those at x = 0 cut it."""
    cage = quad_box(2)
    return cage.with_vertices((cage.vertices + [1.0, 0.0, 0.0]) * [0.485, 0.5, 0.5])


def test_walls_are_polygons_and_fade_as_those_of_triangles(device):
    field, cage = bar(device), half_box()
    on_wall = cage.vertices[:, 0] < 1e-9
    walls = [k for k, face in enumerate(cage.polygons) if on_wall[list(face)].all()]
    assert cut_faces(cage, field).tolist() == walls and len(walls) == 4
    posed = cage.translate((0.0, 0.0, 0.12)).twist(15.0, axis="x")
    split = triangulated(cage)
    points = np.random.default_rng(2).uniform([0.02, -0.3, -0.3], [0.8, 0.3, 0.3], (200, 3))
    directions = np.broadcast_to([0.6, 0.0, 0.8], points.shape)
    for held in ("cut", "still", tuple(walls)):
        pose = (
            posed if held != "still" else posed.with_vertices(np.where(on_wall[:, None], cage.vertices, posed.vertices))
        )
        quads = Deformer(field, CageEdit(cage, falloff=0.25, held=held), coordinates="mean_value", resolution=None)
        faces = held if isinstance(held, str) else [k for k, face in enumerate(split.faces) if on_wall[face].all()]
        triangles = Deformer(
            field, CageEdit(split, falloff=0.25, held=faces), coordinates="mean_value", resolution=None
        )
        quads.pose(pose)
        triangles.pose(triangulated(pose))
        held_pose = quads.deformed[0]
        np.testing.assert_array_equal(held_pose.vertices[on_wall], cage.vertices[on_wall])
        np.testing.assert_array_equal(held_pose.vertices, triangles.deformed[0].vertices)
        found, expected = (each.to_canonical(points, directions)[0] for each in (quads, triangles))
        assert np.abs(found - expected).max() < 0.01  # the quads at x = 0 are flat, others warped


def test_walls_of_quads_snap_to_gaps(device):
    field = make_field(lambda x: 30.0 * (np.abs(np.abs(x[..., 0]) - 0.5) < 0.35), shiny, device=device)
    cage = quad_box(1)
    cage = cage.with_vertices((cage.vertices + [1.0, 0.0, 0.0]) * [0.5, 0.9, 0.9] + [0.17, 0.0, 0.0])
    split = triangulated(cage)
    snapped = snap_to_gaps(cage, field, 0.3)
    assert snapped.polygons == cage.polygons
    np.testing.assert_allclose(snapped.vertices, snap_to_gaps(split, field, 0.3).vertices, atol=0.03)
    assert snapped.vertices[:, 0].min() < 0.16


def test_stages_keep_the_quads_of_their_edits(device, tmp_path):
    field, cage = shiny_field(device), quad_box(2).scale(0.9)
    field.save(tmp_path / "it.npz")
    it = VoxelField.load(tmp_path / "it.npz", device=device)
    deformer = Deformer(it, cage, coordinates="mean_value", resolution=24).pose(bent(cage))
    stage = Stage().add("it", deformer, path=tmp_path / "it.npz")
    stage.save(tmp_path / "scene.stage.json")
    loaded = Stage.load(tmp_path / "scene.stage.json", device=device)
    found = loaded.items["it"].scene_object
    assert found.edits[0].cage.polygons == found.deformed[0].polygons == cage.polygons
    np.testing.assert_array_equal(loaded.render(view()).rgb, stage.render(view()).rgb)
