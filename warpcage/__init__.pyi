"""The public names, for type checkers and editors: `__init__.py` loads each when it is first used."""

from .cage.cage import Cage as Cage
from .cage.check import CageReport as CageReport
from .cage.pose_file import PoseFile as PoseFile
from .cage.random_poses import RandomPoses as RandomPoses
from .coordinates.coordinates import biharmonic_coordinates as biharmonic_coordinates
from .coordinates.coordinates import deform_points as deform_points
from .coordinates.coordinates import green_coordinates as green_coordinates
from .coordinates.coordinates import harmonic_coordinates as harmonic_coordinates
from .coordinates.coordinates import maximum_likelihood_coordinates as maximum_likelihood_coordinates
from .coordinates.coordinates import mean_value_coordinates as mean_value_coordinates
from .deform.bake import bake as bake
from .deform.deformer import Deformer as Deformer
from .deform.deformer import SplatDeformer as SplatDeformer
from .deform.fill import fill_unseen as fill_unseen
from .deform.stage import Stage as Stage
from .edits.edits import CageEdit as CageEdit
from .edits.place import Place as Place
from .edits.place import PlaceFile as PlaceFile
from .errors import Cancelled as Cancelled
from .errors import Error as Error
from .field.voxel_field import VoxelField as VoxelField
from .fitting.evaluation import evaluate as evaluate
from .fitting.evaluation import mean_psnr as mean_psnr
from .fitting.evaluation import psnr as psnr
from .fitting.fit import fit as fit
from .fitting.optimizer import FieldOptimizer as FieldOptimizer
from .fitting.options import FitOptions as FitOptions
from .fitting.splats.from_voxels import to_splats as to_splats
from .fitting.splats.optimizer import SplatFit as SplatFit
from .fitting.splats.options import SplatFitOptions as SplatFitOptions
from .lattice.position_map import PositionMap as PositionMap
from .pose_fits.fit import PoseFit as PoseFit
from .pose_fits.fit import fit_pose as fit_pose
from .pose_fits.fit import fit_poses as fit_poses
from .pose_fits.targets import PoseTargets as PoseTargets
from .render.sampled import SampledField as SampledField
from .render.surface_mesh import SurfaceMesh as SurfaceMesh
from .scene.load import load_scene as load_scene
from .scene.scene import Scene as Scene
from .select.objects import select_object as select_object
from .select.selection import NodeSelection as NodeSelection
from .select.selection import select_nodes as select_nodes
from .splats.fit import SplatRates as SplatRates
from .splats.fit import fit_splats as fit_splats
from .splats.splat_field import SplatField as SplatField
from .studio.captures.capture import capture as capture
from .studio.captures.report import CaptureReport as CaptureReport
from .studio.editor.edit import edit as edit
from .studio.films.film import render_film as render_film
from .studio.jobs.run import RunReport as RunReport
from .studio.jobs.run import run_jobs as run_jobs
from .view.camera import Camera as Camera
from .view.camera import CameraFile as CameraFile
from .view.camera import CameraKey as CameraKey
from .view.camera import turntable as turntable
from .view.camera_path import camera_at as camera_at
from .view.frame import Frame as Frame
from .view.frame import Frames as Frames

__version__: str
__all__ = [
    "Cage",
    "CageEdit",
    "CageReport",
    "Camera",
    "CameraFile",
    "CameraKey",
    "Cancelled",
    "CaptureReport",
    "Deformer",
    "Error",
    "FieldOptimizer",
    "FitOptions",
    "Frame",
    "Frames",
    "NodeSelection",
    "Place",
    "PlaceFile",
    "PoseFile",
    "PoseFit",
    "PoseTargets",
    "PositionMap",
    "RandomPoses",
    "RunReport",
    "SampledField",
    "Scene",
    "SplatDeformer",
    "SplatField",
    "SplatFit",
    "SplatFitOptions",
    "SplatRates",
    "Stage",
    "SurfaceMesh",
    "VoxelField",
    "bake",
    "biharmonic_coordinates",
    "camera_at",
    "capture",
    "deform_points",
    "edit",
    "evaluate",
    "fill_unseen",
    "fit",
    "fit_pose",
    "fit_poses",
    "fit_splats",
    "green_coordinates",
    "harmonic_coordinates",
    "load_scene",
    "maximum_likelihood_coordinates",
    "mean_psnr",
    "mean_value_coordinates",
    "psnr",
    "render_film",
    "run_jobs",
    "select_nodes",
    "select_object",
    "to_splats",
    "turntable",
]
