"""A made scene: a lamp and a ball on a table, above a floor, with crumbs in the air; tilted against what is up."""

import numpy as np

from warpcage import Camera, VoxelField

#: What a node belongs to.
EMPTY, FLOOR, TABLE, LAMP, BALL, FRAGMENT = range(6)

#: Height of the table's top, and of the floor, in the scene's own axes.
TABLE_TOP, FLOOR_TOP = -0.2, -0.8

#: Density of matter, per world unit, and the colours of what there is.
DENSITY = 60.0
COLORS = {
    FLOOR: (0.4, 0.4, 0.5),
    TABLE: (0.6, 0.4, 0.2),
    LAMP: (0.8, 0.1, 0.1),
    BALL: (0.1, 0.2, 0.8),
    FRAGMENT: (0, 0, 0),
}


def tilt(degrees):
    """(3, 3) a turn about an axis between x and y; its columns are the scene's own axes."""
    axis = np.array([0.8, 0.6, 0.0])
    cross = np.cross(np.eye(3), axis)
    angle = np.radians(degrees)
    return np.eye(3) - np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


class TableScene:
    """The scene.

    Args:
        count: Nodes along each axis.
        degrees: How far everything is turned against +z, which is up for the field.
        floor, crumbs: Whether there are any.
    """

    def __init__(self, count=64, degrees=0.0, floor=True, crumbs=True, device="cpu"):
        self.turn = tilt(degrees)
        self.bounds = np.array([[-1.0] * 3, [1.0] * 3])
        cells = (np.indices((count,) * 3).reshape(3, -1).T + 0.5) * (2.0 / count) - 1.0
        self.own = cells @ self.turn  # in the scene's axes
        x, y, z = self.own.T
        label = np.zeros(len(cells), int)
        if floor:
            label[z < FLOOR_TOP] = FLOOR
        label[(np.abs(x) < 0.7) & (np.abs(y) < 0.6) & (z < TABLE_TOP) & (z > TABLE_TOP - 0.12)] = TABLE
        leg = (np.hypot(x, y) < 0.12) & (z <= TABLE_TOP - 0.12) & (z >= FLOOR_TOP)
        label[leg] = TABLE
        label[np.linalg.norm(self.own - [0.4, -0.3, TABLE_TOP + 0.15], axis=1) < 0.15] = BALL
        stem = (np.hypot(x + 0.15, y - 0.1) < 0.08) & (z >= TABLE_TOP) & (z < 0.35)
        foot = (np.hypot(x + 0.15, y - 0.1) < 0.2) & (z >= TABLE_TOP) & (z < TABLE_TOP + 0.14)
        shade = (np.abs(x + 0.05) < 0.3) & (np.abs(y - 0.1) < 0.12) & (np.abs(z - 0.4) < 0.1)
        label[stem | foot | shade] = LAMP
        if crumbs:
            random = np.random.default_rng(1)
            free = np.flatnonzero((label == EMPTY) & (z > -0.1))
            label[random.choice(free, 30)] = FRAGMENT
        self.cells, self.labels, self.count = cells, label, count
        density = np.where(label > 0, DENSITY, 0.0).reshape((count,) * 3)
        sh = np.zeros((*density.shape, 9, 3), np.float32)
        for number, color in COLORS.items():
            sh[(label == number).reshape(density.shape), 0] = (np.array(color) - 0.5) / 0.28209479
        self.field = VoxelField.from_dense(density, sh, self.bounds, device=device)

    def world(self, point):
        """(3,) a point of the scene's own axes in the world."""
        return self.turn @ np.asarray(point, float)

    def heights(self):
        """(n,) of all nodes above the table."""
        return self.own[:, 2] - TABLE_TOP

    def camera(self, eye=(2.2, -2.4, 1.6), size=96):
        return Camera.look_at(
            self.world(eye), self.world((0, 0, 0)), up=self.world((0, 0, 1)), fov_degrees=40, width=size, height=size
        )

    def pixel_of(self, camera, label):
        """(2,) a pixel of a camera that shows what has a label, by the nearest node there."""
        places = self.cells[self.labels == label]
        pixels, depth = camera.project(self.cells[self.labels > 0])
        seen = {}
        owner = self.labels[self.labels > 0]
        for number, (place, far) in enumerate(zip(np.floor(pixels).astype(int), depth, strict=True)):
            if tuple(place) not in seen or far < depth[seen[tuple(place)]]:
                seen[tuple(place)] = number
        middle = camera.project(places)[0].mean(axis=0)
        own = [place for place, number in seen.items() if owner[number] == label]
        return min(own, key=lambda place: np.linalg.norm(np.add(place, 0.5) - middle))
