"""Pictures of scenes: each kind of PNG, and JPEG, is read as what it shows."""

import numpy as np
import pytest
from scene_writers import Pictures, brick_pictures, spiral_cameras, write_transforms

from warpcage import load_scene

BACKGROUND = (0.1, 0.5, 0.9)


@pytest.mark.parametrize("kind", ["16 bit", "8 bit grey", "16 bit grey", "grey and alpha", "16 bit alpha", "palette"])
def test_kinds_of_png(tmp_path, kind):
    from PIL import Image
    from scene_writers import write_deep_png

    write_transforms(tmp_path, brick_pictures(10))
    rng = np.random.default_rng(0)
    levels, alpha = rng.integers(0, 65536, (2, 20, 24), dtype=np.uint16)
    color = rng.integers(0, 65536, (20, 24, 3), dtype=np.uint16)
    bits = 255.0 if kind in ("8 bit grey", "grey and alpha", "palette") else 65535.0
    expected, opacity = np.repeat(levels[..., None], 3, axis=-1) / 65535.0, np.ones((20, 24, 1))
    for i in range(10):
        path = tmp_path / "images" / f"view_{i:02d}.png"
        if kind == "16 bit":
            expected = color / bits
            write_deep_png(path, color)
        elif kind == "16 bit grey":
            write_deep_png(path, levels[..., None])
        elif kind == "16 bit alpha":
            opacity = alpha[..., None] / bits
            write_deep_png(path, np.stack([levels, levels, levels, alpha], axis=-1))
        elif kind == "palette":
            expected = np.round(color[:1, :4] / 65535 * 255).repeat(20, axis=0).repeat(6, axis=1) / 255
            Image.fromarray(np.round(expected * 255).astype(np.uint8)).convert("P", palette=1, colors=16).save(path)
        else:
            byte = (levels >> 8).astype(np.uint8)
            expected = np.repeat(byte[..., None], 3, axis=-1) / bits
            if kind == "grey and alpha":
                opacity = (alpha >> 8)[..., None] / bits
                byte = np.stack([byte, (alpha >> 8).astype(np.uint8)], axis=-1)
            Image.fromarray(byte).save(path)
    scene = load_scene(tmp_path, background=BACKGROUND)
    np.testing.assert_allclose(scene.images[0], expected * opacity + (1 - opacity) * BACKGROUND, atol=1e-6)
    assert (scene.alphas is None) == (kind in ("16 bit", "8 bit grey", "16 bit grey", "palette"))


@pytest.mark.parametrize("extension", [True, False])
def test_jpeg(tmp_path, extension):
    rows, columns = np.mgrid[:20, :24]
    smooth = np.stack([rows * 8 + 40, columns * 7 + 30, (rows + columns) * 4 + 50], axis=-1).astype(np.uint8)
    pictures = Pictures(np.repeat(smooth[None], 9, axis=0), spiral_cameras(9))
    write_transforms(tmp_path, pictures, ending=".jpg", extension=extension)
    scene = load_scene(tmp_path, background=BACKGROUND)
    assert np.abs(scene.images[0] - smooth / 255).mean() < 0.01 and scene.alphas is None


@pytest.mark.parametrize("downscale", [1, 2, 3, 4])
@pytest.mark.parametrize("distortion", [None, {"k1": 0.05, "k2": -0.02}])
def test_opaque_pictures_have_no_alphas_at_any_size(tmp_path, downscale, distortion):
    cameras = spiral_cameras(9, width=69, height=123)
    colors = np.random.default_rng(0).integers(0, 256, (9, 123, 69, 3), dtype=np.uint8)
    opaque = np.full((*colors.shape[:3], 1), 255, np.uint8)
    write_transforms(tmp_path, Pictures(np.concatenate([colors, opaque], axis=-1), cameras), distortion=distortion)
    assert load_scene(tmp_path, downscale=downscale).alphas is None
