"""Cage-based deformation of radiance fields on NVIDIA Warp.

images + cameras -> Scene -> VoxelField -> surface mesh -> Cage -> coordinates on a lattice -> deformed frames,
after Xu and Harada, "Deforming Radiance Fields with Cages" (ECCV 2022).

Each name is loaded when it is first used (PEP 562, SPEC 1), so that `import warpcage` takes no time; type checkers read
`__init__.pyi`.
"""

from .package import find_kernels, find_moved, lazy_exports, require_dependencies

require_dependencies()
find_kernels(__name__)
find_moved()

__version__ = "0.2.0"

#: Public names by the modules that they come from.
_HOMES = {
    "cage.cage": ["Cage"],
    "cage.check": ["CageReport"],
    "cage.pose_file": ["PoseFile"],
    "cage.random_poses": ["RandomPoses"],
    "coordinates.coordinates": [
        "biharmonic_coordinates",
        "deform_points",
        "green_coordinates",
        "harmonic_coordinates",
        "maximum_likelihood_coordinates",
        "mean_value_coordinates",
    ],
    "deform.bake": ["bake"],
    "deform.deformer": ["Deformer", "SplatDeformer"],
    "deform.fill": ["fill_unseen"],
    "deform.stage": ["Stage"],
    "edits.edits": ["CageEdit"],
    "edits.place": ["Place", "PlaceFile"],
    "errors": ["Cancelled", "Error"],
    "field.voxel_field": ["VoxelField"],
    "fitting.evaluation": ["evaluate", "mean_psnr", "psnr"],
    "fitting.fit": ["fit"],
    "fitting.optimizer": ["FieldOptimizer"],
    "fitting.options": ["FitOptions"],
    "fitting.splats.from_voxels": ["to_splats"],
    "fitting.splats.optimizer": ["SplatFit"],
    "fitting.splats.options": ["SplatFitOptions"],
    "lattice.position_map": ["PositionMap"],
    "pose_fits.fit": ["PoseFit", "fit_pose", "fit_poses"],
    "pose_fits.targets": ["PoseTargets"],
    "render.sampled": ["SampledField"],
    "render.surface_mesh": ["SurfaceMesh"],
    "scene.load": ["load_scene"],
    "scene.scene": ["Scene"],
    "select.objects": ["select_object"],
    "select.selection": ["NodeSelection", "select_nodes"],
    "splats.fit": ["SplatRates", "fit_splats"],
    "splats.splat_field": ["SplatField"],
    "studio.captures.capture": ["capture"],
    "studio.captures.report": ["CaptureReport"],
    "studio.editor.edit": ["edit"],
    "studio.films.film": ["render_film"],
    "studio.jobs.run": ["RunReport", "run_jobs"],
    "view.camera": ["Camera", "CameraFile", "CameraKey", "turntable"],
    "view.camera_path": ["camera_at"],
    "view.frame": ["Frame", "Frames"],
}

_PACKAGES = (
    "cage coordinates core deform demo edits examples field fitting gradients interop jax kernels lattice mesh "
    "pose_fits render scene select splats studio torch view"
).split()

__getattr__, __dir__, __all__ = lazy_exports(__name__, _HOMES, _PACKAGES)  # pyright: ignore[reportUnsupportedDunderAll]
