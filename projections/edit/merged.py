"""The places that a merge made one, by the keyframes that founded them."""

from eventsrc.commands import UndoMerge
from eventsrc.errors import MisuseError
from eventsrc.text import counted
from projections.corrections import Keyframe

from .conflicts import EditRefused, describe, refusal
from .current import CurrentMap

_MOST_OFFSETS = 10


def merged_at(current: CurrentMap, offset: int) -> tuple[Keyframe, ...]:
    """The founding keyframes of the places that the event at ``offset`` made one.

    Raises MisuseError with the offsets of merges when nothing merged there, and EditRefused when a
    ``join`` command merged them, or when the event made several merges.
    """
    found = [merge for merge in current.merges if merge.offset == offset]
    if not found:
        _check_not_undone(current, offset)
        raise MisuseError(_nothing_merged(current, offset))
    by_themselves = [
        [merge.survivor, *(p for p in merge.absorbed if p not in merge.joined)] for merge in found
    ]
    merged = [places for places in by_themselves if len(places) > 1]
    if not merged:
        for recorded in reversed(current.corrections.in_force):
            if recorded.command.kind == "join":
                raise refusal(
                    f"the places of the merge at {offset} are joined", recorded, current.reader.path
                )
    if len(merged) != 1:
        ids = current.view.place_id
        parts = "; ".join(" with ".join(str(ids(p)) for p in places) for places in merged)
        raise EditRefused(
            f"{len(merged)} merges happened at offset {offset}: {parts}; say which with "
            "`mapfold edit LOG keep-apart PLACE PLACE`"
        )
    return tuple(current.founder(place) for place in merged[0])


def _check_not_undone(current: CurrentMap, offset: int) -> None:
    for recorded in current.corrections.in_force:
        command = recorded.command
        if isinstance(command, UndoMerge) and command.merge_offset == offset:
            raise EditRefused(f"the merge at {offset} is undone already, by {describe(recorded)}")


def _nothing_merged(current: CurrentMap, offset: int) -> str:
    offsets = sorted({m.offset for m in current.merges}, key=lambda at: (abs(at - offset), at))
    if not offsets:
        return f"nothing merged at offset {offset}; no places were merged in this log"
    near = ", ".join(map(str, sorted(offsets[:_MOST_OFFSETS])))
    more = len(offsets) - _MOST_OFFSETS
    rest = f" (and {more:,} more)" if more > 0 else ""
    return (
        f"nothing merged at offset {offset}; {counted(len(offsets), 'event')} merged places, at "
        f"{near}{rest}: see `mapfold merges {current.reader.path}`"
    )
