"""Arrays in and out: what goes in comes out as the same kind, on its device, of any precision and layout."""

import functools
import sys
import types

import numpy as np
import pytest
import warp as wp
from fields import BOX, OnlyDLPack, shiny_field
from messages import MESSAGES
from refusals import refused

from warpcage import (
    Cage,
    Deformer,
    SplatField,
    biharmonic_coordinates,
    deform_points,
    green_coordinates,
    harmonic_coordinates,
    maximum_likelihood_coordinates,
    mean_value_coordinates,
    turntable,
)
from warpcage.errors import InputError

POSED = BOX.bend(40, axis="x", towards="z")
COUNT = 12
DIRECTIONS = np.tile([0.0, 0.6, 0.8], (COUNT, 1))


class Shaped(OnlyDLPack):
    def __init__(self, values):
        super().__init__(values)
        self.dtype, self.shape = values.dtype, values.shape


class CupyArray(Shaped):
    """Stands in for CuPy's arrays, whose library reads DLPack."""

    __module__ = "cupy"


class Stranger(Shaped):
    """An array of a library that nobody knows: results can be Warp's alone, which speak DLPack too."""

    __module__ = "stranger"


def imported_torch():
    return pytest.importorskip("torch", reason="torch is not installed: pip install torch==2.13.0")


@pytest.fixture
def torch():
    return imported_torch()


def warp_vectors(values):
    kind = {2: wp.vec3h, 4: wp.vec3, 8: wp.vec3d}[values.itemsize]
    return wp.array(np.ascontiguousarray(values), dtype=kind, device="cpu")


def warp_rows(values):
    """Strides are those of the values."""
    number = {2: wp.float16, 4: wp.float32, 8: wp.float64}[values.itemsize]
    pointer = values.__array_interface__["data"][0]
    rows = wp.array(ptr=pointer, dtype=number, shape=values.shape, strides=values.strides, device="cpu", copy=False)
    rows.keeps = values
    return rows


def torch_tensor(values):
    return imported_torch().from_numpy(values)


def jax_array(values):
    jax = pytest.importorskip("jax", reason="JAX is not installed: pip install 'jax[cpu]'")
    with jax.enable_x64(values.itemsize == 8):
        return jax.numpy.asarray(values)


#: Kinds of arrays: what makes one of NumPy's, and the class that results have.
KINDS = {
    "numpy": (lambda values: values, np.ndarray),
    "warp vec3": (warp_vectors, wp.array),
    "warp rows": (warp_rows, wp.array),
    "torch": (torch_tensor, None),
    "jax": (jax_array, None),
    "cupy": (CupyArray, CupyArray),
    "stranger": (Stranger, wp.array),
}

LAYOUTS = {
    "contiguous": lambda values: values.copy(),
    "every second row": lambda values: np.repeat(values, 2, axis=0)[::2],
    "columns of more": lambda values: np.concatenate([values, values], axis=1)[:, 3:],
    "transposed": lambda values: np.ascontiguousarray(values.T).T,
}

FUNCTIONS = {
    "deform_points": lambda points, device: [deform_points(points, BOX, POSED, device=device)],
    "mean_value_coordinates": lambda points, device: [mean_value_coordinates(points, BOX, device=device)],
    "maximum_likelihood_coordinates": lambda points, device: [
        maximum_likelihood_coordinates(points, BOX, device=device)
    ],
    "biharmonic_coordinates": lambda points, device: biharmonic_coordinates(points, BOX, device=device),
    "green_coordinates": lambda points, device: green_coordinates(points, BOX, device=device),
    "harmonic_coordinates": lambda points, device: [harmonic_coordinates(points, BOX, 12, device=device)],
    "contains": lambda points, device: [BOX.contains(points, device=device)],
    "to_canonical": lambda points, device: posed(device).to_canonical(points, DIRECTIONS),
    "sample": lambda points, device: field_on(device).sample(points, DIRECTIONS),
}


@functools.cache
def field_on(device):
    return shiny_field(device, resolution=12)


@functools.cache
def posed(device):
    return Deformer(field_on(device), BOX, coordinates="mean_value", resolution=16).pose(POSED)


@functools.cache
def expected_of(name, dtype, device):
    """What a function gives for the points as NumPy has them."""
    return [np.asarray(each) for each in FUNCTIONS[name](points_in_box(dtype).astype(np.float64), device)]


@pytest.fixture(autouse=True)
def libraries(monkeypatch):
    cupy = types.ModuleType("cupy")
    cupy.from_dlpack = lambda array: CupyArray(np.from_dlpack(array))
    monkeypatch.setitem(sys.modules, "cupy", cupy)
    monkeypatch.setitem(sys.modules, "stranger", types.ModuleType("stranger"))


def points_in_box(dtype="float32"):
    """Points, of few digits so that float16 has them too, inside the box at rest and posed, and one beside it."""
    points = np.random.default_rng(0).integers(-40, 41, (COUNT, 3)) / np.array([128.0, 128.0, 256.0])
    return points.astype(dtype)


def as_numpy(array):
    return array.values if isinstance(array, CupyArray) else array.numpy() if hasattr(array, "numpy") else array


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("dtype", ["float32", "float64", "float16"])
@pytest.mark.parametrize("kind", KINDS)
def test_results_are_of_the_kind_that_came_in(kind, dtype, layout, device):
    make, result_kind = KINDS[kind]
    given = make(LAYOUTS[layout](points_in_box(dtype)))
    for name, function in FUNCTIONS.items():
        for one, reference in zip(function(given, device), expected_of(name, dtype, device), strict=True):
            assert isinstance(one, type(given) if result_kind is None else result_kind), name
            values = np.asarray(as_numpy(one))
            assert values.shape == reference.shape and len(values) == COUNT, name
            if kind != "warp vec3" or reference.shape[1:] != (3,):
                assert tuple(one.shape) == reference.shape, name
            np.testing.assert_allclose(values, reference, atol=2e-6, err_msg=name)
            if kind not in ("numpy", "stranger"):
                assert str(one.device) == str(given.device) if hasattr(given, "device") else True


@pytest.mark.parametrize("kind", KINDS)
def test_no_points(kind, device):
    given = KINDS[kind][0](np.zeros((0, 3), np.float32))
    for name, function in FUNCTIONS.items():
        if name not in ("to_canonical", "sample"):
            assert all(len(as_numpy(each)) == 0 for each in function(given, device)), name
    one, two, region = posed(device).to_canonical(given, given)
    assert len(as_numpy(one)) == len(as_numpy(two)) == len(as_numpy(region)) == 0


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300], ids=str)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", FUNCTIONS)
def test_points_that_are_not_finite_are_refused_by_all_alike(name, kind, value, device):
    if value == 1e300 and name not in ("to_canonical", "sample"):
        value = np.nan  # what is merely far away is outside
    points = points_in_box("float64")
    points[7, 1] = value
    refused(lambda: FUNCTIONS[name](KINDS[kind][0](points), device), match="points must be finite, row 7 is")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["to_canonical", "sample"])
def test_directions_that_are_not_finite_are_refused_too(name, kind, device):
    taker = posed(device).to_canonical if name == "to_canonical" else field_on(device).sample
    directions = DIRECTIONS.copy()
    directions[3, 2] = np.nan
    refused(lambda: taker(points_in_box(), KINDS[kind][0](directions)), match="directions must be finite, row 3 is")


@pytest.mark.parametrize("kind", ["torch", "jax", "warp rows"])
def test_what_lies_right_is_not_copied(kind):
    """A change of the memory that was given is seen: nothing was copied before the kernel reads it."""
    from warpcage.core import as_points

    given = KINDS[kind][0](points_in_box())
    pointer = given.ptr if kind == "warp rows" else wp.from_dlpack(given).ptr
    assert as_points(given).ptr == pointer


def test_results_for_torch_are_the_memory_that_kernels_wrote(torch):
    moved = deform_points(torch.from_numpy(points_in_box()), BOX, POSED)
    again = wp.from_dlpack(moved)
    moved[0, 0] = 17.0
    assert again.numpy()[0, 0] == 17.0 and not moved.requires_grad


@pytest.mark.parametrize("kind", ["torch", "jax", "cupy", "warp rows"])
def test_frames_are_handed_on_where_they_were_written(kind):
    frames = posed("cpu").render(turntable((0, 0, 0), 3, 20, 2, width=8, height=8), outputs=["flow"], flow_pose=BOX)
    found = frames.arrays_like(KINDS[kind][0](points_in_box()))
    assert set(found) == set(frames.arrays)
    for name, array in found.items():
        assert isinstance(array, KINDS[kind][1] or object) and array.shape[0] == 2
        pointer = array.values.ctypes.data if kind == "cupy" else wp.from_dlpack(array).ptr
        assert pointer == frames.arrays[name].ptr


@pytest.mark.parametrize("name", FUNCTIONS)
def test_gradients_that_would_be_lost_are_told(name, device, torch):
    points = torch.from_numpy(points_in_box()).requires_grad_(True)
    refused(lambda: FUNCTIONS[name](points, device), "detach", match=MESSAGES["arrays.no_gradient"])
    with torch.no_grad():
        found = FUNCTIONS[name](points, device)
    assert all(torch.is_tensor(each) and not each.requires_grad for each in found)
    for each, other in zip(found, FUNCTIONS[name](points.detach(), device), strict=True):
        assert torch.equal(each, other)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_tape_of_warp_is_told_too(name, device):
    points = wp.array(points_in_box(), dtype=wp.vec3, device=device, requires_grad=True)
    FUNCTIONS[name](points, device)
    with wp.Tape(), pytest.raises(ValueError, match=MESSAGES["arrays.no_gradient"]):
        FUNCTIONS[name](points, device)


def test_jax_under_a_transformation_is_told():
    jax = pytest.importorskip("jax", reason="JAX is not installed: pip install 'jax[cpu]'")
    slopes = jax.grad(lambda points: deform_points(points, BOX, POSED).sum())
    refused(lambda: slopes(jax.numpy.asarray(points_in_box())), match=MESSAGES["arrays.dlpack"])


def test_numbers_that_kernels_do_not_take_are_refused(torch):
    refused(lambda: deform_points(torch.zeros(4, 3, dtype=torch.bool), BOX, POSED), match=MESSAGES["arrays.numbers"])
    refused(lambda: deform_points(torch.zeros(4, 3, dtype=torch.complex64), BOX, POSED), match="complex")
    whole = torch.zeros(4, 3, dtype=torch.int64)
    np.testing.assert_allclose(deform_points(whole, BOX, POSED), deform_points(np.zeros((4, 3)), BOX, POSED), atol=1e-6)


def test_a_class_of_tensors_of_somebodys_own(device, torch):
    given = torch.nn.Parameter(torch.from_numpy(points_in_box()), requires_grad=False)
    assert isinstance(deform_points(given, BOX, POSED, device=device), torch.Tensor)


def test_cages_of_tensors(device, torch):
    vertices, faces = torch.from_numpy(BOX.vertices.copy()), torch.from_numpy(BOX.faces.copy())
    assert np.array_equal(Cage(vertices, faces).vertices, BOX.vertices)
    refused(lambda: Cage(vertices.requires_grad_(True), faces), match=MESSAGES["arrays.no_gradient"])


@pytest.mark.parametrize("name", ["centers", "scales", "rotations", "opacities", "harmonics"])
def test_parameters_of_splats_are_told(name, torch):
    shapes = {"centers": (3, 3), "scales": (3, 3), "rotations": (3, 4), "opacities": (3, 1), "harmonics": (3, 1, 3)}
    values = {each: torch.full(shape, 0.5) for each, shape in shapes.items()}
    assert SplatField.from_arrays(**values).splat_count == 3
    values[name] = torch.nn.Parameter(values[name])
    refused(lambda: SplatField.from_arrays(**values), f"{name}.detach()", match=MESSAGES["arrays.no_gradient"])


class Unreadable:
    """An array whose memory is nowhere, as torch's on the device "meta"."""

    def __dlpack__(self, **options):
        raise BufferError("it has no memory")

    __dlpack_device__ = __dlpack__


UNREADABLE = {
    "points": lambda array: deform_points(array, BOX, POSED),
    "vertices": lambda array: Cage(array, BOX.faces),
    "sampled": lambda array: field_on("cpu").sample(array, array),
}


@pytest.mark.parametrize("call", UNREADABLE.values(), ids=UNREADABLE)
def test_an_array_without_memory_is_told(call):
    """By the same line everywhere, with what its library says."""
    refused(lambda: call(Unreadable()), match="Unreadable .*: it has no memory", error=InputError)
