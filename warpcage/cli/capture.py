"""`warpcage capture`: from a video or pictures to a scene."""

from __future__ import annotations

import argparse

from ..captures.capture import capture


def run(args: argparse.Namespace) -> None:
    report = capture(
        args.source,
        args.output,
        frames=args.frames,
        feature_size=args.feature_size,
        seed=args.seed,
        progress=not args.quiet,
    )
    print(f"wrote {args.output}: {report.summary()}")
    for sentence in report.advice:
        print(f"  {sentence}")
