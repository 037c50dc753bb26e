"""A hash grid in plain torch, fitted to the demo scene, and deformed in its own marcher by `warpcage.torch`.

    python examples/torch_hash_grid.py --out hash_grid.png

Nothing here is a field of warpcage: `warpcage.torch.to_canonical` takes each sample of the march back to where the grid
was fitted, and gradients pass through it to the vertices of the cage. Needs torch (pip install torch). Left to right: a
picture of the demo scene, the grid's, and the grid's in the pose.
"""

import argparse
import sys

import numpy as np
import warp as wp

import warpcage
from warpcage.demo.bricks import brick_model
from warpcage.demo.raycast import render_mesh_views

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--out", default="hash_grid.png", help="the picture (default: %(default)s)")
parser.add_argument("--steps", type=int, default=1000, help="of the fit (default: %(default)s)")
parser.add_argument("--size", type=int, default=100, help="pixels of a side (default: %(default)s)")
words = parser.parse_args()
try:
    import torch

    import warpcage.torch
except ImportError as error:
    sys.exit(f"torch_hash_grid.py needs {error.name}: pip install torch")
wp.config.log_level = wp.LOG_WARNING  # no line for each module that Warp loads
torch.manual_seed(0)
DEVICE = "cuda:0" if torch.cuda.is_available() else "cpu"
LOW, SIDE, SAMPLES = -1.2, 2.4, 48  # of the box around the scene; samples of a ray
CORNERS = torch.tensor([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], device=DEVICE)
PRIMES = torch.tensor([1, 2654435761, 805459861], device=DEVICE)


class HashGrid(torch.nn.Module):
    """Colour and density at points, after Mueller et al., "Instant neural graphics primitives" (2022)."""

    def __init__(self, cells=(14, 28, 56), entries=1 << 15):
        super().__init__()
        self.cells = cells
        self.tables = torch.nn.Parameter(1e-2 * torch.randn(len(cells), entries, 2))
        layers = torch.nn.Linear(2 * len(cells), 32), torch.nn.ReLU(), torch.nn.Linear(32, 4)
        self.network = torch.nn.Sequential(*layers)

    def forward(self, points):
        found, place = [], (points - LOW) / SIDE
        for table, cells in zip(self.tables, self.cells, strict=True):
            low = torch.floor(place * cells)
            share = (place * cells - low)[:, None]
            spots = (low.long()[:, None] + CORNERS) * PRIMES
            rows = (spots[..., 0] ^ spots[..., 1] ^ spots[..., 2]) % len(table)
            weights = torch.where(CORNERS == 1, share, 1.0 - share).prod(dim=2, keepdim=True)
            found.append((weights * torch.nn.functional.embedding(rows, table)).sum(dim=1))
        values = self.network(torch.cat(found, dim=1))
        inside = ((place > 0) & (place < 1)).all(dim=1)
        return torch.sigmoid(values[:, :3]), torch.where(inside, torch.exp(values[:, 3] + 1.0), 0.0)


def march(grid, origins, directions, jitter=0.0, moved=None):
    """Colours (n, 3) of rays on white. moved: takes samples and directions to where the grid has them."""
    near, far = 4.0 - 0.7 * SIDE, 4.0 + 0.7 * SIDE
    step = (far - near) / SAMPLES
    t = near + step * (torch.arange(SAMPLES, device=DEVICE) + 0.5 + jitter)
    points = (origins[:, None] + t[..., None] * directions[:, None]).reshape(-1, 3)
    empty = False
    if moved is not None:
        points, _, region = moved(points, directions.repeat_interleave(SAMPLES, dim=0))
        empty = region == 1
    rgb, sigma = grid(points)
    depth = step * torch.where(torch.as_tensor(empty, device=DEVICE), 0.0, sigma).reshape(-1, SAMPLES)
    through = torch.exp(-torch.cumsum(depth, dim=1))
    weights = torch.cat([torch.ones_like(through[:, :1]), through[:, :-1]], dim=1) - through
    return (weights[..., None] * rgb.reshape(*weights.shape, 3)).sum(dim=1) + through[:, -1:]


def rays(camera):
    """Origins and directions (h * w, 3) of a camera's rays."""
    return [torch.tensor(each.reshape(-1, 3), dtype=torch.float32, device=DEVICE) for each in camera.rays()]


cameras = warpcage.turntable((0, 0, 0), 4.0, 30, 24, width=words.size, height=words.size, fov_degrees=40)
views = render_mesh_views(*brick_model(), cameras, device=DEVICE)
pictures = torch.tensor(views[..., :3] * views[..., 3:] + 1.0 - views[..., 3:], device=DEVICE).reshape(-1, 3)
origins, directions = (torch.cat(each) for each in zip(*map(rays, cameras), strict=True))
grid = HashGrid().to(DEVICE)
optimizer = torch.optim.Adam(grid.parameters(), lr=2e-2, eps=1e-12)
for _ in range(words.steps):
    chosen = torch.randint(len(pictures), (320,), device=DEVICE)
    colors = march(grid, origins[chosen], directions[chosen], torch.rand(320, 1, device=DEVICE) - 0.5)
    optimizer.zero_grad()
    torch.nn.functional.mse_loss(colors, pictures[chosen]).backward()
    optimizer.step()

# The Deformer asks nothing of the grid but its box and a step: it is `SampledField` that warpcage itself renders.
bounds = [[LOW] * 3, [LOW + SIDE] * 3]
field = warpcage.SampledField(lambda x, _: [each.detach() for each in grid(torch.from_dlpack(x))], bounds, step=0.02)
rest = warpcage.Cage.box([-1.1, -0.7, -0.7], [1.1, 0.7, 0.8], segments=(4, 2, 2))
deformer = warpcage.Deformer(field, rest, coordinates="green", resolution=64, density="paper", device=field.device)
pose = torch.tensor(rest.bend(60, axis="x", towards="z").vertices, dtype=torch.float32, requires_grad=True)


def posed_picture(vertices):
    """The grid's picture in a pose, all of its rays at once."""
    return march(grid, *rays(cameras[0]), moved=lambda x, d: warpcage.torch.to_canonical(deformer, x, d, vertices))


with torch.no_grad():
    still, bent = march(grid, *rays(cameras[0])), posed_picture(pose)
    own = deformer.pose(pose).render(cameras[0], background="white").rgb.reshape(-1, 3)
goal = bent.roll(2 * words.size, dims=0)  # two rows lower
loss = torch.nn.functional.mse_loss(posed_picture(pose), goal)
loss.backward()
with torch.no_grad():
    lower = torch.nn.functional.mse_loss(posed_picture(pose - 0.02 * pose.grad / pose.grad.abs().max()), goal)
    fit = -10.0 * torch.log10(torch.mean((still - pictures[: len(still)]) ** 2))
    same = -10.0 * np.log10(np.mean((bent.cpu().numpy() - own) ** 2))
row = torch.cat([each.reshape(words.size, words.size, 3) for each in (pictures[: len(still)], still, bent)], dim=1)
warpcage.view.write_png(words.out, warpcage.view.to_uint8(row.cpu().numpy()))
print(f"the grid is within {fit:.1f} dB of the demo scene, its marcher within {same:.1f} dB of warpcage's in the pose")
print(f"a step down the gradient by vertices takes the loss from {loss:.6f} to {lower:.6f}")
assert lower < loss
