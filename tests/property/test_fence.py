"""A fence answers as asking every point would, also for the least ε and for points on the edge."""

from hypothesis import given, settings
from hypothesis import strategies as st

from projections.reducers._fence import Fence, turned
from projections.reducers._grid import NEIGHBOUR_CELLS, cell_side_um

EPS = st.sampled_from([0, 1, 2, 3, 5, 7, 13, 50, 1000, 1_500_000, 10**9])


@st.composite
def questions(draw: st.DrawFn) -> tuple[int, list[tuple[int, int]], list[tuple[int, int, int]]]:
    """ε, the points of the cell (0, 0), and askers (side, x, y) in cells around it."""
    eps = draw(EPS)
    last = cell_side_um(eps) - 1
    inside = st.one_of(st.integers(0, last), st.sampled_from([0, last, last // 2]))
    points = draw(st.lists(st.tuples(inside, inside), min_size=1, max_size=30))
    askers = []
    for column, row in draw(st.lists(st.sampled_from(NEIGHBOUR_CELLS), min_size=1, max_size=8)):
        sides = [s for s, yes in enumerate((column < 0, column > 0, row < 0, row > 0)) if yes]
        x, y = draw(inside) + column * (last + 1), draw(inside) + row * (last + 1)
        askers += [(side, x, y) for side in sides]
    return eps, points, askers


@settings(max_examples=400)
@given(questions())
def test_a_fence_answers_as_all_points_would(question) -> None:
    eps, points, askers = question
    for side, x, y in askers:
        fence = Fence(eps)
        for index, point in enumerate(points):
            fence.add(index, turned(side, *point))
            found = fence.reach(turned(side, x, y))
            within = {
                i
                for i, (px, py) in enumerate(points[: index + 1])
                if (px - x) ** 2 + (py - y) ** 2 <= eps * eps
            }
            assert found in within if within else found is None
