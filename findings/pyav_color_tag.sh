#!/bin/sh
# Finding: a colour space that is set on a PyAV stream is a label: the pixels are converted by another one
# Software: PyAV 18.1.0 (PyPI)
# Expected: a film whose stream has colorspace = 1 (BT.709) is encoded by BT.709 and comes back with its colours
# Seen: frames are turned to YCbCr by BT.601 all the same and labelled BT.709: red (200, 40, 40) comes back as (213,
#   55, 37)
# Meets: who writes rendered frames to mp4 by PyAV: every player that heeds the label shifts reds and greens
# Here: frames are converted by reformat(dst_colorspace=...) and labelled alike (`warpcage/studio/films/video.py`).
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check av==18.1.0 numpy==2.4.6
venv/bin/python - <<'END'
import io
import sys

import av
import numpy as np

picture = np.full((64, 64, 3), (200, 40, 40), np.uint8)


def shown(label, converted):
    """The colour of a film of one picture after it was written and read."""
    data = io.BytesIO()
    with av.open(data, "w", format="mp4") as film:
        stream = film.add_stream("libx264", rate=24)
        stream.width, stream.height, stream.pix_fmt = 64, 64, "yuv444p"
        stream.options = {"crf": "0"}
        if label:
            stream.codec_context.colorspace = 1  # BT.709
        frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
        if converted:
            frame = frame.reformat(format="yuv444p", dst_colorspace="ITU709")
        film.mux(stream.encode(frame))
        film.mux(stream.encode(None))
    data.seek(0)
    with av.open(data) as film:
        return next(film.decode(video=0)).to_ndarray(format="rgb24")[32, 32].astype(int)


off = {}
for label, converted in ((False, False), (True, False), (False, True), (True, True)):
    found = shown(label, converted)
    off[label, converted] = int(np.abs(found - picture[0, 0]).max())
    print(f"labelled: {label!s:5} converted: {converted!s:5} {picture[0, 0].tolist()} comes back as {found.tolist()}")
right = off[False, False] <= 2 and off[True, True] <= 2
sys.exit(0 if right and off[True, False] > 8 and off[False, True] > 8 else "the behaviour has changed")
END
