"""Functions of kernels that no gradient passes through say so, and which they are stands in docs/arrays.md."""

import ast
import ctypes
import functools
import importlib
import pathlib
import re
import subprocess
import sys
import typing

import numpy as np
import oracles
import pytest
import warp as wp

from warpcage.core import kernel_names, kernel_source
from warpcage.kernels.edits import bake, extension, inverse, structs, trace
from warpcage.kernels.edits import nodes as map_nodes
from warpcage.kernels.field import background, outer
from warpcage.kernels.fitting import splat_growth as growth
from warpcage.kernels.lattice import cage_map, nodes, rings
from warpcage.kernels.mesh import containment
from warpcage.kernels.splats import pose, splats
from warpcage.mesh.mesh import prepared_fans

#: Warp unrolls loops of so many turns; of others it has only the last values of what they change, on its way back.
MAX_UNROLL = 16


def module_of(name):
    return importlib.import_module(f"warpcage.kernels.{name.replace('/', '.')}")


def decorators(node):
    return [ast.unparse(each) for each in node.decorator_list]


@functools.cache
def functions():
    """All that is decorated as a function of Warp, in factories too: {"file:name": node}."""
    return {
        f"{name}:{node.name}": node
        for name in kernel_names()
        if name != "core/gradients"
        for node in ast.walk(ast.parse(kernel_source(name)))
        if isinstance(node, ast.FunctionDef) and any(".func" in each for each in decorators(node))
    }


def is_native(node):
    return any("func_native" in each for each in decorators(node))


def is_forward_only(node):
    called = (each.func for each in ast.walk(node) if isinstance(each, ast.Call))
    return any(each.startswith("forward.func_native") for each in decorators(node)) or any(
        isinstance(each, ast.Name) and each.id in ("forward_only", "forward_only_radiance") for each in called
    )


@functools.cache
def vector_fields():
    """Names of fields of structs that are vectors or matrices of floats."""
    structs = (each for name in kernel_names() for each in vars(module_of(name)).values() if hasattr(each, "vars"))
    return {
        name
        for each in structs
        for name, var in each.vars.items()
        if getattr(var.type, "_wp_scalar_type_", None) in (wp.float32, wp.float64)
    }


def turns(loop, constants):
    """How often a loop runs, if that is known."""
    try:
        return len(eval(ast.unparse(loop.iter), {"range": range, **constants}))
    except (NameError, TypeError, AttributeError):
        return None


def doubts(key):
    """What of a function Warp's own way back goes wrong with, in silence."""
    node = functions()[key]
    constants = vars(module_of(key.partition(":")[0]))
    arrays = {each.arg for each in node.args.args if "array" in ast.unparse(each.annotation)}
    made = {}  # by a constructor of constants
    for each in ast.walk(node):
        if isinstance(each, ast.Assign) and isinstance(each.targets[0], ast.Name):
            fresh = isinstance(each.value, ast.Call) and all(isinstance(arg, ast.Constant) for arg in each.value.args)
            made[each.targets[0].id] = fresh and made.get(each.targets[0].id, True)
    for each in ast.walk(node):
        if isinstance(each, ast.While):
            yield "a loop"
        elif isinstance(each, ast.For):
            count = turns(each, constants)
            ends = any(isinstance(inner, ast.Break | ast.Continue) for inner in ast.walk(each))
            if count is None or count > MAX_UNROLL or ends:
                yield "a loop"
        elif isinstance(each, ast.Assign | ast.AugAssign):
            target = each.targets[0] if isinstance(each, ast.Assign) else each.target
            if isinstance(target, ast.Subscript):
                whole = target.value
                if isinstance(whole, ast.Attribute) and whole.attr in vector_fields():
                    yield "components of a struct's vector"
                elif isinstance(whole, ast.Name) and whole.id not in arrays and not made.get(whole.id):
                    yield "components written over others"


#: Functions with doubts that speak for themselves all the same, or have nothing to say.
OTHERS = {
    "coordinates/maximum_likelihood:likeliest": "maximum_likelihood_point, for which alone it is, speaks",
    "coordinates/green:green_point": "its own gradient",
    "lattice/cage_map:side_position": "its own gradient",
    "coordinates/mean_value:clear_row": "writes zeros",
    "fitting/splat_growth:clear_means": "writes zeros",
    "lattice/crossings:cross_face": "insert_crossing speaks",
    "lattice/rings:shared_extrapolation": "sum_of_lanes speaks",
    "splats/splats:nearest_wall_of_lanes": "from_lane and least_of_lanes speak",
    # right, as the test of central differences below shows
    "edits/bake:rotated_harmonics": "differentiable",
    "field/outer:contracted_in": "differentiable",
    "lattice/rings:lattice_extrapolation": "differentiable",
    "mesh/containment:winding_number": "differentiable",
}


def function_of(key):
    name, _, function = key.partition(":")
    return getattr(module_of(name), function)


def has_floats(kind):
    if hasattr(kind, "vars"):
        return any(has_floats(var.type) for var in kind.vars.values())
    return getattr(kind, "_wp_scalar_type_", getattr(kind, "dtype", kind)) in (float, wp.float32, wp.float64)


class BuiltOnce:
    """Functions that Warp has read, each once: without this it reads them again where others call them."""

    options, deferred_functions = {"output_arch": None}, []

    def __init__(self):
        self.functions = {}

    def build_function(self, function):
        self.functions[function] = None
        function.build(self)

    def build_struct_recursive(self, struct):
        """Nothing is written of them."""


BUILT = BuiltOnce()


def gives_whole_numbers(key):
    function = function_of(key)
    function = next(iter((function.user_overloads or function.user_templates).values()))
    if any(kind is typing.Any or getattr(kind, "dtype", None) is typing.Any for kind in function.input_types.values()):
        return all(ast.unparse(each.value) in ("True", "False") for each in ast.walk(functions()[key])
                   if isinstance(each, ast.Return))  # fmt: skip
    BUILT.options = function.module.options | {"output_arch": None}
    BUILT.build_function(function)
    results = [var.type for var in function.adj.return_var or ()]
    return bool(results) and not any(map(has_floats, results))


def test_every_doubtful_function_is_accounted_for():
    """Who adds one with a loop, or writes components of vectors: ends it with forward_only, or shows its gradient."""
    doubtful = {
        key
        for key, node in functions().items()
        if not is_native(node)
        and not any("func_grad" in each for each in decorators(node))
        and not is_forward_only(node)
        and any(doubts(key))
    }
    assert set(OTHERS) <= doubtful
    assert [key for key in sorted(doubtful - set(OTHERS)) if not gives_whole_numbers(key)] == []


def test_every_return_after_a_loop_refuses():
    """Warp's way back does not know what a loop came to, and may take another `return` than the way there."""
    for key, node in functions().items():
        loops = [each.lineno for each in ast.walk(node) if isinstance(each, ast.While)]
        if loops and is_forward_only(node):
            for each in ast.walk(node):
                if isinstance(each, ast.Return) and each.lineno > min(loops) and not isinstance(each.value, ast.Name):
                    assert "forward_only" in ast.unparse(each), f"{key}, line {each.lineno}"


def test_every_native_function_is_accounted_for():
    """C++ has an adjoint, of its own or one that refuses, unless it holds no number that a gradient could come to."""
    for key in (key for key, node in functions().items() if is_native(node)):
        function = function_of(key)
        types = list(function.input_types.values())
        result = functions()[key].returns
        writes = any(isinstance(kind, wp.array) and has_floats(kind) for kind in types)
        gives = result is not None and has_floats(function.func.__annotations__["return"])
        if types and (writes or gives) and key not in ADJOINTS:
            assert function.adj_native_snippet, f"{key}: a gradient ends here in silence: give it an adjoint, or refuse"


#: C++ that is called on the way back alone.
ADJOINTS = {"lattice/cage_map:add_side_slope"}


def test_docs_name_the_functions():
    docs = (pathlib.Path(__file__).parents[3] / "docs" / "arrays.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+/\w+)` \| (.+) \|$", docs.partition("Not differentiable are")[2], re.MULTILINE)
    said = {f"{file}:{name}" for file, names in rows for name in re.findall(r"`(\w+)`", names)}
    assert said == {key for key, node in functions().items() if is_forward_only(node)}


# users write such kernels with a backward pass; without optimisation they compile in half the time
if not wp.is_cuda_available():
    wp.set_module_options({"optimization_level": 0})


@wp.struct
class Shape:
    vertices: wp.array(dtype=wp.vec3)
    targets: wp.array(dtype=wp.vec3)
    faces: wp.array(dtype=wp.vec3i)


@wp.func
def cube_corners():
    corners = inverse.mat83()
    for c in range(8):
        corners[c] = wp.vec3(float(c >> 2), float((c >> 1) & 1), float(c & 1))
    return corners


@wp.kernel
def ask(
    which: int,
    x: wp.array(dtype=wp.vec3),
    shape: Shape,
    nodes: wp.array(dtype=wp.vec4),
    others: wp.array(dtype=int),
    carried: pose.CarriedSplats,
    found: wp.array(dtype=float),
):
    n = wp.tid()
    p = x[n]
    if which == 0:
        found[n] = containment.cage_distance(p, shape.vertices, shape.faces)
    elif which == 1:
        found[n] = splats.nearest_wall(p, shape.vertices, shape.faces).normal[0]
    elif which == 2:
        found[n] = pose.nearest_rotation(wp.diag(p + wp.vec3(2.0, 2.0, 2.0)))[0, 1]
    elif which == 3:
        found[n] = background.surface_sample(4, p).weights[0]
    elif which == 4:
        found[n] = map_nodes.node_blend(nodes, 0, 2, 1, p)[0]
    elif which == 5:
        found[n] = map_nodes.share_slope(3, p, p)
    elif which == 6:
        opacity, factor = growth.split_opacity(p[0], 2)
        found[n] = opacity + factor
    elif which == 8:
        found[n] = inverse.place_in_cell(inverse.cell_terms(cube_corners()), p)[0]
    elif which == 7:
        pose.put_splats(n, others, p, wp.identity(n=3, dtype=float), carried)
        found[n] = p[0]
    elif which == 9:  # a distance that decides, and that no gradient is asked of
        if containment.cage_distance(p, shape.vertices, shape.faces) > 0.0:
            found[n] = 3.0 * p[1]


def shape_on(device, vertices, faces):
    shape = Shape()
    shape.vertices = wp.array(vertices, dtype=wp.vec3, device=device)
    shape.targets = wp.array(1.2 * vertices, dtype=wp.vec3, device=device)
    shape.faces = wp.array(faces, dtype=wp.vec3i, device=device)
    return shape


def filled(kind, device):
    """A struct whose arrays, those of structs in it too, hold two zeros a side, which is a lattice of one cell."""
    struct = kind()
    for name, var in kind.vars.items():
        if isinstance(var.type, wp.array):
            setattr(struct, name, wp.zeros((2,) * var.type.ndim, dtype=var.type.dtype, device=device))
        elif hasattr(var.type, "vars"):
            setattr(struct, name, filled(var.type, device))
    return struct


def printed(capfd, device):
    """What has been printed, by kernels too."""
    wp.synchronize_device(device)
    ctypes.CDLL(None).fflush(None)
    return capfd.readouterr().out


def asked(which, device):
    """A place, nodes and splats with their gradients of what the kernel above finds."""
    x = wp.array(np.full((40, 3), 0.3), dtype=wp.vec3, device=device, requires_grad=True)
    nodes = wp.ones(8, dtype=wp.vec4, device=device, requires_grad=True)
    carried = filled(pose.CarriedSplats, device)
    carried.positions = wp.zeros(40, dtype=wp.vec3, device=device, requires_grad=which == 7)
    carried.jacobians = wp.zeros(40, dtype=wp.mat33, device=device)
    found = wp.zeros(40, dtype=float, device=device, requires_grad=True)
    others, shape = wp.full(40, -1, dtype=int, device=device), shape_on(device, *oracles.cage("box"))
    with wp.Tape() as tape:
        wp.launch(ask, 40, [which, x, shape, nodes, others, carried, found], device=device)
    tape.backward(grads={found: wp.ones(40, dtype=float, device=device)})
    return x, nodes, carried


@pytest.mark.parametrize("which", range(9))
def test_a_gradient_that_is_asked_for_is_refused(which, device, capfd):
    """In a line, once in a module, and in NaN."""
    printed(capfd, device)
    for _ in range(2):
        x, nodes, carried = asked(which, device)
        gradient = carried.positions.grad.numpy()[0] if which == 7 else x.grad.numpy()
        assert np.isnan(gradient).any(axis=-1).all()
    assert which != 4 or np.isnan(nodes.grad.numpy()).any()
    lines = re.findall("no gradient passes through", printed(capfd, device))
    assert len(lines) <= 4  # of the types that the file gives, and of what it calls; none if another device has said it


def test_nothing_is_refused_that_is_not_asked_for(device, capfd):
    printed(capfd, device)
    x, _, _ = asked(9, device)
    np.testing.assert_array_equal(x.grad.numpy(), np.tile([0, 3, 0], (40, 1)))
    assert "no gradient" not in printed(capfd, device)


def test_the_line_is_printed_where_somebody_asks(tmp_path):
    """In a process of its own: what a module has said once it says no more."""
    program = tmp_path / "program.py"
    program.write_text(PROGRAM, encoding="utf-8")
    done = subprocess.run([sys.executable, program], capture_output=True, text=True, timeout=300, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert [line for line in done.stdout.splitlines() if "nan" in line.lower()] == [
        (
            "warpcage: no gradient passes through a function of warpcage.kernels.mesh.containment: "
            "slopes are NaN, see Gradients in docs/arrays.md"
        ),
        "[nan nan nan]",
    ]


PROGRAM = """
import numpy as np
import warp as wp

wp.config.quiet = True

from warpcage.kernels.mesh.containment import cage_distance


@wp.kernel
def measure(x: wp.array(dtype=wp.vec3), vertices: wp.array(dtype=wp.vec3), faces: wp.array(dtype=wp.vec3i),
            found: wp.array(dtype=float)):
    n = wp.tid()
    found[n] = cage_distance(x[n], vertices, faces)


with wp.ScopedDevice("cpu"):
    x = wp.zeros(1000, dtype=wp.vec3, requires_grad=True)
    found = wp.zeros(1000, dtype=float, requires_grad=True)
    vertices = wp.array(np.eye(3), dtype=wp.vec3)
    faces = wp.array([[0, 1, 2]], dtype=wp.vec3i)
    with wp.Tape() as tape:
        wp.launch(measure, 1000, [x, vertices, faces, found])
    tape.backward(grads={found: wp.ones(1000, dtype=float)})
print(x.grad.numpy()[999])
"""


@wp.kernel
def go_back(
    which: int,
    x: wp.array2d(dtype=float),
    shape: Shape,
    sides: wp.array2d(dtype=wp.vec4),
    levels: nodes.NodeLevels,
    along: wp.array2d(dtype=float),
    found: wp.array(dtype=float),
):
    n = wp.tid()
    p = wp.vec3(x[n, 0], x[n, 1], x[n, 2])
    w = wp.vec3(along[n, 0], along[n, 1], along[n, 2])
    if which == 0:
        found[n] = containment.winding_number(p, shape.vertices, shape.faces)
    elif which == 1:
        found[n] = wp.dot(w, outer.contracted_in(p + wp.vec3(0.0, 0.0, 2.0), 5))
    elif which == 2:
        numbers = bake.vec27()
        for i in range(16):
            numbers[i] = along[n, i] * p[i % 3]
        turned = bake.rotated_harmonics(numbers, 0, 3, wp.diag(p))
        for i in range(16):
            found[n] += turned[i] * along[n, 15 - i]
    elif which == 3:
        found[n] = wp.dot(w, cage_map.side_position(sides, 2, p))
    elif which == 4:
        extrapolation = rings.lattice_extrapolation(levels, shape.targets, 62, 0)
        found[n] = wp.dot(w, extrapolation.linear) + wp.dot(w, extrapolation.nearby)


@wp.kernel
def carry_back(
    which: int,
    x: wp.array(dtype=wp.vec3),
    walls: extension.WallMap,
    edit: structs.ExactEdit,
    along: wp.array(dtype=wp.vec3),
    found: wp.array(dtype=float),
):
    n = wp.tid()
    if which == 0:
        found[n] = wp.dot(along[n], extension.forward_position(walls, x[n]))
    elif which == 1 or which == 2:
        found[n] = wp.dot(along[n], trace.edit_position(edit, x[n]))
    elif which == 3:
        found[n] = wp.dot(along[n], extension.continued_position(walls, x[n]))


def outcome(build, hosts, device, requires_grad=False):
    """The sum of what a kernel finds, or its slopes by each of the arrays that it is given: (values, dtype)."""
    given = [wp.array(host, dtype=dtype, device=device, requires_grad=requires_grad) for host, dtype in hosts]
    found = wp.zeros(6, dtype=float, device=device, requires_grad=requires_grad)
    kernel, inputs = build(*given)
    with wp.Tape() as tape:
        wp.launch(kernel, 6, [*inputs, found], device=device)
    if not requires_grad:
        return found.numpy().sum(dtype=np.float64)
    tape.backward(grads={found: wp.ones(6, dtype=float, device=device)})
    return [each.grad.numpy() for each in given]


def central_differences(build, hosts, random, device):
    """(arrays, 3) differences of the outcome along three random steps of each array, which its slopes agree with."""
    slopes, found = outcome(build, hosts, device, requires_grad=True), np.zeros((len(hosts), 3))
    for (k, turn), _ in np.ndenumerate(found):
        host, dtype = hosts[k]
        step = random.normal(size=host.shape) * 4e-3
        if dtype == wp.vec4:
            step[..., 3] = 0.0
        low, high = ([*hosts[:k], (host + side * step, dtype), *hosts[k + 1 :]] for side in (-1, 1))
        expected = found[k, turn] = (outcome(build, high, device) - outcome(build, low, device)) / 2
        assert abs((slopes[k] * step).sum() - expected) < 0.01 * abs(expected) + 2e-5
    return found


@pytest.mark.parametrize("which", range(5))
def test_those_that_go_back_do(which, device):
    """By central differences of the same function, of the place and of arrays in structs."""
    random = np.random.default_rng(which)
    vertices, faces = oracles.cage("box")
    if which == 0:
        faces = faces[:-3]  # of an open one; of a closed one it is a constant
    targets = random.normal(size=(125, 3)) if which == 4 else random.normal(size=vertices.shape)
    x, along = random.uniform(0.05, 0.15, (6, 3)), random.normal(size=(6, 16))
    sides = random.normal(size=(2, 8, 4))
    sides[..., 3] = [[-1.0], [1.0]]  # the first is the nearer one
    levels = filled(nodes.NodeLevels, device)
    levels.shapes = wp.array([[5, 5, 5]], dtype=wp.vec3i, device=device)
    levels.codes = wp.zeros(125, dtype=int, device=device)

    def build(x, ours, targets, sides):
        shape = shape_on(device, vertices, faces)
        shape.vertices, shape.targets = ours, targets
        return go_back, [which, x, shape, sides, levels, wp.array(along, dtype=float, device=device)]

    hosts = [(x, float), (vertices, wp.vec3), (targets, wp.vec3), (sides, wp.vec4)]
    assert np.abs(central_differences(build, hosts, random, device)).max() > 1e-3


@pytest.mark.parametrize("which", range(4))
def test_maps_of_edits_go_back(which, device):
    """By central differences, of the place and of both cages; the map that goes on beyond a wall refuses."""
    random = np.random.default_rng(which)
    vertices, faces = oracles.cage("box")
    places, posed = random.uniform(0.05, 0.15, (6, 3)), 1.2 * vertices + 0.1 * random.normal(size=vertices.shape)
    normals, along = random.normal(size=(len(faces), 3)), random.normal(size=(6, 3))

    def build(x, ours, theirs, normals):
        walls, edit = filled(extension.WallMap, device), filled(structs.ExactEdit, device)
        walls.faces = edit.faces = wp.array(faces, dtype=wp.vec3i, device=device)
        walls.rest = edit.deformed_vertices = ours
        walls.posed = edit.rest_vertices = theirs
        edit.rest_normals = normals  # of the other cage, stretched
        walls.rest_size = walls.posed_size = edit.size = 1.0
        walls.rest_fans = edit.fans = prepared_fans(ours, walls.faces, 1.0)
        walls.posed_fans = prepared_fans(theirs, walls.faces, 1.0)
        edit.is_green = int(which == 2)
        return carry_back, [which, x, walls, edit, wp.array(along, dtype=wp.vec3, device=device)]

    hosts = [(host, wp.vec3) for host in (places, vertices, posed, normals)]
    if which == 3:
        assert np.isnan(outcome(build, hosts, device, requires_grad=True)[0]).any(axis=-1).all()
        return
    found = np.abs(central_differences(build, hosts, random, device))
    assert (found[:3] > 1e-5).all() and ((found[3] > 1e-5) == (which == 2)).all()
