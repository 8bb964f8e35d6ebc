"""`mapfold state` and `mapfold draw`: the map folded to a point in the log, as text, JSON or a
picture."""

from pathlib import Path
from typing import Annotated

import typer

from eventsrc.base.errors import MisuseError
from eventsrc.base.progress import working
from eventsrc.base.text import counted, visible
from projections.map.digest import map_digest
from projections.map.records import objects_text
from projections.map.state_output import places_advice, space_advice, state_document, state_text
from projections.map.view import MapView
from projections.store.history_recorder import HistoryRecorder, map_after
from projections.store.timeline_cache import TimelineCache

from .folded_log import CachedLog, FoldToOption, KnownAtOption, LogSettings, classes_advice
from .options import JsonOption, check_picture, option
from .terminal import display, emit, say


def state(
    *,
    at: FoldToOption = "end",
    known_at: KnownAtOption = None,
    json_: JsonOption = False,
    all_: Annotated[
        bool, typer.Option("--all", help="Count objects seen once in the places, too.")
    ] = False,
    digest: Annotated[bool, typer.Option("--digest", help="Print only the digest.")] = False,
    no_digest: Annotated[
        bool, typer.Option("--no-digest", help="Leave out the digest, which reads the whole map.")
    ] = False,
    source: CachedLog,
) -> None:
    """Show the map folded to a point in the log.

    Counts, settings, digest, and each place with its size and neighbours; --json prints all.
    """
    if json_ and digest:
        raise MisuseError("--json and --digest together: --json prints the digest too")
    if digest and no_digest:
        raise MisuseError("--digest and --no-digest exclude each other")
    with source.opened(at, known_at) as (reader, end, known, corrections, settings):
        view = map_after(
            reader, settings, end, corrections=corrections, note=say, cache=not source.no_cache
        )
    hexdigits = None
    if not no_digest:
        with working("computing the digest"):
            hexdigits = map_digest(view)
    if json_:
        emit(state_document(view, hexdigits, known))
    elif digest:
        display(f"{hexdigits}\n")
    else:
        display(state_text(view, hexdigits, known, everything=all_))
    if digest:
        return
    counts = view.counts()
    seen = view.observations
    is_numbered = bool(seen) and all(each.class_name.isdecimal() for each in seen)
    of_classes = classes_advice(source.log) if is_numbered else None
    for advice in (places_advice(counts, settings), space_advice(view), of_classes):
        if advice is not None:
            say(advice)


def draw(
    *,
    at: FoldToOption = "end",
    out: Annotated[Path, option("FILE", "The picture: .png, .svg or .pdf.")] = Path("map.png"),
    house: Annotated[
        int | None, option("SEED", "Draw the plan of this simulated house under the map.", min=0)
    ] = None,
    all_: Annotated[bool, typer.Option("--all", help="Draw objects seen once, too.")] = False,
    min_observations: Annotated[
        int, option("N", "Leave out objects with fewer observations.", min=1)
    ] = 1,
    floor: Annotated[
        str | None,
        option("NAME", "Draw this floor only; - is the floor without a name.", "--floor"),
    ] = None,
    merges: Annotated[
        bool, typer.Option("--merges", help="Mark the keyframes that merged places.")
    ] = False,
    known_at: KnownAtOption = None,
    source: LogSettings,
) -> None:
    """Draw the map folded to a point in the log.

    The robot's path, places in colours, objects, and edges between adjacent places.
    """
    # Imported here: matplotlib takes longer to import than most commands take to run.
    from eventsrc.adapters.sim import build_house
    from projections.adapters.drawing import draw_map, plan_of
    from projections.adapters.drawing.map_picture import merge_marks
    from projections.surfaces.cli.folded_log import view_of_floor

    check_picture(out)
    with source.opened(at, known_at) as (reader, end, _, corrections, settings):
        cache = TimelineCache(reader, settings, corrections, say)
        recorder = HistoryRecorder(reader, settings, corrections, cache, None)
        view: MapView = recorder.at(end)
        merged = [m for m in recorder.history(end).merges if m.cause.offset < end]
    title = f"{source.log.resolve().name} after {counted(view.next_offset, 'event')}"
    if floor is not None:
        view, title = view_of_floor(view, floor), f"{title}, floor {visible(floor)}"
    elif len(floors := {k.floor for k in view.keyframes if k.pose is not None}) > 1:
        say(f"{out} shows {len(floors)} floors, one above the other; --floor NAME draws one")
    with working("drawing"):
        draw_map(
            view,
            out,
            title=title,
            plan=None if house is None else plan_of(build_house(house)),
            marks=merge_marks(view, merged) if merges else (),
            everything=all_,
            min_observations=min_observations,
        )
    places = counted(len(view.places), "place")
    say(f"wrote {out}: {places}, {objects_text(view.objects.values())}")
