"""A reach index answers as a scan of all points does, also for the least ε and points on edges."""

from decimal import Decimal, localcontext

from hypothesis import assume, given, settings
from hypothesis import strategies as st

from projections.fold.core_index import NEIGHBOUR_CELLS, cell_side_um
from projections.fold.reach_index import ReachIndex, from_side
from tests.support.thorough import examples

EPS_UM = 1_500_000
EPS = st.sampled_from([0, 1, 2, 3, 5, 7, 13, 50, 1000, 1_500_000, 10**9])


@st.composite
def queries(draw: st.DrawFn) -> tuple[int, list[tuple[int, int]], list[tuple[int, int, int]]]:
    """ε, the points of the cell (0, 0), and outside (side, x, y) in cells around it."""
    eps = draw(EPS)
    last = cell_side_um(eps) - 1
    inside = st.one_of(st.integers(0, last), st.sampled_from([0, last, last // 2]))
    points = draw(st.lists(st.tuples(inside, inside), min_size=1, max_size=30))
    outside = []
    for column, row in draw(st.lists(st.sampled_from(NEIGHBOUR_CELLS), min_size=1, max_size=8)):
        sides = [s for s, yes in enumerate((column < 0, column > 0, row < 0, row > 0)) if yes]
        x, y = draw(inside) + column * (last + 1), draw(inside) + row * (last + 1)
        outside += [(side, x, y) for side in sides]
    return eps, points, outside


@settings(max_examples=examples(400))
@given(queries())
def test_a_reach_index_answers_as_a_scan_of_all_points(query) -> None:
    eps, points, outside = query
    for side, x, y in outside:
        reach_index = ReachIndex(eps)
        for index, point in enumerate(points):
            reach_index.add(index, from_side(side, *point))
            found = reach_index.point_in_reach(from_side(side, x, y))
            within = {
                i
                for i, (px, py) in enumerate(points[: index + 1])
                if (px - x) ** 2 + (py - y) ** 2 <= eps * eps
            }
            assert found in within if within else found is None


def _meeting(a: tuple[int, int], c: tuple[int, int], eps: int) -> Decimal:
    """Where the boundaries of two points' regions meet, in many digits: of their arcs' crossing and
    the two edges, the one that lies on both boundaries."""
    da, dc = Decimal(c[0] - a[0]), Decimal(c[1] - a[1])
    squared = da * da + dc * dc
    height = ((4 * eps * eps - squared) / squared).sqrt() / 2
    along = (a[0] + c[0]) / Decimal(2) + dc * height
    across = (a[1] + c[1]) / Decimal(2) - da * height
    if across > a[1]:
        return Decimal(a[0] + eps)
    return Decimal(c[0] - eps) if across > c[1] else along


@settings(max_examples=examples(1000))
@given(st.data(), st.sampled_from([3, 5, 7, 13, 50, 1000, 1_500_000]))
def test_a_centre_is_hidden_when_its_neighbours_meet_before_it_begins(data, eps: int) -> None:
    last = cell_side_um(eps) - 1
    inside = st.one_of(st.integers(0, last), st.sampled_from([0, last]))
    a, b, c = sorted(data.draw(st.tuples(inside, inside)) for _ in range(3))
    assume(a[0] < b[0] < c[0])
    with localcontext(prec=80):
        begins, ends = _meeting(a, b, eps), _meeting(b, c, eps)
    assume(abs(begins - ends) > Decimal("1e-40"))
    assert ReachIndex(eps)._is_hidden(a, b, c) == (begins > ends)


def test_the_edge_of_a_region_can_be_where_it_ends() -> None:
    """Two of the rare cases in which the crossing of the whole circles would say otherwise."""
    a, b, c = (786_792, 36_469), (814_764, 650_560), (944_017, 982_992)
    mirrored = [(1_000_000 - along, across) for along, across in (c, b, a)]
    for low, middle, high in ((a, b, c), mirrored):
        with localcontext(prec=80):
            is_hidden = _meeting(low, middle, EPS_UM) > _meeting(middle, high, EPS_UM)
        assert ReachIndex(EPS_UM)._is_hidden(low, middle, high) == is_hidden
