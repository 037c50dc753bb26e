"""How a frame is planned and by which launches it is made."""

import pytest

from warpcage.render import LARGE_PICTURE, FrameFacts, FramePlan, PlannedEdit, plan_frame

ONE, SIDES, TWO = (False,), (True,), (False, True)
WHOLE, GENERAL = (PlannedEdit(0, False),), (PlannedEdit(0, True),)
BACKWARD = (PlannedEdit(1, True), PlannedEdit(0, False))

#: What is known of a frame, and how it is marched.
PLANS = {
    "one edit, near": (FrameFacts(ONE), FramePlan("edit", edits=WHOLE)),
    "with corner values": (FrameFacts(SIDES), FramePlan("edit", edits=GENERAL)),
    "seen from afar": (FrameFacts(ONE, is_far=True), FramePlan("edit", table="shades", edits=WHOLE)),
    "that lies right": (FrameFacts(ONE, is_far=True, is_folded=False), FramePlan("edit", table="shades", edits=WHOLE)),
    "turned over": (FrameFacts(ONE, is_far=True, is_folded=True), FramePlan("edit", edits=WHOLE)),
    "too little memory": (FrameFacts(ONE, is_far=True, shades_fit=False), FramePlan("edit", edits=WHOLE)),
    "many rays": (
        FrameFacts(ONE, is_far=True, rays=LARGE_PICTURE),
        FramePlan("edit", table="shades", edits=WHOLE, is_large=True),
    ),
    "fewer": (FrameFacts(ONE, is_far=True, rays=LARGE_PICTURE - 1), FramePlan("edit", table="shades", edits=WHOLE)),
    "many rays of rows": (FrameFacts(ONE, rays=LARGE_PICTURE), FramePlan("edit", edits=WHOLE)),
    "many rays, corner values": (
        FrameFacts(SIDES, is_far=True, rays=LARGE_PICTURE),
        FramePlan("edit", table="shades", edits=GENERAL),
    ),
    "on a CPU": (FrameFacts(ONE, by_tiles=True), FramePlan("parts", "tile", edits=WHOLE)),
    "on a CPU, seen from afar": (
        FrameFacts(SIDES, by_tiles=True, is_far=True, rays=LARGE_PICTURE),
        FramePlan("parts", "tile", edits=GENERAL),
    ),
    "one that takes fragments": (FrameFacts(ONE, has_fragments=True, is_far=True), FramePlan("stack")),
    "on a CPU, fragments": (FrameFacts(ONE, has_fragments=True, by_tiles=True), FramePlan("stack")),
    "two that may meet": (FrameFacts(TWO, is_far=True), FramePlan("stack", is_simple=True)),
    "two with gaps that may meet": (FrameFacts(TWO, has_gaps=True), FramePlan("stack")),
    "two on a CPU that may meet": (FrameFacts(TWO, by_tiles=True), FramePlan("stack", is_simple=True)),
    "two apart, near": (FrameFacts(TWO, order=(1, 0)), FramePlan("parts", edits=BACKWARD)),
    "two apart, many rays": (
        FrameFacts(TWO, order=(1, 0), is_far=True, rays=LARGE_PICTURE),
        FramePlan("parts", table="shades", edits=BACKWARD),
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
    assert plan.is_shaded == (plan.table == "shades")
