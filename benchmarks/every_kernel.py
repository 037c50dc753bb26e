"""Launch every kernel at small sizes through the public names, for tools that watch each access to memory.

    python benchmarks/every_kernel.py --device cpu
    compute-sanitizer --tool memcheck python benchmarks/every_kernel.py --device cuda:0 --no-pool --eager
    compute-sanitizer --tool racecheck python benchmarks/every_kernel.py --device cuda:0 --eager

--no-pool takes each array from the driver by itself, so that reading behind its end is seen. --eager launches what is
otherwise replayed as a captured graph: over those, sanitizers report what is not there (docs/reliability.md). The exit
status is 1 where a kernel of warpcage.kernels was never launched.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys

import numpy as np
import trimesh
import warp as wp
from common import ball_field
from ground_truth import CarriedMesh, InverseMap, synthetic_scene
from machine_code import kernel_modules

import warpcage
from warpcage import FieldOptimizer, PositionMap
from warpcage.coordinate_kinds import COORDINATE_KINDS
from warpcage.coordinates import coordinates_vjp, deform_points_vjp
from warpcage.core import COORDINATES, launch, limit_threads
from warpcage.fitting.splats import PictureLoss
from warpcage.gradients import frame_gradient
from warpcage.interop import canonical_points_vjp
from warpcage.kernels.coordinates.green import map_green
from warpcage.lattice import HarmonicSolver, PoseGraph
from warpcage.mesh import prepared_fans
from warpcage.pose_fits.targets import PictureLoss as PoseLoss
from warpcage.splats import SplatDensity
from warpcage.studio.editor import frame_pixels
from warpcage.view import RGB_BYTES

#: Kernels that only one kind of device launches.
CPU_ONLY = {"fitting.loss.accumulate_photometric_gradient", "fitting.rmsprop.add_gradients",
            "fitting.rmsprop.join_maximum", "render.march_cpu.", "field.march_cpu.",
            "field.occupancy.gather_densities", "field.occupancy.note_densities", "field.occupancy.spread_lines",
            "mesh.shell.", "mesh.collapses.", "splats.composite_cpu.", "splats.pose.carry_bound",
            "gradients.splat_pose.propagate_rows"}  # fmt: skip
CUDA_ONLY = {"fitting.loss_warps.accumulate_photometric_gradient_by_warps", "field.rows.pack_rows",
             "field.densities.lay_densities", "field.refine.widen_rows", "field.outer_bricks.",
             "field.columns.link_rows", "field.occupancy.spread_distance", "field.colors.",
             "field.march.rows.", "field.march.shaded.", "render.views.rows", "render.views.shaded",
             "render.shading.", "edits.fine_cells.", "edits.inverse.", "core.texels.",
             "edits.nodes.", "view.tile_order.", "gradients.frame.weigh_samples", "gradients.frame.sum_samples",
             "fitting.splat_step.check_room", "fitting.splat_loss.find_slopes_of_tiles",
             "fitting.splat_loss.find_window_slopes_of_tiles",
             "splats.composite.add_", "splats.composite.composite_pixels", "splats.packed_rows.",
             "gradients.splat_pose.propagate_packed_rows", "view.pictures.round_colors"}  # fmt: skip

launched: set[str] = set()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--no-pool", action="store_true", help="take device memory without a pool")
    parser.add_argument("--eager", action="store_true", help="capture no graphs")
    args = parser.parse_args()
    wp.init()
    if args.eager:
        PoseGraph.is_supported = staticmethod(lambda device: False)
        HarmonicSolver.cycle_runner = lambda self, sections: lambda: self.launch_cycle(sections)
    if args.no_pool:
        wp.set_mempool_enabled(args.device, False)
    watch_launches()
    with limit_threads(2):  # on one thread no gradients are joined
        for part in (fields, fits, coordinates, frames, edits, near_frames, references, meshes, splats, posed_splats):
            part(args.device)
            wp.synchronize_device(args.device)
            print(f"{part.__name__}: {len(launched)} kernels so far", flush=True)
    left_out = CUDA_ONLY if wp.get_device(args.device).is_cpu else CPU_ONLY
    unused = {name for name in all_kernels() - launched if not name.startswith(tuple(left_out))}
    print(f"{len(launched)} kernels launched; never: {', '.join(sorted(unused)) or 'none'}")
    return 1 if unused else 0


def kernel_name(kernel) -> str:
    return f"{kernel.module.name}.{kernel.key}".removeprefix("warpcage.kernels.")


def watch_launches() -> None:
    launch = wp.launch

    def watched(kernel, *args, **options):
        launched.add(kernel_name(kernel))
        return launch(kernel, *args, **options)

    wp.launch = watched


def all_kernels() -> set[str]:
    return {kernel_name(kernel) for module in kernel_modules() for kernel in module.kernels.values()}


def camera(size: int = 16) -> warpcage.Camera:
    return warpcage.turntable((0, 0, 0), 4.0, 20, 1, width=size, height=size)[0]


CAGE = warpcage.Cage.icosphere((0, 0, 0), 1.2)
POSE = CAGE.twist(50)
QUADS = warpcage.Cage(
    [(x, y, z) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)],
    [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)],
)
POINTS = np.random.default_rng(0).uniform(-0.6, 0.6, (64, 3))


def fields(device) -> None:
    """Renders, samples, selections and cages of a field."""
    field = ball_field(device)
    frame = field.render(camera(), supersampling=2)
    frame_pixels(frame, "rgb", 1.0, 8.0, 8, 6)
    frame.begin_copies(RGB_BYTES)
    field.render(warpcage.Camera.look_at((0, 0, 0.1), (0, 0, 0), width=8, height=8))  # too near for shaded voxels
    for points in (POINTS, wp.array(POINTS, dtype=wp.vec3, device=device)):
        field.sample(points, np.ones((64, 3)))
    halves = np.zeros((field.voxel_count, 24), np.float16)
    assert warpcage.VoxelField(field.bounds, field.host_links(), field.stored.density, halves, device=device).grid
    CAGE.contains(2.2 * POINTS, device=device)  # in it, at it and beside it
    CAGE.check(field=field)
    for options in (
        ({"method": "voxel"}, {"detail": "parts"}) if field.device.is_cpu else ()
    ):  # on the CPU on any machine
        warpcage.Cage.from_field(field, 40, **options)


def fits(device) -> None:
    """With pictures of alphas, without, with layers, an outer field, several rays per pixel, and a limit of memory; and
    of pixels that count."""
    train, _ = synthetic_scene("bricks", train_views=8, test_views=2, size=20, samples=1, device=device)
    whole = warpcage.Scene(train.images, None, train.cameras)
    around = 0.5 * (1 - train.alphas[..., None]) * np.ones(3)
    split = warpcage.Scene(train.images, train.alphas, train.cameras, surroundings=around)
    counted = dataclasses.replace(whole, weights=(np.arange(20) > 4) * np.ones(whole.images.shape[:3]))
    for scene, options in (
        (train, {}),
        (train, {"supersampling": 2}),
        (whole, {"background": "layers", "background_layers": 3, "background_side": 4}),
        (split, {"background_layers": 3, "background_side": 4}),
        (whole, {"background": "outer", "outer_resolution": 16}),
        (counted, {"background": "outer", "outer_resolution": 16, "variation_views": 4, "variation_outer_views": 4}),
        (train, {"max_memory": "6MB"}),
        (train, {"refine_cameras": True}),
        (whole, {"refine_cameras": True, "background": "layers", "background_layers": 3, "background_side": 4}),
    ):
        field = warpcage.fit(scene, device=device, progress=False, resolution=24, levels=2, least_steps=12, **options)
        field.render(scene.cameras[0])
        if field.background_model is not None:
            field.background_model.sample(*(each.reshape(-1, 3) for each in scene.cameras[0].rays()))
            warpcage.Deformer(field, CAGE, resolution=12).pose(POSE).render(scene.cameras[0])
    shown = warpcage.PoseTargets(whole.cameras, images=whole.images)
    deformer = warpcage.Deformer(field, CAGE, resolution=12).pose(POSE)
    PoseLoss(shown, 20, 1.0, CAGE.size, field.device, field=field, exposure=True)(deformer)
    optimizer = FieldOptimizer(train, device=device, resolution=24, levels=2, least_steps=4)
    for _ in range(3):
        optimizer.step()
    optimizer.finish()


def coordinates(device) -> None:
    """Weights and moved points of each kind, on the device."""
    points = wp.array(POINTS, dtype=wp.vec3, device=device)
    vertices = wp.array(CAGE.vertices, dtype=wp.vec3, device=device)
    faces = wp.array(CAGE.faces, dtype=wp.vec3i, device=device)
    normals = wp.zeros(len(faces), dtype=wp.vec3, device=device)
    inputs = [points, vertices, faces, prepared_fans(vertices, faces, 1.0), vertices, normals, 1.0]
    launch(map_green, len(points), inputs, [wp.empty_like(points)], device=device)
    warpcage.mean_value_coordinates(points, CAGE)
    warpcage.green_coordinates(points, CAGE)
    warpcage.mean_value_coordinates(points, QUADS)
    warpcage.maximum_likelihood_coordinates(points, CAGE)
    warpcage.biharmonic_coordinates(points, CAGE)
    warpcage.harmonic_coordinates(POINTS, CAGE, resolution=12, device=device)
    for kind in COORDINATES:
        warpcage.deform_points(points, CAGE, POSE, coordinates=kind)
        for resolution in (12, 160 if kind == "harmonic" else 24):  # the finer is solved on several levels
            position_map = PositionMap(CAGE, coordinates=kind, resolution=resolution, device=device)
            for pose in (POSE, CAGE.bend(80), POSE):  # the first captures graphs, the others replay them
                position_map.pose(pose)
        PositionMap(slotted(0.5), coordinates=kind, resolution=16, device=device).pose(slotted(0.03))
    sphere = trimesh.creation.icosphere(subdivisions=3)  # faces enough to be looked through for groups of blocks
    fine = warpcage.Cage(sphere.vertices, sphere.faces)
    for kind in ("harmonic", "mean_value", "green", "maximum_likelihood"):
        position_map = PositionMap(CAGE, coordinates=kind, resolution=24, device=device).pose(POSE)
        position_map.vertex_gradient(position_map.data.positions)
        deform_points_vjp(points, CAGE, POSE, points, kind)
    rows = [wp.zeros((len(points), count), dtype=float, device=device) for count in (len(vertices), len(faces))]
    coordinates_vjp(points, CAGE, rows[0])
    deform_points_vjp(points, QUADS, QUADS.bend(40), points)
    by_quads = wp.zeros((len(points), len(QUADS.vertices)), dtype=float, device=device)
    coordinates_vjp(points, QUADS, by_quads)
    coordinates_vjp(points, CAGE, (rows[0], rows[1]), "green")
    for kind in ("harmonic", "mean_value"):
        PositionMap(fine, coordinates=kind, resolution=12, device=device).pose(fine.twist(50)).pose(fine.bend(60))
    PositionMap(QUADS, coordinates="mean_value", resolution=12, device=device).pose(QUADS.bend(40))
    warpcage.deform_points(points, QUADS, QUADS.bend(40), coordinates="mean_value")


def slotted(width: float) -> warpcage.Cage:
    """A block with a slot, whose walls are `width` apart."""
    outline = [(-1, -1), (1, -1), (1, 1), (width / 2, 1), (width / 2, 0), (-width / 2, 0), (-width / 2, 1), (-1, 1)]
    triangles = [(0, 1, 4), (0, 4, 5), (1, 2, 3), (1, 3, 4), (0, 5, 6), (0, 6, 7)]
    mesh = trimesh.creation.extrude_triangulation(np.array(outline, float), np.array(triangles), height=1.0)
    return warpcage.Cage(mesh.vertices, mesh.faces)


def frames(device) -> None:
    """Deformed frames of each kind and store, precise ones, several rays per pixel, and moved points."""
    field = ball_field(device)
    for kind in COORDINATES:
        for options in ({"resolution": 12}, {"resolution": 12, "store": "weights"}, {"resolution": None}):
            if options["resolution"] is None and not COORDINATE_KINDS[kind].is_precise:
                continue
            deformer = warpcage.Deformer(field, CAGE, coordinates=kind, device=device, **options).pose(POSE)
            deformer.render(camera())
            deformer.to_canonical(POINTS, np.ones((64, 3)))
    warpcage.Deformer(field, CAGE, resolution=12, device=device).pose(POSE).render(camera(), supersampling=2)
    deformer = warpcage.Deformer(field, CAGE, resolution=12, device=device).pose(POSE)
    frame_gradient(deformer, camera(), np.ones((16, 16, 3)), by_camera=True, by_field=True)
    shown = warpcage.PoseTargets([camera()], images=np.ones((1, 16, 16, 3)), depths=np.full((1, 16, 16), 3.0))
    for blur in (0.0, 1.0):
        PoseLoss(shown, 16, blur, CAGE.size, wp.get_device(device))(deformer)
    given = [wp.array(each, dtype=wp.vec3, device=device) for each in (POINTS, np.ones((64, 3)))]
    region = deformer.to_canonical(*given)[2]
    canonical_points_vjp(deformer, *given, region, (given[0], given[1]), by_vertices=True)
    asked = warpcage.SampledField(field.sample, field.bounds, step=0.1, device=device)
    warpcage.Deformer(asked, CAGE, resolution=12, device=device).pose(POSE).render(camera())
    warpcage.Deformer(field, slotted(0.5), resolution=16, device=device).pose(slotted(0.03)).render(camera())
    for rest, pose in ((CAGE, POSE), (slotted(0.5), slotted(0.03))):  # cells so wide that their parts are distinguished
        warpcage.Deformer(field, rest, resolution=8, device=device).pose(pose).render(camera())


def edits(device) -> None:
    """Several cages in one scene, and a field baked from them."""
    field = ball_field(device)
    cages = [warpcage.CageEdit(CAGE, keep_source=True), warpcage.CageEdit(CAGE)]
    deformer = warpcage.Deformer(field, cages, resolution=12, device=device).pose([CAGE.translate((0, 0, 3)), POSE])
    deformer.render([camera(), camera()], outputs=["canonical", "flow"], flow_pose=[CAGE, POSE])
    deformer.to_canonical(POINTS, np.ones((64, 3)))
    warpcage.bake(deformer, resolution=16)
    beside = warpcage.Cage.box((-1, -1, 1.2), (1, 1, 2))  # a part each
    apart = warpcage.Deformer(field, [beside, slotted(0.5)], resolution=16, device=device)
    apart.pose([beside.translate((0, 0, 0.1)), slotted(0.03)]).render(camera())
    held = warpcage.CageEdit(slotted(0.5), falloff=0.4, held="still")
    warpcage.Deformer(field, held, resolution=16, device=device).pose(slotted(0.03)).render(camera())
    low = warpcage.Cage.box((-1, -1, -1), (1, 1, 0.6))  # what stands out of it is a fragment
    for options in ({"resolution": 12}, {"coordinates": "mean_value", "resolution": None}):
        part = warpcage.Deformer(field, warpcage.CageEdit(low, fragments=2.0), device=device, **options)
        part.pose(low.bend(20)).render(camera())
    precise = warpcage.Deformer(field, cages, coordinates="mean_value", resolution=None, device=device)
    precise.pose([CAGE.translate((0, 0, 3)), POSE]).render(camera(), outputs="flow", flow_pose=[CAGE, POSE])


def near_frames(device) -> None:
    """Deformed frames of cameras that are too near for shaded voxels."""
    field, near = ball_field(device), warpcage.Camera.look_at((0.3, 0.2, 0.1), (0, 0, 0), width=8, height=8)
    warpcage.Deformer(field, CAGE, resolution=12, device=device).pose(POSE).render(near)
    warpcage.Deformer(field, slotted(0.5), resolution=16, device=device).pose(slotted(0.03)).render(near)
    beside = warpcage.Cage.box((-1, -1, 1.2), (1, 1, 2))
    apart = warpcage.Deformer(field, [beside, slotted(0.5)], resolution=16, device=device)
    apart.pose([beside.translate((0, 0, 0.1)), slotted(0.03)]).render(near)


def references(device) -> None:
    """Ray casts and inverse maps that the benchmarks measure against."""
    mesh = ball_field(device).extract_mesh()
    carried = CarriedMesh(mesh.vertices, mesh.faces, np.full((len(mesh.faces), 3), 0.5), device=device)
    carried.render([camera()])
    carried.shade([0, 1], [(0.3, 0.3), (0.2, 0.5)], np.full((2, 3, 3), 3**-0.5))
    carried.signed_distances(POINTS)
    for kind in ("mean_value", "green", "harmonic"):
        inverse = InverseMap(CAGE, POSE, kind, cuts=1, device=device)
        inverse(0.5 * POINTS)
        inverse.invert(0.5 * POINTS)


def meshes(device) -> None:
    """Views of a mesh with a texture, and of one with a headlight."""
    mesh, picture = ball_field(device).extract_mesh(), np.random.default_rng(0).random((4, 5, 4))
    uv = np.asarray(mesh.vertices)[:, :2]
    warpcage.SurfaceMesh(mesh.vertices, mesh.faces, uv=uv, texture=picture, device=device).render(camera(37))
    warpcage.SurfaceMesh(mesh.vertices, mesh.faces, device=device).render(camera())


def splats(device) -> None:
    """Views of splats: with some of every size, and some out of sight."""
    rng = np.random.default_rng(0)
    values = (np.log(0.02) + rng.normal(size=(300, 3)), rng.normal(size=(300, 4)), rng.normal(size=300))
    field = warpcage.SplatField(
        rng.uniform(-1, 1, (300, 3)), *values, 0.2 * rng.normal(size=(300, 16, 3)), device=device
    )
    field.render(camera(37), supersampling=2, antialias=True)
    warpcage.Stage().add("one", field).add("other", field, place=warpcage.Place((1, 0, 0))).render(camera(37))
    view = warpcage.Camera.look_at((0.1, 0, 0.1), (0, 1, 0), width=40, height=23)
    field.render(view)
    cameras = [camera(37), view]
    pictures = [np.full((each.height, each.width, 3), 0.5) for each in cameras]
    options = {"supersampling": 2, "growth": 1.5, "progress": False}
    warpcage.fit_splats(field, cameras, pictures, steps=3, antialias=True, **options)
    drawn, truth = (wp.array(rng.random((37 * 23, 3)), dtype=wp.vec3, device=device) for _ in range(2))
    weights = wp.array(rng.random(37 * 23), dtype=wp.float32, device=device)
    for tiled in (True, False):
        PictureLoss(37, 23, device, tiled=tiled).slopes(drawn, truth, weights)
    shown = warpcage.turntable((0, 0, 0), 3.0, 20, 3, width=300, height=270)  # large enough for coarse pictures too
    scene = warpcage.Scene(np.stack([field.render(each).rgb for each in shown]), None, shown)
    options = {"steps": 9, "grow_every": 2, "most_splats": 500, "start": "random", "every_value": True}
    options |= {"exposure": True, "least_scale": 1.0, "weights": np.ones((3, 270, 300))}
    fit = warpcage.SplatFit(scene, device=device, **options)
    while fit.step_count < fit.total_steps:
        fit.step()
    fit.finish()


def posed_splats(device) -> None:
    """Splats of every size under each kind of coordinates: bent, at walls, copied, followed, removed, faded."""
    rng = np.random.default_rng(1)
    values = rng.uniform(-5, -1.5, (96, 3)), rng.normal(size=(96, 4)), rng.normal(size=96), rng.normal(size=(96, 4, 3))
    field = warpcage.SplatField(rng.uniform(-1.5, 1.5, (96, 3)), *values, device=device)
    for kind in COORDINATES:
        options = {"coordinates": kind, "resolution": 12, "device": device}
        for map in ("forward", "backward"):
            deformer = warpcage.Deformer(field, CAGE, map=map, **options).pose(POSE)
            deformer.baked()
            if map == "forward":
                ones = np.ones((16, 16))
                frame_gradient(deformer, camera(), depth_gradient=ones, by_vertices=True, by_camera=True)
    warpcage.Deformer(field, QUADS, **options | {"coordinates": "mean_value"}).pose(QUADS.bend(40)).posed_splats()
    lid = warpcage.Cage.box((-1.2, -1.2, 2.0), (1.2, 1.2, 5.0))
    cages = [warpcage.CageEdit(CAGE, keep_source=True), lid, warpcage.CageEdit(lid.translate((0, 4, 0)), remove=True)]
    chain = warpcage.Deformer(field, cages, **options)
    chain.pose([CAGE.translate((0, 0, 3)), lid.translate((0, 4, 0)), None]).posed_splats()
    held = warpcage.CageEdit(slotted(0.5), falloff=0.4, held="still")
    warpcage.Deformer(field, held, **options).pose(slotted(0.03)).posed_splats()
    SplatDensity(field, 16)


if __name__ == "__main__":
    sys.exit(main())
