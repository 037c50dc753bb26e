"""How well renders match held-out views."""

from __future__ import annotations

import numpy as np

from ..core.checks import require_type
from ..scene.scene import Scene


def psnr(image, reference) -> float:
    """Peak signal-to-noise ratio in dB of an image and a reference of one shape, both clamped to [0, 1]; inf where they
    agree. Raises ValueError for other shapes, or whole numbers beyond 1 (8-bit pictures, to be divided by 255)."""
    image, reference = _clamped_pair(image, reference)
    error = float(np.mean((image - reference) ** 2))
    return float("inf") if error == 0 else -10.0 * np.log10(error)


def ssim(image, reference) -> float:
    """Structural similarity (Wang et al. 2004, Gaussian window of 1.5 pixels) of an (h, w, 3) image and a reference,
    both clamped to [0, 1]. Raises ValueError as `psnr`, and for sides below 11 pixels."""
    from skimage.metrics import structural_similarity

    image, reference = _clamped_pair(image, reference)
    if min(image.shape[:2]) < 11:
        raise ValueError(f"structural similarity needs images of at least 11x11 pixels, got {image.shape[:2]}")
    return float(
        structural_similarity(
            image,
            reference,
            channel_axis=-1,
            data_range=1.0,
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
        )
    )


def _clamped_pair(image, reference) -> tuple[np.ndarray, np.ndarray]:
    pair = np.asarray(image), np.asarray(reference)
    if pair[0].shape != pair[1].shape:
        raise ValueError(f"images to compare must be of one shape, got {pair[0].shape} and {pair[1].shape}")
    for values in pair:
        if values.dtype.kind in "iu" and values.size and values.max() > 1:
            raise ValueError(
                f"images to compare must hold values in [0, 1], got {values.dtype} up to {values.max()}: "
                "divide 8-bit pictures by 255"
            )
    return tuple(np.clip(values.astype(np.float64), 0, 1) for values in pair)


def error_image(image, reference) -> np.ndarray:
    """(h, w, 3) the render, and where it errs in red: full red from an absolute error of 0.1 on."""
    image = np.clip(np.asarray(image, np.float32), 0, 1)
    error = np.clip(np.abs(image - reference).max(axis=-1, keepdims=True) / 0.1, 0, 1)
    grey = 0.5 + 0.5 * image.mean(axis=-1, keepdims=True)
    return (1 - error) * grey + error * np.array([0.85, 0.0, 0.0], np.float32)


def masked_psnr(image, reference, mask) -> float:
    """PSNR in dB over the pixels where a mask (h, w) is above 1/2. Raises ValueError where there are none."""
    inside = np.asarray(mask) > 0.5
    if not inside.any():
        raise ValueError("the mask is empty: there is nothing to compare")
    return psnr(np.asarray(image)[inside], np.asarray(reference)[inside])


def evaluate(renderer, scene, *, similarity: bool = False, progress: bool = False) -> list[dict]:
    """Render every view of a scene and compare.

    renderer: anything with .render(camera, background=...) -> Frame, a VoxelField or a Deformer.
    Returns one {"view": name, "psnr": dB} a view, with "ssim" where `similarity` is set, at the scene's image size, not
    quantised; with "masked_psnr", over the pixels of the object alone, where the scene has opacity.

    A renderer with background layers is compared with whole pictures, where the scene has them (its pictures carry no
    opacity, or were split at their masks); otherwise both stand on the scene's background colour.
    Raises ValueError for what is no Scene.
    """
    require_type(scene, Scene, "evaluate compares with")
    from tqdm import tqdm

    rows = []
    background, images = comparison(renderer, scene)
    alphas = [None] * len(scene) if scene.alphas is None else scene.alphas
    views = zip(scene.names, scene.cameras, images, alphas, strict=True)
    for name, camera, image, alpha in tqdm(views, total=len(scene), desc="evaluate", disable=not progress):
        rgb = renderer.render(camera, background=background).rgb
        row = {"view": name, "psnr": psnr(rgb, image)} | ({"ssim": ssim(rgb, image)} if similarity else {})
        if alpha is not None and (alpha > 0.5).any():
            row["masked_psnr"] = masked_psnr(rgb, image, alpha)
        rows.append(row)
    return rows


def comparison(renderer, scene):
    """What `evaluate` renders on, a colour or None for the renderer's own layers, and the pictures (n, h, w, 3) that it
    compares with."""
    field = getattr(renderer, "field", renderer)
    has_surroundings = scene.alphas is None or scene.surroundings is not None
    if getattr(field, "background_model", None) is not None and has_surroundings:
        return None, scene.whole
    return scene.background, scene.images


def mean_psnr(rows: list[dict]) -> float:
    """Mean over views of their PSNR in dB, as papers report it. Raises ValueError for no views."""
    if not rows:
        raise ValueError("mean_psnr needs the rows of one view or more, got none")
    return float(np.mean([row["psnr"] for row in rows]))
