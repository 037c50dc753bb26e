"""Splats: time of their views, alone and beside gsplat, and of their poses."""

from __future__ import annotations

import contextlib
import os
import pathlib
import re
import statistics
import tempfile
import time

import numpy as np
import warp as wp
from common import (
    DEVICE,
    JSON,
    KINDS,
    command,
    launch_times,
    option,
    quiet_device,
    seconds_by_turns,
    seconds_of,
    write_results,
)
from library.splats_truth import without_splits

import warpcage

WHITE = (1.0, 1.0, 1.0)

#: How long a GPU is kept busy before each figure, and poses that are not counted.
WARM_SECONDS, UNCOUNTED = 0.5, 5


# Views


@command(
    DEVICE,
    option("--count", type=int, default=300_000, help="splats of the synthetic scene"),
    option("--sizes", type=int, nargs="*", default=[400, 800], help="pixels along each side; default: 400 800"),
    option("--runs", type=int, default=60),
    option("--peer", help="folder of gsplat's unpacked wheel"),
    JSON,
)
def views(args) -> None:
    """Views of Gaussian splats: time, and agreement with gsplat.

        python benchmarks splats views --device cpu
        python benchmarks splats views --device cuda:0 --peer FOLDER --json docs/results/splats_times_cuda.json

    Scenes: 300,000 splats of degree 3 on balls, which fill a picture of 800x800; and the real files of the folder that
    WARPCAGE_DATA names, if any. On the CPU what counts is the processor time of all threads, as other programs may run.
    --peer names the unpacked wheel of gsplat, which needs nvcc and torch: its pictures are compared, and both are timed
    by turns.

        pip download gsplat==1.5.3 --no-deps && unzip gsplat-1.5.3-py3-none-any.whl -d peer
    """
    device = quiet_device(args.device)
    peer = build_peer(args.peer) if args.peer else None
    rows = []
    for name, field in scenes(args, device):
        for size in args.sizes or [400, 800]:
            for antialias in (False, True) if peer else (False,):
                camera = view_of(field, size)
                row = {"scene": name, "splats": len(field), "degree": field.degree, "size": size}
                row |= {"antialias": antialias} | view_row(field, camera, antialias, peer, args.runs)
                rows.append(row)
                print(row, flush=True)
                write_results(args.json, device, rows=rows)


def scenes(args, device):
    yield "balls", ball_scene(args.count, device)
    folder = pathlib.Path(os.environ.get("WARPCAGE_DATA", "../shared/data")) / "splats"
    for path in sorted(folder.glob("*.ply")):
        yield path.name, warpcage.SplatField.load(path, device=device)


def ball_scene(count: int, device) -> warpcage.SplatField:
    """Splats on twelve balls: sizes, shapes and opacities spread as those of fitted scenes are."""
    rng = np.random.default_rng(0)
    ball, middles, radii = rng.integers(0, 12, count), rng.uniform(-0.7, 0.7, (12, 3)), rng.uniform(0.2, 0.5, 12)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return warpcage.SplatField(
        middles[ball] + radii[ball, None] * normals,
        np.log(0.006) + 0.7 * rng.normal(size=(count, 3)),
        rng.normal(size=(count, 4)),
        2.0 * rng.normal(size=count) - 0.5,
        0.15 * rng.normal(size=(count, 16, 3)),
        device=device,
    )


def view_of(field: warpcage.SplatField, size: int) -> warpcage.Camera:
    """A view that the splats fill."""
    places = field.contents.centers.astype(np.float64)
    low, high = np.percentile(places, [2, 98], axis=0)
    middle, radius = (low + high) / 2, np.linalg.norm(high - low) / 2
    eye = middle + 1.7 * radius * np.array([0.5, 0.3, -0.81])
    return warpcage.Camera.look_at(eye, middle, up=field.up, width=size, height=size, fov_degrees=60)


def view_row(field, camera, antialias: bool, peer, runs: int) -> dict:
    """Times in milliseconds: median and 95th percentile; and the agreement with the peer, dB."""

    def render():
        return field.render(camera, background=WHITE, antialias=antialias)

    if field.device.is_cpu:
        taken = [(time.process_time(), render(), time.process_time()) for _ in range(8)][2:]
        times = [1e3 * (end - begin) for begin, _, end in taken]
        return {"entries": field.renderer.entry_count, "processor_ms": round(statistics.median(times), 1)}
    actions, result = {"ms": render}, {}
    if peer is not None:
        theirs = peer_view(peer, field, camera, WHITE, antialias)
        one, two = theirs().cpu().numpy(), render()
        result["psnr_to_gsplat"] = float(warpcage.psnr(two.rgb, one))
        actions["gsplat_ms"] = theirs
    render()
    result["entries"] = field.renderer.entry_count
    times = times_by_turns(actions, field.device, runs)
    for name, taken in times.items():
        result[name] = [round(float(np.median(taken)), 4), round(float(np.percentile(taken, 95)), 4)]
    if peer is not None:
        result["gsplat_over_ours"] = round(result["gsplat_ms"][0] / result["ms"][0], 3)
    return result


def times_by_turns(actions, device, runs: int) -> dict[str, list[float]]:
    """Milliseconds of each action, by turns, after half a second in which the GPU takes up its clock."""
    begun = time.perf_counter()
    while time.perf_counter() - begun < WARM_SECONDS:
        for action in actions.values():
            action()
    times = seconds_by_turns(actions.values(), device, runs=runs, warm=0)
    return {name: [1e3 * seconds for seconds in taken] for name, taken in zip(actions, times, strict=True)}


# gsplat (Ye et al. 2024) as a peer: the forward kernels of its wheel, built with nvcc for the torch that is there. Of
# the sources only those of forward views of 3D Gaussians are compiled, for three channels, with gsplat's own options.
# Covariances are passed on, so that both renderers project the same splats.


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

#: Binds the forward kernels of gsplat 1.5.3 that draw 3D Gaussians with three channels.
BINDINGS = r"""#include <torch/extension.h>
#include "Common.h"
#include "Ops.h"
#include "Projection.h"
#include "Rasterization.h"

using at::Tensor;

std::vector<Tensor> project(Tensor means, Tensor covars, Tensor opacities, Tensor viewmats, Tensor Ks, int64_t w,
                            int64_t h, double eps, double near, bool compensate) {
    auto opt = means.options();
    int64_t n = means.size(0), c = viewmats.size(0);
    Tensor radii = at::empty({c, n, 2}, opt.dtype(at::kInt)), means2d = at::empty({c, n, 2}, opt);
    Tensor depths = at::empty({c, n}, opt), conics = at::empty({c, n, 3}, opt), comp = at::zeros({c, n}, opt);
    gsplat::launch_projection_ewa_3dgs_fused_fwd_kernel(
        means, covars, at::optional<Tensor>(), at::optional<Tensor>(), opacities, viewmats, Ks, w, h, eps, near, 1e10,
        0.0, gsplat::CameraModelType::PINHOLE, radii, means2d, depths, conics,
        compensate ? at::optional<Tensor>(comp) : at::optional<Tensor>());
    return {radii, means2d, depths, conics, comp};
}

std::vector<Tensor> rasterize(Tensor means2d, Tensor conics, Tensor colors, Tensor opacities, Tensor backgrounds,
                              int64_t w, int64_t h, int64_t tile, Tensor offsets, Tensor ids) {
    auto opt = means2d.options();
    int64_t c = offsets.size(0);
    Tensor out = at::empty({c, h, w, 3}, opt), alpha = at::empty({c, h, w, 1}, opt);
    Tensor last = at::empty({c, h, w}, opt.dtype(at::kInt));
    gsplat::launch_rasterize_to_pixels_3dgs_fwd_kernel<3>(means2d, conics, colors, opacities, backgrounds,
                                                          at::optional<Tensor>(), w, h, tile, offsets, ids, out, alpha,
                                                          last);
    return {out, alpha};
}

PYBIND11_MODULE(TORCH_EXTENSION_NAME, m) {
    m.def("project", &project);
    m.def("rasterize", &rasterize);
    m.def("intersect_tile", [](Tensor means2d, Tensor radii, Tensor depths, int64_t tile, int64_t tw, int64_t th) {
        return gsplat::intersect_tile(means2d, radii, depths, at::optional<Tensor>(), at::optional<Tensor>(),
                                      radii.size(0), tile, tw, th, true, false);
    });
    m.def("intersect_offset", [](Tensor ids, int64_t c, int64_t tw, int64_t th) {
        return gsplat::intersect_offset(ids, c, tw, th);
    });
    m.def("harmonics", [](int64_t degree, Tensor dirs, Tensor coeffs, Tensor mask) {
        return gsplat::spherical_harmonics_fwd(degree, dirs, coeffs, at::optional<Tensor>(mask));
    });
}
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
    (folder / "bindings.cpp").write_text(BINDINGS)
    shim = ["-w", "-include", str(folder / "shim.h")]
    includes = [source / "include", source / "csrc", source / "csrc" / "third_party" / "glm"]
    return load(
        "warpcage_peer",
        [*names, str(folder / "bindings.cpp")],
        extra_cflags=["-O3", *shim],
        extra_cuda_cflags=["-O3", "-use_fast_math", *shim],
        extra_include_paths=[str(path) for path in includes],
        build_directory=str(folder),
    )


def peer_view(peer, field, camera, background, antialias: bool):
    """A function that renders the view and returns colors (h, w, 3), on the device."""
    import torch

    def cuda(values):
        return torch.tensor(np.ascontiguousarray(values), dtype=torch.float32, device="cuda")

    means = cuda(field.contents.centers)
    covariances = cuda(field.covariances[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]])
    opacities, harmonics = cuda(field.opacities), cuda(field.contents.harmonics)[None]
    view = cuda(np.linalg.inv(camera.camera_to_world))[None]
    inner = cuda([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])[None]
    eye, behind = cuda(camera.center), cuda(background)[None]
    width, height = camera.width, camera.height
    across, down = -(-width // TILE), -(-height // TILE)

    def render():
        radii, places, depths, conics, factors = peer.project(
            means, covariances, opacities, view, inner, width, height, 0.3, field.near, antialias
        )
        seen = (radii > 0).all(-1)
        colors = torch.clamp_min(peer.harmonics(field.degree, (means - eye)[None], harmonics, seen) + 0.5, 0.0)
        strengths = opacities[None] * factors if antialias else opacities[None].contiguous()
        _, keys, members = peer.intersect_tile(places, radii, depths, TILE, across, down)
        starts = peer.intersect_offset(keys, 1, across, down)
        return peer.rasterize(places, conics, colors, strengths, behind, width, height, TILE, starts, members)[0][0]

    return render


# Poses


@command(
    option("--count", type=int, default=300_000),
    DEVICE,
    option("--kinds", nargs="+", default=list(KINDS)),
    option("--rounds", type=int, default=30),
    JSON,
)
def poses(args) -> None:
    """Poses of splats: 300,000 under a cage of about 100 vertices, new poses each time.

        python benchmarks splats poses --count 300000 --kinds mean_value harmonic green --json results.json

    Prints, for each kind of coordinates, how long binding takes once; a pose from the call to the last kernel (the
    check of the cage, sums, covariances, turns, splits), the same without the check, and its centers and Jacobians
    alone; and on CUDA each of its kernels. All of it twice: with pieces for splats that a pose may bend, which are
    bound and carried too, and of the same splats left whole, so that there are as many sums as splats. Every pose is
    new: what a cage was found to be is remembered with it. A GPU is kept busy for half a second before each figure, as
    its clock goes down where nothing runs.
    """
    device = quiet_device(args.device)
    field = sphere_scene(args.count, device)
    cage = warpcage.Cage.box((-1.2, -1.2, -1.2), (1.2, 1.2, 1.2), segments=4)
    print(f"{device.name}: {args.count} splats, cage of {len(cage.vertices)} vertices, {len(cage.faces)} faces")
    rows = [pose_row(field, cage, kind, args.rounds, whole) for kind in args.kinds for whole in (False, True)]
    write_results(args.json, device, splats=args.count, cage_vertices=len(cage.vertices), poses=rows)


def sphere_scene(count: int, device, large: float = 0.02) -> warpcage.SplatField:
    """Splats on a sphere of radius one, as thick as fits make them, a share of them large."""
    rng = np.random.default_rng(0)
    centers = rng.normal(size=(count, 3))
    centers *= rng.uniform(0.9, 1.0, (count, 1)) / np.linalg.norm(centers, axis=1, keepdims=True)
    scales = np.log(0.004) + 0.6 * rng.normal(size=(count, 3))
    scales[rng.uniform(size=count) < large] += np.log(12.0)
    harmonics = 0.2 * rng.normal(size=(count, 16, 3))
    quaternions, logits = rng.normal(size=(count, 4)), rng.normal(size=count)
    return warpcage.SplatField(centers.astype(np.float32), scales, quaternions, logits, harmonics, device=device)


def pose_row(field, cage, kind: str, rounds: int, whole: bool) -> dict:
    """Print how long one kind of coordinates takes, of splats in pieces or left whole; the same as a row of results."""
    device = field.device
    begin = time.perf_counter()
    with without_splits() if whole else contextlib.nullcontext():
        deformer = warpcage.Deformer(field, cage, coordinates=kind)
    wp.synchronize_device(device)
    bound = time.perf_counter() - begin
    edits = deformer.posed_edits()
    first = edits.bound[0]
    nodes, pieces = len(edits.tree.rows), int((edits.tree.pieces >= 0).sum())

    def poses():
        return [cage.twist(20 + 3 * k).bend(10 + 2 * k) for k in range(rounds + UNCOUNTED)]

    found = {
        "pose": timed(deformer.pose, poses(), device),
        "without_check": timed(lambda pose: edits.pose([pose]), poses(), device),
        "centres_and_jacobians": timed(
            lambda pose: first.binding.carry(pose, *first.carriers, edits.carried), poses(), device
        ),
    }
    drawn = int((deformer.posed_splats().opacities.numpy() > 0).sum())
    row = {
        "kind": kind,
        "whole": whole,
        "bind_s": bound,
        "nodes": nodes,
        "carried": first.carriers[0].size,
        "with_pieces": pieces,
        "drawn": drawn,
        **{f"{name}_ms": np.median(times) for name, times in found.items()},
        **{f"{name}_95_ms": np.percentile(times, 95) for name, times in found.items()},
    }
    name = f"{kind}, left whole" if whole else kind
    print(f"{name}: bound in {bound:.2f} s, {nodes} nodes, {pieces} with pieces, {drawn} drawn; {row['carried']} sums")
    checked, unchecked, sums = (shown(times) for times in found.values())
    print(f"  pose with its checks {checked}; without {unchecked}; centres and Jacobians {sums}")
    if device.is_cuda:
        row["kernels_ms"] = kernel_times(edits, poses())
        for name, milliseconds in row["kernels_ms"].items():
            print(f"    {name}: {milliseconds:.4f} ms")
    return row


def timed(run, poses, device) -> list[float]:
    """Milliseconds of run() of each pose, the device waited for; the first few, and half a second, are not counted."""
    begin = time.perf_counter()
    while device.is_cuda and time.perf_counter() - begin < WARM_SECONDS:
        run(poses[0])
        wp.synchronize_device(device)
    return [1e3 * seconds_of(lambda pose=pose: run(pose), device) for pose in poses][UNCOUNTED:]


def kernel_times(edits, poses) -> dict[str, float]:
    """Milliseconds of each kernel, and fill or copy, of a pose: medians; by name."""
    found: dict[str, list[float]] = {}
    for pose in poses[:UNCOUNTED]:
        for name, milliseconds in launch_times(lambda pose=pose: edits.pose([pose])):
            found.setdefault(name, []).append(milliseconds)
    return {name: float(np.median(times)) for name, times in found.items()}


def shown(times: list[float]) -> str:
    return f"{np.median(times):.3f} ms (95 %: {np.percentile(times, 95):.3f})"
