#!/bin/sh
# Finding: Warp's tape gives wrong gradients through a loop whose length is only known when it runs
# Software: Warp 1.19.0 (PyPI, warp-lang)
# Expected: the gradient of y = x^8, as three squarings in a loop, is 8 x^7, whether 3 stands in the kernel or in an
#   array
# Seen: with the length in an array it is twice that at x = 1.1, without a warning: what a loop overwrites is not kept
#   for the way back
# Meets: who differentiates a kernel of their own that marches or sums over a list of any length, beside a pose
# Here: kernels that loop are not differentiated by a tape, or their way back is written by hand; docs/arrays.md says
#   which are (`kernels/core/gradients.py`).
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check warp-lang==1.19.0 numpy==2.4.6
venv/bin/python - <<'END'
import sys
import tempfile

import numpy as np
import warp as wp

# kernels are read from a file
source = """
import warp as wp


@wp.kernel
def by_array(x: wp.array(dtype=float), count: wp.array(dtype=int), y: wp.array(dtype=float)):
    power = x[0]
    for _ in range(count[0]):
        power = power * power
    y[0] = power


@wp.kernel
def by_number(x: wp.array(dtype=float), count: wp.array(dtype=int), y: wp.array(dtype=float)):
    power = x[0]
    for _ in range(3):
        power = power * power
    y[0] = power
"""
with open("squares.py", "w") as file:
    file.write(source)
sys.path.insert(0, ".")
import squares  # noqa: E402

wp.config.quiet = True
wp.config.kernel_cache_dir = tempfile.mkdtemp(dir=".")
found = {}
for kernel in (squares.by_number, squares.by_array):
    x, y = (wp.array(values, dtype=float, device="cpu", requires_grad=True) for values in ([1.1], [0.0]))
    with wp.Tape() as tape:
        wp.launch(kernel, 1, [x, wp.array([3], dtype=int, device="cpu")], [y], device="cpu")
    tape.backward(grads={y: wp.ones_like(y)})
    found[kernel.key] = float(x.grad.numpy()[0])
    print(f"{kernel.key}: y {y.numpy()[0]:.4f}, gradient {found[kernel.key]:.4f}, right is {8 * 1.1**7:.4f}")
right = np.isclose(found["by_number"], 8 * 1.1**7, rtol=1e-4)
sys.exit(0 if right and found["by_array"] > 1.5 * 8 * 1.1**7 else "the behaviour has changed")
END
