"""One Deformer for every kind of field, the options of its frames, and the old name of a Deformer of splats."""

import dataclasses
import inspect
import pathlib
import pickle

import numpy as np
import pytest
from fields import BOX, shiny_field, view
from refusals import refused
from splat_scenes import one_splat

from warpcage import Deformer, SampledField, SplatDeformer, SplatField, Stage, SurfaceMesh, VoxelField
from warpcage.core.spec import options_of
from warpcage.deform.objects import render_object
from warpcage.deform.views import ViewKeywords
from warpcage.field.render import (
    PoseKeywords,
    RenderKeywords,
    RenderOptions,
    SplatKeywords,
    StageKeywords,
    View,
    VoxelKeywords,
)

PAGE = pathlib.Path(__file__).parents[3] / "docs" / "python.md"


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


#: What takes options of a frame, and their keywords.
TAKERS = {
    VoxelField.render: VoxelKeywords,
    SplatField.render: SplatKeywords,
    SurfaceMesh.render: RenderKeywords,
    Deformer.render: ViewKeywords,
    Deformer.render_poses: PoseKeywords,
    Stage.render: StageKeywords,
}


def test_keywords_are_the_options_of_a_frame():
    """Each is taken by a method, but for `fill`, and has the type of the option."""
    types = {field.name: field.type for field in dataclasses.fields(RenderOptions)}
    taken = {
        name: getattr(kind, "__forward_arg__", kind)
        for keywords in (PoseKeywords, StageKeywords)
        for name, kind in keywords.__annotations__.items()
    }
    assert taken == {name: kind for name, kind in types.items() if name != "fill"}


@pytest.mark.parametrize(("method", "keywords"), TAKERS.items(), ids=[each.__qualname__ for each in TAKERS])
def test_help_describes_the_options_that_a_method_takes(method, keywords):
    parameters = inspect.signature(method).parameters
    assert set(keywords.__annotations__) <= set(parameters) and "options" not in parameters
    defaults = {name: parameters[name].default for name in keywords.__annotations__ if hasattr(RenderOptions, name)}
    assert defaults == {name: getattr(RenderOptions, name) for name in defaults}
    text = " ".join(inspect.getdoc(method).split())
    described = {name for name, each in options_of(RenderOptions).items() if f" {name}: {each.help} " in text}
    assert described == set(options_of(RenderOptions)) & set(keywords.__annotations__)


def test_docs_have_the_table_of_options():
    rows = [f"| `{name}` | {each.help} |" for name, each in options_of(RenderOptions).items() if name != "fill"]
    assert "\n".join(["| option | what it does |", "| --- | --- |", *rows]) in PAGE.read_text()


@pytest.mark.parametrize("wrong", ["colour", "fill"])
@pytest.mark.parametrize("kind", ["voxels", "splats", "a mesh", "a deformer", "a pose", "a stage"])
def test_an_unknown_option_is_refused_with_those_that_there_are(kind, wrong, device):
    deformer = deformer_of("voxels", device)
    others = {"a deformer": deformer, "a pose": deformer.posed(BOX), "a stage": Stage(device=device)}
    scene = others[kind] if kind in others else KINDS[kind](device)
    text = refused(lambda: scene.render(view(size=8), **{wrong: 1}), error=TypeError)
    assert text.startswith(f"render got an unexpected keyword argument {wrong!r}: it takes background, supersampling")
    assert ("outputs" in text) == (kind in ("a deformer", "a pose")) and ("step_scale" in text) == (kind == "a stage")


@pytest.mark.parametrize("kind", KINDS)
def test_every_frame_is_finished_by_its_view(kind, device, monkeypatch):
    """By `View.finished`, once: there an option of finished frames reaches all renderers."""
    finished, found = View.finished, []
    monkeypatch.setattr(
        View, "finished", lambda *args, **options: found.append(finished(*args, **options)) or found[-1]
    )
    deformer = deformer_of(kind, device)
    scenes = [deformer, deformer.posed(BOX.twist(20))]
    if kind != "a function":
        scenes += [deformer.field, Stage().add("posed", deformer)]
    for scene in scenes:
        found.clear()
        assert scene.render(view(size=4), supersampling=2) is found[-1] and len(found) == 1 + isinstance(scene, Stage)


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
