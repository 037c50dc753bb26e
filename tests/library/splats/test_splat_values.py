"""What files of splats mean: activated values, the filter of Mip-Splatting, rows and whole fields that are none."""

import warnings

import numpy as np
import pytest
import splat_scenes
from refusals import refused
from splat_scenes import DATA, field_of, needs_data, ring, true_field

import warpcage
from warpcage.splats import SplatContents

NAMES = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
NAMES += ["rot_0", "rot_1", "rot_2", "rot_3"]


def write_ply(path, columns):
    """A .ply file with a property for each of the columns, in their order."""
    count = len(next(iter(columns.values())))
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    lines += [f"property float {name}" for name in columns] + ["end_header", ""]
    rows = np.stack([np.asarray(values, "<f4") for values in columns.values()], axis=1)
    path.write_bytes("\n".join(lines).encode() + rows.tobytes())
    return path


def some_columns(count=40, seed=0):
    rng = np.random.default_rng(seed)
    columns = {name: rng.normal(size=count) for name in NAMES}
    columns["opacity"] = rng.uniform(-4.0, 4.0, count)
    return columns | {f"scale_{k}": rng.uniform(-5.0, -1.0, count) for k in range(3)}


def loaded(path, **options):
    """The field of a file, which must be read without a warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return splat_scenes.loaded(path, **options)


def warned(path, message):
    """The field of a file, which must be read with one warning, of one line."""
    with pytest.warns(UserWarning, match=message) as said:
        field = splat_scenes.loaded(path)
    assert len(said) == 1 and "\n" not in str(said[0].message)
    return field


def require_same_again(field, path):
    """What is written has the same logarithms and logits, which all programs read."""
    field.save(path)
    again = loaded(path)
    for name in ("log_scales", "logits"):
        np.testing.assert_array_equal(getattr(again.contents, name), getattr(field.contents, name))
    return again


def activated(columns):
    """The same splats with scales and opacities in place of logarithms and logits."""
    scales = {f"scale_{k}": np.exp(columns[f"scale_{k}"]) for k in range(3)}
    return columns | scales | {"opacity": 1.0 / (1.0 + np.exp(-columns["opacity"]))}


def test_activated_values_are_found_and_said(tmp_path):
    columns = some_columns()
    plain = loaded(write_ply(tmp_path / "plain.ply", columns))
    path = write_ply(tmp_path / "activated.ply", activated(columns))
    field = warned(path, "activated.ply: no .* activated=False")
    np.testing.assert_allclose(field.scales, plain.scales, rtol=1e-6)
    np.testing.assert_allclose(field.opacities, plain.opacities, rtol=1e-6)
    require_same_again(field, tmp_path / "again.ply")


def test_activated_overrules_what_ranges_tell(tmp_path):
    columns = some_columns()
    path = write_ply(tmp_path / "activated.ply", activated(columns))
    np.testing.assert_allclose(loaded(path, activated=True).opacities, activated(columns)["opacity"], rtol=1e-6)
    raw = loaded(path, activated=False).contents
    np.testing.assert_array_equal(raw.logits, activated(columns)["opacity"].astype(np.float32))
    plain = write_ply(tmp_path / "plain.ply", columns)
    np.testing.assert_array_equal(loaded(plain).contents.logits, columns["opacity"].astype(np.float32))
    refused(lambda: loaded(path, activated="yes"), match="activated must be true or false")
    loaded(plain).save(tmp_path / "a.splat")
    refused(lambda: loaded(tmp_path / "a.splat", activated=True), match="a.splat: .* not read with activated")


def test_activated_values_are_found_with_zeros_and_rounded_ones(tmp_path):
    columns = activated(some_columns())
    columns["opacity"][:3] = 0.0, 1.0, np.nextafter(np.float32(1.0), np.float32(2.0))
    columns["scale_1"][5] = 0.0  # which is no splat
    path = write_ply(tmp_path / "activated.ply", columns)
    with pytest.warns(UserWarning) as said:
        field = splat_scenes.loaded(path)
    parts = zip(("activated=False", "1 of 40"), said, strict=True)
    assert all(part in str(each.message) for part, each in parts)
    np.testing.assert_array_equal(field.opacities[:3], [0.0, 1.0, 1.0])
    columns = activated(some_columns()) | {"opacity": np.where(np.arange(40) == 3, 1.0, 0.5)}
    field = loaded(write_ply(tmp_path / "activated.ply", columns), activated=True)
    assert field.opacities[3] == 1.0 and np.isposinf(field.contents.logits[3])


@pytest.mark.parametrize("kind", ["opacity", "scale"])
def test_one_kind_of_activated_values_is_found_alone(kind, tmp_path):
    columns = some_columns(400)
    changed = {name: values for name, values in activated(columns).items() if name.startswith(kind)}
    path = write_ply(tmp_path / "half.ply", columns | changed)
    field = warned(path, "half.ply: no .* activated=False").contents
    plain = loaded(write_ply(tmp_path / "plain.ply", columns)).contents
    np.testing.assert_allclose(field.logits, plain.logits, atol=1e-4)
    np.testing.assert_allclose(field.log_scales, plain.log_scales, atol=1e-5)
    raw = loaded(path, activated=False).contents
    np.testing.assert_array_equal(raw.logits, (columns | changed)["opacity"].astype(np.float32))
    np.testing.assert_array_equal(raw.log_scales[:, 1], (columns | changed)["scale_1"].astype(np.float32))


@pytest.fixture(scope="module")
def fitted():
    """Values after a few steps of a fit."""
    field, shown = true_field("cpu"), ring(6, 20)
    pictures = [field.render(camera).rgb for camera in shown]
    return warpcage.fit_splats(field, shown, pictures, steps=4, progress=False).contents


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3, 1e6])
def test_fitted_files_are_never_taken_for_activated(size, fitted, tmp_path):
    """In worlds of any size, from micrometres to maps: what a fit makes has logits of both signs."""
    rng = np.random.default_rng(0)
    columns = {name: fitted.centers[:, k] * size for k, name in enumerate("xyz")}
    columns |= {name: np.zeros(len(fitted.centers)) for name in NAMES[3:6]} | {"opacity": fitted.logits}
    columns |= {f"scale_{k}": fitted.log_scales[:, k] + np.log(size) for k in range(3)}
    columns |= {f"rot_{k}": rng.normal(size=len(fitted.centers)) for k in range(4)}
    field = loaded(write_ply(tmp_path / "fitted.ply", columns))
    np.testing.assert_array_equal(field.contents.logits, fitted.logits)


@needs_data
def test_given_files_are_never_taken_for_activated():
    for name in ("biker.compressed.ply", "small_degree3.ply"):
        loaded(DATA / name)


@pytest.mark.parametrize("kind", ["unit splats", "large splats", "one value"])
def test_splats_made_by_hand_are_logarithms(kind, tmp_path):
    """Logits of 0 are not opacities of 0; logits that leave 0 to 1 are none either."""
    columns = {name: np.zeros(5) for name in NAMES} | {"x": np.arange(5.0), "rot_0": np.ones(5)}
    if kind == "large splats":
        columns |= {f"scale_{k}": np.full(5, 2.0) for k in range(3)} | {"opacity": np.linspace(-1, 3, 5)}
    if kind == "one value":
        columns["x"] = np.zeros(5)
    field = loaded(write_ply(tmp_path / "handmade.ply", columns))
    np.testing.assert_array_equal(field.contents.log_scales[:, 0], columns["scale_0"].astype(np.float32))
    np.testing.assert_array_equal(field.contents.logits, columns["opacity"].astype(np.float32))


@pytest.mark.parametrize("of_activated", [False, True])
def test_the_filter_of_mip_splatting_is_applied(of_activated, tmp_path):
    """s' = sqrt(s^2 + f^2), o' = o sqrt(prod s^2 / prod s'^2); what is written has no filter."""
    columns = some_columns()
    width = np.random.default_rng(1).uniform(0.0, 0.3, 40)
    width[:2] = 0.0
    held = activated(columns) if of_activated else columns
    path = write_ply(tmp_path / "mip.ply", held | {"filter_3D": width})
    field = loaded(path, activated=of_activated)
    scales = np.stack([np.exp(columns[f"scale_{k}"]) for k in range(3)], axis=1)
    wide = np.sqrt(scales**2 + width[:, None] ** 2)
    opacities = activated(columns)["opacity"] * np.sqrt((scales**2).prod(axis=1) / (wide**2).prod(axis=1))
    np.testing.assert_allclose(field.scales, wide, rtol=2e-6)
    np.testing.assert_allclose(field.opacities, opacities, rtol=2e-6)
    if not of_activated:
        assert field.contents.logits[0] == np.float32(columns["opacity"][0])  # no width: its bits
    again = require_same_again(field, tmp_path / "plain.ply")
    assert b"filter_3D" not in (tmp_path / "plain.ply").read_bytes()
    again.save(tmp_path / "twice.ply")
    assert (tmp_path / "twice.ply").read_bytes() == (tmp_path / "plain.ply").read_bytes()


def test_the_filter_leaves_other_foreign_values_as_they_are(tmp_path):
    columns = {"label": np.arange(40.0), **some_columns(), "filter_3D": np.full(40, 0.1), "beta": -np.arange(40.0)}
    field = loaded(write_ply(tmp_path / "mip.ply", columns))
    assert field.antialias  # such files are drawn as they were fitted
    names = field.contents.layout.table.dtype.names
    assert names == ("label", *NAMES, "beta")
    field.save(tmp_path / "again.ply")
    np.testing.assert_array_equal(loaded(tmp_path / "again.ply").contents.layout.table["beta"], -np.arange(40.0))


def test_a_few_bad_rows_are_left_out_and_counted(tmp_path):
    columns = some_columns() | {"label": np.arange(40.0)}
    columns["x"][3], columns["rot_2"][7], columns["scale_1"][9] = np.nan, np.inf, -np.inf
    columns["opacity"][5], columns["opacity"][6] = np.inf, -np.inf
    path = write_ply(tmp_path / "bad.ply", columns)
    field = warned(path, "bad.ply: 3 of 40 .* first is splat 3")
    assert field.splat_count == 37
    assert field.opacities[4] == 1.0 and field.opacities[5] == 0.0  # opaque, and not seen
    good = np.delete(np.arange(40), [3, 7, 9])
    np.testing.assert_array_equal(field.contents.centers[:, 0], columns["x"][good].astype(np.float32))
    field.save(tmp_path / "good.ply")
    again = loaded(tmp_path / "good.ply")
    np.testing.assert_array_equal(again.contents.layout.table["label"], good)


@pytest.mark.parametrize(
    "count, bad, kept",
    [(40, 10, True), (40, 11, False), (2000, 20, True), (2000, 21, False), (4, 2, True), (4, 3, False)],
)
def test_how_many_rows_are_a_few(count, bad, kept, tmp_path):
    """Ten, or one of a hundred where that is more, and no more than half of a file."""
    columns = some_columns(count)
    columns["y"][1 : 1 + bad] = np.nan
    path = write_ply(tmp_path / "bad.ply", columns)
    if kept:
        assert warned(path, f": {bad} of {count} splats are left out").splat_count == count - bad
    else:
        refused(lambda: loaded(path), match=f"splat 1 has .*: {bad} of {count} are such")


def test_fields_without_rotation_are_written_with_one(tmp_path):
    """A field may have quaternions of length zero; other programs divide by the length."""
    zeros = [np.zeros(shape, np.float32) for shape in ((3, 3), (3, 4), 3, (3, 1, 3))]
    field_of(SplatContents(np.eye(3, dtype=np.float32), *zeros)).save(tmp_path / "a.ply")
    again = loaded(tmp_path / "a.ply").contents
    np.testing.assert_array_equal(again.quaternions, np.repeat([[1.0, 0, 0, 0]], 3, axis=0))
    np.testing.assert_array_equal(again.centers, np.eye(3))


def test_scales_of_zero_are_left_out(tmp_path):
    rows = np.zeros(4, [("place", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("turn", "u1", 4)])
    rows["scale"], rows["color"], rows["turn"] = 0.1, 200, [255, 128, 128, 128]
    rows["place"][:, 0] = range(4)
    rows["scale"][2, 1] = 0.0
    (tmp_path / "a.splat").write_bytes(rows.tobytes())
    field = warned(tmp_path / "a.splat", "1 of 4 splats is left out")
    np.testing.assert_array_equal(field.contents.centers[:, 0], [0.0, 1.0, 3.0])


def test_a_few_rows_of_zeros_are_left_out(tmp_path):
    columns = {name: np.where(np.arange(40) == 7, 0.0, values) for name, values in some_columns().items()}
    path = write_ply(tmp_path / "a.ply", columns)
    assert len(warned(path, "1 of 40 splats .* is splat 7$")) == 39


BROKEN = {
    "the end was never filled": (
        lambda c: {name: np.where(np.arange(40) < 20, values, 0.0) for name, values in c.items()},
        "20 of its 40 splats are zero",
    ),
    "all rows zero": (lambda c: {name: np.zeros(40) for name in c}, "its 40 splats are zero"),
    "one row of zeros": (lambda c: {name: np.zeros(1) for name in c}, "its 1 splat are zero"),
    "no rotation": (lambda c: c | {f"rot_{k}": np.zeros(40) for k in range(4)}, "all its 40 quaternions are of"),
    "no scales": (lambda c: c | {f"scale_{k}": np.full(40, -np.inf) for k in range(3)}, "scales of its 40 splats are"),
    "no scale along an axis": (lambda c: c | {"scale_2": np.full(40, -np.inf)}, "scales of its 40 splats are zero"),
    "one row again and again": (
        lambda c: {name: np.full(40, values[0]) for name, values in c.items()},
        "all its 40 splats are at one place",
    ),
    "one place": (lambda c: c | {name: np.full(40, 3.0) for name in "xyz"}, "all its 40 splats are at one place"),
    "no number": (lambda c: c | {"x": np.full(40, np.nan)}, "splat 0 has centers .*: 40 of 40 are"),
    "many rows not finite": (
        lambda c: c | {"x": np.where(np.arange(40) < 11, c["x"], np.inf)},
        "splat 11 has .*: 29 of 40 are such",
    ),
}


@pytest.mark.parametrize("name", list(BROKEN))
def test_fields_that_no_program_meant_to_write_are_refused(name, tmp_path):
    change, message = BROKEN[name]
    path = write_ply(tmp_path / "broken.ply", change(some_columns()))
    refused(lambda: loaded(path), "broken.ply", match=message)


def test_some_splats_without_rotation_are_not_turned(tmp_path):
    columns = some_columns()
    for k in range(4):
        columns[f"rot_{k}"][:39] = 0.0
    field = loaded(write_ply(tmp_path / "most.ply", columns))
    np.testing.assert_array_equal(field.rotations[0], np.eye(3))
