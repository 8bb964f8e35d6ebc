"""Which sites are of one building, without a common frame: their maps are aligned, every two.

Pairs that are sure join sites, as runs of a log are joined: where they contradict each other, those
count whose scores have the largest sum. A pair that is only likely joins nothing and is named.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, NamedTuple

from eventsrc.base.errors import MapfoldError
from eventsrc.base.text import counted, table, visible
from eventsrc.envelope.model import RunId
from eventsrc.log import LogReader
from projections.localize.align.alignment import Alignment, align
from projections.localize.align.framed_things import FramedThings, own_map, things_of_map
from projections.localize.align.several import Contradiction, PlacedRun, RunPair, placed_runs
from projections.map.parsing import read_corrections

from .engines import Progress
from .site_tasks import ChosenSettings, error_text
from .sites import Site

_HEADS = "building", "site", "things", "x", "y", "yaw", "± m", "pairs", "most in common with"


class SiteThings(NamedTuple):
    """What can be compared of a site; without it the reason, ``error``."""

    things: FramedThings | None
    error: str | None = None


def things_of_site(site: Site, progress: Progress) -> SiteThings:
    """The things of one site's map, folded by evidence: of the runs in its own frame."""
    try:
        with LogReader(site.log) as reader:
            known = read_corrections(reader, reader.next_offset)
            settings = ChosenSettings().of(known)
            view = own_map(reader, reader.next_offset, known, settings)
            progress(int(reader.next_offset))
    except (MapfoldError, OSError) as error:
        return SiteThings(None, error_text(error, site))
    things = things_of_map(view)
    bare = None if things else "no object has both an embedding and a position"
    return SiteThings(things, bare)


def align_pair(pair: tuple[FramedThings, FramedThings], _: Progress) -> Alignment | None:
    """The transform of the second site into the frame of the first, as a task."""
    return align(*pair)


def comparable(things: Mapping[str, FramedThings]) -> tuple[list[tuple[str, str]], list[str]]:
    """The pairs of sites whose embeddings are of one space, and the sites of other spaces than most
    have."""
    spaces = {name: (each.space, each.looks.shape[1]) for name, each in things.items()}
    pairs = [two for two in combinations(things, 2) if spaces[two[0]] == spaces[two[1]]]
    usual = max(Counter(spaces.values()).items(), key=lambda each: each[1], default=None)
    return pairs, [name for name, space in spaces.items() if usual and space != usual[0]]


@dataclass(frozen=True, slots=True)
class Buildings:
    """Sites by building: ``groups`` of two sites or more, each in the frame of its first one, which
    has no entry of its own; ``alone`` are the others.

    ``likely`` are pairs of sites of different groups that may be of one building.
    """

    things: Mapping[str, FramedThings]
    found: Mapping[tuple[str, str], Alignment | None]
    groups: Mapping[str, Sequence[PlacedRun]]
    alone: Sequence[str]
    likely: Sequence[tuple[str, str, Alignment]]
    contradictions: Sequence[Contradiction]

    @classmethod
    def of(
        cls,
        things: Mapping[str, FramedThings],
        found: Mapping[tuple[str, str], Alignment | None],
    ) -> "Buildings":
        """The buildings by the alignments of pairs of sites."""
        names = list(things)
        told = [
            (names.index(one), names.index(other), each)
            for (one, other), each in found.items()
            if each is not None and each.verdict != "unknown"
        ]
        placed, against = placed_runs(
            [RunId(name) for name in names],
            [each.poses for each in things.values()],
            [RunPair(*pair) for pair in told if pair[2].verdict == "sure"],
        )
        groups: dict[str, list[PlacedRun]] = {}
        for each in placed:
            groups.setdefault(each.frame, []).append(each)
        group = {name: name for name in names} | {each.run: each.frame for each in placed}
        return cls(
            things,
            found,
            groups,
            [name for name in names if name not in groups and group[name] == name],
            [
                (names[one], names[other], each)
                for one, other, each in told
                if each.verdict == "likely" and group[names[one]] != group[names[other]]
            ],
            against,
        )

    @property
    def is_in_doubt(self) -> bool:
        """Whether pairs of a group contradict each other so much that it may be wrong."""
        return any(each.verdict != "sure" for group in self.groups.values() for each in group)

    def document(self) -> dict[str, Any]:
        """The buildings as JSON."""
        return {
            "buildings": [
                {"frame": frame, "sites": [frame, *(each.run for each in group)]}
                | {"placed": [{"site": e.run} | e.document() for e in group]}
                for frame, group in self.groups.items()
            ],
            "alone": [{"site": name} | self._nearest_document(name) for name in self.alone],
            "likely": [
                {"one": one, "other": other} | each.document() for one, other, each in self.likely
            ],
            "contradictions": [each._asdict() for each in self.contradictions],
        }

    def text(self) -> str:
        """A table with a line for each site, then what is not sure."""
        rows = []
        for number, (frame, group) in enumerate(self.groups.items(), start=1):
            rows.append([f"{number}", *self._head(frame), "0.00", "0.00", "0.0°", "", "", ""])
            for each in group:
                x, y, angle = each.transform
                at = f"{x:.2f}", f"{y:.2f}", f"{math.degrees(angle):.1f}°", f"{each.se_m:.2f}"
                doubt = "" if each.verdict == "sure" else "in doubt: pairs contradict"
                rows.append([f"{number}", *self._head(each.run), *at, f"{each.pairs}", doubt])
        rows += [["-", *self._head(name), *[""] * 5, self._nearest(name)] for name in self.alone]
        if not any(self.groups.values()):
            rows = [[*row[:3], row[-1]] for row in rows]
            lines = table([*_HEADS[:3], _HEADS[-1]], rows, right=_HEADS[2:3])
        else:
            lines = table(_HEADS, rows, right=_HEADS[2:8])
        for one, other, found in self.likely:
            lines += (
                f"perhaps one building: {visible(one)} and {visible(other)}:"
                f" {counted(len(found.pairs), 'common thing')}, score {found.score:.0f}, the next"
                f" best {found.second:.0f}\n"
            )
        return lines + "".join(f"{each}\n" for each in self.contradictions)

    def _head(self, name: str) -> tuple[str, str]:
        return visible(name), f"{len(self.things[name].object_ids):,}"

    def _nearest(self, name: str) -> str:
        best = self._most_common(name)
        if best is None:
            return "none"
        other, found = best
        return f"{visible(other)}: {len(found.pairs):,}, score {found.score:.0f}"

    def _nearest_document(self, name: str) -> dict[str, Any]:
        best = self._most_common(name)
        if best is None:
            return {"nearest": None, "common": 0, "score": 0.0}
        return {"nearest": best[0], "common": len(best[1].pairs), "score": best[1].score}

    def _most_common(self, name: str) -> tuple[str, Alignment] | None:
        """The other site whose alignment with this one has the highest score."""
        return max(
            (
                (other if one == name else one, found)
                for (one, other), found in self.found.items()
                if found is not None and name in (one, other)
            ),
            key=lambda each: each[1].score,
            default=None,
        )
