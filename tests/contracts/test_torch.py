"""Another renderer's arrays: torch through DLPack. torch is no dependency; without it these tests are skipped."""

import numpy as np
import pytest
from fields import BOX, KINDS, rotation, shiny_field, view

from warpcage import Deformer
from warpcage.core import as_points

torch = pytest.importorskip("torch", reason="torch is not installed: pip install torch==2.13.0")


def tensors(device, count=400):
    if device != "cpu" and not torch.cuda.is_available():
        pytest.skip("this torch has no CUDA")
    random = np.random.default_rng(0)
    points = torch.from_numpy(random.uniform(-1.2, 1.2, (count, 3)).astype(np.float32)).to(device)
    directions = torch.from_numpy(random.normal(size=(count, 3)).astype(np.float32)).to(device)
    return points, torch.nn.functional.normalize(directions, dim=1)


def test_tensors_are_read_where_they_lie(device):
    points, _ = tensors(device)
    array = as_points(points)
    assert array.ptr == points.data_ptr() and str(array.device) == device
    with torch.no_grad():
        array = as_points(points.requires_grad_(True))
    assert array.ptr == points.data_ptr()


@pytest.mark.parametrize("kind", KINDS)
def test_to_canonical_takes_tensors_and_gives_tensors(kind, device):
    points, directions = tensors(device)
    pose = BOX.bend(50, axis="x", towards="z")
    deformer = Deformer(shiny_field(device), BOX, coordinates=kind, resolution=32).pose(pose)
    expected = deformer.to_canonical(points.cpu().numpy(), directions.cpu().numpy())
    tensors_back = deformer.to_canonical(points, directions)
    for tensor, reference in zip(tensors_back, expected, strict=True):
        assert tensor.device == points.device and tensor.shape == reference.shape
        np.testing.assert_allclose(tensor.cpu().numpy(), reference, atol=2e-6)
    assert (expected[2] == 2).sum() > 30


def test_a_torch_renderer_sees_the_turned_field(device):
    """Density along rays by a formula in torch, through a turned cage: as the formula, asked along turned rays."""
    turn = rotation(35, 20)
    deformer = Deformer(shiny_field(device), BOX, coordinates="mean_value", resolution=32)
    deformer.pose(BOX.with_vertices(BOX.vertices @ turn.T))

    def density(x):
        return torch.clamp(0.35 - (x * torch.tensor([1.0, 1.5, 2.0], device=x.device)).norm(dim=1), min=0.0)

    points, directions = tensors(device, 4000)
    points = 0.6 * points
    mapped, along, region = deformer.to_canonical(points, directions)
    seen = torch.where(region == 1, 0.0, density(mapped))
    matrix = torch.tensor(turn, dtype=torch.float32, device=points.device)
    torch.testing.assert_close(seen, density(points @ matrix), atol=1e-5, rtol=0)
    inside = region == 2
    assert inside.sum() > 200 and (seen > 0.01).sum() > 50
    error = (along - directions @ matrix)[inside].norm(dim=1)
    assert error.mean() < 1e-3


def test_frames_are_tensors_over_the_memory_that_kernels_wrote(device):
    """Of all views at once, from poses that are tensors too; `torch.from_dlpack` does as well."""
    points, _ = tensors(device, count=1)
    deformer = Deformer(shiny_field(device), BOX, coordinates="mean_value", resolution=16)
    poses = torch.stack([torch.from_numpy(BOX.bend(angle).vertices.copy()) for angle in (0, 20, 40)]).to(device)
    options = {"outputs": ["canonical", "flow", "instance"], "flow_poses": poses.flip(0)}
    frames = deformer.render_poses(poses, view(size=16), **options)
    found = frames.arrays_like(points)
    assert [tuple(found[name].shape) for name in ("rgb", "alpha", "flow")] == [
        (3, 16, 16, 3),
        (3, 16, 16),
        (3, 16, 16, 2),
    ]
    assert found["instance"].dtype == torch.int32 and str(found["rgb"].device) == device
    for name, tensor in found.items():
        assert tensor.data_ptr() == frames.arrays[name].ptr == frames[0].arrays[name].ptr
        assert torch.from_dlpack(frames.arrays[name]).data_ptr() == tensor.data_ptr()
        np.testing.assert_array_equal(tensor.cpu().numpy(), getattr(frames, name))
    tiny = frames.arrays_like(np.zeros(1))
    assert isinstance(tiny["depth"], np.ndarray) and tiny["depth"].shape == (3, 16, 16)


def test_frames_wait_for_the_stream_that_asks():
    """Kernels run on Warp's stream, and what torch does next on its own waits for them."""
    if not torch.cuda.is_available():
        pytest.skip("this torch has no CUDA")
    deformer = Deformer(shiny_field("cuda:0"), BOX, coordinates="mean_value", resolution=16).pose(BOX.bend(20))
    expected = deformer.render(view(size=64)).rgb.mean()
    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        mean = torch.from_dlpack(deformer.render([view(size=64)] * 8).arrays["rgb"]).mean(dim=(1, 2, 3))
    stream.synchronize()
    np.testing.assert_allclose(mean.cpu().numpy(), expected, rtol=1e-5)
