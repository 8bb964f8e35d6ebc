"""``mapfold find``: where things are."""

from typing import Annotated

import typer

from eventsrc.base.text import shorten_by, table, visible
from projections.ask.find import FoundObject, FoundObjects, Wanted, find, robot_seconds
from projections.map.naming import ShortIds, things_of
from projections.store.history_recorder import map_after

from .folded_log import CachedLog, FoldToOption, KnownAtOption
from .options import JsonOption
from .terminal import display, emit, say


def find_things(
    *,
    source: CachedLog,
    what: Annotated[
        str | None,
        typer.Argument(
            metavar="WHAT",
            help="A class, such as chair or chairs, or an object's id [default: everything].",
        ),
    ] = None,
    room: Annotated[
        str | None,
        typer.Option("--in", metavar="PLACE", help="Only what is in this place, such as kitchen."),
    ] = None,
    near: Annotated[
        str | None,
        typer.Option(
            "--near", metavar="X,Y|THING", help="Nearest first, to a point in metres or a thing."
        ),
    ] = None,
    at: FoldToOption = "end",
    known_at: KnownAtOption = None,
    missing: Annotated[
        bool,
        typer.Option(
            "--missing", help="Only missing objects: the robot looked and did not see them."
        ),
    ] = False,
    moved: Annotated[bool, typer.Option("--moved", help="Only what has moved.")] = False,
    seen_since: Annotated[
        str | None,
        typer.Option("--seen-since", metavar="TIME", help="Only what was seen at TIME or later."),
    ] = None,
    not_seen_since: Annotated[
        str | None,
        typer.Option("--not-seen-since", metavar="TIME", help="Only what was last seen earlier."),
    ] = None,
    top: Annotated[int, typer.Option("--top", metavar="N", min=1, help="Most answers.")] = 10,
    every: Annotated[bool, typer.Option("--all", help="Also what was seen once.")] = False,
    json_: JsonOption = False,
) -> None:
    """Find things: where they are, how often and when they were seen.

    WHAT forgives letter case, plurals and near spellings; a place is given by its id, name or type.
    """
    wanted = Wanted(
        what=what,
        room=room,
        near=near,
        missing=missing,
        moved=moved,
        seen_since=None if seen_since is None else robot_seconds(seen_since),
        not_seen_since=None if not_seen_since is None else robot_seconds(not_seen_since),
        top=top,
        every=every,
    )
    with source.opened(at, known_at) as (reader, end, _, corrections, settings):
        view = map_after(
            reader, settings, end, corrections=corrections, note=say, cache=not source.no_cache
        )
    shorten_by(ShortIds.of(things_of(view)).text)
    found = find(view, wanted)
    if json_:
        emit(found.document())
        return
    display(_table(found) if found.answers else "nothing found\n")
    for line in _remarks(wanted, found):
        say(line)


def _table(found: FoundObjects) -> str:
    header = ["object", "class", "place", "position (m)", "seen", "last seen"]
    if found.answers[0].distance_m is not None:
        header.insert(4, "away (m)")
    rows = []
    for each in found.answers:
        row = [
            each.object_id,
            visible(each.class_name),
            _place(each),
            _position(each),
            f"{each.obs_count:,}×",
            _last(each),
        ]
        if each.distance_m is not None:
            row.insert(4, f"{each.distance_m:.2f}")
        rows.append(row)
    return table(header, rows, right=("seen", "away (m)"))


def _place(each: FoundObject) -> str:
    if each.place_id is None:
        return "no place"
    word = each.place_name or each.place_type
    place_id = visible(each.place_id)
    return place_id if word is None else f"{place_id} {visible(word)}"


def _position(each: FoundObject) -> str:
    at = f"({each.x:.2f}, {each.y:.2f})"
    return f"seen from {at}" if each.sigma_m is None else f"{at} ± {each.sigma_m:.2f}"


def _last(each: FoundObject) -> str:
    """When it was last seen, and what became of it."""
    seen = f"{each.last_seen.iso} {visible(each.last_seen.run_id)}:{each.last_seen.keyframe_id}"
    if each.missing_in is not None:
        return f"{seen}; missing in {visible(each.missing_in)}"
    if each.moved_from is not None:
        return f"{seen}; was at ({each.moved_from[0]:.2f}, {each.moved_from[1]:.2f})"
    return seen


def _remarks(wanted: Wanted, found: FoundObjects) -> list[str]:
    remarks = []
    if wanted.what is not None and found.match in ("words", "spelling"):
        classes = ", ".join(map(visible, found.classes))
        remarks.append(f"no class {wanted.what!r}; found {classes}")
    if found.count > len(found.answers):
        remarks.append(f"{found.count - len(found.answers):,} more; --top {found.count} lists all")
    if found.unconfirmed:
        remarks.append(f"+ {found.unconfirmed:,} seen once; --all lists them")
    return remarks
