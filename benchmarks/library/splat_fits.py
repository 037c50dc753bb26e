"""Fits of splats: what ours reach in how many seconds, beside gsplat's, and how long their steps take."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import importlib.util
import itertools
import pathlib
import time
import types

import numpy as np
import warp as wp
from common import DEVICE, FIT_OPTIONS, UsageError, command, fit_options, option, quiet_device, write_results
from library.fits import QUALITIES, every_nth, memory_peak
from library.splats import times_by_turns

import warpcage
from warpcage.fitting.evaluation import ssim
from warpcage.fitting.splats import checked_splat_options
from warpcage.splats.io.contents import MIN_OPACITY

#: Views, factor on their size and on the number of points of the fit that compiles kernels, and steps of gsplat's.
WARM_VIEWS, WARM_SHRINK, WARM_STEPS = 8, 8, 40

#: Frames that are timed.
FRAMES = 60

#: Rates of gsplat's examples for its MCMC strategy; that of the centers is times the size of the scene, and falls.
RATES = {"means": 1.6e-4, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3, "shN": 2.5e-3 / 20}

#: What the rate of the centers falls to, Adam's epsilon, and steps after which a degree of the harmonics is added.
FALL, EPSILON, DEGREE_STEPS, DEGREE = 0.01, 1e-15, 1000, 3

#: Opacity at the start, and the part of the distance to the neighbors that scales start with.
FIRST_OPACITY, FIRST_SCALE, NEIGHBORS = 0.5, 0.1, 3

#: Share of the structural similarity in the loss, and weights of the mean opacity and the mean scale.
SIMILARITY, OPACITY_WEIGHT, SCALE_WEIGHT = 0.2, 0.01, 0.01

#: How gsplat's MCMC strategy adds and moves splats.
STRATEGY = {
    "noise_lr": 5e5,
    "refine_start_iter": 500,
    "refine_stop_iter": 25_000,
    "refine_every": 100,
    "min_opacity": 0.005,
}

#: Window of the structural similarity, and its constants.
WINDOW, SIGMA, STEADY = 11, 1.5, (0.01**2, 0.03**2)

#: The harmonic of degree 0, and numbers of a block of distances between points.
HARMONIC_0, BLOCK = 0.28209479177387814, 1 << 24

MISSING = (
    "the fits of gsplat need torch with CUDA and gsplat 1.5.3, built with nvcc; there is no {}: benchmarks/README.md "
    "says how they come to a machine"
)

SCENES = option("scene", nargs="+", help="scene folders, each FOLDER or FOLDER:DOWNSCALE")
WHOLE = option("--whole", action="store_true", help="whole pictures, whatever masks a scene has")
BACKGROUND = option("--background", default="black", help="color behind transparent pixels, and behind the splats")
SEEDS = option("--seeds", type=int, nargs="+", default=[0], help="a fit of each")
OUT = option("--out", type=pathlib.Path, default=pathlib.Path("splat_fits"), help="folder for results and splats")


# Ours


@command(
    SCENES,
    WHOLE,
    BACKGROUND,
    option("--quality", nargs="+", default=["standard"], choices=QUALITIES),
    SEEDS,
    FIT_OPTIONS,
    DEVICE,
    option("--cold", action="store_true", help="do not compile kernels before the first fit"),
    option("--save", action="store_true", help="keep the splats, as .ply"),
    OUT,
)
def ours(args) -> None:
    """Our fits of splats: held-out PSNR and SSIM, seconds, splats, memory, time of a frame.

        python benchmarks splat-fits ours ../shared/data/bonsai --quality fast standard high --seeds 0 1 2
        python benchmarks splat-fits ours SCENE:2 --option NAME=VALUE --device cuda:0 --out results --save

    Views are held out as scenes have it: every eighth picture by name, where they have no splits of their own. Seconds
    run from pictures in host memory to the finished splats; loading the pictures, and a small fit before that compiles
    the kernels, stand beside them. "memory" is the most that Warp's arrays have held on the GPU from the start of the
    process to the end of the fit, "memory_before" the same up to its begin: where the first is larger, it is the peak
    of this fit. Frames have the size of the pictures.
    """
    device = quiet_device(args.device)
    options = fit_options(args.option)
    rows, compiled = Rows(args.out / "splat_fits_ours.json", device), None
    for given in args.scene:
        views = Views.load(given, args)
        if compiled is None and not args.cold:
            compiled = seconds_of_fit(warm_scene(views.train), device, {"quality": "fast", **options})[0]
            print(f"kernels compiled, {compiled:.1f} s", flush=True)
        for quality, seed in itertools.product(args.quality, args.seeds):
            chosen = {"quality": quality, "seed": seed, **options}
            steps, before = planned_steps(chosen), memory_peak(device)
            seconds, field = seconds_of_fit(views.train, device, chosen)
            fit = {
                "program": f"warpcage, {quality}",
                "version": warpcage.__version__,
                "seed": seed,
                "options": chosen,
                "steps": steps,
                "compile_seconds": compiled,
                "seconds": seconds,
                "memory": memory_peak(device),
                "memory_before": before,
            }
            rows.add(views.facts | fit | splat_facts(field) | scores(field, views.test, device))
            if args.save:
                field.save(args.out / f"{views.stem}_{quality}_{seed}.ply")


def seconds_of_fit(scene: warpcage.Scene, device, options: dict) -> tuple[float, warpcage.SplatField]:
    """Seconds of one of our fits, and its splats."""
    wp.synchronize_device(device)
    begin = time.perf_counter()
    field = warpcage.fit(scene, representation="splats", device=device, progress=False, **options)
    wp.synchronize_device(device)
    return time.perf_counter() - begin, field


def optimizer_of(scene: warpcage.Scene, device, options: dict):
    """What our fit makes its steps by; the one place that knows how it is called."""
    from warpcage.fitting.splats.optimizer import SplatFit

    return SplatFit(scene, device=device, **options)


def planned_steps(options: dict) -> int:
    """How many steps a fit of ours is going to make."""
    return checked_splat_options({name: value for name, value in options.items() if name != "seed"}).steps


# Steps of ours


@command(
    SCENES,
    WHOLE,
    BACKGROUND,
    option("--quality", default="standard", choices=QUALITIES),
    option("--seed", type=int, default=0),
    FIT_OPTIONS,
    DEVICE,
    option("--window", type=int, default=200, help="steps that are timed together"),
    option("--steps", type=int, help="end after so many"),
    OUT,
)
def profile(args) -> None:
    """Milliseconds of a step of our fit, and splats, along the fit.

        python benchmarks splat-fits profile ../shared/data/bonsai --device cuda:0
        python benchmarks splat-fits profile SCENE --window 100 --steps 2000 --option NAME=VALUE

    The device is waited for at the ends of windows alone. Kernels that a window is the first to need are compiled in
    it: a second run is without that.
    """
    device = quiet_device(args.device)
    options = {"quality": args.quality, "seed": args.seed, **fit_options(args.option)}
    results = Rows(args.out / "splat_fits_profile.json", device, shown=False)
    for given in args.scene:
        views = Views.load(given, args)
        optimizer, windows = optimizer_of(views.train, device, options), []
        last = min(args.steps or optimizer.total_steps, optimizer.total_steps)
        print(f"{views.facts['scene']}: {last} of {optimizer.total_steps} steps\n   step   splats  ms a step")
        while optimizer.step_count < last:
            wp.synchronize_device(device)
            count, begin = min(args.window, last - optimizer.step_count), time.perf_counter()
            for _ in range(count):
                optimizer.step()
            wp.synchronize_device(device)
            milliseconds = 1e3 * (time.perf_counter() - begin) / count
            windows.append({"step": optimizer.step_count, "splats": optimizer.splat_count, "ms": milliseconds})
            print(f"{optimizer.step_count:7d}  {optimizer.splat_count:7d}  {milliseconds:9.3f}", flush=True)
        median = float(np.median([window["ms"] for window in windows]))
        print(f"median of the windows {median:.3f} ms a step")
        results.add(views.facts | {"options": options, "median_ms": median, "windows": windows})


# What both fits share


@dataclasses.dataclass(frozen=True)
class Views:
    """The pictures of a scene that are fitted, and those that are held out.

    Args:
        stem: What files of its results are called after.
        train: Training views.
        test: Views that are held out.
        facts: Of the scene, for its rows.
    """

    stem: str
    train: warpcage.Scene
    test: warpcage.Scene
    facts: dict

    @classmethod
    def load(cls, given: str, args) -> Views:
        """Read a scene, FOLDER or FOLDER:DOWNSCALE."""
        folder, _, factor = given.partition(":")
        options = {"downscale": int(factor or 1), "background": args.background, "masks": not args.whole}
        begin = time.perf_counter()
        train, test = (warpcage.load_scene(folder, split=split, **options) for split in ("train", "test"))
        name = pathlib.Path(folder).resolve().name
        height, width = train.images.shape[1:3]
        points = getattr(train, "points", None)
        facts = {
            "scene": name + (f", 1/{factor}" if factor else ""),
            "views": len(train),
            "held_out": len(test),
            "size": [width, height],
            "points": 0 if points is None else len(points),
            "load_seconds": time.perf_counter() - begin,
        }
        return cls(f"{name}_{factor}" if factor else name, train, test, facts)


class Rows:
    """Rows of results, kept in a file whenever there is one more.

    Args:
        path: The file.
        device: Warp device that they were measured on.
        shown: Whether each is printed.
        more: What else is in the file.
    """

    def __init__(self, path: pathlib.Path, device, *, shown: bool = True, **more):
        self.path, self.device, self.shown, self.more = path, device, shown, more
        self.rows: list[dict] = []
        if shown:
            print(
                f"{'scene':16} {'program':24} seed  steps   splats  seconds      MB  PSNR dB  worst    SSIM  ms a frame"
            )

    def add(self, row: dict) -> None:
        """Keep a row, and print its line."""
        self.rows.append(row | {"card": self.device.name})
        write_results(self.path, self.device, **self.more, rows=self.rows)
        if self.shown:
            megabytes = "      -" if row["memory"] is None else f"{row['memory'] / 1e6:7.0f}"
            print(
                f"{row['scene'][-16:]:16} {row['program']:24} {row['seed']:4d} {row['steps']:6d} {row['splats']:8d}"
                f" {row['seconds']:8.2f} {megabytes} {row['psnr']:8.2f} {row['psnr_worst']:6.2f} {row['ssim']:7.4f}"
                f" {row['frame_ms']:11.3f}",
                flush=True,
            )


def warm_scene(scene: warpcage.Scene) -> warpcage.Scene:
    """A few views of a scene, small, with few of its points."""
    few = every_nth(scene, max(1, len(scene) // WARM_VIEWS))
    height, width = (max(16, side // WARM_SHRINK) for side in few.images.shape[1:3])
    rows, columns = (
        np.arange(side) * full // side for side, full in zip((height, width), few.images.shape[1:3], strict=True)
    )
    parts = {"images": few.images, "alphas": few.alphas, "surroundings": few.surroundings}
    small = {name: None if part is None else part[:, rows][:, :, columns] for name, part in parts.items()}
    for name in ("points", "point_colors"):
        if getattr(scene, name, None) is not None:
            small[name] = getattr(scene, name)[::WARM_SHRINK]
    return dataclasses.replace(few, cameras=[camera.resized(width, height) for camera in few.cameras], **small)


def splat_facts(field: warpcage.SplatField) -> dict:
    """How many splats there are, and how many of them can be seen."""
    return {"splats": len(field), "splats_seen": int((field.opacities >= MIN_OPACITY).sum())}


def scores(renderer, test: warpcage.Scene, device) -> dict:
    """PSNR and structural similarity on held-out views, and the time of a frame of their size."""
    rows = []
    for name, camera, image in zip(test.names, test.cameras, test.images, strict=True):
        rgb = renderer.render(camera, background=test.background).rgb
        rows.append({"view": name, "psnr": warpcage.psnr(rgb, image), "ssim": similarity(rgb, image)})
    worst = min(rows, key=lambda row: row["psnr"])
    cameras = itertools.cycle(test.cameras)
    draw = getattr(renderer, "draw", renderer.render)
    times = times_by_turns({"ms": lambda: draw(next(cameras), background=test.background)}, device, FRAMES)["ms"]
    return {
        "psnr": warpcage.mean_psnr(rows),
        "psnr_worst": worst["psnr"],
        "worst_view": worst["view"],
        "ssim": float(np.mean([row["ssim"] for row in rows])),
        "frame_ms": float(np.median(times)),
    }


def similarity(rgb: np.ndarray, image: np.ndarray) -> float:
    """Structural similarity of a render (h, w, 3); by torch where it is there, as it is faster."""
    if importlib.util.find_spec("torch") is None:
        return ssim(rgb, image)
    import torch

    device = "cuda" if torch.cuda.is_available() else "cpu"
    pair = [torch.tensor(np.clip(each, 0, 1), dtype=torch.float64, device=device) for each in (rgb, image)]
    return float(torch_similarity(*pair))


def torch_similarity(first, second):
    """Mean structural similarity of two (h, w, 3) tensors, over the windows that lie within the picture."""
    import torch

    places = torch.arange(WINDOW, dtype=first.dtype, device=first.device) - WINDOW // 2
    weights = torch.exp(-0.5 * (places / SIGMA) ** 2)
    one, two = (each.permute(2, 0, 1) for each in (first, second))
    maps = torch.cat([one, two, one * one, two * two, one * two])[None]
    kernels = (weights / weights.sum()).expand(maps.shape[1], 1, 1, WINDOW).contiguous()
    for kernel in (kernels, kernels.transpose(2, 3).contiguous()):
        maps = torch.nn.functional.conv2d(maps, kernel, groups=len(kernel))
    mean_1, mean_2, square_1, square_2, product = maps[0].chunk(5)
    between = 2 * (product - mean_1 * mean_2) + STEADY[1]
    within = square_1 - mean_1**2 + square_2 - mean_2**2 + STEADY[1]
    return ((2 * mean_1 * mean_2 + STEADY[0]) * between / ((mean_1**2 + mean_2**2 + STEADY[0]) * within)).mean()


# gsplat's (Ye et al. 2024), by its Python API: the MCMC strategy (Kheradmand et al. 2024) with the settings of its
# examples, in a world of their size. Pictures lie on the GPU in 8 bits: the loader of the examples is no faster.


@command(
    SCENES,
    WHOLE,
    BACKGROUND,
    option("--steps", type=int, nargs="+", default=[7000], help="a fit of each"),
    option("--cap", type=int, default=1_000_000, help="most splats"),
    SEEDS,
    DEVICE,
    OUT,
)
def gsplat(args) -> None:
    """Fits of gsplat with its MCMC strategy, from the same pictures and points, measured as ours are.

        python benchmarks splat-fits gsplat ../shared/data/bonsai --steps 7000 30000 --cap 1000000 --seeds 0

    Two rows a fit: its splats drawn by gsplat, and the same splats, saved as .ply in the folder of the results, drawn
    by warpcage. Seconds run from 8-bit pictures in host memory to the last step. "memory" is the most that torch's
    tensors held during the fit, "memory_reserved" what torch took for them. The structural similarity of the loss is
    torch's convolutions, by rows and by columns; the examples have it fused in a kernel of its own, which may be
    faster.
    """
    device = quiet_device(args.device)
    check_peer(device)
    import torch

    torch.backends.cudnn.allow_tf32 = False
    version = importlib.metadata.version("gsplat")
    rows, compiled = Rows(args.out / "splat_fits_gsplat.json", device, torch=torch.__version__), None
    for given in args.scene:
        views = Views.load(given, args)
        if getattr(views.train, "points", None) is None:
            raise UsageError(f"{given}: gsplat begins with the points of a reconstruction, and the scene has none")
        if compiled is None:
            begin = time.perf_counter()
            quick = {"refine_start_iter": 0, "refine_every": WARM_STEPS // 4}
            PeerFit(warm_scene(views.train), WARM_STEPS, args.cap, 0, device, **quick).run()
            compiled = time.perf_counter() - begin
            print(f"gsplat built or found, {compiled:.1f} s", flush=True)
        for steps, seed in itertools.product(args.steps, args.seeds):
            fit = PeerFit(views.train, steps, args.cap, seed, device)
            fit.run()
            facts = views.facts | {
                "version": version,
                "seed": seed,
                "cap": args.cap,
                "steps": steps,
                "compile_seconds": compiled,
                "seconds": fit.seconds,
                "memory": fit.memory,
                "memory_reserved": fit.memory_reserved,
            }
            field = fit.field(views.train.up)
            facts |= splat_facts(field)
            rows.add(facts | {"program": "gsplat"} | scores(fit, views.test, device))
            path = args.out / f"{views.stem}_gsplat_{steps}_{seed}.ply"
            field.save(path)
            drawn = warpcage.SplatField.load(path, device=device)
            rows.add(facts | {"program": "gsplat, drawn by warpcage"} | scores(drawn, views.test, device))
            del fit, field, drawn
            torch.cuda.empty_cache()


def check_peer(device) -> None:
    """Say in one line what gsplat lacks here."""
    for name in ("torch", "gsplat"):
        if importlib.util.find_spec(name) is None:
            raise UsageError(MISSING.format(name))
    import torch

    if device.is_cpu or not torch.cuda.is_available():
        raise UsageError(MISSING.format("CUDA"))


@dataclasses.dataclass(frozen=True)
class World:
    """Where gsplat trains: cameras have a median distance of 1 from what they look at.

    Args:
        origin: (3,) the median of the places on the cameras' axes that are closest to the origin of the scene.
        scale: Factor on lengths of the scene.
        size: 1.1 times the greatest distance of a camera from the middle of all, in this world.
    """

    origin: np.ndarray
    scale: float
    size: float

    @classmethod
    def of(cls, cameras: list[warpcage.Camera]) -> World:
        """That of some cameras."""
        eyes = np.stack([camera.center for camera in cameras])
        ahead = np.stack([camera.rotation[:, 2] for camera in cameras])
        origin = np.median(eyes - (eyes * ahead).sum(axis=1, keepdims=True) * ahead, axis=0)
        scale = 1 / np.median(np.linalg.norm(eyes - origin, axis=1))
        return cls(origin, scale, 1.1 * scale * np.linalg.norm(eyes - eyes.mean(axis=0), axis=1).max())

    def lens_of(self, cameras: list[warpcage.Camera], device) -> tuple:
        """World-to-camera matrices (n, 4, 4) and intrinsics (n, 3, 3), as tensors."""
        import torch

        poses = np.stack([camera.camera_to_world for camera in cameras])
        poses[:, :3, 3] = self.scale * (poses[:, :3, 3] - self.origin)
        inner = [[[each.fx, 0, each.cx], [0, each.fy, each.cy], [0, 0, 1]] for each in cameras]
        return tuple(torch.tensor(each, dtype=torch.float32, device=device) for each in (np.linalg.inv(poses), inner))


class PeerFit:
    """A fit of gsplat.

    Args:
        scene: Training views, with points.
        steps: How many it makes.
        cap: Most splats.
        seed: Of all that is random.
        device: Warp device, whose name torch knows too.
        strategy: What is other than STRATEGY has it.

    Attributes:
        seconds: Of the fit.
        memory: Most bytes that its tensors held at once, on the GPU.
        memory_reserved: The same of what torch took for them.
        parameters: Values of the splats, in gsplat's names.
    """

    def __init__(self, scene: warpcage.Scene, steps: int, cap: int, seed: int, device, **strategy):
        import torch

        self.scene, self.steps, self.seed, self.device = scene, steps, seed, str(device)
        self.options = {"cap_max": cap, **STRATEGY, **strategy}
        self.world = World.of(scene.cameras)
        self.pictures = torch.stack([torch.tensor(255 * each).round().to(torch.uint8) for each in scene.images])
        self.seconds, self.memory, self.memory_reserved, self.parameters = 0.0, None, None, {}
        self.drawn, self.lenses = (), {}

    def run(self) -> None:
        """Make all steps."""
        import torch

        cuda = torch.device(self.device).type == "cuda"
        if cuda:
            torch.cuda.synchronize()
            torch.cuda.reset_peak_memory_stats()
        begin = time.perf_counter()
        torch.manual_seed(self.seed)
        self.begin()
        order = itertools.chain.from_iterable(torch.randperm(len(self.scene)).tolist() for _ in itertools.count())
        for step in range(self.steps):
            self.step(step, next(order))
        if cuda:
            torch.cuda.synchronize()
            self.memory, self.memory_reserved = torch.cuda.max_memory_allocated(), torch.cuda.max_memory_reserved()
        self.seconds = time.perf_counter() - begin
        del self.optimizers, self.strategy, self.state, self.pictures
        with torch.no_grad():
            self.drawn = self.values()

    def begin(self) -> None:
        """Put everything on the GPU, a splat at each point."""
        import torch
        from gsplat.strategy import MCMCStrategy

        scene, count = self.scene, len(self.scene.points)
        colors = getattr(scene, "point_colors", None)
        colors = np.full((count, 3), 0.5) if colors is None else colors
        places = torch.tensor(
            self.world.scale * (scene.points - self.world.origin), dtype=torch.float32, device=self.device
        )
        first = torch.tensor((colors - 0.5) / HARMONIC_0, dtype=torch.float32, device=self.device)
        values = {
            "means": places,
            "scales": torch.log(FIRST_SCALE * neighbor_distances(places))[:, None].repeat(1, 3),
            "quats": torch.rand((count, 4), device=self.device),
            "opacities": torch.logit(torch.full((count,), FIRST_OPACITY, device=self.device)),
            "sh0": first[:, None],
            "shN": torch.zeros((count, (DEGREE + 1) ** 2 - 1, 3), device=self.device),
        }
        self.parameters = torch.nn.ParameterDict({name: torch.nn.Parameter(each) for name, each in values.items()})
        self.rate = RATES["means"] * self.world.size
        self.optimizers = {
            name: torch.optim.Adam([self.parameters[name]], lr=rate, eps=EPSILON, fused=True)
            for name, rate in (RATES | {"means": self.rate}).items()
        }
        self.strategy = MCMCStrategy(**self.options)
        self.strategy.check_sanity(self.parameters, self.optimizers)
        self.state = self.strategy.initialize_state()
        self.pictures = self.pictures.to(self.device)
        self.views, self.inner = self.world.lens_of(scene.cameras, self.device)
        self.behind = torch.tensor(scene.background, device=self.device)[None]

    def step(self, step: int, index: int) -> None:
        """A step by one picture."""
        import torch

        picture = self.pictures[index] / 255
        lens = (self.views[index : index + 1], self.inner[index : index + 1])
        colors, info = self.rasterized(self.values(), lens, picture.shape[1], picture.shape[0], step)
        loss = (1 - SIMILARITY) * (colors - picture).abs().mean()
        loss = loss + SIMILARITY * (1 - torch_similarity(colors, picture))
        loss = loss + OPACITY_WEIGHT * torch.sigmoid(self.parameters["opacities"]).mean()
        loss = loss + SCALE_WEIGHT * torch.exp(self.parameters["scales"]).mean()
        loss.backward()
        for optimizer in self.optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        self.rate *= FALL ** (1 / self.steps)
        self.optimizers["means"].param_groups[0]["lr"] = self.rate
        self.strategy.step_post_backward(
            self.parameters, self.optimizers, self.state, step=step, info=info, lr=self.rate
        )

    def values(self) -> tuple:
        """What gsplat draws: places, quaternions, scales, opacities and harmonics."""
        import torch

        held = self.parameters
        harmonics = torch.cat([held["sh0"], held["shN"]], dim=1)
        return held["means"], held["quats"], torch.exp(held["scales"]), torch.sigmoid(held["opacities"]), harmonics

    def rasterized(self, values: tuple, lens: tuple, width: int, height: int, step: int) -> tuple:
        """The picture (h, w, 3) of a view with the degree of a step, and what gsplat says of it."""
        from gsplat import rasterization

        degree = min(step // DEGREE_STEPS, DEGREE)
        colors, _, info = rasterization(
            *values, *lens, width, height, sh_degree=degree, packed=False, backgrounds=self.behind
        )
        return colors[0], info

    def draw(self, camera: warpcage.Camera, *, background):
        """The picture (h, w, 3) of a camera of the scene, on the GPU; the background is that of the fit."""
        import torch

        if id(camera) not in self.lenses:
            self.lenses[id(camera)] = self.world.lens_of([camera], self.device)
        with torch.no_grad():
            lens = self.lenses[id(camera)]
            return self.rasterized(self.drawn, lens, camera.width, camera.height, self.steps - 1)[0]

    def render(self, camera: warpcage.Camera, *, background) -> types.SimpleNamespace:
        """The picture as `.rgb`, on the host."""
        return types.SimpleNamespace(rgb=self.draw(camera, background=background).cpu().numpy())

    def field(self, up: np.ndarray) -> warpcage.SplatField:
        """The splats in the world of the scene."""
        held = {name: each.detach().cpu().numpy() for name, each in self.parameters.items()}
        return warpcage.SplatField(
            (held["means"] / self.world.scale + self.world.origin).astype(np.float32),
            held["scales"] - np.float32(np.log(self.world.scale)),
            held["quats"],
            held["opacities"],
            np.concatenate([held["sh0"], held["shN"]], axis=1),
            background=self.scene.background,
            up=up,
            device=self.device,
        )


def neighbor_distances(places):
    """(n,) root mean square of the distances to the closest other points."""
    import torch

    squares = []
    for block in places.split(max(1, BLOCK // len(places))):
        found = torch.cdist(block, places, compute_mode="donot_use_mm_for_euclid_dist")
        squares.append((found.topk(NEIGHBORS + 1, largest=False).values[:, 1:] ** 2).mean(dim=1))
    return torch.cat(squares).sqrt().clamp_min(1e-7)
