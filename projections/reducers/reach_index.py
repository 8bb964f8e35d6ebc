"""Is any point of a crowded cell within ε of a point beyond one of its sides? In O(log n), exactly.

A cell that a robot visits for a year holds ten thousand points, and its neighbour across a wall
must ask this at every keyframe. Only the points whose ε-circle reaches furthest at some height
matter. Stand left of the cell: each point covers what its circle's left arc bounds, and whatever
lies deeper. Two such regions have one boundary point in common (the slope of the lower centre's arc
is the greater one everywhere): their arcs cross, or one arc meets the edge of the other's region.
So along the envelope the centres ascend and each owns one interval of heights. A new centre is kept
if it owns something, and evicts the neighbours that own nothing any more; a question finds the
owner of its height by bisection and compares one distance (the "unit-spherical emptiness checking
with line separation" of Gan and Tao 2015).

Everything is integer: where two arcs cross involves a root, so "is it before t?" is decided by
comparing signs, then squares.

A fence is written for the side "left": its axes are (across, along) = (x, y). The other three sides
are the same after `turned`.
"""

from bisect import bisect_left

Turned = tuple[int, int]
"""A point as (along, across): across grows into the cell, away from whoever asks."""


def turned(side: int, x: int, y: int) -> Turned:
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


class Fence:
    """The envelope of a cell's points towards one side; see the module's head.

    ``fed`` is how many of the cell's points it has taken in; the owner of the fence feeds it the
    rest, in their order, before asking.
    """

    __slots__ = ("_eps", "_eps2", "_posts", "_which", "fed")

    def __init__(self, eps_um: int) -> None:
        self._eps = eps_um
        self._eps2 = eps_um * eps_um
        self._posts: list[Turned] = []  # ascending along; one per height
        self._which: list[int] = []
        self.fed = 0

    def add(self, point: int, at: Turned) -> None:
        """Take in the point with index ``point``."""
        self.fed += 1
        posts = self._posts
        i = bisect_left(posts, (at[0],))
        if i < len(posts) and posts[i][0] == at[0]:
            if posts[i][1] <= at[1]:
                return
            del posts[i], self._which[i]
        if 0 < i < len(posts) and self._is_hidden(posts[i - 1], at, posts[i]):
            return
        posts.insert(i, at)
        self._which.insert(i, point)
        while i + 2 < len(posts) and self._is_hidden(at, posts[i + 1], posts[i + 2]):
            del posts[i + 1], self._which[i + 1]
        while i >= 2 and self._is_hidden(posts[i - 2], posts[i - 1], at):
            del posts[i - 1], self._which[i - 1]
            i -= 1

    def reach(self, at: Turned) -> int | None:
        """A point of the cell within ε of ``at``, which lies on this side of the cell, or None."""
        posts = self._posts
        low, high = 0, len(posts) - 1
        while low < high:
            middle = (low + high) // 2
            if self._meeting_minus(posts[middle], posts[middle + 1], at[0]) < 0:
                low = middle + 1
            else:
                high = middle
        along, across = posts[low]
        near = (along - at[0]) ** 2 + (across - at[1]) ** 2 <= self._eps2
        return self._which[low] if near else None

    def _is_hidden(self, a: Turned, b: Turned, c: Turned) -> bool:
        """True when b's region adds nothing to a's and c's; along(a) < along(b) < along(c).

        Let z be where a's and c's boundaries meet. If their arcs cross there, z is (a + c)/2 + h·n
        with n the unit normal of c - a towards the asker, h = √(ε² - D/4) and D = |c - a|²; then b
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
        towards = ua * dc - uc * da  # N = (dc, -da), its across part negative: to the asker
        is_outside = not _exceeds(2 * towards, rest, ua * ua + uc * uc - squared, squared)
        return is_outside and _exceeds(da, rest, -uc, squared)

    def _meeting_minus(self, a: Turned, c: Turned, along: int) -> int:
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
