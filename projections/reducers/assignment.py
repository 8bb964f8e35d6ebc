"""Which Object each observation of a picture takes where several want the same one: the choice
with the largest sum of evidence.

Observations that want no Object in common do not depend on each other. Of those that do, up to
`_MOST` are assigned by the Hungarian method, an observation being considered for as many Objects as
there are observations, its best. More than that, which no camera sees, take what they want most,
best first, so that a picture's cost is bounded.
"""

from collections.abc import Iterable, Sequence
from typing import TypeAlias

from projections.deltas import ObjectOrdinal

Match: TypeAlias = tuple[float, ObjectOrdinal, float]
"""How much speaks for an Object, which one, and the cosine of the best pair of looks."""
_MOST = 32


def _value(match: Match) -> float:
    return match[0]


def assign(wanted: Sequence[Sequence[Match]]) -> list[Match | None]:
    """The match that each observation takes, of those it wants, all above 0; None for none. Each
    Object is taken once. Of equal choices always the same one, the first where there is one."""
    taken = [max(matches, key=_value) if matches else None for matches in wanted]
    ordinals = [match[1] for match in taken if match is not None]
    if len(set(ordinals)) == len(ordinals):
        return taken
    for together in _together(wanted):
        if len(together) > 1:
            own = [wanted[row] for row in together]
            chosen = _largest_sum(own) if len(own) <= _MOST else _best_first(own)
            for row, match in zip(together, chosen, strict=True):
                taken[row] = match
    return taken


def _together(wanted: Sequence[Sequence[Match]]) -> list[list[int]]:
    """The observations that want an Object in common, directly or through others, ascending."""
    leader = list(range(len(wanted)))

    def leader_of(row: int) -> int:
        while leader[row] != row:
            row = leader[row]
        return row

    first: dict[ObjectOrdinal, int] = {}
    for row, matches in enumerate(wanted):
        for _, ordinal, _ in matches:
            one, other = leader_of(first.setdefault(ordinal, row)), leader_of(row)
            leader[max(one, other)] = min(one, other)
    together: dict[int, list[int]] = {}
    for row in range(len(wanted)):
        together.setdefault(leader_of(row), []).append(row)
    return list(together.values())


def _best_first(wanted: Sequence[Iterable[Match]]) -> list[Match | None]:
    """Matches taken in the order of their evidence."""
    taken: list[Match | None] = [None] * len(wanted)
    used: set[ObjectOrdinal] = set()
    pairs = [(match, row) for row, matches in enumerate(wanted) for match in matches]
    for match, row in sorted(pairs, key=lambda pair: -pair[0][0]):
        if taken[row] is None and match[1] not in used:
            taken[row] = match
            used.add(match[1])
    return taken


def _largest_sum(wanted: Sequence[Sequence[Match]]) -> list[Match | None]:
    """The Hungarian method with potentials, one observation after the other. Where an observation
    does not want an Object, and in columns without one, the gain is 0: it takes none."""
    size = len(wanted)
    columns: dict[ObjectOrdinal, int] = {}
    rows: list[dict[int, Match]] = []
    for matches in wanted:
        best = sorted(matches, key=_value, reverse=True)[:size]
        rows.append({columns.setdefault(match[1], len(columns) + 1): match for match in best})
    width = max(len(columns), size) + 1
    gains = [[0.0] * width for _ in range(size)]
    for of_one, own in zip(gains, rows, strict=True):
        for column, match in own.items():
            of_one[column] = match[0]
    of_row, of_column = [0.0] * size, [0.0] * width  # potentials
    holder = [-1] * width  # column → its observation
    for new in range(size):
        holder[0], column = new, 0
        slack, way = [float("inf")] * width, [0] * width
        left = set(range(1, width))
        path = [0]
        while holder[column] >= 0:
            row = holder[column]
            gain, base = gains[row], of_row[row]
            least, nearest = float("inf"), 0
            for other in sorted(left):
                rest = base + of_column[other] - gain[other]
                if rest < slack[other]:
                    slack[other], way[other] = rest, column
                if slack[other] < least:
                    least, nearest = slack[other], other
            for other in path:
                of_row[holder[other]] -= least
                of_column[other] += least
            for other in left:
                slack[other] -= least
            column = nearest
            left.remove(column)
            path.append(column)
        while column:
            before = way[column]
            holder[column] = holder[before]
            column = before
    taken: list[Match | None] = [None] * size
    for column in range(1, width):
        if holder[column] >= 0:
            taken[holder[column]] = rows[holder[column]].get(column)
    return taken
