"""gsplat (Ye et al. 2024) as a peer: the forward kernels of its wheel, built with nvcc for the torch that is there.

    pip download gsplat==1.5.3 --no-deps && unzip gsplat-1.5.3-py3-none-any.whl -d peer

Of the sources only those of forward views of 3D Gaussians are compiled, for three channels, with gsplat's own options.
Covariances are handed over, so that both renderers project the same splats.
"""

from __future__ import annotations

import os
import pathlib
import re
import shutil
import tempfile

import numpy as np

SOURCES = (
    "ProjectionEWA3DGSFused.cu",
    "IntersectTile.cu",
    "RasterizeToPixels3DGSFwd.cu",
    "SphericalHarmonicsCUDA.cu",
    "Intersect.cpp",
    "SphericalHarmonics.cpp",
)
TILE = 16

#: Names that newer versions of torch no longer have.
SHIM = """#pragma once
#include <optional>
namespace c10 { using std::nullopt; using std::optional; }
namespace at { using std::optional; }
"""


def build_peer(wheel: str | os.PathLike):
    """The extension, from the unpacked wheel's folder or its folder gsplat/cuda."""
    from torch.utils.cpp_extension import load

    source = pathlib.Path(wheel).resolve()
    source = source / "gsplat" / "cuda" if (source / "gsplat").is_dir() else source
    folder = pathlib.Path(tempfile.gettempdir()) / "warpcage_peer"
    folder.mkdir(exist_ok=True)
    (folder / "shim.h").write_text(SHIM)
    names = []
    for name in SOURCES:
        text = (source / "csrc" / name).read_text()
        text = re.sub(r"^__INS__\((?!3\))\d+\)\n", "", text, flags=re.MULTILINE)
        (folder / name).write_text(text)
        names.append(str(folder / name))
    shutil.copy(pathlib.Path(__file__).parent / "splats_peer.cpp", folder)
    shim = ["-w", "-include", str(folder / "shim.h")]
    includes = [source / "include", source / "csrc", source / "csrc" / "third_party" / "glm"]
    return load(
        "warpcage_peer",
        [*names, str(folder / "splats_peer.cpp")],
        extra_cflags=["-O3", *shim],
        extra_cuda_cflags=["-O3", "-use_fast_math", *shim],
        extra_include_paths=[str(path) for path in includes],
        build_directory=str(folder),
    )


def peer_view(peer, field, camera, background, antialias: bool):
    """A function that renders the view and returns colours (h, w, 3), on the device."""
    import torch

    def cuda(values):
        return torch.tensor(np.ascontiguousarray(values), dtype=torch.float32, device="cuda")

    means = cuda(field.contents.centres)
    covariances = cuda(field.covariances[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]])
    opacities, harmonics = cuda(field.opacities), cuda(field.contents.harmonics)[None]
    view = cuda(np.linalg.inv(camera.camera_to_world))[None]
    inner = cuda([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])[None]
    eye, behind = cuda(camera.centre), cuda(background)[None]
    width, height = camera.width, camera.height
    across, down = -(-width // TILE), -(-height // TILE)

    def render():
        radii, places, depths, conics, factors = peer.project(
            means, covariances, opacities, view, inner, width, height, 0.3, field.near, antialias
        )
        seen = (radii > 0).all(-1)
        colours = torch.clamp_min(peer.harmonics(field.degree, (means - eye)[None], harmonics, seen) + 0.5, 0.0)
        strengths = opacities[None] * factors if antialias else opacities[None].contiguous()
        _, keys, members = peer.intersect_tile(places, radii, depths, TILE, across, down)
        starts = peer.intersect_offset(keys, 1, across, down)
        return peer.rasterize(places, conics, colours, strengths, behind, width, height, TILE, starts, members)[0][0]

    return render
