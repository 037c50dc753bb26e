"""Gradients of torch through points, weights, canonical points and frames, beside differences and exact cases."""

import gc
import math

import numpy as np
import pytest
from fields import BOX, rotation, shiny_field, surrounded_ball, view
from refusals import refused
from splat_scenes import splats_in_box

import warpcage
from warpcage import Cage, CageEdit, Deformer
from warpcage.gradients import frame_gradient

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'warpcage[torch]'")
from warpcage import torch as passing

#: Compiled functions take objects from there on.
compiles = pytest.mark.skipif(
    tuple(int(part) for part in torch.__version__.split(".")[:2]) < (2, 14), reason="torch.compile needs torch 2.14"
)

CAGE = Cage.icosphere((0.2, -0.1, 0.3), 1.3, 1)
POSE = CAGE.twist(40)
BENT = BOX.bend(30, axis="x", towards="z")


@pytest.fixture(autouse=True)
def seeded(device):
    if device != "cpu" and not torch.cuda.is_available():
        pytest.skip("this torch has no CUDA")
    torch.manual_seed(3)


def tensor(values, device="cpu", grad=False):
    return torch.tensor(np.array(values), device=device, requires_grad=grad)


def some_points(device, count=6, grad=False):
    return tensor(0.2 + np.random.default_rng(1).uniform(-0.4, 0.4, (count, 3)), device, grad)


def same_gradients(function, compiled, *given):
    """Whether a compiled function has the values and gradients of the plain one."""
    found = []
    for each in (function, compiled):
        leaves = [value.detach().clone().requires_grad_() for value in given]
        loss = each(*leaves)
        loss.backward()
        found.append([loss.detach(), *[leaf.grad for leaf in leaves]])
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("kind", ["mean_value", "green"])
def test_moved_points_pass_gradients_to_points_pose_and_cage(kind, device):
    given = [some_points(device, grad=True), tensor(POSE.vertices, grad=True), tensor(CAGE.vertices, grad=True)]

    def moved(points, pose, rest):
        return passing.deform_points(points, CAGE, pose, kind, rest_vertices=rest)

    plain = warpcage.deform_points(given[0].detach().float(), CAGE, POSE, kind)
    assert torch.equal(moved(*given), plain) and plain.dtype == torch.float32
    assert torch.equal(passing.deform_points(given[0], CAGE, POSE, kind), plain)
    options = {"eps": 2e-3, "atol": 3e-3, "rtol": 1e-2, "nondet_tol": 1e-5}
    assert torch.autograd.gradcheck(moved, given, fast_mode=True, **options)


def test_harmonic_points_pass_gradients_to_the_pose(device):
    """They are linear in it: the gradient is that by the weights."""
    cage = Cage.box([-0.9, -0.8, -0.7], [0.9, 1.0, 1.1])
    points, pose = some_points(device, 40), tensor(cage.twist(20).vertices, grad=True)
    slopes = torch.randn(40, 3, device=device)
    (passing.deform_points(points, cage, pose, "harmonic") * slopes).sum().backward()
    weights = warpcage.harmonic_coordinates(points.float(), cage)
    expected = (weights.T @ slopes).cpu().double()
    assert (pose.grad - expected).norm() < 5e-3 * expected.norm()


@pytest.mark.parametrize("name", ["mean_value_coordinates", "green_coordinates"])
def test_weights_pass_gradients_to_points_and_cage(name, device):
    given = [some_points(device, grad=True), tensor(CAGE.vertices, device, grad=True)]

    def weights(points, vertices):
        return getattr(passing, name)(points, CAGE, vertices=vertices)

    for found, plain in zip(weights(*given), getattr(warpcage, name)(given[0].detach().float(), CAGE), strict=True):
        torch.testing.assert_close(found, plain, rtol=0, atol=1e-6)
    options = {"eps": 2e-3, "atol": 3e-3, "rtol": 1e-2, "nondet_tol": 1e-5}
    assert torch.autograd.gradcheck(weights, given, fast_mode=True, **options)


def test_operators_are_what_torch_asks_of_them(device):
    """Schemas, shapes of what is traced, and gradients of the compiled ones, by torch's own check."""
    from warpcage.interop import number_of

    cage = number_of(CAGE, Cage, "")
    points, pose = some_points(device, grad=True).float().detach().requires_grad_(), tensor(POSE.vertices, grad=True)
    deformer = bent_deformer("mean_value", device)
    held = view(size=8)
    owner, camera = number_of(deformer, Deformer, ""), number_of(held, warpcage.Camera, "")
    assert passing.deform_points and passing.render  # operators are there once one is used
    ops, directions = torch.ops.warpcage, torch.randn(6, 3, device=device)
    vertices = tensor(BENT.vertices, grad=True)
    calls = [
        (ops.deform_points.default, (points, None, pose, cage, -1, "green", "")),
        (ops.coordinates.default, (points, None, cage, "green", "raise")),
        (ops.to_canonical.default, (points, directions, vertices, owner, None)),
        (ops.render.default, (vertices, None, owner, camera, [0.0] * 3, None)),
    ]
    tests = ("test_schema", "test_autograd_registration", "test_faketensor")
    for operator, given in calls:
        torch.library.opcheck(operator, given, test_utils=tests)


@compiles
def test_functions_compile_whole(device):
    points, pose = some_points(device), tensor(POSE.vertices)
    deformer = bent_deformer("mean_value", device)
    vertices = tensor(BENT.vertices)

    def loss(points, pose, vertices):
        moved = passing.deform_points(points * 1.1, CAGE, pose, "green")
        weights = passing.mean_value_coordinates(moved, POSE)
        canonical, along, _ = passing.to_canonical(deformer, 0.3 * moved, weights @ pose.float().to(moved), vertices)
        return moved.square().sum() + weights.square().sum() + canonical.sin().sum() + (along * canonical).sum()

    same_gradients(loss, torch.compile(loss, fullgraph=True, backend="aot_eager"), points, pose, vertices)


@compiles
def test_a_compiled_function_follows_another_cage():
    compiled = torch.compile(
        lambda points, rest, pose: passing.deform_points(points, rest, pose), fullgraph=True, backend="aot_eager"
    )
    points = some_points("cpu").float()
    for rest in (CAGE, POSE, CAGE):
        assert torch.equal(compiled(points, rest, BOX_LIKE), warpcage.deform_points(points, rest, BOX_LIKE))


BOX_LIKE = CAGE.stretch(1.2)


def test_mapped_operators_and_backgrounds_by_name(device):
    points, poses = some_points(device), tensor(np.stack([POSE.vertices, CAGE.vertices * 1.1]), device)
    mapped = torch.func.vmap(lambda pose: passing.deform_points(points, CAGE, pose))(poses)
    assert torch.equal(mapped, torch.stack([passing.deform_points(points, CAGE, pose) for pose in poses]))
    deformer, camera = bent_deformer("mean_value", device, 16), view(size=8)
    by_name, by_numbers = (passing.render(deformer, camera, background=each)[0] for each in ("black", (0.0, 0.0, 0.0)))
    assert torch.equal(by_name, by_numbers)


def test_backward_again_adds_and_twice_is_refused():
    points = some_points("cpu", grad=True)
    loss = passing.deform_points(points, CAGE, POSE).square().sum()
    loss.backward(retain_graph=True)
    once = points.grad.clone()
    loss.backward()
    assert torch.equal(points.grad, 2 * once)
    slopes = torch.autograd.grad(passing.deform_points(points, CAGE, POSE).square().sum(), points, create_graph=True)[0]
    with pytest.raises(RuntimeError, match="no autograd formula"):
        slopes.square().sum().backward()


def bent_deformer(kind, device, resolution=32):
    return Deformer(shiny_field(device), BOX, coordinates=kind, resolution=resolution, device=device).pose(BENT)


def spread(device, count=300):
    points = 0.9 * (torch.rand(count, 3) - 0.5)
    return points.to(device), torch.randn(count, 3).to(device)


def test_a_rigid_pose_turns_gradients_of_canonical_points(device):
    """phi(x) = R^T (x - t), so that slopes come back turned, and by vertices they move against the points."""
    turn, shift = rotation(35, 20), np.array([0.1, -0.05, 0.2])
    deformer = Deformer(shiny_field(device), BOX, coordinates="mean_value", resolution=32, device=device)
    points, directions = (each.requires_grad_() for each in spread(device))
    vertices = tensor(BOX.vertices @ turn.T + shift, grad=True)
    found = passing.to_canonical(deformer, points, directions, vertices)
    plain = deformer.posed(vertices.detach()).to_canonical(points.detach(), directions.detach())
    assert all(map(torch.equal, found, plain))
    matrix = torch.tensor(turn, dtype=torch.float32, device=device)
    by_points, by_directions = torch.randn_like(points), torch.randn_like(points)
    ((found[0] * by_points) + (found[1] * by_directions)).sum().backward()
    mapped = (found[2] == 2)[:, None]
    assert 100 < mapped.sum() < 300
    length, unit = directions.detach().norm(dim=1, keepdim=True), torch.nn.functional.normalize(directions.detach())
    turned = by_directions @ matrix.T
    turned = (turned - (turned * unit).sum(dim=1, keepdim=True) * unit) / length
    torch.testing.assert_close(points.grad, torch.where(mapped, by_points @ matrix.T, by_points), atol=2e-3, rtol=0)
    torch.testing.assert_close(directions.grad, torch.where(mapped, turned, by_directions), atol=2e-3, rtol=0)
    # a shift of all vertices shifts every mapped point back
    shifted = -(mapped * (by_points @ matrix.T)).sum(dim=0).cpu()
    torch.testing.assert_close(vertices.grad.sum(dim=0).float(), shifted, atol=5e-2, rtol=1e-3)


@pytest.mark.parametrize("kind", ["harmonic", "mean_value", "green"])
def test_gradients_of_canonical_points_are_differences(kind, device):
    """Over a cell of the lattice by points; by vertices that leave its box where it is."""
    deformer = bent_deformer(kind, device)
    points, directions = spread(device)
    points = 0.6 * points  # by the cage a node turns from the map to its continuation
    vertices, slopes = tensor(BENT.vertices), torch.randn(2, 300, 3, device=device)
    cell = float(deformer.posed_edits().lattices.posed()[0][0].deformed.spacing)

    def losses(*given):
        """Of each point, and NaN for those that are not mapped."""
        canonical, along, region = passing.to_canonical(deformer, *given)
        of_points = (slopes[0] * canonical).sum(dim=1), (slopes[1] * along).sum(dim=1)
        return [torch.where(region == 2, each, math.nan) for each in of_points]

    low, high = vertices.min(dim=0).values, vertices.max(dim=0).values
    margin = 0.05 * (high - low)
    free = (vertices > low + margin) & (vertices < high - margin)
    given, moves = (points, directions, vertices), (0.5 * cell, 1e-2, 2e-3)
    for which, bound in ((0, 2e-3), (1, 2e-2)):
        for number, move in enumerate(moves):
            change = torch.randn(given[number].shape, dtype=given[number].dtype).to(given[number])
            change = (
                torch.where(free, change, 0.0) if number == 2 else change.sign() * (torch.arange(3).to(change) == 1)
            )
            ends = []
            for side in (move, -move):
                moved = [each + side * change if n == number else each for n, each in enumerate(given)]
                ends.append(losses(*moved)[which])
            expected = (ends[0] - ends[1]) / (2 * move)
            leaves = [each.clone().requires_grad_() for each in given]
            held = torch.isfinite(expected) & torch.isfinite(losses(*given)[which])
            assert held.sum() > 100
            losses(*leaves)[which][held].sum().backward()
            if number == 2:
                found, expected = (leaves[2].grad * change).sum(), expected[held].sum()
                assert abs(found - expected) < bound * (leaves[2].grad * change).abs().sum()
            else:
                found, expected = (leaves[number].grad * change).sum(dim=1)[held], expected[held]
                assert (found - expected).norm() < bound * max(leaves[number].grad[held].norm(), 1e-6)


def test_frames_pass_gradients_to_pose_and_camera(device):
    """A loss of a frame, as its pose grows, bends back and its camera moves: differences to a few hundredths."""
    deformer, camera = bent_deformer("mean_value", device, 48), view(size=32)
    background = (0.2, 0.3, 0.4)
    slopes = torch.randn(32, 32, 3).cumsum(dim=0).cumsum(dim=1).to(device) / 100
    frame = deformer.render(camera, background=background)
    plain = passing.render(deformer, camera, background=background)
    for name, found in zip(("rgb", "alpha", "depth"), plain, strict=True):
        np.testing.assert_array_equal(found.cpu().numpy(), getattr(frame, name))

    def loss(vertices, change):
        rgb, alpha, _ = passing.render(deformer, camera, vertices, camera_change=change, background=background)
        return (rgb * slopes).sum() + alpha.square().sum()

    vertices = tensor(BENT.vertices, grad=True)
    change = tensor([0.3, -0.2, 0.25, 0.1, 0.05, -0.1, 0.1], grad=True)
    loss(vertices, change).backward()
    directions = [(vertices.detach() - vertices.detach().mean(dim=0), torch.zeros(7).double())]
    directions += [(torch.zeros_like(vertices), each) for each in torch.eye(7).double()]
    pairs = []
    with torch.no_grad():
        for one, other in directions:
            ends = [float(loss(vertices + side * one, change + side * other)) for side in (2e-3, -2e-3)]
            pairs.append(((vertices.grad * one).sum() + (change.grad * other).sum(), (ends[0] - ends[1]) / 4e-3))
    found, expected = np.array(pairs, float).T
    assert np.linalg.norm(found - expected) < 0.05 * np.linalg.norm(expected), (found, expected)


def test_frames_of_splats_pass_the_gradients_of_the_package(device):
    deformer = Deformer(splats_in_box(device, 60), BOX, coordinates="green", device=device).pose(BENT)
    camera, vertices = view(size=24), tensor(BENT.vertices, grad=True)
    found = passing.render(deformer, camera, vertices)
    frame = deformer.render(camera)
    for name, part in zip(("rgb", "alpha", "depth"), found, strict=True):
        np.testing.assert_array_equal(part.detach().cpu().numpy(), getattr(frame, name))
    slopes = [torch.randn_like(part) for part in found]
    torch.autograd.backward(found, slopes)
    others = {"alpha_gradient": slopes[1], "depth_gradient": slopes[2]}
    expected = frame_gradient(deformer, camera, slopes[0], by_vertices=True, **others).vertices.numpy()
    assert np.linalg.norm(vertices.grad.numpy() - expected) < 1e-4 * np.linalg.norm(expected)


def test_the_pose_of_the_deformer_stays(device):
    deformer = bent_deformer("mean_value", device)
    points, directions = spread(device, 50)
    before = deformer.deformed
    vertices = tensor(BOX.stretch(1.2).vertices, grad=True)
    loss = passing.to_canonical(deformer, points, directions, vertices)[0].sum()
    middle = passing.to_canonical(deformer, points, directions)
    assert all(map(torch.equal, middle, deformer.to_canonical(points, directions)))
    loss.backward()  # in the pose of its own, behind another one
    again = tensor(BOX.stretch(1.2).vertices, grad=True)
    passing.to_canonical(deformer, points, directions, again)[0].sum().backward()
    torch.testing.assert_close(vertices.grad, again.grad, rtol=1e-4, atol=1e-4)
    assert deformer.deformed is before


def test_what_has_no_gradient_is_refused(device):
    points, directions = spread(device, 4)
    field = shiny_field(device)
    for edits, options in (([BOX, BOX], {}), (CageEdit(BOX, remove=True), {}), (BOX, {"resolution": None})):
        deformer = Deformer(field, edits, coordinates="mean_value", **{"resolution": 16, **options})
        refused(lambda deformer=deformer: passing.to_canonical(deformer, points, directions), "one edit")
    refused(lambda: passing.to_canonical(field, points, directions), "a Deformer, got VoxelField")
    deformer, camera = bent_deformer("mean_value", device, 16), view(size=8)
    refused(lambda: passing.render(deformer, camera, camera_change=torch.zeros(6)), "(7,)")
    around = Deformer(surrounded_ball(device), BOX, coordinates="mean_value", resolution=16)
    refused(lambda: passing.render(around, camera), "surroundings", "colour")
    refused(lambda: passing.render(deformer, camera, camera_change=torch.full((7,), math.nan)), "must be finite, got")
    refused(lambda: passing.render(deformer, camera, BOX), "vertices must be a tensor of real numbers, got Cage")
    refused(
        lambda: passing.deform_points(points.numpy(force=True), BOX, BENT), "points must be a tensor", "got ndarray"
    )
    refused(
        lambda: passing.deform_points(points, BOX, BENT.vertices), "deformed, where it is no Cage, must be a tensor"
    )
    refused(lambda: passing.deform_points(points + 1j, BOX, BENT), "got torch.complex64")
    refused(lambda: passing.mean_value_coordinates(points, points), "the cage must be a Cage, got Tensor")
    refused(
        lambda: torch.func.jvp(lambda x: passing.deform_points(x, BOX, BENT), (points,), (points,)),
        "jvp",
        error=TypeError,
    )
    posed = points.clone().requires_grad_()
    refused(lambda: warpcage.deform_points(posed, BOX, BENT), "warpcage.torch", "deform_points", "detach")


def test_an_object_that_is_gone_is_told(device):
    from warpcage.interop import number_of, object_of

    cage = Cage.box([0, 0, 0], [1, 1, 1])
    number = number_of(cage, Cage, "")
    assert object_of(number, Cage) is cage and number_of(cage, Cage, "") == number
    refused(lambda: object_of(number, Deformer), "Deformer", error=RuntimeError)
    del cage
    gc.collect()
    refused(lambda: object_of(number, Cage), "no longer there", error=RuntimeError)
