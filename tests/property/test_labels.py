"""Labels on a picture never cover each other, and none is left out that would have fitted."""

import math

from hypothesis import given, settings
from hypothesis import strategies as st

from projections.adapters.drawing.sheet import Extent, LabelRequest, place_labels
from tests.support.thorough import examples

BOUNDS = (0.0, 0.0, 10.0, 8.0)
RINGS = (0.1, 0.4, 1.2)

coordinates = st.floats(0, 10)
wanted = st.builds(
    LabelRequest, coordinates, coordinates, width=st.floats(0.1, 4), height=st.floats(0.1, 1)
)
extents = st.builds(Extent, coordinates, coordinates, st.floats(0.05, 2), st.floats(0.05, 2))


def _overlap(a: Extent, b: Extent) -> bool:
    """By their edges, unlike the code under test."""
    return (
        a.x - a.half_width < b.x + b.half_width
        and b.x - b.half_width < a.x + a.half_width
        and a.y - a.half_height < b.y + b.half_height
        and b.y - b.half_height < a.y + a.half_height
    )


def _slightly_smaller(box: Extent) -> Extent:
    return Extent(box.x, box.y, box.half_width - 1e-9, box.half_height - 1e-9)


@given(st.lists(wanted, max_size=12), st.lists(extents, max_size=4))
def test_placed_labels_are_apart_inside_and_as_large_as_wanted(
    labels: list[LabelRequest], taken: list[Extent]
) -> None:
    placed = place_labels(labels, taken, BOUNDS, RINGS)
    assert len(placed) == len(labels)
    boxes = [_slightly_smaller(box) for box in placed if box is not None]
    for index, box in enumerate(boxes):
        assert not any(_overlap(box, _slightly_smaller(other)) for other in taken)
        assert not any(_overlap(box, other) for other in boxes[:index])
        assert box.x - box.half_width >= 0
        assert box.x + box.half_width <= 10
        assert box.y - box.half_height >= 0
        assert box.y + box.half_height <= 8
    for label, box_or_none in zip(labels, placed, strict=True):
        if box_or_none is not None:
            assert (2 * box_or_none.half_width, 2 * box_or_none.half_height) == (
                label.width,
                label.height,
            )


@given(wanted)
def test_a_lone_label_with_space_around_it_lies_on_the_first_ring(label: LabelRequest) -> None:
    wide = (-100.0, -100.0, 100.0, 100.0)
    (box,) = place_labels([label], [], wide, RINGS)
    assert box is not None
    reach = (RINGS[0] + label.width / 2, RINGS[0] + label.height / 2)
    offset = ((box.x - label.x) / reach[0], (box.y - label.y) / reach[1])
    assert math.isclose(math.hypot(*offset), 1.0, rel_tol=1e-6)


@given(wanted)
@settings(max_examples=examples(100))
def test_a_label_is_left_out_only_when_everything_is_taken(label: LabelRequest) -> None:
    assert place_labels([label], [Extent(5, 5, 50, 50)], BOUNDS, RINGS) == [None]
    assert place_labels([label], [], (4.0, 4.0, 4.05, 4.05), RINGS) == [None]
