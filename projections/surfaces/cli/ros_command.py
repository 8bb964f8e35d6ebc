"""`mapfold ros`: the map in a running ROS 2 graph, as a node over rmw_zenoh."""

import re
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from typing import TYPE_CHECKING, Annotated, Final

import typer

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import counted, visible
from eventsrc.record.importers.bag_streams import BagOptions
from eventsrc.record.recorder.bridged import Bridge
from eventsrc.record.recorder.listener import Listener
from eventsrc.record.ros_node import RosNode, find_topics
from eventsrc.ros.derivation import RosRecording
from eventsrc.ros.library import MessageTypes
from eventsrc.ros.wire import RmwWire, topic_of
from projections.fold.map_errors import DatabaseUnavailable, ProjectionMissing
from projections.localize.relocalize import Answer, Question, rank

from .bridge_options import used_topics
from .folded_log import FoldSettings, NoCacheOption
from .options import (
    DomainOption,
    LiveDbOption,
    LogOrDbArgument,
    VectorsOption,
    ZenohClient,
    domain_of,
    option,
)
from .signals import stop_on_signals
from .terminal import say

if TYPE_CHECKING:
    from projections.adapters.ros.map_messages import ShownMap
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
    namespace: Annotated[
        str, option("NS", "Of the node and the robot, as /bot1.", "--namespace")
    ] = "",
    name: Annotated[str, option("NAME", "The node's name.", "--name")] = "mapfold",
    auto: Annotated[
        bool, typer.Option("--auto", help="Look at once where the robot is, as if asked.")
    ] = False,
    odom_frame: Annotated[
        str, option("FRAME", "In which a lost robot's tf moves it.", "--odom-frame")
    ] = "odom",
    settings: FoldSettings,
    no_cache: NoCacheOption = False,
    client: ZenohClient,
) -> None:
    """Show the map in ROS 2, as a node over rmw_zenoh, until Ctrl-C (extra [ros]).

    Publishes ~/markers for RViz, ~/objects (Detection3DArray) and ~/walls (OccupancyGrid), all
    transient local. A growing log is followed. Asked by the service ~/localize (std_srvs/Trigger),
    it publishes /initialpose once the robot's detections make it sure where the robot is. ROS need
    not be installed.
    """
    if (log is None) == (db is None):
        raise MisuseError("give a LOG, or --db URL to show the databases' map")
    if log is not None and vector_db is not None:
        raise MisuseError("--vector-db is for --db, not for a log")
    if not _NAME.fullmatch(name):
        raise MisuseError(f"--name {visible(name)[:80]} is no name of a ROS 2 node, as mapfold is")
    under = topic_of(namespace, name, "--name").removesuffix(f"/{name}")
    number, types = domain_of(domain), MessageTypes()
    from projections.adapters.ros.initial_pose import InitialPose
    from projections.adapters.ros.map_messages import ShownMap
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
        following = _Following(maps, ShownMap(node))

        def listen() -> Listener | None:
            wire, options = RmwWire(number), BagOptions(map_frame=odom_frame)
            made = find_topics(session, wire, types, options, under, stop=stop, note=say)
            if made is None:
                return None
            following.pin()
            recording = RosRecording(key=f"{node.names.name}/lost", streams=tuple(made.streams))
            bridge = Bridge(recording, used_topics(recording), types, wire)
            return Listener(session, bridge, types)

        found = InitialPose(node, listen, following.ask, say)
        session.confirm()
        say(f"node {under}/{name} in domain {number}; Ctrl-C ends it")
        if auto:
            say(found.start()[1])
        with ThreadPoolExecutor(1, thread_name_prefix="initial-pose") as thread:
            looking = thread.submit(found.run, stop)
            looking.add_done_callback(lambda _: stop.set())
            try:
                following.run(stop)
            finally:
                stop.set()
            looking.result()
    say("node ended")


class _Following:
    """Shows the newest map, and answers questions by the one that was shown when `pin` was called:
    the log may grow meanwhile, by what the lost robot sees, too."""

    def __init__(self, maps: "LogMaps | LiveMaps", shown: "ShownMap") -> None:
        self._maps, self._shown = maps, shown
        self._lock = threading.Lock()  # `maps` are not for several threads at once
        self._moment: tuple[str, str | None] = "end", None
        self._pinned: tuple[str, str | None] = self._moment

    def pin(self) -> None:
        """Answer by this map from now on; may be called from any thread."""
        self._pinned = self._moment

    def ask(self, question: Question) -> Answer:
        """The answer of the map; may be called from any thread."""
        with self._lock:
            return rank(question, self._maps.candidates(question.crops, *self._pinned))

    def run(self, stop: threading.Event) -> None:
        """Show the map, and again whenever it has changed, until ``stop``."""
        last, fault = None, None
        while not stop.is_set():
            began = time.monotonic()
            try:
                with self._lock:
                    cited = self._maps.map("end", None)
                    self._moment = cited.moment("end", None)
            except (DatabaseUnavailable, ProjectionMissing) as error:
                if fault != str(error):
                    fault = str(error)
                    say(fault)
            else:
                fault = None
                if cited.name != last:
                    changed = self._shown.show(cited.view)
                    if last is None or changed:
                        topics = "" if last is not None else f" on {', '.join(self._shown.topics)}"
                        events = counted(cited.name.offset, "event")
                        say(f"map of {events}: {counted(changed, 'marker')} changed{topics}")
                    last = cited.name
            stop.wait(max(_LOOK_S, _SHARE * (time.monotonic() - began)))
