"""The editor with Gaussian splats: pictures of poses, checks, and what is exported."""

import dataclasses

import numpy as np
import pytest

pytest.importorskip("aiohttp")
pytest.importorskip("simplejpeg")

from editor_pages import BOX, nothing_logged, with_pages  # noqa: F401
from splat_scenes import ball_of_splats

import warpcage
from warpcage.splats import field_size, load_field
from warpcage.studio.editor import Session, export_baked, inspect, new_document


@pytest.fixture(scope="module")
def splats():
    return ball_of_splats()


def posed_document(field, cage):
    document = new_document(field, [BOX], 16)
    edit = dataclasses.replace(document.edits[0], posed=cage.vertices)
    return dataclasses.replace(document, edits=(edit,))


def test_pages_see_splats_move(splats, tmp_path):
    session = Session(splats, new_document(splats, [BOX], 16), None)

    async def test(server, page):
        await page.until(lambda: page.frames)
        assert page.sections["session"]["field"]["splats"] == 400
        await page.ask(do="pose.set", edit=1, vertices=(BOX.vertices + (0, 0, 0.3)).tolist())
        await page.until(lambda: page.frames[-1]["sharp"] and len(page.frames) > 1)
        assert all(frame["error"] is None for frame in page.frames)

    with_pages(test, tmp_path, session=session)


def test_cages_of_splats_are_checked(splats):
    held = inspect(new_document(splats, [BOX], 16), 1, splats)
    assert held["inside_share"] == 1.0 and held["leaking_faces"] == []
    half = BOX.with_vertices(BOX.vertices * (1, 1, 0.5) + (0, 0, 0.35))
    cut = inspect(new_document(splats, [half], 16), 1, splats)
    assert 0.2 < cut["inside_share"] < 0.8 and cut["leaking_faces"]


def test_baked_splats_are_splats(splats, tmp_path):
    document, reports = posed_document(splats, BOX.rotate(90, axis="z")), []
    baked = export_baked(document, splats, tmp_path / "bent.ply", lambda _, text: reports.append(text))
    again = load_field(tmp_path / "bent.ply")
    assert field_size(baked) == "400 splats" and "400 splats" in reports[-1] and len(again) == 400
    expected = splats.contents.centers @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    assert np.abs(again.contents.centers - expected).max() < 1e-3
    with pytest.raises(ValueError, match=r"\.ply"):
        export_baked(document, splats, tmp_path / "bent.npz")


def test_a_file_of_splats_is_opened(splats, tmp_path):
    splats.save(tmp_path / "ball.ply")
    with warpcage.edit(tmp_path / "ball.ply", BOX) as editor:
        assert len(editor.posed) == 1 and (tmp_path / "ball.session.json").name in str(editor.session_path or "")
