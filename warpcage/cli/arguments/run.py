"""Arguments of `warpcage run`."""

from __future__ import annotations

import argparse

from .. import options

NAME = "run"
HELP = "make all that a job file describes: frames, fits and evaluations, over several GPUs or machines"
EXAMPLE = """\
  warpcage run jobs.jsonl -o frames
  warpcage run jobs.jsonl -o frames --dry-run
  warpcage run jobs.jsonl -o frames --workers 2
  warpcage run jobs.jsonl -o /shared/frames --cluster 10.0.0.1:6379
  warpcage run jobs.jsonl -o /shared/frames --part 3/16
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("jobs", help="job file (.jsonl), as docs/batch.md describes it")
    parser.add_argument(
        "-o",
        "--output",
        required=True,
        metavar="DIR",
        help="folder of what is made, and of manifest.jsonl, which says what became of each item. What is there "
        "already and whose inputs did not change is kept",
    )
    parser.add_argument(
        "--workers",
        type=options.positive_int,
        metavar="N",
        help="processes that work, one a GPU, or with a part of the cores each where there is none; more than one "
        "needs Ray (default: 1; on a cluster all of its GPUs)",
    )
    parser.add_argument(
        "--cluster",
        metavar="ADDRESS",
        help='work on a Ray cluster, such as 10.0.0.1:6379, or "auto" for the one that this machine belongs to; all '
        "its machines see the files under the same paths",
    )
    parser.add_argument(
        "--part",
        metavar="K/N",
        help="make the K-th of N equal ranges of the items, such as 3/16, beside runs of others; a run without it "
        "joins their manifests (docs/farms.md)",
    )
    parser.add_argument(
        "--retries",
        type=options.whole_number,
        default=2,
        metavar="N",
        help="how often an item is tried again, elsewhere where possible, after the death of its worker or an error "
        "that is not one of its input (default: %(default)s)",
    )
    parser.add_argument(
        "--item-timeout",
        type=options.positive_float,
        metavar="SECONDS",
        help="end the worker of an item that takes longer, loading included, and try the item again like one of a "
        "worker that died. One worker is a process of its own then, which needs Ray (default: no limit)",
    )
    parser.add_argument(
        "--dry-run",
        action="store_true",
        help="say what would be made, what is there already, and how long it would take, from an item of each kind "
        "that is made once and thrown away",
    )
    options.add_device(parser)
    options.add_quiet(parser)
