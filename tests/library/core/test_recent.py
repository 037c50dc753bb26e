"""What is kept: those that were used last, within a number and within bytes; and bytes of nested arrays."""

import contextlib

import numpy as np
import warp as wp

from warpcage.core import MEASURED_EVERY, LRUCache, array_bytes


def test_those_that_were_used_last_are_kept():
    dropped = []
    kept = LRUCache(2, dropped=dropped.append)
    for key in "abacb":
        assert kept.get(key, lambda key=key: key.upper()) == key.upper()
    assert [key for key, _ in kept.items()] == ["c", "b"] and dropped == ["B", "A"]
    kept.drop("c")
    kept.drop("never there")
    assert "b" in kept and "c" not in kept and len(kept) == 1
    kept.clear()
    assert dropped == ["B", "A", "C", "B"] and len(kept) == 0


def test_values_that_grow_are_measured_again_and_drive_others_out():
    measured = []

    def measure(value):
        measured.append(value)
        return len(value)

    kept = LRUCache(9, most_bytes=100, measure=measure)
    first, second = (kept.get(key, lambda: bytearray(30)) for key in "ab")
    assert kept.held_bytes == 60
    second.extend(bytes(80))
    kept.settle("b")
    assert kept.held_bytes == 110 and "a" not in kept and "b" in kept  # the one that is in use stays
    del measured[:]
    for _ in range(2 * MEASURED_EVERY):
        kept.settle("b")
    assert 5 < len(measured) < 15
    kept.settle("a")
    assert first is kept.get("a", lambda: first) and len(kept) == 1


def test_what_cannot_be_made_is_not_kept():
    kept = LRUCache(1)
    kept.get("a", lambda: 1)
    with contextlib.suppress(ZeroDivisionError):
        kept.get("b", lambda: 1 / 0)
    assert "b" not in kept and kept.held_bytes == 0


def test_bytes_of_arrays_count_once(device):
    numbers = np.zeros((10, 3))
    array = wp.zeros(100, dtype=wp.vec3, device=device)
    held = [numbers, {"a": numbers[2:], "b": (array, array[10:20], "text", 3.0, None)}]
    held.append(held)
    assert array_bytes(held) == numbers.nbytes + array.capacity
    assert array_bytes(held, leave=(array, held[1]["b"][1])) == numbers.nbytes
    texture = wp.Texture3D(width=4, height=3, depth=2, num_channels=4, dtype=wp.float16, device=device)
    assert array_bytes([texture, (0, texture)]) == 2 * 4 * 4 * 3 * 2


def test_bytes_of_a_deformer_beside_its_field(device):
    from fields import BOX, shiny_field, view

    from warpcage import Deformer

    field = shiny_field(device)
    values = field.grid.links, field.grid.density, field.grid.sh  # which some fields make when they are asked for
    alone = array_bytes(field)
    assert sum(each.capacity for each in values) <= alone
    deformer = Deformer(field, BOX, coordinates="mean_value", resolution=24)
    deformer.pose(BOX.twist(20)).render(view())
    beside = array_bytes(deformer, leave=(field,))
    node_count = deformer.posed_edits().lattices.posed()[0][0].deformed.distance.size
    assert 20 * node_count < beside < array_bytes(deformer)
    assert array_bytes(field) >= alone  # with what a march has made
