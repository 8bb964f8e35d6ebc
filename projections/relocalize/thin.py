"""Whether a map has too few observations for its answers to be trusted.

Nothing that is measured of other maps holds for one that a robot has just begun: whatever it is
shown, the few things it has seen are the most similar, and every pose is near the few spots it has
seen them from. It shows in the candidates, so no question costs more.
"""

import math
from collections.abc import Iterable, Sequence
from typing import Final

from eventsrc.text import counted

from .candidates import NEIGHBOURS, Match
from .question import Crop

LEAST_SPOTS: Final = 5
"""Candidates from fewer places to stand are of a robot that looked around, not of a drive."""
SPOT_M: Final = 0.35


def thinness(crops: Sequence[Crop], matches: Sequence[Sequence[Match]]) -> str | None:
    """What the map is thin of, as a clause; None where it is not, or no crop has an embedding.

    A map is thin with fewer observations than are fetched for one crop, or if those that are were
    made from fewer than five spots.
    """
    rows = [row for crop, row in zip(crops, matches, strict=True) if crop.vector is not None]
    if not rows:
        return None
    seen = {match.observation: match for row in rows for match in row}
    few = max(len(row) for row in rows) < NEIGHBOURS
    spots = _spots(seen[ordinal] for ordinal in sorted(seen))
    if not few and spots >= LEAST_SPOTS:
        return None
    number = counted(len(seen), "observation") if few else "its most similar observations"
    where = counted(spots, "spot") if spots < LEAST_SPOTS else f"{LEAST_SPOTS} spots or more"
    return f"{number} from {where}"


def _spots(matches: Iterable[Match]) -> int:
    """How many places to stand the matches were seen from, counted up to `LEAST_SPOTS`."""
    spots: list[tuple[float, float]] = []
    for match in matches:
        if match.pose is None:
            continue
        x, y = match.pose[:2]
        for a, b in spots:
            if math.hypot(x - a, y - b) < SPOT_M:
                break
        else:
            spots.append((x, y))
            if len(spots) == LEAST_SPOTS:
                break
    return len(spots)
