"""Write the page docs/select.md: choosing an object of a scene, with what one run of examples/edit_fox.py makes.

    python benchmarks/select_page.py --data ../shared/data/fox --json docs/results/select.json --figures docs/pictures
    python benchmarks/select_page.py --results docs/results --page docs/select.md

The first runs the example at an eighth of the pictures' size (WORDS) and keeps its figures and pictures; both write the
page, whose text is select_text.md with the figures in it.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import pathlib
import string
import tempfile

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
    parser.add_argument("--json", help="where the figures of the run go")
    parser.add_argument("--figures", help="folder for the pictures of the run")
    parser.add_argument("--results", default="docs/results")
    parser.add_argument("--page", default="docs/select.md")
    args = parser.parse_args()
    if args.data:
        if not args.json or not args.figures:
            parser.error("--data runs the example: say where its --json and --figures go")
        run_example(args)
    path = pathlib.Path(args.json or pathlib.Path(args.results) / "select.json")
    if not path.exists():
        raise SystemExit(f"no {path}: give --data, --json and --figures first")
    text = page_text(json.loads(path.read_text(encoding="utf-8")))
    pathlib.Path(args.page).write_text(text, encoding="utf-8")
    print(f"wrote {args.page}")


def run_example(args) -> None:
    """The figures and pictures of the example at a small size."""
    spec = importlib.util.spec_from_file_location("edit_fox", HERE.parent / "examples" / "edit_fox.py")
    assert spec is not None and spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    device = resolve_device(args.device)
    with tempfile.TemporaryDirectory() as out:
        figures = example.main(["--data", args.data, "--out", out, "--device", str(device), *WORDS])
        for name in ("chosen", "edit"):
            picture = read_image(pathlib.Path(out) / f"{name}.png")
            write_jpeg(pathlib.Path(args.figures) / f"select_{name}.jpg", picture[..., :3], quality=90)
    del figures["device"]  # the machine's is written
    write_results(args.json, device, words=WORDS, **figures)


def page_text(results: dict) -> str:
    """The page, with the figures of a run."""
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
    )


if __name__ == "__main__":
    main()
