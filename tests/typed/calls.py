# pyright: strict
"""Typical calls of a pipeline, which type checkers take and know the results of. Nothing here is run."""

from __future__ import annotations

import pathlib
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from typing_extensions import assert_type

import warpcage
from warpcage import Cage, Deformer, Frame, Frames, PoseFile, SplatField, VoxelField

Kind = Literal["harmonic", "mean_value", "green", "maximum_likelihood", "biharmonic"]


def follow(done: int, total: int, words: str) -> bool:
    return done < total or words != "fit"


def fitted(folder: pathlib.Path) -> VoxelField:
    scene = warpcage.load_scene(folder, downscale=2, progress=follow)
    splats = warpcage.fit(scene, representation="splats", quality="fast", steps=7000, most_splats=200_000)
    assert_type(splats, SplatField)
    field = warpcage.fit(scene, quality="high", progress=follow, resolution=256, max_memory="4GB", checkpoint="fit.npz")
    assert_type(field, VoxelField)
    return field


def posed(field: VoxelField, splats: SplatField, kind: Kind) -> VoxelField:
    cage = Cage.from_field(field, vertex_count=60, progress=follow)
    deformer = Deformer(field, cage, coordinates=kind, resolution=64, density="paper", store="map")
    assert_type(deformer, Deformer[VoxelField])
    assert_type(Deformer(splats, [cage, cage], map="backward"), Deformer[SplatField])
    deformer.pose(cage.twist(20))
    deformer.pose(np.zeros((8, 3), np.float32))
    deformer.pose([pathlib.Path("a.obj"), None])
    assert_type(warpcage.bake(Deformer(splats, cage).pose(cage)), SplatField)
    return warpcage.bake(deformer, 64, progress=follow)


def seen(deformer: Deformer[VoxelField], camera: warpcage.Camera) -> NDArray[np.float32]:
    frame = deformer.render(camera, background="transparent", supersampling=2)
    assert_type(frame, Frame)
    frame.save("bent.exr")
    frames = deformer.render([camera, camera], outputs=["flow", "instance"], flow_camera=camera)
    assert_type(frames, Frames)
    assert_type(frames[0], Frame)
    assert_type(deformer.render_poses([np.zeros((8, 3))], camera, flow_poses=[np.zeros((8, 3))]), Frames)
    made = warpcage.render_film(
        deformer, "a.mp4", poses=[deformer.edits[0].cage, np.zeros((8, 3))], camera=[camera] * 2
    )
    assert_type(made, list[pathlib.Path])
    warpcage.render_film(deformer.field, pathlib.Path("frames"), camera="cameras.json", move=None, size=(16, 9))
    return frame.rgba


def walk(rest: Cage) -> Cage:
    file = PoseFile.load("walk.glb", rest, fps=25)
    return file.at_time(0.5)


def ended(field: VoxelField) -> str:
    try:
        Cage.from_field(field, progress=lambda done, total, words: False)
    except warpcage.Cancelled as error:
        return str(error)
    except warpcage.Error as error:
        raise RuntimeError("no cage") from error
    return ""
