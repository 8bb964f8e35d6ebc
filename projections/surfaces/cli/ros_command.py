"""`mapfold ros`: the map in a running ROS 2 graph, as a node over rmw_zenoh."""

import re
import threading
import time
from contextlib import ExitStack
from typing import TYPE_CHECKING, Annotated, Final

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import counted, visible
from eventsrc.ros.library import MessageTypes
from eventsrc.ros.wire import topic_of
from projections.fold.map_errors import DatabaseUnavailable, ProjectionMissing

from .bridge_options import DomainOption, domain_of
from .folded_log import FoldSettings, NoCacheOption
from .option import option
from .options import LiveDbOption, LogOrDbArgument, VectorsOption, ZenohClient
from .signals import stop_on_signals
from .terminal import say

if TYPE_CHECKING:
    from projections.adapters.ros.shown_map import ShownMap
    from projections.surfaces.mcp.cited_maps import LiveMaps, LogMaps

_LOOK_S: Final = 1.0
_SHARE: Final = 5.0
"""A map that took long to make is looked for again after so many times as long."""
_NAME: Final = re.compile(r"[A-Za-z_]\w{0,99}", re.ASCII)


def ros(
    *,
    log: LogOrDbArgument = None,
    db: LiveDbOption = None,
    vector_db: VectorsOption = None,
    domain: DomainOption = None,
    namespace: Annotated[str, option("NS", "The node's namespace, as /bot1.", "--namespace")] = "",
    name: Annotated[str, option("NAME", "The node's name.", "--name")] = ("mapfold"),
    settings: FoldSettings,
    no_cache: NoCacheOption = False,
    client: ZenohClient,
) -> None:
    """Show the map in ROS 2, as a node over rmw_zenoh, until Ctrl-C (extra [ros]).

    Publishes ~/markers for RViz, ~/objects (Detection3DArray) and ~/walls (OccupancyGrid), all
    transient local. A growing log is followed. ROS need not be installed.
    """
    if (log is None) == (db is None):
        raise MisuseError("give a LOG, or --db URL to show the databases' map")
    if log is not None and vector_db is not None:
        raise MisuseError("--vector-db is for --db, not for a log")
    if not _NAME.fullmatch(name):
        raise MisuseError(
            f"--name {visible(name)[:80]} is no name of a ROS 2 node; example: mapfold"
        )
    under = topic_of(namespace, name, "--name").removesuffix(f"/{name}")
    number, types = domain_of(domain), MessageTypes()
    from eventsrc.record.ros_node import RosNode
    from projections.adapters.ros.shown_map import ShownMap
    from projections.surfaces.mcp.cited_maps import LiveMaps, LogMaps

    with ExitStack() as stack:
        maps: LogMaps | LiveMaps
        if log is not None:
            checked = settings.checked()
            maps = stack.enter_context(LogMaps(log, checked, cache=not no_cache, note=say))
        else:
            settings.of_past_map(None)  # refuses settings
            # Imported here: the drivers take as long to import as a small map to fold.
            from projections.postgres.connection import open_targets
            from projections.surfaces.serve import Pools

            targets = stack.enter_context(open_targets(db or None, vector_db))
            maps = LiveMaps(stack.enter_context(Pools(targets, 2, say)))
        stop = stack.enter_context(stop_on_signals())
        session = stack.enter_context(client.session())
        node = stack.enter_context(RosNode(session, types, number, under, name))
        shown = ShownMap(node)
        session.confirm()
        say(f"node {under}/{name} in domain {number}; Ctrl-C ends it")
        _follow(maps, shown, stop)
    say("node ended")


def _follow(maps: "LogMaps | LiveMaps", shown: "ShownMap", stop: threading.Event) -> None:
    """Show the map, and again whenever it has changed, until ``stop``."""
    last, fault = None, None
    while True:
        began = time.monotonic()
        try:
            cited = maps.map("end", None)
            fault = None
        except (DatabaseUnavailable, ProjectionMissing) as error:
            if fault != str(error):
                fault = str(error)
                say(fault)
            cited = None
        if cited is not None and cited.name != last:
            changed = shown.show(cited.view)
            if last is None or changed:
                events = counted(cited.name.offset, "event")
                topics = "" if last is not None else f" on {', '.join(shown.topics)}"
                say(f"map of {events}: {counted(changed, 'marker')} changed{topics}")
            last = cited.name
        took = time.monotonic() - began
        if stop.wait(max(_LOOK_S, _SHARE * took)):
            return
