"""`mapfold draw`: a picture of the map folded to a point in the log."""

from pathlib import Path
from typing import Annotated

import typer

from eventsrc.envelope import FIRST_OFFSET
from eventsrc.log import LogReader
from eventsrc.text import counted
from projections.model.fold import fold_events
from projections.model.view import MapView
from projections.reducers.semantic_map import SemanticMap

from .options import SetOption, SettingsOption, W, check_picture, point, settings_from
from .terminal import say


def draw(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="The log's folder.")],
    at: Annotated[
        str,
        typer.Option("--at", metavar="W", help=f"Fold to here: {W}."),
    ] = "end",
    out: Annotated[
        Path, typer.Option(metavar="FILE", help="The picture; its suffix says how: png, svg, pdf.")
    ] = Path("map.png"),
    house: Annotated[
        int | None,
        typer.Option(metavar="SEED", help="Draw the plan of this simulated house under it.", min=0),
    ] = None,
    min_observations: Annotated[
        int, typer.Option(metavar="N", help="Leave out objects seen less often.", min=1)
    ] = 2,
    merges: Annotated[
        bool, typer.Option("--merges", help="Mark the keyframes that merged places.")
    ] = False,
    set_: SetOption = None,
    settings_file: SettingsOption = None,
) -> None:
    """A picture of the map folded to a point in the log.

    The robot's path, places in colours, objects, and edges between adjacent places.
    """
    # Imported here: matplotlib takes longer to import than most commands take to run.
    from eventsrc.sim import build_house
    from projections.drawing import draw_map, floor_of
    from projections.drawing.picture import bridges_of, fold_with_merges

    check_picture(out)
    settings = settings_from(settings_file, set_)
    view = MapView(settings, keep_embeddings=False)
    with LogReader(log) as reader:
        events = reader.read(FIRST_OFFSET, point(reader, at))
        merged = fold_with_merges(fold_events(events, SemanticMap(settings)), view)
    draw_map(
        view,
        out,
        title=f"{log.resolve().name} after {counted(view.next_offset, 'event')}",
        floor=None if house is None else floor_of(build_house(house)),
        bridges=bridges_of(view, merged) if merges else (),
        min_observations=min_observations,
    )
    places, objects = counted(len(view.places), "place"), counted(len(view.objects), "object")
    say(f"wrote {out}: {places}, {objects}")


def register(app: typer.Typer) -> None:
    """Add `draw` to ``app``."""
    app.command()(draw)
