"""A `wp.Tape` of a caller: nothing of the package is on it, and its gradients are the same to the bit."""

import itertools
import pathlib
import re

import numpy as np
import pytest
import warp as wp
from fields import BOX, shiny_field, view
from messages import MESSAGES
from refusals import refused
from runs import write_files
from scenes import blob_scene
from splat_scenes import scene_of, splats_in_box

import warpcage
from warpcage import Cage, Deformer, PositionMap
from warpcage.core import COORDINATES
from warpcage.deform import exact

STEPS = 2  #: the second one finds graphs and recorded launches of the first
COUNT = len(BOX.vertices)
FIT = {"resolution": 16, "levels": 1, "epochs": 1, "batch_rays": 256, "progress": False}


@wp.kernel
def step_places(before: wp.array(dtype=wp.vec3), speeds: wp.array(dtype=wp.vec3), after: wp.array(dtype=wp.vec3)):
    tid = wp.tid()
    x = before[tid]
    v = speeds[tid]
    after[tid] = x + 0.01 * wp.vec3(wp.sin(x[1]) * v[0], v[1] * x[0], wp.cos(x[2] * v[2]))


@wp.kernel
def add_squares(places: wp.array(dtype=wp.vec3), loss: wp.array(dtype=float)):
    tid = wp.tid()
    wp.atomic_add(loss, 0, wp.length_sq(places[tid]))


def simulated(device, work=None):
    """A differentiable simulation of a cage's vertices that calls `work` with those of each step: what is on its tape,
    and the gradients at its start and of its speeds."""
    rng = np.random.default_rng(4)
    states = [wp.zeros(COUNT, dtype=wp.vec3, device=device, requires_grad=True) for _ in range(STEPS + 1)]
    states[0].assign(BOX.vertices)
    speeds = wp.array(rng.normal(size=(COUNT, 3)), dtype=wp.vec3, device=device, requires_grad=True)
    loss = wp.zeros(1, dtype=float, device=device, requires_grad=True)
    with wp.Tape() as tape:
        for before, after in itertools.pairwise(states):
            wp.launch(step_places, COUNT, [before, speeds], [after], device=device)
            if work is not None:
                work(after.numpy())
        wp.launch(add_squares, COUNT, [states[-1]], [loss], device=device)
    recorded = [launch[0].key for launch in tape.launches]
    tape.backward(loss)
    return recorded, states[0].grad.numpy().tobytes(), speeds.grad.numpy().tobytes(), len(tape.gradients)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """What the calls need, on each device: made outside of any tape."""
    held, patch = {}, pytest.MonkeyPatch()
    patch.setattr(exact, "GUIDE_RESOLUTION", 24)  # a finer guide takes most of the time

    def on(device):
        if device not in held:
            field, splats = shiny_field(device, resolution=12), splats_in_box(device, count=60, degree=1)
            cameras = [view(eye=eye, size=12) for eye in ((2.5, 0, 0.5), (0, 2.5, 0.5), (-2.5, 0, 0.5))]
            folder = write_files(tmp_path_factory.mktemp("tapes"))
            field.save(folder / "loaded.npz")
            warm = {"harmonic": 16, "mean_value": 16, "green": None, "maximum_likelihood": 16, "biharmonic": 16}
            held[device] = {
                "device": device,
                "folder": folder,
                "field": field,
                "splats": splats,
                "camera": cameras[0],
                "cameras": cameras,
                "scene": blob_scene(count=4, size=12, device=device),
                "splat_scene": scene_of(splats, cameras),
                "points": wp.array(0.5 * BOX.vertices, dtype=wp.vec3, device=device),
                "posed": {
                    kind: Deformer(field, BOX, coordinates=kind, resolution=cells) for kind, cells in warm.items()
                },
                "posed splats": {kind: Deformer(splats, BOX, coordinates=kind, resolution=12) for kind in warm},
                "map": PositionMap(BOX, resolution=12, device=device),
                "fit": warpcage.FieldOptimizer(
                    blob_scene(count=4, size=12, device=device), device=device, resolution=16, levels=1
                ),
            }
        return held[device]

    yield on
    patch.undo()


def saved(world, item, name):
    item.save(world["folder"] / name)


def by_kind(call):
    """A call by each kind of coordinates."""
    return lambda world, x: [call(world, x, kind) for kind in COORDINATES]


#: What programs call at each step, by the public name: a world and the vertices of the step.
CALLS = {
    "Cage.contains": lambda w, x: BOX.with_vertices(x).contains(w["points"]),
    "Cage.from_field": lambda w, x: Cage.from_field(w["field"], 30),
    "Deformer": lambda w, x: Deformer(w["field"], BOX, resolution=12).pose(x).render(w["camera"]).rgb,
    "Deformer.pose, render": by_kind(lambda w, x, kind: w["posed"][kind].pose(x).render(w["camera"]).rgb),
    "Deformer.render_poses": lambda w, x: w["posed"]["mean_value"].render_poses(
        [x, BOX], w["camera"], outputs=["flow", "canonical", "instance"], flow_poses=[BOX, x]
    ),
    "Deformer.sample": lambda w, x: w["posed"]["green"].pose(x).sample(w["points"], w["points"]),
    "Deformer.to_canonical": by_kind(
        lambda w, x, kind: w["posed"][kind].pose(x).to_canonical(w["points"], w["points"])
    ),
    "Deformer.inverse_error": lambda w, x: w["posed"]["mean_value"].pose(x).inverse_error(),
    "FieldOptimizer.step": lambda w, x: w["fit"].step(),
    "Frames": lambda w, x: w["posed"]["green"].pose(x).render(w["cameras"]).arrays_like(w["points"]),
    "fit_pose, fit_poses": lambda w, x: warpcage.fit_poses(
        w["posed"]["mean_value"],
        [np.full((1, 12, 12, 3), 0.5)],
        cameras=w["camera"],
        parameters="rigid",
        restarts=0,
        start=x,
    ),
    "Frame.save": lambda w, x: saved(w, w["posed"]["green"].pose(x).render(w["camera"]), "frame.png"),
    "NodeSelection": lambda w, x: warpcage.select_nodes(w["field"], cage=BOX.with_vertices(x)).mask.sum(),
    "PositionMap.pose": by_kind(
        lambda w, x, kind: PositionMap(BOX, coordinates=kind, resolution=12, device=w["device"]).pose(x)
    ),
    "PositionMap": lambda w, x: w["map"].pose(x).data,
    "RandomPoses": lambda w, x: warpcage.RandomPoses(BOX, seed=1).vertices(0),
    "SampledField": lambda w, x: (
        Deformer(
            warpcage.SampledField(
                lambda p, d: (abs(d.numpy()), np.ones(len(p))), w["field"].bounds, device=w["device"]
            ),
            BOX,
            coordinates="mean_value",
            resolution=12,
        )
        .pose(x)
        .render(w["camera"])
        .rgb
    ),
    "SplatDeformer": lambda w, x: Deformer(w["splats"], BOX, coordinates="mean_value").pose(x).render(w["camera"]).rgb,
    "SplatDeformer.pose, render": by_kind(lambda w, x, kind: w["posed splats"][kind].pose(x).render(w["camera"]).rgb),
    "SplatDeformer.baked": lambda w, x: saved(w, w["posed splats"]["green"].pose(x).baked(), "posed.ply"),
    "SplatField.render": lambda w, x: w["splats"].render(w["camera"]).rgb,
    "SplatField.save": lambda w, x: saved(w, w["splats"], "splats.spz"),
    "SplatFit, fit": lambda w, x: warpcage.fit(
        w["splat_scene"], representation="splats", steps=2, most_splats=80, device=w["device"], progress=False
    ),
    "Stage": lambda w, x: (
        warpcage.Stage().add("a", w["posed"]["green"].pose(x)).add("b", w["splats"]).render(w["camera"]).rgb
    ),
    "SurfaceMesh": lambda w, x: warpcage.SurfaceMesh(x, BOX.faces, device=w["device"]).render(w["camera"]).rgb,
    "VoxelField.load": lambda w, x: warpcage.VoxelField.load(w["folder"] / "loaded.npz", device=w["device"]),
    "VoxelField.render": lambda w, x: w["field"].render(w["camera"]).rgb,
    "VoxelField.sample": lambda w, x: w["field"].sample(w["points"], w["points"]),
    "VoxelField.extract_mesh": lambda w, x: w["field"].extract_mesh(),
    "VoxelField.save": lambda w, x: [saved(w, w["field"], name) for name in ("field.npz", "field.nvdb")],
    "bake": lambda w, x: warpcage.bake(w["posed"]["mean_value"].pose(x), 12),
    "deform_points": by_kind(
        lambda w, x, kind: [warpcage.deform_points(p, BOX, x, kind) for p in (w["points"], 0.5 * BOX.vertices)]
    ),
    "evaluate": lambda w, x: warpcage.evaluate(w["field"], w["scene"], progress=False),
    "fill_unseen": lambda w, x: warpcage.fill_unseen(
        w["posed"]["harmonic"].pose(x).render(w["camera"]), w["field"], w["camera"]
    ),
    "fit": lambda w, x: warpcage.fit(w["scene"], device=w["device"], **FIT),
    "fit_splats": lambda w, x: warpcage.fit_splats(
        w["splats"], w["cameras"], [np.zeros((12, 12, 3), np.float32)] * 3, steps=2, progress=False
    ),
    "biharmonic_coordinates": lambda w, x: warpcage.biharmonic_coordinates(w["points"], BOX.with_vertices(x)),
    "green_coordinates": lambda w, x: warpcage.green_coordinates(w["points"], BOX.with_vertices(x)),
    "harmonic_coordinates": lambda w, x: warpcage.harmonic_coordinates(w["points"], BOX.with_vertices(x), 12),
    "load_scene": lambda w, x: warpcage.load_scene(w["folder"] / "scene"),
    "maximum_likelihood_coordinates": lambda w, x: warpcage.maximum_likelihood_coordinates(
        w["points"], BOX.with_vertices(x)
    ),
    "mean_value_coordinates": lambda w, x: warpcage.mean_value_coordinates(w["points"], BOX.with_vertices(x)),
    "psnr, mean_psnr": lambda w, x: warpcage.psnr(w["field"].render(w["camera"]).rgb, np.zeros((12, 12, 3))),
    "render_film": lambda w, x: warpcage.render_film(
        w["posed"]["green"], w["folder"] / "tape.gif", poses=[x, BOX], camera=w["camera"], progress=False
    ),
    "select_nodes": lambda w, x: warpcage.select_nodes(w["splats"], cage=BOX.with_vertices(x)),
    "select_object": lambda w, x: warpcage.select_object(w["field"], plane=None),
    "to_splats": lambda w, x: warpcage.to_splats(w["field"]),
}

#: What launches nothing, or in processes of its own.
OTHERS = {
    *(
        "CageEdit",
        "CageReport",
        "Camera",
        "CameraFile",
        "CameraKey",
        "Cancelled",
        "CaptureReport",
        "Error",
        "FitOptions",
    ),
    *(
        "Place",
        "PlaceFile",
        "PoseFile",
        "PoseFit",
        "PoseTargets",
        "RunReport",
        "Scene",
        "SplatFitOptions",
        "SplatRates",
        "camera_at",
        "capture",
    ),
    *("edit", "run_jobs", "turntable"),
}


@pytest.mark.parametrize("name", CALLS)
def test_nothing_is_on_the_tape_of_a_caller(name, device, world):
    expected = simulated(device)
    assert expected[0] == ["step_places"] * STEPS + ["add_squares"]
    objects = world(device)
    assert simulated(device, lambda vertices: CALLS[name](objects, vertices)) == expected


def test_the_table_is_of_all_public_names():
    named = {word.partition(".")[0] for name in CALLS for word in name.split(", ")}
    public = {name for name in warpcage.__all__ if callable(getattr(warpcage, name))}
    assert named - {"pose", "render"} <= public and (named | OTHERS) >= public and not named & OTHERS


@pytest.mark.parametrize(
    "name", ["deform_points", "PositionMap", "Deformer.pose, render", "SplatDeformer.pose, render"]
)
def test_arrays_that_ask_for_a_gradient_are_refused_on_a_tape(name, device, world):
    """A clone that asks for none is taken, and nothing is on the tape."""
    pose = wp.array(BOX.vertices, dtype=wp.vec3, device=device, requires_grad=True)
    with wp.Tape() as tape:
        refused(lambda: CALLS[name](world(device), pose), "wp.clone(", match=MESSAGES["arrays.no_gradient"])
        CALLS[name](world(device), wp.clone(pose, requires_grad=False))
    assert tape.launches == []


def test_all_launches_go_through_one_function():
    """Which keeps them off tapes; arrays of the package ask for no gradient, so that their copies are on none."""
    package = pathlib.Path(warpcage.__file__).parent
    rooms = [room for room in package.iterdir() if room.is_dir() and room.name not in ("examples", "kernels")]
    pattern = re.compile(r"\b(wp|warp)\.(launch|launch_tiled|map)\(|requires_grad=True")
    found = [path for room in rooms for path in room.rglob("*.py") if pattern.search(path.read_text(encoding="utf-8"))]
    assert found == [package / "core" / "devices.py"]
