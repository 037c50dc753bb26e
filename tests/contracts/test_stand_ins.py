"""What stands in place of a file, a pointer of Git LFS or git-annex or a web page, is called that by all readers."""

import pytest
from fields import shiny_field
from runs import write_files
from scene_writers import brick_pictures, write_blender, write_colmap

from warpcage import Cage, Camera, CameraFile, NodeSelection, PoseFile, SplatField, VoxelField, capture, load_scene
from warpcage.captures import scan_video
from warpcage.cli import main
from warpcage.core import NpyFile
from warpcage.view import read_exr, read_image

POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"4d7a2146" * 8 + b"\nsize 123456\n"
PAGE = b"\xef\xbb\xbf\n<!DOCTYPE html>\n<html lang='en'><head><title>lego.npz at main</title></head></html>\n"

WEB = "is a web page, not the file itself"

#: Contents, and what a message calls them.
STAND_INS = {
    "lfs": (POINTER, "is a Git LFS pointer, not the file itself: fetch it with `git lfs pull`"),
    "annex": (b"/annex/objects/MD5E-s100--d41d8cd98f00b204e9800998ecf8427e.npz\n", "is a git-annex pointer"),
    "page": (PAGE, WEB),
    "xhtml": (b'<?xml version="1.0"?>\n<!DOCTYPE html PUBLIC "x">\n<html></html>', WEB),
    "comment": (b"<!-- saved from a site -->\n<HTML><BODY>404</BODY></HTML>", WEB),
}
LFS = STAND_INS["lfs"][1]

READERS = [
    ("field.npz", VoxelField.load),
    ("chosen.npz", lambda path: NodeSelection.load(path, shiny_field("cpu"))),
    *((f"cage{ending}", Cage.load) for ending in (".obj", ".ply", ".off", ".glb", ".gltf")),
    *((f"splats{ending}", SplatField.load) for ending in (".ply", ".compressed.ply", ".splat", ".spz")),
    ("poses.json", PoseFile.load),
    ("poses.npy", NpyFile),
    ("cameras.json", CameraFile.load),
    ("camera.glb", Camera.load),
    *((f"picture{ending}", read_image) for ending in (".png", ".jpg", ".webp")),
    ("picture.exr", read_exr),
    ("video.mp4", scan_video),
]


def refused(action, *words):
    with pytest.raises(ValueError) as caught:
        action()
    message = str(caught.value)
    assert "\n" not in message and all(word in message for word in words), message


@pytest.mark.parametrize("name, read", READERS, ids=[name for name, _ in READERS])
@pytest.mark.parametrize("kind", STAND_INS)
def test_readers_of_one_file(tmp_path, name, read, kind):
    content, said = STAND_INS[kind]
    (tmp_path / name).write_bytes(content)
    refused(lambda: read(tmp_path / name), said, name)


def test_files_that_only_speak_of_such_things_are_read(tmp_path):
    """The beginning decides."""
    path = tmp_path / "cage.obj"
    Cage.box((0, 0, 0), (1, 1, 1)).save(path)
    path.write_text("# <html> version https://git-lfs.github.com/spec/v1\n" + path.read_text())
    assert len(Cage.load(path).vertices) == 8


def test_files_inside_scenes(tmp_path):
    pictures = brick_pictures(3)
    write_blender(tmp_path / "blender", pictures)
    first = min((tmp_path / "blender").rglob("*.png"))
    first.write_bytes(POINTER)
    refused(lambda: load_scene(tmp_path / "blender"), LFS, first.name)
    (tmp_path / "blender" / "transforms_train.json").write_bytes(PAGE)
    refused(lambda: load_scene(tmp_path / "blender"), "is a web page", "transforms_train.json")
    write_colmap(tmp_path / "colmap", pictures, binary=True)
    for path in (tmp_path / "colmap").rglob("cameras.*"):
        path.write_bytes(POINTER)
    refused(lambda: load_scene(tmp_path / "colmap"), LFS, "cameras.")


def test_pictures_of_a_capture(tmp_path):
    for name in ("a.jpg", "b.jpg", "c.jpg"):
        (tmp_path / name).write_bytes(POINTER)
    refused(lambda: capture(tmp_path, tmp_path / "scene"), LFS, "a.jpg")


def test_buffers_beside_a_gltf_file(tmp_path):
    from warpcage.mesh.io.gltf import write_gltf

    cage = Cage.box((0, 0, 0), (1, 1, 1))
    text = write_gltf(cage.vertices, cage.faces).decode()
    start = text.index("data:application")
    (tmp_path / "cage.gltf").write_text(text[:start] + "cage.bin" + text[text.index('"', start) :])
    (tmp_path / "cage.bin").write_bytes(POINTER + bytes(1000))
    refused(lambda: Cage.load(tmp_path / "cage.gltf"), LFS, "cage.bin")


@pytest.mark.parametrize(
    "words",
    [
        ("render", "{0}.npz", "-o", "x.png"),
        ("info", "{0}.npz"),
        ("info", "{0}.ply"),
        ("info", "{0}.json"),
        ("check", "{0}.obj"),
        ("cage", "{0}.stl", "-o", "cage.obj"),
        ("render", "ball.npz", "--cage", "cage.obj", "--posed", "{0}.obj", "-o", "x.png"),
        ("render", "ball.npz", "--camera", "{0}.json", "-o", "x.png"),
        ("render", "ball.npz", "--edits", "{0}.json", "-o", "x.png"),
        ("run", "{0}.jsonl", "-o", "out"),
        ("capture", "{0}.mp4", "-o", "out"),
    ],
    ids=lambda words: " ".join(words[:2]),
)
def test_commands(tmp_path, monkeypatch, capsys, words):
    write_files(tmp_path)
    monkeypatch.chdir(tmp_path)
    name = next(word for word in words if "{0}" in word).format("pointer")
    (tmp_path / name).write_bytes(POINTER)
    assert main([word.format("pointer") for word in words]) != 0
    said = capsys.readouterr().err
    assert LFS in said and name in said and "Traceback" not in said
