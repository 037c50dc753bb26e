"""The spec of a film: its shots in time, and what is written."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from fractions import Fraction
from typing import Any

from ...core.names import LOOPS, MAX_FRAMES, TRANSPARENT, shown
from ...core.spec import Values, flag, fraction, number, one_of, option, whole
from ...errors import InputError
from .shot import PICTURE, ShotSpec

#: Groups of options.
TIME, CAMERA = "time", "camera path"

#: What a film may show of its frames.
SHOWN = ("rgb", "alpha", "depth", "disparity", "masks")

#: Moments that motion blur is the mean of, where their number is not given, and most of them.
SUBFRAMES, MAX_SUBFRAMES = 8, 256


def _shutter(value: Any, name: str) -> tuple[float, int]:
    """The share of a frame that a shutter is open, of degrees above 0 to 360, and the number of moments in it."""
    if isinstance(value, list | tuple) and len(value) == 2:  # as JSON has it
        value = f"{360.0 * value[0]:.17g}:{value[1]}"
    degrees, separator, count = str(value).partition(":")
    try:
        found = float(degrees), int(count) if separator else SUBFRAMES
    except ValueError:
        found = 0.0, 0
    if not (0.0 < found[0] <= 360.0 and 1 <= found[1] <= MAX_SUBFRAMES):
        raise InputError(
            f"{name} must be degrees above 0 to 360, or with a number of moments up to {MAX_SUBFRAMES}, as in 180 or "
            f"180:16, got {shown(value)}"
        )
    return found[0] / 360.0, found[1]


@dataclasses.dataclass(frozen=True)
class FilmSpec(ShotSpec):
    """How a film is made: all of its shots alike, and where they are in time."""

    frames: int = option(48, whole(1, MAX_FRAMES), "number of frames", flag="--frames N", group=TIME)
    fps: Fraction = option(
        Fraction(24),
        fraction(),
        "frames per second, such as 24, 12.5, 29.97 or 30000/1001, which is the same",
        flag="--fps RATE",
        group=TIME,
    )
    motion: str = option(
        "swing",
        one_of("swing", "once", "hold"),
        "swing: to the last pose and back; once: to the last pose; hold: posed throughout",
        flag="--motion",
        group=TIME,
    )
    loop: str | None = option(
        None,
        one_of(*LOOPS),
        "what a film of keys at times does at its end: once, with its first and its last moment, so that 2 s at 24 a "
        "second are 49 frames; loop: begin again; ping-pong: go back to its beginning",
        flag="--loop",
        default_help="what the pose file says, or once",
        group=TIME,
    )
    interpolation: str = option(
        "smooth",
        one_of("smooth", "linear"),
        "linear: straight from pose to pose at constant speed; smooth: through the poses without a stop, slow at both "
        "ends",
        flag="--interpolation",
        group=TIME,
    )
    overwrite: bool = option(
        False,
        flag(),
        "replace the frames of another film that are in the folder",
        flag="--overwrite",
        default_help="",
        group=TIME,
    )
    turn: float | None = option(
        None,
        number(),
        "how far the camera turns around the target; 0 keeps it still",
        flag="--turn DEGREES",
        default_help="0 where the poses have times; otherwise 360, or there and back within what the cameras of the "
        "fitted pictures saw, where these are known",
        group=CAMERA,
    )
    shutter: tuple[float, int] | None = option(
        None,
        Values(_shutter),
        "motion blur: how long the shutter is open, of 360 degrees a frame (180 is usual), by averaging N moments in "
        "linear light",
        flag="--shutter DEGREES[:N]",
        default_help=str(SUBFRAMES),
        group=CAMERA,
    )
    show: str = option(
        "rgb",
        one_of(*SHOWN),
        "rgb; alpha; depth (near is white) or disparity, on one scale for the whole film; masks: what is turned inside "
        "out, background that was uncovered and places where a posed cage shows nothing, and print how much",
        flag="--show",
        group=PICTURE,
    )
    format: str | None = option(
        None,
        one_of("png", "exr"),
        "file format in a folder of pictures: png (alpha not premultiplied), or exr (linear light, premultiplied "
        "alpha, with depth)",
        flag="--format",
        default_help="png",
        group=PICTURE,
    )

    def check(self, named: Callable[[str], str] = "--{}".format) -> None:
        super().check(named)
        if self.show == "rgb":
            return
        shown = f"{named('show')} {self.show}"
        if self.background == TRANSPARENT:
            raise InputError(f"{shown} has no opacity: leave out {named('background')} {TRANSPARENT}")
        if self.format == "exr":
            raise InputError(
                f"{named('format')} exr holds colours, opacity and depth together: leave out {named('show')}"
            )
        if self.shutter is not None:
            raise InputError(f"{named('shutter')} blurs colours: leave it out, or {shown}")
