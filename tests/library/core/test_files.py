"""Outputs appear whole, with the permissions of what they replace, through links, and under long names."""

import os
import stat
import zlib

import numpy as np
import pytest
from refusals import refused

from warpcage.core import atomic_path, joined_crc, npz, read_npz
from warpcage.field.io import field_file


def write(path, text="new"):
    with atomic_path(path) as temporary:
        temporary.write_text(text)


def permissions(path):
    return stat.S_IMODE(path.stat().st_mode)


@pytest.fixture
def umask():
    """Sets the umask of the process for one test."""
    before = os.umask(0o022)
    yield os.umask
    os.umask(before)


@pytest.mark.parametrize("mask", [0o022, 0o027, 0o077, 0o000])
def test_a_new_file_is_as_open_as_any_and_the_umask_is_never_touched(tmp_path, umask, monkeypatch, mask):
    umask(mask)
    (tmp_path / "ordinary").write_text("")

    def touched(mask):
        raise AssertionError("files of other threads would get this umask")

    with monkeypatch.context() as patch:
        patch.setattr("os.umask", touched)
        write(tmp_path / "new.txt")
    assert permissions(tmp_path / "new.txt") == permissions(tmp_path / "ordinary") == 0o666 & ~mask


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o664, 0o755, 0o444])
def test_a_file_passes_on_its_permissions_and_nobody_else_reads_meanwhile(tmp_path, umask, mode):
    path = tmp_path / "private.txt"
    path.write_text("old")
    path.chmod(mode)
    with atomic_path(path) as temporary:
        assert permissions(temporary) & ~0o600 & ~mode == 0
        temporary.write_text("new")
    assert path.read_text() == "new" and permissions(path) == mode


@pytest.mark.parametrize("there", [True, False], ids=["target", "no target yet"])
def test_a_link_stays_a_link(tmp_path, there):
    far = tmp_path / "far" / "target.dat"
    far.parent.mkdir()
    (tmp_path / "near").mkdir()
    if there:
        far.write_text("old")
    (tmp_path / "near" / "middle").symlink_to("../far/target.dat")
    link = tmp_path / "near" / "link.txt"
    link.symlink_to("middle")
    with atomic_path(link) as temporary:
        assert temporary.parent == far.parent and temporary.suffix == ".txt"
        temporary.write_text("new")
    assert link.is_symlink() and (tmp_path / "near" / "middle").is_symlink()
    assert far.read_text() == "new" and not far.is_symlink()
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["far", "link.txt", "middle", "near", "target.dat"]

    with pytest.raises(ZeroDivisionError), atomic_path(link) as temporary:
        temporary.write_text("half")
        raise ZeroDivisionError
    assert far.read_text() == "new" and len(list(far.parent.iterdir())) == 1


@pytest.mark.parametrize("name", ["a" * 245 + ".png", "a" * 251 + ".png", "ü" * 125 + ".json", "a" * 255])
def test_names_as_long_as_the_file_system_takes(tmp_path, name):
    write(tmp_path / name, "old")
    write(tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == [name] and (tmp_path / name).read_text() == "new"


def test_what_cannot_be_written_is_named_and_nothing_is_left(tmp_path):
    (tmp_path / "file").write_text("old")
    (tmp_path / "loop").symlink_to("loop")
    for path in (tmp_path / ("a" * 256), tmp_path / "loop"):
        with pytest.raises(OSError) as error:
            write(path)
        assert error.value.filename == str(path)
    refused(lambda: write(tmp_path / "file" / "below.txt"), error=OSError)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "loop"]
    assert (tmp_path / "file").read_text() == "old"


def test_large_arrays_are_read_in_parts_and_their_checksum_is_compared(tmp_path, monkeypatch):
    monkeypatch.setattr(npz, "CHUNK", 1000)
    random, path = np.random.default_rng(0), tmp_path / "large.npz"
    arrays = {"a": random.random((77, 31)), "b": random.integers(0, 255, 5001, np.uint8), "c": np.arange(3)}
    arrays["columns"] = np.asfortranarray(arrays["a"])
    np.savez(path, **arrays)
    read = read_npz(path, "field file")
    assert all(np.array_equal(read[name], array) and read[name].dtype == array.dtype for name, array in arrays.items())
    data = bytearray(path.read_bytes())
    place = data.find(arrays["b"].tobytes()) + 4321
    data[place] ^= 1
    path.write_bytes(data)
    refused(lambda: read_npz(path, "field file"), match="CRC")


@pytest.mark.parametrize("length", [0, 1, 7, 1000, 1 << 20])
def test_the_checksum_of_two_parts_is_that_of_both(length):
    random = np.random.default_rng(length)
    first, second = random.bytes(123), random.bytes(length)
    assert joined_crc(zlib.crc32(first), zlib.crc32(second), length) == zlib.crc32(first + second)


def test_arrays_of_fields_are_converted_numbered_and_looked_through_in_parts(monkeypatch):
    monkeypatch.setattr(field_file, "PART_NUMBERS", 100)
    random = np.random.default_rng(0)
    halves = random.normal(size=(301, 7)).astype(np.float16)
    assert np.array_equal(field_file.as_single(halves), halves.astype(np.float32))
    assert field_file.as_single(halves[:0]).shape == (0, 7) and field_file.are_finite(halves)
    halves[300, 6] = np.nan
    assert not field_file.are_finite(halves)
    occupied = random.random((13, 9, 5)) < 0.4
    expected = np.full(occupied.shape, -1)
    expected[occupied] = np.arange(occupied.sum())
    links = field_file.numbered(occupied)
    assert np.array_equal(links, expected) and links.dtype == np.int32
