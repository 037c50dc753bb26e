"""Several pages of one editor: they see the same, vanish, come late, read nothing; films, checks, jobs."""

import asyncio
import gc
import os
import re
import threading

import numpy as np
import pytest

aiohttp = pytest.importorskip("aiohttp")
pytest.importorskip("hypothesis")

from editor_pages import BOX, WAIT, Page, new_session, on_pages, pages, with_pages
from editor_pages import nothing_logged as _nothing_logged  # noqa: F401 (a fixture for all tests)
from scenes import LAMP, TableScene

from warpcage import Cage
from warpcage.cage import UpAxis
from warpcage.select import visible_nodes
from warpcage.studio.editor import Document, Session, inspection, new_document, read_session, server, tasks, view_camera
from warpcage.studio.editor.web import clients

REST = BOX.vertices


# -- Several pages


@on_pages
async def test_pages_see_the_same_and_a_drag_of_one_moves_in_the_other(host, page, other, third):
    await page.send(do="drag.begin", edit=1, label="pull")
    await page.move(REST * 1.1)
    await other.until(lambda: np.array_equal(other.posed(), REST * 1.1))  # before it ends
    assert other.sections["history"]["undo"] == 0 and (2, 1) not in page.vertices
    await page.move(REST * 1.2)
    await page.do(do="drag.end", edit=1)
    await other.do(do="edit.change", id=1, name="Trunk")
    await third.drag(REST * 1.3, kind=3)
    await page.do(do="settings", background="black")
    for one in (page, other, third):
        await one.until(lambda: one.sections["settings"]["background"] == "black")  # noqa: B023
        np.testing.assert_array_equal(one.rest(), REST * 1.3)
        np.testing.assert_allclose(one.posed(), REST * 1.5)
    kept = [dict(one.sections) for one in (page, other, third)]
    assert kept[0] == kept[1] == kept[2] and kept[0]["edits"][0]["name"] == "Trunk"
    assert kept[0]["history"]["undo_label"] == "change background"


@on_pages
async def test_a_page_that_comes_later_sees_a_drag_under_way(host, page):
    await page.send(do="drag.begin", edit=1)
    await page.move(REST * 1.1)
    await page.until(lambda: page.frames and page.frames[-1]["applied"]["1"] == 1)
    async with pages(host) as (late,):
        np.testing.assert_array_equal(late.posed(), REST * 1.1)
        await late.until(lambda: late.frames)
        await page.move(REST * 1.2)
        await late.until(lambda: np.array_equal(late.posed(), REST * 1.2))


@on_pages
async def test_a_drag_that_another_page_ends_is_kept_and_said_once(host, page, other):
    await page.send(do="drag.begin", edit=1, label="pull")
    await page.move(REST * 1.1)
    await page.until(lambda: page.frames and page.frames[-1]["applied"]["1"] == 1)
    await other.do(do="select", edit=1, mode="face", vertices=[2])
    for factor in np.linspace(1.2, 2.0, 2 * clients.MAX_MISTAKES):
        await page.move(REST * factor)
    assert await page.refused(do="drag.end", edit=1) == server.STRAYED
    assert page.notices == [server.STRAYED] and other.notices == []
    labels = [label for label, _ in host.session.history.undo_steps]
    assert labels == ["pull", "select"]
    await page.until(lambda: np.array_equal(page.posed(), REST * 1.1))
    await page.drag(REST * 1.4)  # the next one works
    assert await page.do(do="undo") == "move"


@on_pages
async def test_gestures_out_of_order_are_refused_or_ignored(host, page, other):
    await page.move(REST * 3)
    assert await page.refused(do="drag.end", edit=1) == server.STRAYED
    assert await page.refused(do="drag.begin", edit=7)
    await page.do(do="drag.begin", edit=1)
    await other.move(REST * 4)  # not the one that began
    assert await other.refused(do="drag.end", edit=1) == server.STRAYED
    await page.move(REST * 5, edit=2)
    await page.move(REST[:-1])
    await page.move(REST * np.nan)
    await page.move(REST * 1e300)
    await page.until(lambda: len(page.notices) == 5)
    await page.do(do="drag.begin", edit=1)  # again, without an end
    await page.move(REST * 1.5)
    await page.do(do="drag.end", cancel=True)
    await page.do(do="preset.begin", edit=1, vertices=None)
    await page.refused(do="preset.set", preset="bend", amount=1e308)
    await page.do(do="preset.set", preset="stretch", amount=2, axis="z")
    await page.do(do="preset.end", cancel=False)
    assert [label for label, _ in host.session.history.undo_steps] == ["stretch"]
    await page.until(lambda: np.isclose(np.ptp(page.posed()[:, 2]), 2 * np.ptp(REST[:, 2])))


def test_pages_that_vanish_leave_nothing_and_lose_nothing(tmp_path):
    async def test(host, page):
        for number in range(10):
            await asyncio.sleep(0)
            socket = await page_socket(host)
            lost = Page(socket)
            await lost.until(lambda: lost.client is not None)  # noqa: B023
            await lost.send(do="size", width=30, height=20)
            await lost.send(do="view", eye=[3, number, 1], target=[0, 0, 0], up=[0, 0, 1], fov=40, moving=True)
            if number % 2:
                await lost.send(do="drag.begin", edit=1, label=f"pull {number}")
                await lost.move(REST * (1 + number / 10))
                await page.until(lambda: np.array_equal(page.posed(), REST * (1 + number / 10)))  # noqa: B023
            lost.reader.cancel()
            connection = socket._response.connection  # noqa: SLF001  (aiohttp has no public way to break one off)
            connection.transport.abort()  # as a browser that is killed
            await page.until(lambda: page.sections["session"]["pages"] == 1)
            connection.close()
            await page.until(
                lambda: np.array_equal(page.sections["edits"][0]["posed"], host.session.document.edits[0].posed)
            )
        assert next(iter(host.clients.values())).number == page.client and len(host.clients) == 1
        assert not host.session.moving and not host.lookers and host.connected == 1
        assert [label for label, _ in host.session.history.undo_steps] == [f"pull {k}" for k in (1, 3, 5, 7, 9)]
        await page.until(lambda: page.frames and page.frames[-1]["width"] == 24 and page.frames[-1]["sharp"])

    async def page_socket(host):
        http = aiohttp.ClientSession()
        opened.append(http)
        return await http.ws_connect(host.address + "socket")

    async def test_and_close(host, page):
        await test(host, page)
        await asyncio.gather(*(http.close() for http in opened))

    opened = []
    with_pages(test_and_close, tmp_path)


@on_pages
async def test_connections_that_end_before_the_first_word_leave_nothing(host, page):
    for _ in range(20):
        _reader, writer = await asyncio.open_connection("127.0.0.1", host.port)
        key = "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: " + "A" * 22
        writer.write(f"GET /{host.token}/socket HTTP/1.1\r\nHost: localhost\r\n{key}==\r\n\r\n".encode())
        writer.transport.abort()
    await page.refused(do="nothing")
    await page.until(lambda: len(host.clients) == host.connected == page.sections["session"]["pages"] == 1)


def test_no_more_pages_than_there_is_room_for(tmp_path, monkeypatch):
    monkeypatch.setattr(server, "MAX_PAGES", 3)

    async def test(host, *_):
        async with aiohttp.ClientSession() as http:
            connects = [http.ws_connect(host.address + "socket") for _ in range(5)]
            answers = await asyncio.gather(*connects, return_exceptions=True)
            sockets = [answer for answer in answers if isinstance(answer, aiohttp.ClientWebSocketResponse)]
            assert len(sockets) == 1 and all(a.status == 503 for a in answers if a not in sockets)
            await sockets[0].close()

    with_pages(test, tmp_path, 2)


def test_a_page_that_reads_nothing_is_not_listened_to_before_it_does(tmp_path, monkeypatch):
    monkeypatch.setattr(clients, "MESSAGE_BURST", 1e9)

    async def test(host, page, other):
        (deaf,) = [client for client in host.clients.values() if client.number == page.client]
        gate = asyncio.Event()
        write = deaf.write_all

        async def blocked():
            await gate.wait()  # as a socket whose buffer is full
            await write()

        deaf.write_all = blocked
        count = 5 * clients.MAX_WAITING
        for _ in range(count):
            await page.post(do="time", time=0.5)
        for factor in np.linspace(1, 2, 50):
            await other.drag(REST * factor)
            await other.do(do="edit.add", kind="move", shape="box", lower=[0] * 3, upper=[1] * 3)
            await other.do(do="undo")
        assert len(deaf.texts) <= clients.MAX_WAITING + 1
        assert (len(deaf.vertices) <= 4 and deaf.frame is None) or len(deaf.frame) == 2
        gate.set()
        await page.until(lambda: len(page.replies) == count + 1)
        await page.until(lambda: np.array_equal(page.posed(), host.session.document.edits[0].posed))

    with_pages(test, tmp_path, 2)


@on_pages
async def test_a_page_that_never_says_what_it_has_seen_gets_no_more_than_two_frames_at_once(host, page):
    page.sees = False
    (client,) = host.clients.values()
    await page.do(do="drag.begin", edit=1)
    for factor in np.linspace(1, 1.5, 20):
        count = host.renderer.frames
        await page.move(REST * factor)
        await page.do(do="seen", frame=0)
        while host.renderer.frames == count:
            await asyncio.sleep(0.005)
        assert len(client.sent_frames) <= clients.FRAMES_UNDER_WAY
    await page.do(do="drag.end")
    page.sees = True
    last = page.frames[-1]["frame"]
    await page.do(do="seen", frame=last)
    await page.until(lambda: page.frames[-1]["applied"]["1"] == 20 and page.frames[-1]["sharp"])


@on_pages
async def test_the_latest_pose_wins(host, page):
    await page.until(lambda: page.frames and page.frames[-1]["sharp"])
    gate, show, shown = threading.Event(), host.renderer.show, []

    def slow(request, sharp):
        shown.append(request.applied[1])
        assert gate.wait(WAIT)
        show(request, sharp)

    host.renderer.show = slow
    await page.do(do="drag.begin", edit=1)
    await page.move(REST * 1.01)
    while not shown:
        await asyncio.sleep(0.005)
    for factor in np.linspace(1.02, 1.5, 49):
        await page.move(REST * factor)
    await page.do(do="seen", frame=1)  # all have been taken
    gate.set()
    await page.until(lambda: page.frames[-1]["applied"]["1"] == 50)
    assert shown[:2] == [1, 50], shown
    await page.do(do="drag.end")


async def key_two_poses(page):
    await page.do(do="key.add", time=0.0, pose=True)
    await page.do(do="time", time=1.0)
    await page.do(do="pose.set", edit=1, vertices=(REST * 1.5).tolist())
    await page.do(do="key.add", time=1.0, pose=True)


@on_pages
async def test_a_film_plays_stops_for_a_hand_and_ends_with_the_last_page(host, page, other):
    await key_two_poses(page)
    await page.do(do="timeline", length=1.0, loop="ping-pong")
    steps = len(host.session.history.undo_steps)
    await other.do(do="play", on=True)
    await page.until(lambda: page.sections["playback"]["playing"])
    await page.until(lambda: 1.01 < page.posed()[7, 0] / REST[7, 0] < 1.49)
    await page.do(do="settings", background="white")  # which does not stop it
    assert host.player.playing
    await page.do(do="drag.begin", edit=1)
    await other.until(lambda: not other.sections["playback"]["playing"])
    await page.do(do="drag.end")
    assert len(host.session.history.undo_steps) == steps + 1
    await page.refused(do="play", on=1)
    await page.do(do="play", on=True)
    for one in (page, other):
        await one.socket.close()
    while host.clients:
        await asyncio.sleep(0.005)
    assert not host.player.playing


@on_pages
async def test_a_film_plays_from_its_start_where_no_key_lies_ahead(host, page):
    await key_two_poses(page)
    await page.do(do="time", time=1.5)  # the film is 4 s long: still pictures alone from here on
    await page.do(do="play", on=True)
    await page.until(lambda: 1.01 < page.posed()[7, 0] / REST[7, 0] < 1.49)
    await page.do(do="play", on=False)


@on_pages
async def test_a_film_that_cannot_go_on_stops(host, page, monkeypatch):
    def scrub(time):
        raise ValueError("no such pose")

    monkeypatch.setattr(host.session, "scrub", scrub)
    await page.do(do="play", on=True)
    await page.until(lambda: not page.sections["playback"]["playing"])
    assert not host.player.playing


# -- Checks, jobs and what takes long


@on_pages
async def test_the_check_follows_the_active_cage_and_says_why_it_cannot(host, page, monkeypatch):
    await page.until(lambda: page.sections["check"] and not page.sections["check"]["pending"])  # without a touch
    assert page.sections["check"]["edit"] == 1 and page.sections["check"]["problem"] == ""
    await page.drag(REST * [-1, 1, 1])
    await page.until(lambda: "posed cage" in page.sections["check"]["problem"])
    await page.do(do="settings", mode="rest")
    await page.until(lambda: page.sections["check"]["problem"] == "" and not page.sections["check"]["pending"])
    await page.do(do="edit.delete", id=1)
    await page.until(lambda: page.sections["check"] is None)
    await page.do(do="undo")
    await page.until(lambda: page.sections["check"] and not page.sections["check"]["pending"])

    def fail(*_):
        raise MemoryError

    monkeypatch.setattr(inspection, "inspect", fail)
    await page.drag(REST * 1.1)
    await page.until(lambda: "not enough memory" in page.sections["check"]["problem"])
    assert page.sections["check"]["pending"] is False


def test_a_cage_around_the_object_that_is_clicked(tmp_path):
    scene = TableScene(degrees=8.0, floor=False, fragments=False)

    async def test(host, page):
        eye, target, up = (scene.world(each).tolist() for each in ((2.2, -2.4, 1.6), (0, 0, 0), (0, 0, 1)))
        await page.do(do="view", eye=eye, target=target, up=up, fov=40)
        seen = view_camera(host.session.document.view, 300, 200)
        across, down = (seen.project(scene.world((-0.05, 0.0, 0.4))[None])[0][0] / [300, 200]).tolist()
        click = {"across": across, "down": down, "aspect": 1.5, "plane": "ground"}
        await page.do(do="cage.generate", edit=None, count=40, click=click)
        await page.until(lambda: page.sections["jobs"] and page.sections["jobs"][0]["state"] == "done")
        share = float(re.search(r"around ([\d.]+)% of what is visible", page.sections["jobs"][0]["result"])[1])
        assert 0.0 < share < 100.0 * (scene.labels == LAMP).sum() / (scene.labels > 0).sum() * 2
        await page.do(do="cage.generate", edit=None, count=40, click={**click, "across": 0.01, "down": 0.01})
        await page.until(lambda: page.sections["jobs"][-1]["state"] == "failed")
        assert "is on nothing" in str(page.sections["jobs"][-1])
        stroke = {"places": [[across, down]], "aspect": 1.5, "plane": "ground"}
        await page.refused(do="cage.generate", count=40, click={**stroke, "places": [[0.5]]})
        await page.refused(do="cage.generate", count=40, click={**stroke, "places": [[0.5, 0.5]] * 65})
        for wrong in ([], {}, {**click, "plane": "sky"}, {**click, "aspect": 0}, {**click, "down": 2}):
            await page.refused(do="cage.generate", count=40, click=wrong)

    session = Session(scene.field, new_document(scene.field))
    with_pages(test, tmp_path, session=session)


def test_a_new_cage_is_finer_where_another_is_bent_or_selected(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(Cage, "from_field", lambda *_, **options: asked.append(options) or BOX)

    async def test(host, page):
        bent = REST * [1.0, 1.0, 1.2]
        await page.drag(bent)
        await page.do(do="key.add", time=1.0, pose=True)
        for focus in (None, {"edit": 1}, {"edit": 1, "vertices": [0, 1]}):
            await page.do(do="cage.generate", count=30, symmetry="auto", faces="quads", focus=focus, finer=3)
        await page.until(lambda: [job["state"] for job in page.sections["jobs"]] == ["done"] * 3)
        assert all((each["symmetry"], each["faces"], each["finer"]) == ("auto", "quads", 3.0) for each in asked)
        (nowhere,), (poses,), (points,) = ([each["focus"]] for each in asked)
        assert nowhere is None and [type(each) for each in poses] == [Cage] * 3
        np.testing.assert_array_equal([each.vertices for each in poses], [REST, bent, bent])
        nodes = visible_nodes(host.session.field)
        expected = [REST[0], REST[1], REST[:2].mean(axis=0)] if [0, 1] in np.sort(BOX.edges).tolist() else REST[:2]
        nearest = [np.linalg.norm(nodes - place, axis=1).min() for place in expected]
        assert len(points) == len(expected) and all((nodes == point).all(axis=1).any() for point in points)
        np.testing.assert_allclose(np.linalg.norm(points - expected, axis=1), nearest)
        await page.refused(do="cage.generate", count=30, focus={"edit": 1, "vertices": []})
        await page.refused(do="cage.generate", count=30, focus={"edit": 9})
        for wrong in ({"focus": "all"}, {"finer": 9}, {"faces": "n-gons"}, {"symmetry": "w"}):
            await page.refused(do="cage.generate", count=30, **wrong)

    with_pages(test, tmp_path)


def test_a_job_waits_for_the_hand_and_takes_in_what_was_done_meanwhile(tmp_path, monkeypatch):
    started, go = threading.Event(), threading.Event()

    def generate(*_, **__):
        started.set()
        assert go.wait(WAIT)
        return Cage.box((-0.8, -0.8, -0.8), (0.8, 0.8, 0.8), segments=2)

    monkeypatch.setattr(Cage, "from_field", generate)

    async def test(host, page):
        number = await page.do(do="cage.generate", edit=None, count=26, margin=1.5, method="auto", symmetry=None)
        await asyncio.get_running_loop().run_in_executor(None, started.wait, WAIT)
        await page.do(do="drag.begin", edit=1)
        await page.move(REST * 1.1)
        go.set()
        await page.until(lambda: page.sections["jobs"][0]["share"] == 0.95)
        await page.move(REST * 1.2)
        await page.do(do="view", eye=[3, 2, 1], target=[0, 0, 0], up=[0, 0, 1], fov=50)
        await page.do(do="drag.end", edit=1)
        await page.until(lambda: page.sections["jobs"][0]["state"] == "done")
        assert number == 1
        first, second = host.session.document.edits
        np.testing.assert_array_equal(first.posed, REST * 1.2)
        assert len(second.rest) == 26 and host.session.document.view.fov == 50
        assert [label for label, _ in host.session.history.undo_steps] == ["move", "add Move 2"]
        for margin in (-1, 1e308, True, "1", [1], 65):
            await page.refused(do="cage.generate", count=20, margin=margin)

    with_pages(test, tmp_path)


def test_closing_waits_for_no_hand_and_saves_what_it_moved(tmp_path):
    path = tmp_path / "ball.session.json"

    async def test():
        host = server.Server(new_session(path), tmp_path)
        await host.start()
        async with pages(host) as (page,):
            await page.do(do="cage.subdivide", edit=1)
            await page.do(do="drag.begin", edit=1)
            await page.do(do="cage.simplify", edit=1, count=10)
            await page.until(lambda: page.sections["jobs"][0]["share"] == 0.9)
            await page.move(host.session.document.edits[0].posed * 1.1)
            await page.do(do="seen", frame=0)
            await asyncio.wait_for(host.stop(), WAIT)
            assert await page.ended() == aiohttp.WSCloseCode.GOING_AWAY
        return host

    host = asyncio.run(test())
    assert host.jobs.section()[0]["state"] == "cancelled"
    assert not [thread for thread in threading.enumerate() if thread.name.startswith(("warpcage-", "warpcage "))]
    (edit,) = read_session(path).edits
    np.testing.assert_array_equal(edit.posed, edit.rest * 1.1)
    assert len(edit.rest) == 26


def test_a_page_is_served_while_its_file_is_read(tmp_path, monkeypatch):
    BOX.save(tmp_path / "cage.obj")
    started, go = threading.Event(), threading.Event()

    def load(*_, **__):
        started.set()
        assert go.wait(WAIT)
        return BOX, UpAxis("z")

    monkeypatch.setattr(tasks, "load_standing", load)

    async def test(host, page):
        number = await page.post(do="cage.load", file="cage.obj", edit=None)
        await page.do(do="select", edit=1, mode="vertex", vertices=[3])
        assert number not in page.replies
        go.set()
        await page.until(lambda: number in page.replies)
        assert "error" not in page.replies[number] and len(host.session.document.edits) == 2

    with_pages(test, tmp_path)


def test_a_pose_with_another_axis_up_is_turned_to_its_cage(tmp_path):
    posed = BOX.move((0.3, 0.2, 0.4), group=[0, 1])
    posed.save(tmp_path / "y.obj", up="y")
    posed.save(tmp_path / "z.obj")

    async def test(host, page):
        for name, said in (("y.obj", "load y.obj (y up)"), ("z.obj", "load z.obj")):
            await page.do(do="pose.load", file=name, edit=1)
            np.testing.assert_allclose(host.session.document.edits[0].posed, posed.vertices, atol=1e-12)
            assert host.session.history.undo_steps[-1][0] == said
            await page.do(do="undo")

    with_pages(test, tmp_path)


# -- A thousand drags


def held():
    gc.collect()
    with open("/proc/self/statm") as file:
        memory = int(file.read().split()[1]) * os.sysconf("SC_PAGESIZE")
    kinds = (Document, Page, asyncio.Task, clients.Client, np.ndarray)
    objects = gc.get_objects()
    counts = {kind.__name__: sum(type(scene_object) is kind for scene_object in objects) for kind in kinds}
    return threading.active_count(), len(os.listdir("/proc/self/fd")), memory, counts


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="counts files in /proc")
def test_a_thousand_drags_leave_threads_files_and_memory_flat(tmp_path, monkeypatch):
    monkeypatch.setattr(clients, "MESSAGE_BURST", 1e9)
    monkeypatch.setattr("warpcage.studio.editor.steps.history.DEPTH", 200)

    async def test(host, page, other):
        for count in range(1000):
            if count == 300:
                before = held()
            await page.drag(REST * (1.1 + count % 7 / 20), REST * (1.2 + count % 5 / 20))
        assert len(host.session.history.undo_steps) == 200
        await other.until(lambda: np.array_equal(other.posed(), host.session.document.edits[0].posed))
        page.frames.clear(), other.frames.clear()
        after = held()
        assert after[0] <= before[0] + 3 and after[1] <= before[1] + 2, (before, after)
        assert after[2] - before[2] < 40e6, (before, after)
        for kind, number in after[3].items():
            assert number <= before[3][kind] + 60, (before, after)

    with_pages(test, tmp_path, 2)
