"""Frames of videos in the colours of sRGB, those of high dynamic range too, as phones film them (HLG, PQ)."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...view.exr import screen_colors
from ..films.video import one_thread

#: Transfer characteristics of ISO/IEC 23091-2 (H.273) that are tone-mapped, by their numbers: SMPTE ST 2084 and ARIB
#: STD-B67, the two of BT.2100.
TRANSFERS = {16: "PQ", 18: "HLG"}

#: Numbers of H.273: matrix and primaries of BT.709, nothing said, and range of all codes.
_BT709, _UNSAID, _FULL_RANGE = 1, 2, 2

#: Matrices of H.273 other than BT.601's, by their numbers, as PyAV calls them.
_MATRICES = {_BT709: "ITU709", 4: "FCC", 7: "SMPTE240M"}

#: Shares of red and blue in luma of BT.2020 and BT.709, non-constant luminance.
_LUMA = {True: (0.2627, 0.0593), False: (0.2126, 0.0722)}

#: Light of white paper, that of the screen of HLG, and that at 1 of PQ, cd/m^2 (BT.2408 and BT.2100).
PAPER, SCREEN, PQ_MOST = 203.0, 1000.0, 10000.0

#: HLG: BT.2100 table 5. PQ: table 4.
_A = 0.17883277
_B, _C = 1.0 - 4.0 * _A, 0.5 - _A * float(np.log(4.0 * _A))
_M1, _M2, _C1, _C2, _C3 = 2610 / 16384, 2523 / 32, 3424 / 4096, 2413 / 128, 2392 / 128

#: From linear light with the primaries of BT.2020 to that with those of BT.709 (BT.2087).
_TO_BT709 = np.array([[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], np.float32)

#: Light up to this share of paper stays as it is, what is brighter is pressed below 1.
KNEE = 0.5


def transfer_of(frame: Any, context: Any = None) -> str:
    """ "HLG" or "PQ" for a frame, "" for others; context: the stream's codec, which older versions of PyAV ask."""
    for scene_object in (frame, context):
        number = getattr(scene_object, "color_trc", None)
        if number is not None and int(number) in TRANSFERS:
            return TRANSFERS[int(number)]
    return ""


def plain_picture(frame: Any) -> np.ndarray:
    """(h, w, 3) uint8 of a frame, as it is stored, by the matrix that it names."""
    # PyAV 14 takes that of BT.601 whatever the frame says
    named = _MATRICES.get(int(getattr(frame, "colorspace", _UNSAID) or _UNSAID))
    return frame.reformat(format="rgb24", src_colorspace=named, **one_thread()).to_ndarray()


def mapped_picture(frame: Any, transfer: str) -> np.ndarray:
    """(h, w, 3) uint8 sRGB of a frame, as it is stored."""
    # the planes themselves: versions of PyAV put them into arrays in different orders
    same_size = frame.reformat(format="yuv444p16le").planes
    planes = np.stack([_rows(plane, frame.width) for plane in same_size]) / np.float32(256.0)  # in steps of 8 bits
    if int(getattr(frame, "color_range", 1) or 1) == _FULL_RANGE:
        luma, chroma = planes[0] / 255.0, (planes[1:] - 128.0) / 255.0
    else:
        luma, chroma = (planes[0] - 16.0) / 219.0, (planes[1:] - 128.0) / 224.0
    wide = int(getattr(frame, "colorspace", _UNSAID) or _UNSAID) != _BT709
    red, blue = _LUMA[wide]
    signal = np.empty((*luma.shape, 3), np.float32)
    signal[..., 0] = luma + 2.0 * (1.0 - red) * chroma[1]
    signal[..., 2] = luma + 2.0 * (1.0 - blue) * chroma[0]
    signal[..., 1] = (luma - red * signal[..., 0] - blue * signal[..., 2]) / (1.0 - red - blue)
    primaries = int(getattr(frame, "color_primaries", _UNSAID) or _UNSAID)
    mapped = srgb_of(signal, transfer, wide_primaries=primaries != _BT709)
    return np.round(255.0 * mapped).astype(np.uint8)


def _rows(plane: Any, width: int) -> np.ndarray:
    """(h, width) float32 of a plane of 16 bits."""
    return np.frombuffer(plane, "<u2").reshape(plane.height, plane.line_size // 2)[:, :width].astype(np.float32)


def srgb_of(signal: np.ndarray, transfer: str, *, wide_primaries: bool = True) -> np.ndarray:
    """Values of sRGB (..., 3) in [0, 1] of a signal R'G'B' (..., 3) of HLG or PQ; wide_primaries: those of BT.2020."""
    light = (light_of_hlg if transfer == "HLG" else light_of_pq)(np.clip(signal, 0.0, 1.0))
    if wide_primaries:
        light = light @ _TO_BT709.T.astype(light.dtype)
    light = np.maximum(light, 0.0)  # colours that sRGB does not have end at its border
    # the curve is that of the brightest channel, by which all are scaled: hues stay
    most = light.max(axis=-1, keepdims=True)
    light = np.clip(light * (pressed(most) / np.maximum(most, 1e-6)), 0.0, 1.0)
    return screen_colors(light)


def light_of_hlg(signal: np.ndarray) -> np.ndarray:
    """Light of a screen of 1000 cd/m^2, in papers, of HLG's R'G'B' (..., 3) in [0, 1]."""
    scene = np.where(signal <= 0.5, signal**2 / 3.0, (np.exp((signal - _C) / _A) + _B) / 12.0)
    luminance = scene @ np.array([0.2627, 0.6780, 0.0593], scene.dtype)
    return SCREEN / PAPER * luminance[..., None] ** 0.2 * scene  # the OOTF of BT.2100, whose gamma is 1.2 there


def light_of_pq(signal: np.ndarray) -> np.ndarray:
    """Light, in papers, of PQ's R'G'B' (..., 3) in [0, 1]."""
    root = signal ** (1.0 / _M2)
    return PQ_MOST / PAPER * (np.maximum(root - _C1, 0.0) / (_C2 - _C3 * root)) ** (1.0 / _M1)


def pressed(light: np.ndarray) -> np.ndarray:
    """Light in papers as sRGB can show it: the same up to KNEE, from there smoothly to 1 at 1000 cd/m^2."""
    # Reinhard et al. 2002, equation 4, of what is above the knee: its slope begins with 1
    above = np.maximum(light - KNEE, 0.0) / (1.0 - KNEE)
    white = (SCREEN / PAPER - KNEE) / (1.0 - KNEE)
    curve = KNEE + (1.0 - KNEE) * above * (1.0 + above / white**2) / (1.0 + above)
    return np.where(light <= KNEE, light, np.minimum(curve, 1.0))
