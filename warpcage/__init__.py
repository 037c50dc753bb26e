"""Cage-based deformation of radiance fields on NVIDIA Warp.

images + cameras -> Scene -> VoxelField -> surface mesh -> Cage -> coordinates on a lattice -> deformed frames,
after Xu and Harada, "Deforming Radiance Fields with Cages" (ECCV 2022).
"""

from .bake import bake
from .cage import Cage
from .cage_check import CageReport
from .cage_edits import CageEdit
from .camera import Camera, turntable
from .coordinates import deform_points, green_coordinates, harmonic_coordinates, mean_value_coordinates
from .deformer import Deformer
from .evaluation import evaluate, mean_psnr, psnr
from .field import VoxelField
from .fit_options import FitOptions
from .optimize import FieldOptimizer, fit
from .pose_file import PoseFile
from .position_map import PositionMap
from .render import Frame
from .scene import Scene, load_scene
from .selection import NodeSelection, select_nodes

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
