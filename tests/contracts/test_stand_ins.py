"""What stands in place of a file, a pointer of Git LFS or git-annex or a web page, is called that by all readers."""

import pytest
from fields import shiny_field
from hostile import put, whole
from refusals import refused

from warpcage import Cage, Camera, CameraFile, NodeSelection, PoseFile, SplatField, VoxelField, capture, load_scene
from warpcage.core import NpyFile
from warpcage.studio.captures import scan_video
from warpcage.studio.cli import main
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


@pytest.mark.parametrize("name, read", READERS, ids=[name for name, _ in READERS])
def test_readers_of_one_file(tmp_path, name, read):
    for content, said in STAND_INS.values():
        (tmp_path / name).write_bytes(content)
        refused(lambda: read(tmp_path / name), said, name)


def test_files_that_only_speak_of_such_objects_are_read(tmp_path):
    """The beginning decides."""
    path = tmp_path / "cage.obj"
    Cage.box((0, 0, 0), (1, 1, 1)).save(path)
    path.write_text("# <html> version https://git-lfs.github.com/spec/v1\n" + path.read_text())
    assert len(Cage.load(path).vertices) == 8


def test_files_inside_scenes(tmp_path):
    blender, colmap = put(tmp_path / "blender", whole("blender")), put(tmp_path / "colmap", whole("colmap binary"))
    put(blender, {"train/view_00.png": POINTER})
    refused(lambda: load_scene(blender), LFS, "view_00.png")
    put(blender, {"transforms_train.json": PAGE})
    refused(lambda: load_scene(blender), WEB, "transforms_train.json")
    put(colmap, {"sparse/0/cameras.bin": POINTER})
    refused(lambda: load_scene(colmap), LFS, "cameras.")


def test_pictures_of_a_capture(tmp_path):
    put(tmp_path, dict.fromkeys(("a.jpg", "b.jpg", "c.jpg"), POINTER))
    refused(lambda: capture(tmp_path, tmp_path / "scene"), LFS, "a.jpg")


def test_buffers_beside_a_gltf_file(tmp_path):
    text = whole("cage.gltf")["cage.gltf"].decode()
    start = text.index("data:application")
    text = text[:start] + "cage.bin" + text[text.index('"', start) :]
    put(tmp_path, {"cage.gltf": text, "cage.bin": POINTER + bytes(1000)})
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
def test_commands(files, monkeypatch, capsys, words):
    monkeypatch.chdir(files)
    name = next(word for word in words if "{0}" in word).format("pointer")
    (files / name).write_bytes(POINTER)
    assert main([word.format("pointer") for word in words]) != 0
    said = capsys.readouterr().err
    assert LFS in said and name in said and "Traceback" not in said
