"""Write the page docs/select.md: choosing an object of a scene, with what one run of examples/edit_fox.py makes.

    python benchmarks/select_page.py --data ../shared/data/fox --json docs/results/select.json --figures docs/pictures
    python benchmarks/select_page.py --data ../shared/data/fox --json docs/results/select_full.json --figures full \
        --device cuda:0 --words "--downscale 2 --quality standard --no-video --cage cage.obj"
    python benchmarks/select_page.py --results docs/results --page docs/select.md

The first runs the example at an eighth of the pictures' size (WORDS) and keeps its figures and pictures, the second at
half their size. All write the page, whose text is select_text.md with the figures in it.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import pathlib
import shlex
import string
import tempfile
import textwrap

from page import source
from results import write_jpeg, write_results

from warpcage.core.devices import resolve_device
from warpcage.view.pictures import read_image

HERE = pathlib.Path(__file__).resolve().parent
TEXT = HERE / "select_text.md"

#: Options of the example, and of its small fit.
WORDS = ["--downscale", "8", "--quality", "fast", "--resolution", "96", "--no-video"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", metavar="DIR", help="the fox: run the example before the page is written")
    parser.add_argument("--device", default=None)
    parser.add_argument("--words", default=" ".join(WORDS), help="options of the example (default: %(default)s)")
    parser.add_argument("--json", help="where the figures of the run go")
    parser.add_argument("--figures", help="folder for the pictures of the run")
    parser.add_argument("--results", default="docs/results")
    parser.add_argument("--page", default="docs/select.md")
    args = parser.parse_args()
    if args.data:
        if not args.json or not args.figures:
            parser.error("--data runs the example: say where its --json and --figures go")
        run_example(args)
    path, large = (pathlib.Path(args.results) / f"{name}.json" for name in ("select", "select_full"))
    if not path.exists():
        raise SystemExit(f"no {path}: give --data, --json and --figures first")
    small, full = (json.loads(each.read_text(encoding="utf-8")) if each.exists() else None for each in (path, large))
    text = page_text(small, "" if full is None else full_text(full))
    pathlib.Path(args.page).write_text(text, encoding="utf-8")
    print(f"wrote {args.page}")


def run_example(args) -> None:
    """The figures and pictures of the example."""
    words = shlex.split(args.words)
    spec = importlib.util.spec_from_file_location("edit_fox", HERE.parent / "examples" / "edit_fox.py")
    assert spec is not None and spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    device = resolve_device(args.device)
    with tempfile.TemporaryDirectory() as out:
        figures = example.main(["--data", args.data, "--out", out, "--device", str(device), *words])
        for name in ("chosen", "edit"):
            picture = read_image(pathlib.Path(out) / f"{name}.png")
            write_jpeg(pathlib.Path(args.figures) / f"select_{name}.jpg", picture[..., :3], quality=90)
    del figures["device"]  # the machine's is written
    words = [os.path.basename(word) if os.path.isabs(word) else word for word in words]
    write_results(args.json, device, words=words, **figures)


def page_text(results: dict, full: str) -> str:
    """The page, with the figures of a run, and what is said of one at half size."""
    width, height = results["image_size"]
    return string.Template(TEXT.read_text(encoding="utf-8")).substitute(
        words=" ".join(word for word in results["words"] if word != "--no-video"),
        size=f"{width}x{height}",
        views=results["train_views"],
        psnr=f"{results['psnr']:.1f}",
        seconds=f"{results['seconds']:.0f}",
        choosing=f"{results['choosing_seconds']:.1f}",
        vertices=results["cage_vertices"],
        enclosed=f"{100 * results['enclosed']:.1f}",
        still=f"{results['still']:.1g}",
        source=source(results).strip(),
        full=full,
    )


def full_text(results: dict) -> str:
    """What is said of a run at half size."""
    width, height = results["image_size"]
    text = f"""
At {width}x{height} (`{" ".join(word for word in results["words"] if word != "--no-video")}`) the field has
{results["voxels"] / 1e6:.1f} million voxels and {results["psnr"]:.1f} dB on held-out views after
{results["seconds"]:.0f} s. Choosing took {results["choosing_seconds"]:.1f} s, the cage of {results["cage_vertices"]}
vertices that the small run made holds {100 * results["enclosed"]:.1f} % of the fox, and outside both cages pixels
change by {results["still"]:.1g} at most, but for one in a thousand.
"""
    return f"\n{textwrap.fill(' '.join(text.split()), 120)}\n\n{source(results).strip()}\n"


if __name__ == "__main__":
    main()
