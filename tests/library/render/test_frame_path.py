"""How a frame is planned and by which launches it is made."""

import pathlib
import re
import sys

import pytest
from fields import BOX, MARCHES, TILES, box_around, two_balls, use_march, view

import warpcage
from warpcage import Deformer
from warpcage.core import recorded_launches
from warpcage.render import FrameFacts, FramePlan, PlannedEdit, plan_frame

ONE, SIDES, TWO = (False,), (True,), (False, True)
WHOLE, GENERAL = (PlannedEdit(0, False),), (PlannedEdit(0, True),)
BACKWARD = (PlannedEdit(1, True), PlannedEdit(0, False))

#: What is known of a frame, and how it is marched.
PLANS = {
    "one edit, near": (FrameFacts(ONE), FramePlan("edit", edits=WHOLE)),
    "with corner values": (FrameFacts(SIDES), FramePlan("edit", edits=GENERAL)),
    "seen from afar": (FrameFacts(ONE, is_far=True), FramePlan("edit", table="shaded", edits=WHOLE)),
    "that lies right": (FrameFacts(ONE, is_far=True, is_folded=False), FramePlan("edit", table="shaded", edits=WHOLE)),
    "turned over": (FrameFacts(ONE, is_far=True, is_folded=True), FramePlan("edit", edits=WHOLE)),
    "too little memory": (FrameFacts(ONE, is_far=True, colors_fit=False), FramePlan("edit", edits=WHOLE)),
    "seen from afar, corner values": (FrameFacts(SIDES, is_far=True), FramePlan("edit", table="shaded", edits=GENERAL)),
    "on a CPU": (FrameFacts(ONE, by_tiles=True), FramePlan("parts", "tile", edits=WHOLE)),
    "on a CPU, seen from afar": (
        FrameFacts(SIDES, by_tiles=True, is_far=True),
        FramePlan("parts", "tile", edits=GENERAL),
    ),
    "one that takes fragments": (FrameFacts(ONE, has_fragments=True, is_far=True), FramePlan("stack")),
    "on a CPU, fragments": (FrameFacts(ONE, has_fragments=True, by_tiles=True), FramePlan("stack")),
    "two that may meet": (FrameFacts(TWO, is_far=True), FramePlan("stack", is_simple=True)),
    "two with gaps that may meet": (FrameFacts(TWO, has_gaps=True), FramePlan("stack")),
    "two on a CPU that may meet": (FrameFacts(TWO, by_tiles=True), FramePlan("stack", is_simple=True)),
    "two apart, near": (FrameFacts(TWO, order=(1, 0)), FramePlan("parts", edits=BACKWARD)),
    "two apart, seen from afar": (
        FrameFacts(TWO, order=(1, 0), is_far=True),
        FramePlan("parts", table="shaded", edits=BACKWARD),
    ),
    "two apart, turned over": (
        FrameFacts(TWO, order=(1, 0), is_far=True, is_folded=True),
        FramePlan("parts", edits=BACKWARD),
    ),
    "two apart on a CPU": (FrameFacts(TWO, order=(1, 0), by_tiles=True), FramePlan("parts", "tile", edits=BACKWARD)),
    "two apart, fragments": (FrameFacts(TWO, order=(1, 0), has_fragments=True), FramePlan("stack")),
}


@pytest.mark.parametrize("case", PLANS)
def test_a_plan_follows_from_facts(case):
    facts, plan = PLANS[case]
    assert plan_frame(facts) == plan
    assert plan.is_shaded == (plan.table == "shaded")


# -- The hops of a frame, as docs/architecture.md lists them

#: Rooms that a frame goes through; helpers of other rooms are called from everywhere.
ROOMS = ("deform", "edits", "field", "render")
PACKAGE = pathlib.Path(warpcage.__file__).parent
PAGE = pathlib.Path(__file__).parents[3] / "docs" / "architecture.md"


def listed_hops():
    """File and function of each hop that the page lists."""
    rows = re.findall(r"^\| (\d) \| `([^`]+)` \| `([^`]+)` \|", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert [int(number) for number, _, _ in rows] == list(range(1, 10))
    return [(file, name) for _, file, name in rows]


def traced(run):
    """The calls of functions in ROOMS while `run` runs, as file, name, and the files of ROOMS that wait for it."""
    calls, waiting = [], []

    def note(frame, event, _):
        if event == "call":
            code = frame.f_code
            path = pathlib.Path(code.co_filename)
            file = path.relative_to(PACKAGE).as_posix() if path.is_relative_to(PACKAGE) else ""
            if file.split("/")[0] in ROOMS:
                calls.append((file, code.co_qualname, [each for each in waiting if each]))
            waiting.append(file if file.split("/")[0] in ROOMS else "")
        elif event == "return" and waiting:
            waiting.pop()

    sys.setprofile(note)
    try:
        run()
    finally:
        sys.setprofile(None)
    return calls


@pytest.mark.skipif(sys.version_info < (3, 11), reason="code objects have no qualified names")
@pytest.mark.parametrize("scene", ["one edit", "edits apart", "edits that meet"])
@pytest.mark.parametrize("march", MARCHES)
def test_a_frame_takes_nine_hops_and_none_back(march, scene, device, monkeypatch):
    use_march(march, device, monkeypatch)
    deformer = posed(scene, device)
    deformer.render(view())
    calls = traced(lambda: deformer.render(view()))
    names = [(file, name) for file, name, _ in calls]
    hops = [hop for hop in listed_hops() if hop in names]
    assert [hop for hop in listed_hops() if hop not in names] == []
    assert sorted(hops, key=names.index) == hops
    assert [(file, name, files) for file, name, files in calls if file in files and file != files[-1]] == []


# -- The launches of a frame


def posed(scene, device, **options):
    rests = {
        "one edit": [BOX],
        "edits apart": [box_around(-0.5, 0, 0), box_around(0.5, 0, 0)],
        "edits that meet": [BOX, box_around(0.5, 0, 0)],
    }[scene]
    deformer = Deformer(two_balls(device), rests, coordinates="mean_value", resolution=24, **options)
    return deformer.pose([rest.rotate(25) for rest in rests])


DENSITIES, AIM = ["occupancy.note_densities"], ["shading.find_view_directions"]
SHADES = ["shading.shade_carried_rows"]
EMPTY = ["cell_tables.mark_edit_cells", *3 * ["occupancy.spread_lines"]]
JOINED = ["cell_tables.join_cell_tables", "cell_tables.join_nodes"]
PLACES = ["inverse.scatter_cells", "inverse.gather_inverse"]

#: Of a scene and a march: what a frame launches of a pose that was seen before, and of a new one.
LAUNCHES = {
    ("one edit", "tiles"): ([*DENSITIES, TILES], [*DENSITIES, *EMPTY, *JOINED, TILES]),
    ("one edit", "rows"): (
        [*DENSITIES, "views.rows"],
        [*DENSITIES, *EMPTY, *JOINED, "nodes.expand_map_cells", "views.rows"],
    ),
    ("one edit", "shaded"): (
        [*AIM, *DENSITIES, *SHADES, "views.shaded"],
        [
            *(*DENSITIES, *EMPTY, *JOINED, "nodes.expand_map_cells"),
            *(*PLACES, "shading.keep_cage", *AIM, *SHADES, "views.shaded"),
        ],
    ),
    ("edits apart", "tiles"): ([*DENSITIES, *2 * [TILES]], [*DENSITIES, *2 * EMPTY, *2 * JOINED, *2 * [TILES]]),
    ("edits apart", "shaded"): (
        [*AIM, *DENSITIES, *SHADES, *2 * ["views.shaded+part"]],
        [
            *(*DENSITIES, *2 * EMPTY, *2 * JOINED, *2 * ["nodes.expand_map_cells"]),
            *(*2 * PLACES, *2 * ["shading.keep_cage"], *AIM, *SHADES, *2 * ["views.shaded+part"]),
        ],
    ),
    ("edits that meet", "shaded"): (
        [*DENSITIES, "views.stack+simple"],
        [*DENSITIES, *2 * EMPTY, *2 * JOINED, "views.stack+simple"],
    ),
}


@pytest.mark.parametrize(("scene", "march"), LAUNCHES)
def test_the_order_of_launches(scene, march, monkeypatch):
    """On a CPU, where nothing is launched ahead: the device is at work before the host allocates or waits."""
    use_march(march, "cpu", monkeypatch)
    deformer = posed(scene, "cpu")
    deformer.render(view())
    expected_known, expected_new = LAUNCHES[scene, march]
    with recorded_launches() as launched:
        deformer.render(view())
    assert launched == expected_known
    deformer.pose([edit.cage.rotate(10) for edit in deformer.edits])
    with recorded_launches() as launched:
        deformer.render(view())
    assert launched == expected_new


def test_a_pose_that_follows_a_frame_launches_what_the_next_one_needs(monkeypatch):
    use_march("shaded", "cpu", monkeypatch)
    monkeypatch.setattr("warpcage.render.scene.LOOKS_AHEAD_ON_CPU", True)
    deformer = posed("one edit", "cpu")
    deformer.render(view())
    with recorded_launches() as launched:
        deformer.pose(BOX.rotate(10))
    tables = [*EMPTY, *JOINED, "nodes.expand_map_cells", *PLACES, "shading.keep_cage"]
    assert launched[-len(tables) :] == tables
    with recorded_launches() as launched:
        deformer.render(view())
    assert launched == LAUNCHES["one edit", "shaded"][0]


def test_a_posed_scene_is_a_few_parts(device):
    assert len(vars(posed("edits apart", device).posed_edits())) <= 12
