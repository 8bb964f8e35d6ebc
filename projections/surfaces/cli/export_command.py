"""The map for other programs: `mapfold export` writes files, `mapfold foxglove` serves Foxglove."""

import hashlib
import math
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import counted
from eventsrc.base.user_files import write_files
from eventsrc.record.transport.config import is_loopback
from projections.fold.corrections import map_fingerprint
from projections.map.fold import RecordedFold
from projections.map.records import objects_text
from projections.store.history_recorder import map_after
from projections.surfaces.cli.folded_log import view_of_floor

from .folded_log import FoldToOption, KnownAtOption, LogSettings
from .options import option
from .signals import stop_on_signals
from .terminal import Bar, say

if TYPE_CHECKING:
    from projections.adapters.foxglove.playback import Playback


def export(
    *,
    at: FoldToOption = "end",
    graphml: Annotated[
        Path | None, option("FILE", "Places and Objects as a graph: Gephi, yEd, networkx.")
    ] = None,
    dot: Annotated[Path | None, option("FILE", "The same for Graphviz: neato -Tsvg FILE.")] = None,
    geojson: Annotated[
        Path | None, option("FILE", "Places, Objects, ways and paths: QGIS; see --origin.")
    ] = None,
    csv: Annotated[
        Path | None, option("DIR", "Four tables: places, objects, keyframes and adjacency .csv.")
    ] = None,
    csv_raw: Annotated[
        bool,
        typer.Option(
            "--csv-raw",
            help="For programs: no apostrophe before texts that a spreadsheet takes for formulas.",
        ),
    ] = False,
    nav2: Annotated[
        Path | None, option("FILE", "A waypoint for each Place, as Nav2's RViz panel loads.")
    ] = None,
    dsg: Annotated[
        Path | None, option("FILE", "Rooms, poses and Objects as spark_dsg's scene graph, JSON.")
    ] = None,
    foxglove: Annotated[
        Path | None,
        option("FILE.mcap", "How the map came about, event by event (extra [foxglove])."),
    ] = None,
    rerun: Annotated[
        Path | None, option("FILE.rrd", "The same for the Rerun viewer (extra [rerun]).")
    ] = None,
    every: Annotated[
        int | None,
        option(
            "N",
            "A scene every N events, for --foxglove and --rerun [default: as many as make at"
            " most 500 scenes].",
            min=1,
        ),
    ] = None,
    origin: Annotated[
        str | None,
        option(
            "LAT,LON[,YAW]",
            "Where the map frame's origin is on Earth (WGS 84), and its x axis in degrees"
            " counter-clockwise from east, for --geojson [default: coordinates are metres].",
        ),
    ] = None,
    all_: Annotated[
        bool, typer.Option("--all", help="Objects seen once, too, in --foxglove and --rerun.")
    ] = False,
    floor: Annotated[
        str | None, option("NAME", "This floor only; - is the floor without a name.", "--floor")
    ] = None,
    known_at: KnownAtOption = None,
    source: LogSettings,
) -> None:
    """Write the map folded to a point in the log for other programs.

    GraphML, Graphviz, GeoJSON, CSV, Nav2 waypoints, spark_dsg and recordings for Foxglove and
    Rerun, one or several at once. The same log and settings give the same bytes; for Rerun, the
    same data. Files have all objects, with whether each is confirmed; recordings and spark_dsg have
    the confirmed ones.
    """
    files = {
        "graphml": graphml,
        "dot": dot,
        "geojson": geojson,
        "csv": csv,
        "nav2": nav2,
        "dsg": dsg,
    }
    recordings = {"foxglove": foxglove, "rerun": rerun}
    if not any((files | recordings).values()):
        names = ", ".join(f"--{name}" for name in files | recordings)
        raise MisuseError(f"nothing to write; give at least one of {names}")
    if origin is not None and geojson is None:
        raise MisuseError("--origin is for --geojson")
    if csv_raw and csv is None:
        raise MisuseError("--csv-raw is for --csv")
    if every is not None and not any(recordings.values()):
        raise MisuseError("--every is for --foxglove and --rerun")
    if all_ and not any(recordings.values()):
        raise MisuseError("--all is for --foxglove and --rerun; the other files have all objects")
    if floor is not None and foxglove is not None:
        raise MisuseError("--foxglove shows all floors, one above the other; leave --floor out")
    if floor is not None and rerun is not None:
        raise MisuseError("--rerun shows all floors, each in a view; leave --floor out")
    from projections.adapters import export as formats  # here: with the imports of several formats

    where = None if origin is None else formats.Origin(*_degrees(origin))
    with source.opened(at, known_at) as (reader, end, _, corrections, settings):
        for name, file in recordings.items():
            if file is not None:
                made = f"{reader.log_id} {map_fingerprint(settings, corrections)} {end} {every}"
                write = _recorder(name, f"{made} all" if all_ else made, everything=all_)
                with Bar() as bar:
                    fold = RecordedFold(
                        reader,
                        settings,
                        end,
                        corrections=corrections,
                        every=every,
                        progress=bar.show_fold,
                    )
                    scenes = write(fold, file)
                say(f"wrote {file}: {counted(end, 'event')}, {counted(scenes, 'scene')}")
        if not any(files.values()):
            return
        view = map_after(reader, settings, end, corrections=corrections, note=say)
    if floor is not None:
        view = view_of_floor(view, floor)
    texts: dict[Path, str] = {}
    if graphml is not None:
        texts[graphml] = formats.graphml(view)
    if dot is not None:
        texts[dot] = formats.dot(view)
    if geojson is not None:
        texts[geojson] = formats.geojson(view, where)
    if nav2 is not None:
        texts[nav2] = formats.nav2_waypoints(view)
    if dsg is not None:
        texts[dsg] = formats.spark_dsg(view)
    if csv is not None:
        texts |= {csv / name: text for name, text in formats.tables(view, raw=csv_raw).items()}
    write_files({path: text.encode() for path, text in texts.items()})
    places, objects = counted(len(view.places), "place"), objects_text(view.objects.values())
    say(f"wrote {', '.join(map(str, texts))}: {places}, {objects}")


def _recorder(
    name: str, identity: str, *, everything: bool = False
) -> Callable[[RecordedFold, Path], int]:
    """The function that writes the recordings of an option. Raises MisuseError if its extra is not
    installed."""
    try:
        if name == "foxglove":
            from projections.adapters.foxglove.playback import write_recording

            return partial(write_recording, everything=everything)
        from projections.adapters.rerun import rrd_recording
    except ModuleNotFoundError as error:
        raise MisuseError(
            f"--{name} needs {error.name}, which is not installed; pip install 'mapfold[{name}]'"
        ) from None
    recording_id = hashlib.sha256(identity.encode()).hexdigest()[:32]
    return partial(rrd_recording.write_recording, recording_id=recording_id, everything=everything)


def _degrees(text: str) -> tuple[float, ...]:
    """``52.52,13.405`` or ``52.52,13.405,90``. Raises MisuseError."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) not in (2, 3) or not all(map(math.isfinite, values)):
        raise MisuseError(f"--origin {text}: write it as LAT,LON or LAT,LON,YAW, in degrees")
    if not (-89 <= values[0] <= 89 and -180 <= values[1] <= 180):
        raise MisuseError(
            f"--origin {text}: give a latitude of -89 to 89 and a longitude of -180 to 180"
        )
    return values


def foxglove(
    *,
    host: Annotated[str, option("ADDRESS", "Listen here.")] = "127.0.0.1",
    port: Annotated[int, option("N", "0 takes a free one.", min=0, max=65_535)] = 8765,
    layout: Annotated[
        Path | None, option("FILE", "Write a layout there first, for Foxglove to import from file.")
    ] = None,
    all_: Annotated[bool, typer.Option("--all", help="Show objects seen once, too.")] = False,
    known_at: KnownAtOption = None,
    source: LogSettings,
) -> None:
    """Show a log's map in Foxglove, whose timeline sets the time.

    Seek, play and pause show the map as it was. In Foxglove: Open connection, Foxglove WebSocket.
    Anybody who can reach the address can read the log. Ctrl-C ends it.
    """
    try:
        from projections.adapters.foxglove.playback import (
            PROTOCOL,
            ClientTroubles,
            PastMaps,
            Playback,
            layout_json,
        )
    except ModuleNotFoundError as error:
        raise MisuseError(
            f"mapfold foxglove needs {error.name}, which is not installed;"
            " pip install 'mapfold[foxglove]'"
        ) from None
    source.checked()
    if layout is not None:
        write_files({layout: layout_json().encode()})
        say(f"wrote {layout}")
    with source.opened(known_at=known_at) as (reader, end, _, corrections, settings):
        with Bar() as bar:
            maps = PastMaps(reader, settings, corrections, end, bar.show_fold)
        if maps.moments.backwards:
            say(
                f"{counted(maps.moments.backwards, 'event')} with an earlier stamp than an event"
                " before; the timeline shows them at that event's time"
            )
        try:
            playback = Playback(maps, source.log.resolve().name, host, port, everything=all_)
        except (OSError, UnicodeError) as error:  # the latter of a host that is no text
            raise MisuseError(
                f"cannot listen on {host}:{port}: {error}; give another --host or --port"
            ) from None
        with stop_on_signals() as stop, ClientTroubles(say) as troubles:
            if not is_loopback(host):
                say(f"warning: others can reach {host}, and can read the log; there is no token")
            shown = f"[{host}]" if ":" in host else host
            say(
                f"showing {counted(end, 'event')} of {source.log} at ws://{shown}:{playback.server.port}"
            )
            say(
                f"in Foxglove: Open connection, Foxglove WebSocket (it must speak {PROTOCOL});"
                " Ctrl-C ends it"
            )
            _run(playback, stop)
    if troubles.unsaid:
        say(f"{counted(troubles.unsaid, 'more trouble')} with clients")
    say("closed")


def _run(playback: "Playback", stop: threading.Event) -> None:
    """Play until ``stop``; an error of the player ends it and is raised."""
    failed: list[BaseException] = []

    def play() -> None:
        try:
            playback.run()
        except BaseException as error:  # noqa: BLE001 - raised below
            failed.append(error)
            stop.set()

    player = threading.Thread(target=play, name="playback")
    player.start()
    stop.wait()
    playback.end()
    player.join()
    if failed:
        raise failed[0]
