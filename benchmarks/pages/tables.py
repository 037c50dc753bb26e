"""What pages are made of: tables, and what results were measured by and on."""

from __future__ import annotations

NAMES = {"mean_value": "mean value", "harmonic": "harmonic", "green": "green"}
POSES = ("rigid", "twist", "bend", "stretch", "local")

#: What is now the command of a script that results name.
RENAMED = {
    "capture": "captures",
    "coverage": "truth coverage",
    "deformed_render": "frames times",
    "fit_scenes": "fits scenes",
    "ground_truth": "truth fields",
    "select_page": "select",
    "splat_poses": "splats poses",
    "splats": "splats views",
    "splats_truth": "splats-truth",
    "table1": "frames table1",
}


def table(head: list[str], rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows]) + "\n"


def source(results: dict) -> str:
    """The command, and what it ran on."""
    machine = results["machine"]
    on = machine["device"] if machine["device"] != "CPU" else f"{machine['processor']}, {machine['cores']} cores"
    cuda = f", driver for CUDA {machine['cuda_driver']}" if "cuda_driver" in machine else ""
    script, *options = results["command"].removeprefix("python benchmarks/").split(".py", 1)
    command = f"benchmarks {RENAMED[script]}{options[0]}" if script in RENAMED else results["command"][7:]
    return (
        f"`python {command}`\n({on}{cuda}, Python {machine['python']}, Warp {machine['warp']}, "
        f"NumPy {machine['numpy']})\n"
    )


def with_sources(make):
    """What a function makes of files, and the commands of the files below it."""
    return lambda files: [*make(files), *map(source, files)]


def shown(value: float | None, form: str) -> str:
    return "–" if value is None else form.format(value)


def joined(values) -> str:
    return ", ".join(values)


def with_95(median: float, high: float) -> str:
    return f"{median:.3f} ({high:.3f})"


def by_pixels(size) -> str:
    return "x".join(map(str, size))


def decibels(value: float | None) -> str:
    return shown(value, "{:+.2f}")


def quality(measured: dict) -> list[str]:
    return [f"{measured['psnr']:.2f}", f"{measured['ssim']:.4f}"]
