"""The small brick scene, its field and its cage that the quick benchmarks of run_all.py work on.

python benchmarks/prepare_quick.py FOLDER
"""

import pathlib
import sys

import warpcage
from warpcage.reference.brick_scene import write_brick_scene

folder = pathlib.Path(sys.argv[1])
write_brick_scene(folder / "scene", train_views=24, test_views=2, size=48, device="cpu")
field = warpcage.fit(warpcage.load_scene(folder / "scene"), device="cpu", quality="fast", epochs=1.0, progress=False)
field.save(folder / "field.npz")
warpcage.Cage.load(pathlib.Path(__file__).parent / "cages" / "bricks.obj").save(folder / "cage.obj")
