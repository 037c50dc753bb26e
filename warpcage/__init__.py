"""Cage-based deformation of radiance fields on NVIDIA Warp.

images + cameras -> Scene -> VoxelField -> surface mesh -> Cage -> coordinates on a lattice -> deformed frames,
after Xu and Harada, "Deforming Radiance Fields with Cages" (ECCV 2022).
"""

from .cage.cage import Cage
from .cage.pose_file import PoseFile
from .cage.report import CageReport
from .coordinates.deform import deform_points
from .coordinates.weights import green_coordinates, harmonic_coordinates, mean_value_coordinates
from .deform.bake import bake
from .deform.deformer import Deformer
from .deform.edits import CageEdit
from .field.selection import NodeSelection, select_nodes
from .field.voxel_field import VoxelField
from .fitting.evaluation import evaluate, mean_psnr, psnr
from .fitting.optimizer import FieldOptimizer, fit
from .fitting.options import FitOptions
from .lattice.position_map import PositionMap
from .scene.load import load_scene
from .scene.scene import Scene
from .view.camera import Camera, turntable
from .view.frame import Frame

__version__ = "0.1.0"
__all__ = [
    "Cage",
    "CageEdit",
    "CageReport",
    "Camera",
    "Deformer",
    "FieldOptimizer",
    "FitOptions",
    "Frame",
    "NodeSelection",
    "PoseFile",
    "PositionMap",
    "Scene",
    "VoxelField",
    "bake",
    "deform_points",
    "evaluate",
    "fit",
    "green_coordinates",
    "harmonic_coordinates",
    "load_scene",
    "mean_psnr",
    "mean_value_coordinates",
    "psnr",
    "select_nodes",
    "turntable",
]
