#!/bin/sh
# Finding: PyAV decodes VP9 films with opacity without it
# Software: PyAV 18.1.0 (PyPI)
# Expected: a .webm of yuva420p is read with the opacity that was written, as browsers show it
# Seen: the stream says alpha_mode 1, but FFmpeg's own decoder of VP9, which is the first choice, gives yuv420p: all
#   opaque; libvpx-vp9, asked for by name, has it
# Meets: who reads a film of an object without its background back, to composite it or to compare frames
# Here: .webm with opacity is for browsers (docs/films.md); read it back by libvpx-vp9, as
#   `tests/library/view/test_transparency.py` does.
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

picture = np.zeros((64, 64, 4), np.uint8)
picture[16:48, 16:48] = (200, 40, 40, 255)
data = io.BytesIO()
with av.open(data, "w", format="webm") as film:
    stream = film.add_stream("libvpx-vp9", rate=24)
    stream.width, stream.height, stream.pix_fmt = 64, 64, "yuva420p"
    film.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgba").reformat(format="yuva420p")))
    film.mux(stream.encode(None))
found = {}
for name in ("as the file is opened", "libvpx-vp9"):
    data.seek(0)
    with av.open(data) as film:
        stream = film.streams.video[0]
        mode = stream.metadata.get("alpha_mode")
        decoder = av.CodecContext.create(name, "r") if name == "libvpx-vp9" else stream.codec_context
        frame = next(frame for packet in film.demux(stream) for frame in decoder.decode(packet))
    least = int(frame.to_ndarray(format="rgba")[..., 3].min())
    found[name] = (mode, frame.format.name, least)
    print(f"{name}: alpha_mode {mode}, {frame.format.name}, least opacity {least}")
expected = [("1", "yuv420p", 255), ("1", "yuva420p", 0)]
sys.exit(0 if list(found.values()) == expected else "the behaviour has changed")
END
