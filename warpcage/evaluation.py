"""How well renders match held-out views."""

from __future__ import annotations

import numpy as np


def psnr(image, reference) -> float:
    """Peak signal-to-noise ratio in dB of an image clamped to [0, 1] against a reference; inf where they are equal."""
    error = float(np.mean((np.clip(np.asarray(image, np.float64), 0, 1) - np.asarray(reference, np.float64)) ** 2))
    return float("inf") if error == 0 else -10.0 * np.log10(error)


def evaluate(renderer, scene, *, progress: bool = False) -> list[dict]:
    """Render every view of a scene and compare.

    renderer: anything with .render(camera, background=...) -> Frame, a VoxelField or a Deformer.
    Returns one {"view": name, "psnr": dB} a view, at the scene's image size, not quantised.
    """
    from tqdm import tqdm

    rows = []
    views = zip(scene.names, scene.cameras, scene.images, strict=True)
    for name, camera, image in tqdm(views, total=len(scene), desc="evaluate", disable=not progress):
        rows.append({"view": name, "psnr": psnr(renderer.render(camera, background=scene.background).rgb, image)})
    return rows


def mean_psnr(rows: list[dict]) -> float:
    """Mean over views of their PSNR in dB, as papers report it."""
    return float(np.mean([row["psnr"] for row in rows]))
