"""Find a point of a dense cell within ε of a point beyond one of its sides, exactly, in O(log n).

A cell that a robot visits for a year holds ten thousand points, and each keyframe in a nearby cell
needs this look-up. Seen from the left of the cell, each point of it covers a region between the
left arc of its ε-circle and the cell's far side. The left boundaries of two such regions have one
point in common (the slope of the lower centre's arc is the greater one everywhere): their arcs
cross, or one arc meets the edge of the other's region. So along the envelope of all regions the
centres ascend, and each is on it for one interval of heights. A new centre is kept if it has an
interval, and removes the neighbours that have none any more; a query finds the centre at its height
by bisection and compares one distance (the "unit-spherical emptiness checking with line separation"
of Gan and Tao 2015).

All arithmetic is on integers. The height where two arcs cross has a square root in it; to compare
it with another height, signs are compared, then squares.

A SidePoint is (along, across) a side. Seen from the left, along (the height) is y and across is x;
`from_side` maps the other three sides to this one.
"""

from bisect import bisect_left

SidePoint = tuple[int, int]
"""(along, across) a side of a cell, in micrometres; across grows into the cell."""


def from_side(side: int, x: int, y: int) -> SidePoint:
    """(x, y) as seen from ``side``: 0 from the left, 1 the right, 2 below, 3 above."""
    if side == 0:
        return y, x
    if side == 1:
        return y, -x
    return (x, y) if side == 2 else (x, -y)


def _exceeds(a: int, p: int, b: int, q: int) -> bool:
    """a·√p > b·√q for integers, p and q not negative."""
    left, right = a * a * p, b * b * q
    return (left if a > 0 else -left) > (right if b > 0 else -right)


class ReachIndex:
    """The envelope of a cell's points towards one side.

    ``added`` is the number of the cell's points added so far; the caller adds the rest in order
    before a query.
    """

    __slots__ = ("_centres", "_eps", "_eps2", "_points", "added")

    def __init__(self, eps_um: int) -> None:
        self._eps = eps_um
        self._eps2 = eps_um * eps_um
        self._centres: list[SidePoint] = []  # on the envelope; ascending along, one per height
        self._points: list[int] = []  # their indices
        self.added = 0

    def add(self, point: int, at: SidePoint) -> None:
        """Add the point with index ``point`` at ``at``."""
        self.added += 1
        centres = self._centres
        i = bisect_left(centres, (at[0],))
        if i < len(centres) and centres[i][0] == at[0]:
            if centres[i][1] <= at[1]:
                return
            del centres[i], self._points[i]
        if 0 < i < len(centres) and self._is_hidden(centres[i - 1], at, centres[i]):
            return
        centres.insert(i, at)
        self._points.insert(i, point)
        while i + 2 < len(centres) and self._is_hidden(at, centres[i + 1], centres[i + 2]):
            del centres[i + 1], self._points[i + 1]
        while i >= 2 and self._is_hidden(centres[i - 2], centres[i - 1], at):
            del centres[i - 1], self._points[i - 1]
            i -= 1

    def point_in_reach(self, at: SidePoint) -> int | None:
        """A point of the cell within ε of ``at``, which lies on this side of the cell, or None."""
        centres = self._centres
        low, high = 0, len(centres) - 1
        while low < high:
            middle = (low + high) // 2
            if self._meeting_minus(centres[middle], centres[middle + 1], at[0]) < 0:
                low = middle + 1
            else:
                high = middle
        along, across = centres[low]
        near = (along - at[0]) ** 2 + (across - at[1]) ** 2 <= self._eps2
        return self._points[low] if near else None

    def _is_hidden(self, a: SidePoint, b: SidePoint, c: SidePoint) -> bool:
        """True when b's region adds nothing to a's and c's; along(a) < along(b) < along(c).

        Let z be where a's and c's boundaries meet. If their arcs cross there, z is (a + c)/2 + h·n
        with n the unit normal of c - a out of the cell, h = √(ε² - D/4) and D = |c - a|²; then b
        is hidden when |b - z| ≥ ε, that is (|U|² - D)·√D ≥ 2 (U·N) √(4ε² - D) with
        U = 2b - a - c and N the normal of length √D, unless z lies deeper than b.
        """
        da, dc = c[0] - a[0], c[1] - a[1]
        squared = da * da + dc * dc
        rest = 4 * self._eps2 - squared
        if _exceeds(dc, squared, da, rest):  # c's arc meets the upper edge of a's region
            return self._meeting_minus(b, c, a[0] + self._eps) <= 0
        if _exceeds(-dc, squared, da, rest):  # a's arc meets the lower edge of c's region
            return self._meeting_minus(a, b, c[0] - self._eps) >= 0
        ua, uc = 2 * b[0] - a[0] - c[0], 2 * b[1] - a[1] - c[1]
        towards = ua * dc - uc * da  # N = (dc, -da), its across part negative: out of the cell
        is_outside = not _exceeds(2 * towards, rest, ua * ua + uc * uc - squared, squared)
        return is_outside and _exceeds(da, rest, -uc, squared)

    def _meeting_minus(self, a: SidePoint, c: SidePoint, along: int) -> int:
        """The sign of (the height at which a's and c's boundaries meet) - ``along``.

        Crossing arcs meet at (a + c)/2 + dc·√((4ε² - D)/D)/2 along the side.
        """
        da, dc = c[0] - a[0], c[1] - a[1]
        squared = da * da + dc * dc
        rest = 4 * self._eps2 - squared
        if _exceeds(dc, squared, da, rest):
            return a[0] + self._eps - along
        if _exceeds(-dc, squared, da, rest):
            return c[0] - self._eps - along
        twice = 2 * along - a[0] - c[0]
        return _exceeds(dc, rest, twice, squared) - _exceeds(twice, squared, dc, rest)
