"""Text output of ``mapfold fleet``: the table of sites, and the ranking of sites for a question."""

from collections.abc import Sequence
from typing import Final

from eventsrc.base.text import visible
from projections.adapters.fleet.site_tasks import SiteStatus
from projections.adapters.fleet.sites import Site
from projections.adapters.fleet.which_site import WhichSite
from projections.postgres.status import SinkStatus

from .event_text import iso_time

_HEADS: Final = (
    "site", "state", "events", "MB", "keys", "last keyframe", "rejected", "lost", "graph", "vectors"
)  # fmt: skip
_NUMBERS: Final = frozenset({2, 3, 4, 6, 7})
_MB: Final = 1_000_000
_LISTED: Final = 10


def status_table(sites: Sequence[Site], found: Sequence[SiteStatus]) -> str:
    """One line a site."""
    rows = [list(_HEADS)]
    rows += [_row(site, each) for site, each in zip(sites, found, strict=True)]
    widths = [max(len(row[column]) for row in rows) for column in range(len(_HEADS))]
    return "".join(_line(row, widths) for row in rows)


def _line(row: Sequence[str], widths: Sequence[int]) -> str:
    cells = (
        cell.rjust(width) if column in _NUMBERS else cell.ljust(width)
        for column, (cell, width) in enumerate(zip(row, widths, strict=True))
    )
    return "  ".join(cells).rstrip() + "\n"


def _row(site: Site, found: SiteStatus) -> list[str]:
    info, databases = found.info, found.databases
    if info is None or databases is None:
        return [visible(site.name), "failed", *"------", "-", "-"]
    last = "-" if info.last_stamp_ns is None else iso_time(info.last_stamp_ns)[:19] + "Z"
    published = [key for key in info.keys if not key.startswith("mapfold/")]
    return [
        visible(site.name),
        "ok" if found.healthy else "findings",
        f"{info.events:,}",
        f"{info.size_bytes / _MB:,.1f}",
        f"{len(published):,}",
        last,
        f"{info.rejected:,}",
        f"{info.lost:,}",
        *map(_sink_cell, databases.sinks),
    ]


def _sink_cell(sink: SinkStatus) -> str:
    """The condition, the number of events behind, and that of parked events."""
    cell: str = sink.condition
    if sink.lag:
        cell = f"behind by {sink.lag:,}" if cell == "behind" else f"{cell}, behind by {sink.lag:,}"
    if sink.dead_letters:
        cell += f", {len(sink.dead_letters):,} parked"
    return cell


def which_site_text(which: WhichSite) -> str:
    """The likeliest site, then all of them with place and probabilities."""
    if not which.sites:
        return "no site could be asked\n"
    best = which.best
    if best is None:
        first = f"none of these sites (probability {which.none:.2f})"
    else:
        first = f"{visible(best.name)} (probability {best.probability:.2f})"
    lines = [first]
    for number, each in enumerate(which.sites[:_LISTED], start=1):
        answer = each.answer
        place = visible(answer.places[0].name or answer.places[0].place_id) if answer.places else ""
        at = "" if answer.pose is None else f" at ({answer.pose.x:.2f}, {answer.pose.y:.2f}) m"
        lines.append(
            f"{number}. {visible(each.name)}  {each.probability:.3f}"
            f"  known {answer.known:.2f}, confidence {answer.confidence:.2f}"
            f"  {place}{at}".rstrip()
            + (f"  (thin map: {answer.thin})" if answer.thin is not None else "")
        )
    if len(which.sites) > _LISTED:
        lines.append(f"and {len(which.sites) - _LISTED:,} more")
    lines.append(f"none of them  {which.none:.3f}")
    return "\n".join(lines) + "\n"
