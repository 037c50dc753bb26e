"""CaptureReport: what a capture found, for people and for programs."""

from __future__ import annotations

import dataclasses
import json
import pathlib
from collections.abc import Sequence

import numpy as np

from ...core.checks import listed
from ...core.names import agreed, counted
from ...scene.coverage import LARGE_GAP, Coverage
from ...view.pictures import contact_sheet
from .colmap import Found

#: A picture is blurred where its sharpness is below this share of the median.
BLURRED = 0.6

#: What is said to be little: of pictures; of pixels.
FEW_PICTURES, LARGE_ERROR = 30, 1.5

#: Pictures on the contact sheet, and the longer side of each.
MAX_THUMBNAILS, THUMBNAIL = 100, 160

#: Frame of a picture that has a camera, and of one that has none.
GREEN, RED = (0.15, 0.6, 0.25), (0.85, 0.15, 0.1)


@dataclasses.dataclass(frozen=True)
class CaptureReport:
    """What `capture` found. All of it is in the scene's folder too, as capture.json and capture.md.

    Args:
        folder: Folder of the scene.
        source: Name of the video or folder that was captured.
        pictures: Names of the pictures that cameras were looked for.
        registered: Whether each has a camera.
        sharpness: Sharpness of each, some 0.2 for blurred to 1 for sharp ones.
        errors: Mean reprojection error of each in pixels of the pictures as they are written, None without a camera.
        points: Number of points of the reconstruction.
        error: Mean reprojection error over all, pixels of the pictures as they are written.
        size: Width and height of the pictures as they are written.
        around: Largest gap between neighbouring cameras on the circle around the object, degrees.
        elevation: Lowest and highest camera as seen from the object, degrees above its horizon.
        sphere: Share of all directions from the object within 20 degrees of which a camera stands.
        upper: The same for directions above its horizon.
        advice: Sentences on what would make the capture better.
        facts: What else there is to say, by name.
    """

    folder: pathlib.Path
    source: str
    pictures: list[str]
    registered: list[bool]
    sharpness: list[float]
    errors: list[float | None]
    points: int
    error: float
    size: tuple[int, int]
    around: float
    elevation: tuple[float, float]
    sphere: float
    upper: float
    advice: list[str]
    facts: dict[str, object]

    @property
    def registered_count(self) -> int:
        """Number of pictures whose camera was found."""
        return sum(self.registered)

    @property
    def left_out(self) -> list[str]:
        """Names of the pictures without a camera."""
        return [name for name, there in zip(self.pictures, self.registered, strict=True) if not there]

    @property
    def blurred(self) -> list[str]:
        """Names of the pictures that are clearly less sharp than most."""
        return _blurred(self.pictures, self.sharpness)

    def summary(self) -> str:
        """One line that says what was found."""
        low, high = self.elevation
        return (
            f"cameras of {self.registered_count} of {len(self.pictures)} pictures, reprojection error "
            f"{self.error:.2f} pixels, {counted(self.points, 'point')}, views around "
            f"{360 - self.around:.0f} degrees at heights "
            f"of {low:.0f} to {high:.0f}"
        )

    def to_json(self) -> str:
        """The report as JSON, with a number or a list for each of its parts."""
        content = {
            "source": self.source,
            "registered": self.registered_count,
            "pictures": [
                {
                    "name": name,
                    "registered": there,
                    "sharpness": round(sharp, 4),
                    "reprojection_error": None if error is None else round(error, 4),
                }
                for name, there, sharp, error in zip(
                    self.pictures, self.registered, self.sharpness, self.errors, strict=True
                )
            ],
            "points": self.points,
            "reprojection_error": round(self.error, 4),
            "size": list(self.size),
            "coverage": {
                "largest_gap_degrees": round(self.around, 1),
                "elevation_degrees": [round(angle, 1) for angle in self.elevation],
                "sphere": round(self.sphere, 4),
                "upper_half": round(self.upper, 4),
            },
            "left_out": self.left_out,
            "blurred": self.blurred,
            "advice": self.advice,
            **self.facts,
        }
        return json.dumps(content, indent=1, ensure_ascii=False) + "\n"

    def to_markdown(self) -> str:
        """The report as a page."""
        low, high = self.elevation
        rows = [
            ("pictures with a camera", f"{self.registered_count} of {len(self.pictures)}"),
            ("reprojection error", f"{self.error:.2f} pixels of {self.size[0]}x{self.size[1]}"),
            ("points", str(self.points)),
            ("views around the object", f"{360 - self.around:.0f} of 360 degrees"),
            ("heights of the cameras", f"{low:.0f} to {high:.0f} degrees above the object's horizon"),
            ("sphere around it that is covered", f"{100 * self.sphere:.0f} %, its upper half {100 * self.upper:.0f} %"),
            ("blurred pictures", f"{len(self.blurred)}"),
            *(
                (name.replace("_", " "), str(value))
                for name, value in self.facts.items()
                if not isinstance(value, dict)
            ),
        ]
        lines = [f"# Capture of {self.source}", "", "| | |", "| --- | --- |"]
        lines += [f"| {name} | {value} |" for name, value in rows]
        lines += ["", *(f"- {sentence}" for sentence in self.advice), ""] if self.advice else [""]
        if "object" in self.facts:
            lines += ["![cameras, points, and the object's box from three sides](box.png)", ""]
            lines += ["![from where the object was seen, and what of its surroundings](seen.png)", ""]
        lines += ["![all pictures; those without a camera have a red frame](contact.png)", ""]
        if self.left_out:
            lines += ["No camera: " + ", ".join(self.left_out), ""]
        if self.blurred:
            lines += ["Blurred: " + ", ".join(self.blurred), ""]
        return "\n".join(lines)


def make_report(
    folder: pathlib.Path,
    source: str,
    names: Sequence[str],
    sharpness: Sequence[float] | np.ndarray,
    found: Found,
    size: tuple[int, int],
    to_pixels: float,
    facts: dict[str, object],
    seen: Coverage,
) -> CaptureReport:
    """The report of a capture; names and sharpness are of all pictures, `found` and `seen` in the object's coordinates.
    size: of the pictures as they are written; to_pixels: pixels of those in a pixel that errors are measured in."""
    registered = [False] * len(names)
    errors: list[float | None] = [None] * len(names)
    for picture, error in zip(found.pictures, found.errors, strict=True):
        registered[picture], errors[picture] = True, float(error) * to_pixels
    sphere, upper = seen.shares()
    report = CaptureReport(
        folder=folder,
        source=source,
        pictures=list(names),
        registered=registered,
        sharpness=[float(value) for value in sharpness],
        errors=errors,
        points=len(found.points),
        error=found.error * to_pixels,
        size=size,
        around=seen.around,
        elevation=seen.elevation,
        sphere=sphere,
        upper=upper,
        advice=[],
        facts=facts,
    )
    report.advice.extend(_advice(report))
    return report


def make_contact_sheet(thumbnails: Sequence[np.ndarray], registered: Sequence[bool]) -> np.ndarray:
    """All pictures on one sheet, (h, w, 3) float32, those with a camera in a green frame, the others in a red one.
    thumbnails: (h, w, 3) uint8, no side longer than THUMBNAIL, at most MAX_THUMBNAILS of them."""
    height = max(picture.shape[0] for picture in thumbnails) + 6
    width = max(picture.shape[1] for picture in thumbnails) + 6
    framed = []
    for picture, there in zip(thumbnails, registered, strict=True):
        sheet = np.empty((height, width, 3), np.float32)
        sheet[...] = GREEN if there else RED
        top, left = (height - picture.shape[0]) // 2, (width - picture.shape[1]) // 2
        sheet[top : top + picture.shape[0], left : left + picture.shape[1]] = picture.astype(np.float32) / 255.0
        framed.append(sheet)
    return contact_sheet(framed, gap=3)


def _blurred(names: Sequence[str], sharpness: Sequence[float]) -> list[str]:
    least = BLURRED * float(np.median(sharpness))
    return [name for name, value in zip(names, sharpness, strict=True) if value < least]


def _advice(report: CaptureReport) -> list[str]:
    """What would make the capture better."""
    sentences = []
    left_out, blurred = len(report.left_out), len(report.blurred)
    if left_out:
        sentences.append(
            f"{counted(left_out, 'picture')} {agreed(left_out, 'has', 'have')} no camera "
            f"({listed(report.left_out[:5])}): they overlap too little with the "
            "others, show something else, or are blurred."
        )
    if report.around > LARGE_GAP:
        sentences.append(
            f"The cameras leave {report.around:.0f} degrees around the object unseen: what lies there is guesswork. "
            "Walk all the way around it, if it is to be turned."
        )
    low, high = report.elevation
    if high - low < 15.0:
        sentences.append("All cameras stand at one height: a second round from higher up shows tops and hollows.")
    if report.registered_count < FEW_PICTURES:
        sentences.append(
            f"{counted(report.registered_count, 'picture')} "
            f"{agreed(report.registered_count, 'is', 'are')} few: 60 to 150 give a cleaner field."
        )
    if blurred:
        sentences.append(
            f"{counted(blurred, 'picture')} {agreed(blurred, 'is', 'are')} blurred: move slower, or find more light."
        )
    if report.error > LARGE_ERROR * max(report.size) / 1000.0:
        sentences.append(
            "The reprojection error is large: something moved, shines like a mirror, or the lens zoomed on the way."
        )
    return sentences
