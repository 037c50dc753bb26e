"""Calls that type checkers refuse: each at a line that ends in `# wrong`. Nothing here is run."""

from __future__ import annotations

import warpcage
from warpcage import Cage, Deformer, SplatField, VoxelField


def calls(field: VoxelField, splats: SplatField, cage: Cage, scene: warpcage.Scene) -> None:
    Deformer(field, cage, coordinates="linear")  # wrong
    Deformer(field, cage, density="thick")  # wrong
    Deformer(field, cage, store="lattice")  # wrong
    Deformer(field, cage, resolutions=64)  # wrong
    Deformer(field, 5)  # wrong
    Deformer(cage, field)  # wrong
    warpcage.fit(scene, quality="best")  # wrong
    warpcage.fit(scene, resolutoin=256)  # wrong
    warpcage.fit(scene, representation="splats", resolution=256)  # wrong
    warpcage.fit(scene, representation="meshes")  # wrong
    warpcage.fit(scene, progress=5)  # wrong
    warpcage.bake(Deformer(splats, cage)).node_weights()  # wrong
    warpcage.bake(field)  # wrong
    warpcage.render_film(field, "a.mp4", poses=5)  # wrong
    Cage.from_field(field, progress="yes")  # wrong
