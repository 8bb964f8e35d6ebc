"""`mapfold export`: the map folded to a point in the log, in the formats of other programs."""

import math
from pathlib import Path
from typing import Annotated

import typer

from eventsrc.errors import MisuseError
from eventsrc.log import LogReader
from eventsrc.text import counted
from projections.model.fold import fold_log_cached
from projections.model.log_commands import read_corrections

from .options import (
    KnownAtOption,
    LogArgument,
    SetOption,
    SettingsOption,
    W,
    known_point,
    point,
    settings_from,
)
from .terminal import say


def export(
    log: LogArgument,
    at: Annotated[str, typer.Option("--at", metavar="W", help=f"Fold to here: {W}.")] = "end",
    graphml: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Places and Objects as a graph: Gephi, yEd, networkx."),
    ] = None,
    dot: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The same for Graphviz: neato -Tsvg FILE.")
    ] = None,
    geojson: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Places, Objects, ways and paths: QGIS; see --origin."),
    ] = None,
    csv: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Four tables: places, objects, keyframes and adjacency .csv."
        ),
    ] = None,
    nav2: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="A waypoint for each Place, as Nav2's RViz panel loads."),
    ] = None,
    origin: Annotated[
        str | None,
        typer.Option(
            metavar="LAT,LON[,YAW]",
            help="Where the map frame's origin is on Earth (WGS 84), and its x axis in degrees"
            " counter-clockwise from east, for --geojson [default: coordinates are metres].",
        ),
    ] = None,
    floor: Annotated[
        str | None,
        typer.Option("--floor", metavar="NAME", help="This floor only; - is that without a name."),
    ] = None,
    known_at: KnownAtOption = None,
    set_: SetOption = None,
    settings_file: SettingsOption = None,
) -> None:
    """Write the map folded to a point in the log for other programs.

    GraphML, Graphviz, GeoJSON, CSV and Nav2 waypoints, one or several at once. The same log and
    settings give the same bytes.
    """
    from projections import export as formats
    from projections.drawing.one_floor import view_of_floor

    wanted = {"graphml": graphml, "dot": dot, "geojson": geojson, "csv": csv, "nav2": nav2}
    if not any(wanted.values()):
        raise MisuseError("nothing to write: give " + ", ".join(f"--{name}" for name in wanted))
    if origin is not None and geojson is None:
        raise MisuseError("--origin is for --geojson")
    where = None if origin is None else formats.Origin(*_degrees(origin))
    settings_from(settings_file, set_)  # a bad value is an error before the log is opened
    with LogReader(log) as reader:
        end = point(reader, at)
        corrections = read_corrections(reader, known_point(reader, known_at, end))
        settings = settings_from(settings_file, set_, corrections)
        _, view = fold_log_cached(reader, settings, end, note=say, corrections=corrections)
    if floor is not None:
        view = view_of_floor(view, floor)
    files: dict[Path, str] = {}
    if graphml is not None:
        files[graphml] = formats.graphml(view)
    if dot is not None:
        files[dot] = formats.dot(view)
    if geojson is not None:
        files[geojson] = formats.geojson(view, where)
    if nav2 is not None:
        files[nav2] = formats.nav2_waypoints(view)
    if csv is not None:
        files |= {csv / name: text for name, text in formats.tables(view).items()}
    for path, text in files.items():
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, "utf-8", newline="")
        except OSError as error:
            raise MisuseError(
                f"{path}: cannot be written: {error.strerror}; choose another"
            ) from None
    places, objects = counted(len(view.places), "place"), counted(len(view.objects), "object")
    say(f"wrote {', '.join(map(str, files))}: {places}, {objects}")


def _degrees(text: str) -> tuple[float, ...]:
    """``52.52,13.405`` or ``52.52,13.405,90``. Raises MisuseError."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) not in (2, 3) or not all(map(math.isfinite, values)):
        raise MisuseError(f"--origin {text}: wants LAT,LON or LAT,LON,YAW in degrees")
    if not (-89 <= values[0] <= 89 and -180 <= values[1] <= 180):
        raise MisuseError(f"--origin {text}: latitude is -89 to 89, longitude -180 to 180")
    return values


def register(app: typer.Typer) -> None:
    """Add `export` to ``app``."""
    app.command()(export)
