"""Pictures and values of a small made scene on the CPU, by name: hashed to compare two trees on one machine to the bit.

PYTHONPATH=.:tests/support python tests/contracts/picture_hashes.py a.json  # in a tree
diff a.json ../clean/b.json  # of another tree, such as a clean copy: an array a line
"""

import contextlib
import functools
import hashlib
import json
import pathlib
import sys
import tempfile
from functools import partial as part

import numpy as np
from field_arrays import field_arrays
from fields import slotted

import warpcage
from warpcage import Cage, CageEdit, Camera, Deformer, SplatField, VoxelField

THREADS = 1  # results of fits depend on them

#: Summaries of what version 0.1.0 made, and how many values of an array they hold.
GOLDEN, SAMPLES = pathlib.Path(__file__).parent.parent / "data" / "pictures.npz", 14

BOX = Cage.box([-0.75, -0.55, -0.4], [0.75, 0.55, 0.4], segments=2)
LEFT, RIGHT = (Cage.box([x - 0.3, -0.3, -0.3], [x + 0.3, 0.3, 0.3]) for x in (-0.5, 0.5))
CAMERA = Camera.look_at((2.5, 1.2, 1.0), (0, 0, 0), width=20, height=16, fov_degrees=28)
NEAR = Camera.look_at((0.9, 0.4, 0.3), (0, 0, 0), width=20, height=16)
COORDINATES = ("harmonic", "mean_value", "green")
PARTS = ("rgb", "alpha", "depth", "reveal", "fold", "outside")


def bent(cage=BOX):
    return cage.bend(70, axis="x", towards="z")


def closed(cage, share):
    """The slotted prism with its arms nearer to each other."""
    vertices = cage.vertices.copy()
    vertices[np.abs(vertices[:, 0]) < 0.3, 0] *= share
    return cage.with_vertices(vertices)


@functools.cache
def made_field(shape="ellipsoid"):
    """Matter with stripes whose colour depends on the direction that they are seen from."""
    side = 28
    places = (np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1) + 0.5) / side * 2 - 1
    middles, radii = {
        "ellipsoid": ([(0.0, 0.0, 0.0)], (0.55, 0.35, 0.25)),
        "two balls": ([(-0.5, 0.0, 0.0), (0.5, 0.0, 0.0)], (0.2, 0.2, 0.2)),
    }[shape]
    density = sum(
        30.0 * np.clip((1.15 - np.linalg.norm((places - middle) / np.array(radii), axis=-1)) / 0.3, 0, 1)
        for middle in middles
    )
    sh = np.zeros((side, side, side, 9, 3))
    sh[..., 0, :] = 0.8 * np.sin(places @ np.array([[7.0, 1, 2], [2, 6, -3], [1, -3, 7]]))
    sh[..., 1:, :] = 0.35 * np.random.default_rng(0).normal(size=(8, 3))
    return VoxelField.from_dense(density, sh, [[-1, -1, -1], [1, 1, 1]], device="cpu")


@functools.cache
def made_splats():
    """Splats of degree 2 in a box."""
    random, count = np.random.default_rng(1), 150
    return SplatField(
        random.uniform(-0.6, 0.6, (count, 3)) * [1.0, 0.7, 0.5],
        random.uniform(-4.0, -2.5, (count, 3)),
        random.normal(size=(count, 4)),
        random.normal(size=count) + 1.0,
        0.4 * random.normal(size=(count, 9, 3)),
        device="cpu",
    )


def file_field(version):
    """A field that was loaded from a file of a version."""
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "field.npz"
        np.savez(path, **field_arrays(version))
        return VoxelField.load(path, device="cpu")


def frame_parts(frame):
    """The arrays of a frame."""
    parts = {name: getattr(frame, name, None) for name in PARTS}
    return {name: np.array(array) for name, array in parts.items() if array is not None}


def deformed(rest, posed, *, field=None, camera=CAMERA, **options):
    """The parts of a frame of a deformed field."""
    deformer = Deformer(made_field() if field is None else field, rest, device="cpu", **options)
    return frame_parts(deformer.pose(posed).render(camera))


def points_and_directions():
    random = np.random.default_rng(5)
    return random.uniform(-0.9, 0.9, (60, 3)), random.normal(size=(60, 3))


def canonical(rest, posed, dtype=np.float32, **options):
    """What `to_canonical` says of some points."""
    points, directions = (each.astype(dtype) for each in points_and_directions())
    deformer = Deformer(made_field(), rest, device="cpu", **options).pose(posed)
    found = deformer.to_canonical(points, directions, return_outside=True)
    return dict(zip(("points", "directions", "region", "outside"), found, strict=True))


def whole(**options):
    return frame_parts(made_field().render(CAMERA, **options))


def sampled():
    points, directions = points_and_directions()
    return dict(zip(("colour", "density"), made_field().sample(points, directions), strict=True))


def field_values(field):
    """Values of a field at some points, and a picture of it."""
    low, high = field.bounds
    points, directions = points_and_directions()
    color, density = field.sample(0.5 * (low + high) + 0.5 * (high - low) * points, directions)
    camera = Camera.look_at(field.center + (2.6, 1.0, 1.3), field.center, width=20, height=16)
    return {"colour": color, "density": density, **frame_parts(field.render(camera))}


@functools.cache
def brick_views(count, size):
    """A scene of pictures of the made field."""
    cameras = warpcage.turntable((0, 0, 0), 3.0, 25, count, width=size, height=size)
    frames = [made_field().render(camera, background="white") for camera in cameras]
    return warpcage.Scene(
        np.stack([frame.rgb for frame in frames]), np.stack([frame.alpha for frame in frames]), cameras
    )


def fitted(**options):
    """A fit of a few steps: its field's values."""
    scene = brick_views(6, 24)
    usual = {"resolution": 14, "batch_rays": 512, "least_steps": 6, "epochs": 0.1, "levels": 2, "max_memory": None}
    field = warpcage.fit(scene, device="cpu", seed=3, progress=False, **(usual | options))
    refined = field.refined_cameras
    cameras = {} if refined is None else {"cameras": np.array([each.camera_to_world for each in refined.cameras])}
    return {**field_values(field), "count": np.array([field.voxel_count]), **cameras}


def surrounded_fit(kind):
    """A fit of a few steps of pictures with something behind."""
    scene = brick_views(6, 24)
    whole = warpcage.Scene(scene.images * 0.9, None, scene.cameras)
    usual = {"resolution": 12, "batch_rays": 512, "least_steps": 6, "epochs": 0.1, "levels": 1}
    small = {"background_layers": 3, "background_side": 8}
    if kind == "outer":  # finer than the box: its first rates are (16 / 12)^2 times the given ones
        small = {"outer_resolution": 16, "rate_outer": 0.06 * 9 / 16, "rate_outer_density": 0.083 * 9 / 16}
    field = warpcage.fit(whole, device="cpu", seed=1, progress=False, background=kind, **usual, **small)
    return field_values(field)


def fitted_splats():
    cameras = warpcage.turntable((0, 0, 0), 3.0, 25, 3, width=24, height=24)
    images = [0.8 * made_splats().render(camera).rgb for camera in cameras]
    field = warpcage.fit_splats(made_splats(), cameras, images, steps=4, progress=False)
    return splat_values(field)


def splat_values(field):
    return {"covariances": field.covariances, "opacities": field.opacities, **frame_parts(field.render(CAMERA))}


def posed_splats(posed, rest=BOX, **options):
    return deformed(rest, posed, field=made_splats(), **options)


def splats_of_two_edits():
    edits = [CageEdit(LEFT, remove=True), CageEdit(RIGHT, keep_source=True)]
    return posed_splats([None, RIGHT.rotate(40)], edits, **MEAN)


def baked_splats():
    return splat_values(warpcage.bake(Deformer(made_splats(), BOX, device="cpu", **MEAN).pose(bent())))


def generated_cages():
    """Cages that are made of the field."""
    field = made_field()
    cage = Cage.from_field(field, 30)
    pose = cage.random_pose(2, 1)
    return {"cage": cage.vertices, "faces": cage.faces, "pose": pose.vertices, "simple": cage.simplify(20).vertices}


def cage_coordinates():
    points = 0.35 * points_and_directions()[0]
    green, normals = warpcage.green_coordinates(points, BOX, device="cpu")
    return {
        "mean_value": warpcage.mean_value_coordinates(points, BOX, device="cpu"),
        "harmonic": warpcage.harmonic_coordinates(points, BOX, resolution=24, device="cpu"),
        "green": green,
        "green_normals": normals,
        "moved": warpcage.deform_points(points, BOX, bent(), "green", device="cpu"),
    }


def selected():
    field = made_field("two balls")
    sphere = warpcage.select_nodes(field, sphere=[0.5, 0, 0, 0.4])
    chosen = warpcage.select_object(field, point=(-0.5, 0, 0), plane=None)
    return {
        "sphere": sphere.node_densities().sum(axis=2),
        "part": chosen.node_densities().sum(axis=2),
        **frame_parts(chosen.cut_out().render(CAMERA)),
    }


def filled():
    field = file_field(4)
    rest = Cage.box(field.center - 0.5, field.center + 0.5)
    camera = Camera.look_at(field.center + (2.6, 1.0, 1.3), field.center, width=20, height=16)
    frame = Deformer(field, rest, resolution=16, device="cpu").pose(rest.translate((0, 0, 0.4))).render(camera)
    frame = warpcage.fill_unseen(frame, field, camera)
    return {"rgb": frame.rgb, "filled": np.array(frame.filled)}


def removed_and_kept():
    edits = [CageEdit(LEFT, remove=True), CageEdit(RIGHT, keep_source=True)]
    return deformed(edits, [None, RIGHT.translate((-0.4, 0, 0.5))], field=made_field("two balls"), resolution=16)


def baked(**options):
    deformer = Deformer(made_field(), BOX, coordinates="mean_value", resolution=16, device="cpu").pose(bent())
    return field_values(warpcage.bake(deformer, **options))


def posed_twice():
    """Poses one after another, and one of its own between."""
    deformer = Deformer(made_field(), BOX, coordinates="mean_value", resolution=16, device="cpu")
    other = deformer.posed(BOX.twist(40))
    first = frame_parts(deformer.pose(bent()).render(CAMERA))
    second = frame_parts(other.render(CAMERA))
    again = frame_parts(deformer.pose(BOX.taper(0.5)).render(CAMERA))
    return {f"{name} {key}": each[key] for name, each in enumerate((first, second, again)) for key in ("rgb", "alpha")}


def precise(kind):
    return deformed(BOX, bent(), coordinates=kind, resolution=None)


SLOT, HALF, END = (
    slotted(0.4),
    Cage.box([-0.2, -0.6, -0.5], [0.8, 0.6, 0.5]),
    Cage.box([-0.8, -0.3, -0.3], [-0.45, 0.3, 0.3]),
)
MEAN = {"coordinates": "mean_value", "resolution": 16}


def two(edits, posed, **options):
    options = {**MEAN, **options}
    return deformed(edits, posed, field=made_field("two balls"), **options)


#: What makes each set of arrays, by its name.
CASES = {
    "canonical": whole,
    "canonical, four rays a pixel": lambda: whole(supersampling=2, background="black"),
    "canonical, other step": lambda: whole(step=0.05),
    "file, version 1": lambda: field_values(file_field(1)),
    "file, layers": lambda: field_values(file_field(2)),
    "file, luminous": lambda: field_values(file_field(3)),
    "file, outer field": lambda: field_values(file_field(4)),
    "sample": sampled,
    **{f"deformed, {kind}": part(deformed, BOX, bent(), coordinates=kind, resolution=24) for kind in COORDINATES},
    **{f"precise, {kind}": part(precise, kind) for kind in COORDINATES[1:]},
    "deformed, weights kept": lambda: deformed(BOX, bent(), store="weights", **MEAN),
    "deformed, density of the paper": lambda: deformed(BOX, BOX.stretch(1.5), density="paper", **MEAN),
    "deformed, at rest": lambda: deformed(BOX, BOX, **MEAN),
    "deformed, near": lambda: deformed(BOX, bent(), camera=NEAR, **MEAN),
    "deformed, slot": lambda: deformed(SLOT, closed(SLOT, 0.05), **MEAN),
    "deformed, slot, harmonic": lambda: deformed(SLOT, closed(SLOT, 0.3), resolution=24),
    "posed twice": posed_twice,
    "two edits apart": lambda: two([LEFT, RIGHT], [LEFT.rotate(20), RIGHT.rotate(-30)]),
    "two edits, harmonic": lambda: two([LEFT, RIGHT], [LEFT.rotate(20), RIGHT.rotate(-30)], coordinates="harmonic"),
    "two edits that overlap": lambda: deformed([BOX, RIGHT], [BOX.rotate(20), RIGHT.rotate(15, axis="x")], **MEAN),
    "two edits, slot": lambda: deformed([SLOT, BOX], [closed(SLOT, 0.05), BOX.rotate(20)], **MEAN),
    "two edits, precise": lambda: two([LEFT, RIGHT], [LEFT.rotate(20), RIGHT.twist(30)], resolution=None),
    "copy": lambda: two([CageEdit(LEFT, keep_source=True)], [LEFT.translate((0.2, 0, 0.6))]),
    "removed": lambda: two([CageEdit(LEFT, remove=True)], [None]),
    "removed and kept": removed_and_kept,
    "falloff": lambda: deformed([CageEdit(HALF, falloff=0.2)], [HALF.rotate(25)], **MEAN),
    "falloff, faces": lambda: deformed([CageEdit(BOX, falloff=0.1, held=(0, 1))], [BOX.rotate(25)], **MEAN),
    "fragments": lambda: two([CageEdit(END, fragments=0.5)], [END.translate((0, 0, 0.5))]),
    **{f"to_canonical, {kind}": part(canonical, BOX, bent(), coordinates=kind, resolution=24) for kind in COORDINATES},
    "to_canonical, precise": lambda: canonical(BOX, bent(), coordinates="green", resolution=None),
    "to_canonical, float64": lambda: canonical(BOX, bent(), np.float64, **MEAN),
    "to_canonical, falloff": lambda: canonical(CageEdit(BOX, falloff=0.1, held="still"), BOX.rotate(25), **MEAN),
    "to_canonical, two edits": lambda: canonical(
        [CageEdit(LEFT, remove=True), RIGHT], [None, RIGHT.rotate(30)], **MEAN
    ),
    "filled": filled,
    "bake": baked,
    "bake, finer": lambda: baked(resolution=36, bounds=[[-1, -1, -1], [1, 1, 1.2]]),
    "fit": fitted,
    "fit, refined cameras": lambda: fitted(refine_cameras=True),
    "fit, outer field": lambda: surrounded_fit("outer"),
    "fit, layers": lambda: surrounded_fit("layers"),
    "splats": lambda: splat_values(made_splats()),
    "splats, four rays a pixel": lambda: frame_parts(made_splats().render(CAMERA, supersampling=2, antialias=True)),
    **{f"splats, {kind}": part(posed_splats, bent(), coordinates=kind, resolution=16) for kind in COORDINATES},
    **{
        f"splats, backward, {kind}": part(posed_splats, bent(), coordinates=kind, resolution=16, map="backward")
        for kind in COORDINATES
    },
    "splats, two edits": splats_of_two_edits,
    "splats, falloff": lambda: posed_splats([BOX.rotate(25)], [CageEdit(BOX, falloff=0.1, held="still")], **MEAN),
    "splats, baked": baked_splats,
    "splats, fit": fitted_splats,
    "cages": generated_cages,
    "coordinates": cage_coordinates,
    "selection": selected,
}


@functools.cache
def made(name):
    """The arrays of a case, in one thread."""
    from warpcage.core.threads import limit_threads

    with limit_threads(THREADS):
        return {key: np.asarray(array) for key, array in CASES[name]().items()}


def hashes(name):
    """SHA-256 of each array of a case, of its type and shape too."""
    found = {}
    for key, array in made(name).items():
        digest = hashlib.sha256(f"{array.dtype.str} {array.shape}\n".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
        found[f"{name}: {key}"] = digest.hexdigest()
    return found


def summary(array):
    """Statistics of an array's finite values, their number, and some of all values: what other machines compare."""
    flat = np.asarray(array, np.float64).ravel()
    there = flat[np.isfinite(flat)] if np.isfinite(flat).any() else np.zeros(1)
    statistics = [flat.size, np.isfinite(flat).sum(), there.mean(), there.std(), there.min(), there.max()]
    places = np.linspace(0, flat.size - 1, min(SAMPLES, flat.size)).astype(int)
    return np.concatenate([statistics, flat[places]]).astype(np.float32)


def read_golden():
    """The summary of each array of version 0.1.0, by case and name."""
    with np.load(GOLDEN) as held:
        parts = np.split(held["values"], np.cumsum(held["lengths"])[:-1])
        return dict(zip(map(str, held["names"]), parts, strict=True))


if __name__ == "__main__":
    everything = {}
    for case in CASES:
        print(case, file=sys.stderr, flush=True)
        with contextlib.redirect_stdout(sys.stderr):
            everything |= hashes(case)
    pathlib.Path(sys.argv[1]).write_text(json.dumps(everything, indent=1) + "\n", encoding="utf-8")
    print(f"{len(everything)} arrays of {pathlib.Path(warpcage.__file__).parent}", file=sys.stderr)
