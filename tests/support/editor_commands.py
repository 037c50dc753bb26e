"""All commands of the editor's page with their arguments, in a session of two objects whose keys hold all there is."""

import numpy as np

from warpcage import Cage

CAGE = Cage.box((-0.7, -0.7, -0.7), (0.7, 0.7, 0.7), segments=2)
REST = CAGE.vertices
BALL = Cage.icosphere((0.0, 0.0, 0.0), 0.9, 1)

#: What `key_all` makes: keys that hold poses of two edits, places of both objects, and cameras.
FIRST, SECOND, COPY, OWN, KEYS = 1, 3, 2, 0, (4, 5)


async def key_all(page):
    await page.do(do="object.copy", id=OWN, offset=[3, 0, 0])
    await page.do(do="key.add", time=0.0, pose=True, camera=True)
    await page.do(do="time", time=1.0)
    await page.drag(CAGE.twist(80).vertices, edit=SECOND)
    await page.do(do="object.select", id=OWN)
    await page.drag(CAGE.twist(60).vertices, edit=FIRST)
    await page.do(do="key.add", time=1.0, pose=True, camera=True)
    await page.drag(REST * 1.5, edit=FIRST)


OF_EDIT = '2 keys lose their poses of "Move 1".'
ROUGH = 'The new cage of "Move 1" takes the poses of 2 keys over roughly: up to '
OLD_POSE = '1 key loses its old pose of "Move 1".'

#: Commands by which keys lose something, with what the page says.
LOSING = [
    ({"do": "edit.delete", "id": FIRST}, OF_EDIT),
    ({"do": "cage.generate", "edit": FIRST, "count": 42, "margin": None, "method": "auto", "symmetry": None}, ROUGH),
    ({"do": "cage.simplify", "edit": FIRST, "count": 20}, ROUGH),
    ({"do": "cage.load", "edit": FIRST, "file": "ball.obj", "up": "z"}, ROUGH),
    ({"do": "key.add", "time": 1.0, "pose": True}, OLD_POSE),
    ({"do": "key.change", "id": KEYS[1], "pose": True}, OLD_POSE),
    ({"do": "key.delete", "id": KEYS[0]},
     "1 key loses its poses of 2 cages, 1 key its camera, 1 key its positions of 2 objects."),
    ({"do": "camera.move", "move": "turn:90"}, "2 keys lose their cameras."),
    ({"do": "camera.frame", "aspect": 0.2}, "2 keys lose their old cameras."),
    ({"do": "poses.load", "file": "poses.json", "edit": FIRST}, OF_EDIT),
    ({"do": "object.remove", "id": COPY},
     '2 keys lose their poses of "Move 1", 2 keys their positions of "scene 2".'),
]  # fmt: skip

#: The others, each with those that end it.
KEEPING = [
    [{"do": "select", "edit": FIRST, "mode": "vertex", "vertices": [0, 1]}],
    [{"do": "settings", "coordinates": "green", "resolution": 24, "density": "paper", "background": "#102030",
      "supersampling": 2, "show": "masks", "mode": "rest"}],
    [{"do": "pose.set", "edit": FIRST, "vertices": (REST * 3).tolist(), "label": "move"}],
    [{"do": "pose.reset", "edit": FIRST, "vertices": [0, 1]}],
    [{"do": "pose.load", "file": "same.obj", "edit": FIRST, "up": "z"}],
    [{"do": "edit.add", "kind": "copy", "shape": "box", "lower": [-0.5] * 3, "upper": [0.5] * 3}],
    [{"do": "edit.change", "id": FIRST, "name": "Arm", "kind": "remove", "visible": True}],
    [{"do": "edit.order", "ids": [FIRST]}],
    [{"do": "cage.subdivide", "edit": FIRST}],
    [{"do": "cage.subdivide", "edit": FIRST, "vertices": [0, 7]}],
    [{"do": "cage.box", "edit": FIRST, "vertices": [0, 7], "margin": 0.1}],
    [{"do": "cage.mirror", "edit": FIRST, "axis": "x", "place": 0.0}],
    [{"do": "camera.outside", "aspect": 0.2}],
    [{"do": "object.select", "id": COPY}],
    [{"do": "object.add", "file": "arm.npz", "name": "one", "beside": True, "place": {}}],
    [{"do": "object.copy", "id": COPY, "offset": [1, 0, 0]}],
    [{"do": "object.change", "id": COPY, "name": "Ball", "visible": False, "locked": False,
      "place": {"position": [0, 0, 9], "turn": [0, 90, 0], "scale": 2}}],
    [{"do": "timeline", "length": 3.0, "fps": 12.0, "loop": "loop"}],
    [{"do": "time", "time": 0.5}],
    [{"do": "play", "on": True}, {"do": "play", "on": False}],
    [{"do": "undo"}, {"do": "redo"}],
    [{"do": "drag.begin", "edit": FIRST, "label": "move", "rest": False},
     {"do": "drag.end", "edit": FIRST, "cancel": False}],
    [{"do": "preset.begin", "edit": FIRST, "vertices": [0, 1, 2, 9, 25]},
     {"do": "preset.set", "preset": "bend", "amount": 40.0, "axis": "x", "towards": "z", "limits": [0, 1]},
     {"do": "preset.end", "edit": FIRST, "cancel": False}],
    [{"do": "place.begin", "object": COPY, "label": "move"},
     {"do": "place.set", "object": COPY, "matrix": np.eye(4).tolist(), "seq": 1},
     {"do": "place.end", "object": COPY, "cancel": False}],
    [{"do": "landmark.begin", "edit": FIRST, "across": 0.5, "down": 0.5, "aspect": 1.5},
     {"do": "landmark.set", "place": [0.1, 0.2, 0.9], "seq": 1},
     {"do": "landmark.end", "cancel": False},
     {"do": "landmark.delete", "edit": FIRST, "landmark": 0}],
    [{"do": "view", "eye": [3, 3, 3], "target": [0, 0, 0], "up": [0, 0, 1], "fov": 40.0, "seq": 1, "moving": False}],
    [{"do": "size", "width": 24, "height": 16}],
    [{"do": "seen", "frame": 1}],
    [{"do": "object.pick", "across": 0.5, "down": 0.5, "aspect": 1.5}],
    [{"do": "files"}],
    [{"do": "object.files"}],
    [{"do": "poses.save", "file": "kept.json", "edit": FIRST}],
    [{"do": "upload.drop", "file": "sent.obj"}],
    [{"do": "export", "what": "poses", "file": "out.json", "edit": FIRST, "rest": False}],
]  # fmt: skip

#: Those that write files of a session that has none here, or are of a job that there is not.
REFUSED = [
    {"do": "export.command", "file": "film.mp4", "width": 16, "height": 16},
    {"do": "stage.save", "file": "no.json"},
    {"do": "job.cancel", "id": 1},
    {"do": "job.clear", "id": 1},
]

EVERY = [*(message for message, _ in LOSING), *(message for each in KEEPING for message in each), *REFUSED]
