"""Fields and cameras that do not belong together are said; splats in nerfstudio's frame are taken out of it."""

import dataclasses
import json
import warnings

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from splat_scenes import ring, scene_of, true_field

import warpcage
from warpcage import SplatField
from warpcage.render.belonging import SceneViews, mismatch
from warpcage.scene.formats.transforms import read_frame
from warpcage.studio.cli import main

#: What nerfstudio's loader did to a dataset: the axes of its transforms.json, then its own turn, middle and scale.
APPLIED = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0.5], [0, 0, 0, 1]])
OWN, SCALE = np.eye(4), 0.23
OWN[:3, :3] = Rotation.from_euler("xyz", [25, -40, 70], degrees=True).as_matrix()
OWN[:3, 3] = -3.1, -1.6, -0.7


def exported(field):
    """Splats in nerfstudio's frame, by NumPy and SciPy alone; harmonics of degree 1 turn as a vector does."""
    held, turn = field.contents, OWN[:3, :3]
    vectors = np.stack([-held.harmonics[:, 3], -held.harmonics[:, 1], held.harmonics[:, 2]], axis=1)
    x, y, z = np.moveaxis(np.einsum("ab,nbc->nac", turn, vectors), 1, 0)
    harmonics = np.stack([held.harmonics[:, 0], -y, z, -x], axis=1)
    quaternions = (Rotation.from_matrix(turn) * Rotation.from_quat(held.quaternions[:, [1, 2, 3, 0]])).as_quat()
    centers = SCALE * (held.centers @ turn.T + OWN[:3, 3])
    return SplatField(
        centers, held.log_scales + np.log(SCALE), quaternions[:, [3, 0, 1, 2]], held.logits, harmonics, device="cpu"
    )


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A scene, the field that its pictures show, and the same as nerfstudio exports it; each in a folder of its own."""
    root = tmp_path_factory.mktemp("place")
    field = true_field("cpu", 120)
    scene = dataclasses.replace(scene_of(field, ring(9, 20)), to_source=np.linalg.inv(APPLIED))
    scene.save(root / "scene")
    for name, each in (("own", field), ("export", exported(field))):
        (root / name).mkdir()
        each.save(root / name / "splat.ply")
    content = {"transform": (OWN @ APPLIED)[:3].astype(np.float32).tolist(), "scale": SCALE}
    (root / "frame.json").write_text(json.dumps(content))
    return root


def evaluated(place, capsys, name, *options):
    main(["evaluate", str(place / name / "splat.ply"), str(place / "scene"), "--quiet", "--device", "cpu", *options])
    said = capsys.readouterr()
    return float(said.out.splitlines()[-1].split()[1]), said.err


def test_a_field_of_its_scene_is_left_in_peace(place, capsys):
    psnr, said = evaluated(place, capsys, "own")
    assert psnr > 40 and "belong" not in said


@pytest.mark.parametrize("where", ["--frame", "beside the field", "beside the scene"])
def test_splats_in_the_frame_of_nerfstudio(place, capsys, where):
    file, options = place / "frame.json", []
    if where == "--frame":
        options = ["--frame", str(file)]
    else:
        file = place / ("export" if where == "beside the field" else "scene") / "dataparser_transforms.json"
        file.write_text((place / "frame.json").read_text())
    try:
        psnr, said = evaluated(place, capsys, "export", *options)
    finally:
        if not options:
            file.unlink()
    own, _ = evaluated(place, capsys, "own")
    assert psnr == pytest.approx(own, abs=0.5)
    assert f"moved out of nerfstudio's coordinates by {file}: 4.348 times as large" in said and "belong" not in said


def test_without_the_file_it_is_said(place, capsys):
    psnr, said = evaluated(place, capsys, "export")
    assert psnr < 20 and said.count("\n") == 1
    assert "do not belong together" in said and "neither a turn by 90 degrees nor a scale explains it" in said
    assert "--frame dataparser_transforms.json" in said


def test_a_file_that_is_not_needed_changes_nothing(place, capsys):
    """A field that was fitted in the dataset's own frame, beside a file of another program's."""
    file = place / "scene" / "dataparser_transforms.json"
    file.write_text((place / "frame.json").read_text())
    psnr, said = evaluated(place, capsys, "own")
    file.unlink()
    assert psnr > 40 and "frame" not in said


@pytest.mark.parametrize("command", ["render", "animate", "info"])
def test_other_commands_say_it_too(place, tmp_path, capsys, command):
    argv = {
        "render": ["-o", str(tmp_path / "a.png"), "--camera", f"{place / 'scene'}:0"],
        "animate": ["-o", str(tmp_path / "film"), "--camera", f"{place / 'scene'}:0", "--frames", "1", "--quiet"],
        "info": ["--scene", str(place / "scene")],
    }[command]
    main([command, str(place / "export" / "splat.ply"), "--device", "cpu", *argv])
    assert "do not belong together" in capsys.readouterr().err
    argv = [word.replace("film", "second") for word in argv] + ["--frame", str(place / "frame.json")]
    main([command, str(place / "export" / "splat.ply"), "--device", "cpu", *argv])
    said = capsys.readouterr().err
    assert "moved out of nerfstudio's coordinates" in said and "belong together" not in said


def test_figures_in_python_and_in_job_files_warn_of_it(place, tmp_path):
    scene = warpcage.load_scene(place / "scene", split="all")
    with pytest.warns(UserWarning, match="do not belong together"):
        warpcage.evaluate(SplatField.load(place / "export" / "splat.ply", device="cpu"), scene)
    argv = {"id": "a", "kind": "evaluate", "field": f"{place / 'export' / 'splat.ply'}", "scene": f"{place / 'scene'}"}
    lines = [{"format": "warpcage jobs", "version": 1}, argv | {"split": "all", "output": "a.json"}]
    (tmp_path / "jobs.jsonl").write_text("\n".join(map(json.dumps, lines)))
    with pytest.warns(UserWarning, match="do not belong together"):
        warpcage.run_jobs(tmp_path / "jobs.jsonl", tmp_path / "out", device="cpu")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warpcage.evaluate(SplatField.load(place / "own" / "splat.ply", device="cpu"), scene)


def test_bake_writes_splats_where_the_dataset_is(place, tmp_path, capsys):
    """Before applied_transform, which the file is about: no scene says it here."""
    out = tmp_path / "moved.ply"
    main(["bake", str(place / "export" / "splat.ply"), "--frame", str(place / "frame.json"), "-o", str(out)])
    found, field = SplatField.load(out, device="cpu"), true_field("cpu", 120)
    back = np.linalg.inv(APPLIED)
    np.testing.assert_allclose(found.centers, field.centers @ back[:3, :3].T + back[:3, 3], atol=1e-5)
    np.testing.assert_allclose(found.scales, field.scales, rtol=1e-5)
    turned = np.einsum("ab,nbc,dc->nad", back[:3, :3], field.covariances, back[:3, :3])
    np.testing.assert_allclose(found.covariances, turned, atol=1e-6)


@pytest.mark.parametrize(
    ("turn", "scale", "argv"),
    [
        (Rotation.from_euler("x", -90, degrees=True), 1.0, "turning it by 90 degrees about x (y up in place of z up"),
        (Rotation.from_euler("z", 180, degrees=True), 1.0, "turning it by 180 degrees about z would explain"),
        (Rotation.identity(), 12.0, "scaling it by about 0.08"),
    ],
)
def test_what_would_explain_it_is_said(place, turn, scale, argv):
    field, scene = true_field("cpu", 120), warpcage.load_scene(place / "scene", split="all")
    held = field.contents
    quaternions = (turn * Rotation.from_quat(held.quaternions[:, [1, 2, 3, 0]])).as_quat()[:, [3, 0, 1, 2]]
    values = held.log_scales + np.log(scale), quaternions, held.logits, held.harmonics[:, :1]
    moved = SplatField(scale * turn.apply(held.centers), *values, device="cpu")
    found = mismatch(moved, SceneViews.of(scene))
    assert found is not None and not found.may_be_pose
    line = found.text
    assert line is not None and argv in line and "\n" not in line


def test_nothing_in_the_picture_is_said(place, tmp_path, capsys):
    out = str(tmp_path / "a.png")
    main(["render", str(place / "own" / "splat.ply"), "-o", out, "--eye", "9", "9", "9", "--target", "20", "20", "20"])
    assert "does not look at the field" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[1]", "must hold a JSON object"),
        ("{", "is not a JSON file"),
        ({"scale": 1}, "has no transform and scale"),
        ({"transform": 3, "scale": 1}, "transform must be a 4x4 matrix"),
        ({"transform": np.eye(4)[:3].tolist(), "scale": None}, "scale must be one finite number"),
        ({"transform": np.eye(4)[:3].tolist(), "scale": 0}, "scale must be positive"),
        ({"transform": np.eye(4)[:3].tolist(), "scale": 1e999}, "scale must be one finite number"),
        ({"transform": (2 * np.eye(4))[:3].tolist(), "scale": 1}, "must be a turn and a shift"),
        ({"transform": np.diag([1, 1, -1, 1.0])[:3].tolist(), "scale": 1}, "must be a turn and a shift"),
        ({"transform": np.zeros((3, 4)).tolist(), "scale": 1}, "must be a turn and a shift"),
        ({"transform": np.eye(4)[:3].tolist(), "scale": 1e-300}, "a scale of 1e-300 .* is not a frame's"),
        ({"transform": [[1, 0, 0, 1e308], [0, 1, 0, 0], [0, 0, 1, 0]], "scale": 1}, "a shift of .* is not a frame's"),
        ({"transform": [[1, 0, 0, "a"], [0, 1, 0, 0], [0, 0, 1, 0]], "scale": 1}, "must be one finite number"),
        ({"transform": np.diag([1, 1, 1, 2.0]).tolist(), "scale": 1}, "must be a turn and a shift"),
    ],
)
def test_files_of_frames_that_cannot_be_used(tmp_path, content, message):
    path = tmp_path / "dataparser_transforms.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(ValueError, match=message) as caught:
        read_frame(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)
