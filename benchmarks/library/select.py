"""Choosing an object of a scene: one run of examples/edit_fox.py."""

from __future__ import annotations

import importlib.util
import os
import pathlib
import shlex
import tempfile

from common import DEVICE, HERE, command, option, write_jpeg, write_results

#: Options of the example, and of its small fit.
OPTIONS = "--downscale 8 --quality fast --resolution 96 --no-video"


@command(
    option("--data", metavar="DIR", required=True, help="pictures of the fox"),
    DEVICE,
    option("--options", "--words", default=OPTIONS, help="options of the example (default: %(default)s)"),
    option("--json", required=True, help="file for the figures"),
    option("--figures", required=True, help="folder for the pictures"),
)
def main(args) -> None:
    """Figures and pictures of one run of examples/edit_fox.py, for docs/select.md.

        python benchmarks select --data data/fox --json docs/results/select.json --figures docs/pictures
        python benchmarks select --data data/fox --json docs/results/select_full.json --figures full \\
            --device cuda:0 --options "--downscale 2 --quality standard --no-video --cage cage.obj"
    """
    from warpcage.core import resolve_device
    from warpcage.view import read_image

    arguments = shlex.split(args.options)
    spec = importlib.util.spec_from_file_location("edit_fox", HERE.parent / "examples" / "edit_fox.py")
    assert spec is not None and spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    device = resolve_device(args.device)
    with tempfile.TemporaryDirectory() as out:
        figures = example.main(["--data", args.data, "--out", out, "--device", str(device), *arguments])
        for name in ("chosen", "edit"):
            picture = read_image(pathlib.Path(out) / f"{name}.png")
            write_jpeg(pathlib.Path(args.figures) / f"select_{name}.jpg", picture[..., :3], quality=90)
    del figures["device"]  # the machine's is written
    arguments = [os.path.basename(each) if os.path.isabs(each) else each for each in arguments]
    write_results(args.json, device, options=arguments, **figures)
