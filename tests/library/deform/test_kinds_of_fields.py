"""One Deformer for every kind of field, the options of its frames, and the old name of a Deformer of splats."""

import dataclasses
import pickle

import numpy as np
import pytest
from fields import BOX, shiny_field, view
from refusals import refused
from splat_scenes import one_splat

from warpcage import Deformer, SampledField, SplatDeformer, SurfaceMesh
from warpcage.deform.objects import render_object
from warpcage.field.render import RenderOptions


def sampled(device):
    return SampledField(lambda points, _: (np.ones((len(points), 3)), np.ones(len(points))), BOX.bounds, device=device)


KINDS = {
    "voxels": lambda device: shiny_field(device, resolution=8),
    "splats": one_splat,
    "a function": sampled,
    "a mesh": lambda device: SurfaceMesh(BOX.vertices, BOX.faces, device=device),
}


def deformer_of(kind, device):
    return Deformer(KINDS[kind](device), BOX, coordinates="mean_value", resolution=8)


@pytest.mark.parametrize("kind", KINDS)
def test_one_class_for_all_kinds(kind, device):
    """Its own pose and one of a PosedDeformer give the same frame."""
    deformer, pose = deformer_of(kind, device), BOX.twist(20)
    assert type(deformer) is Deformer
    apart = deformer.posed(pose).render(view(size=8), background="grey")
    own = deformer.pose(pose).render(view(size=8), background="grey")
    assert np.array_equal(apart.rgb, own.rgb) and np.array_equal(apart.depth, own.depth)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "splats"])
def test_methods_of_splats_are_refused_for_others(kind, device, tmp_path):
    deformer = deformer_of(kind, device)
    calls = [deformer.posed_splats, deformer.baked, lambda: deformer.save_sequence(tmp_path / "a_#.ply", [BOX])]
    for call in calls:
        assert "is for splats" in refused(call)


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("background", "mauve"),
        ("background", (0.0, 2.0, 0.0)),
        ("supersampling", 0),
        ("supersampling", 9),
        ("antialias", 1),
        ("step", -0.1),
        ("step_scale", 0.0),
        ("fill", "yes"),
    ],
)
def test_options_of_a_frame_are_checked_where_they_are_made(name, wrong):
    assert name.split("_")[0] in refused(lambda: RenderOptions(**{name: wrong}))


@pytest.mark.parametrize("kind", ["voxels", "splats", "a mesh"])
def test_options_of_other_kinds_do_nothing(kind, device):
    deformer, camera = deformer_of(kind, device).pose(BOX.twist(20)), view(size=8)
    options = RenderOptions("black", 1)
    other = {"voxels": {"antialias": True}, "splats": {"step_scale": 2.0}, "a mesh": {"antialias": True}}[kind]
    frames = [render_object(deformer, camera, each) for each in (options, dataclasses.replace(options, **other))]
    assert np.array_equal(frames[0].rgb, frames[1].rgb)


def test_the_old_name_of_a_deformer_of_splats(device):
    """It warns, makes a Deformer, and finds those that have splats."""
    splats, voxels = deformer_of("splats", device), deformer_of("voxels", device)
    with pytest.warns(UserWarning, match="SplatDeformer is Deformer now"):
        assert isinstance(splats, SplatDeformer) and not isinstance(voxels, SplatDeformer)
    with pytest.warns(UserWarning, match="SplatDeformer is Deformer now"):
        old = SplatDeformer(splats.field, BOX, coordinates="mean_value")
    assert isinstance(old, Deformer)
    assert np.array_equal(old.pose(BOX).baked().contents.centers, splats.field.contents.centers)
    with pytest.warns(UserWarning, match="SplatDeformer is Deformer now"):
        refused(lambda: SplatDeformer(voxels.field, BOX), match="needs a SplatField")
    with pytest.raises(TypeError, match="held on a device"):
        pickle.dumps(splats)
