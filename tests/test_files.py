"""Outputs appear whole, with the permissions of what they replace, through links, and under long names."""

import os
import stat

import pytest

from warpcage.core.files import atomic_path


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
    with pytest.raises(OSError):
        write(tmp_path / "file" / "below.txt")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "loop"]
    assert (tmp_path / "file").read_text() == "old"
