"""Find the topics to record in a running ROS 2 graph over rmw_zenoh, as those of a bag are found.

Publishers announce topic and type by liveliness tokens. A few messages of each topic that may be
used are received and forgotten: their frames say which camera belongs to which detections
(`eventsrc.record.importers.bag_streams`).
"""

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Final

from eventsrc.base.text import counted, visible
from eventsrc.ros import messages as ros
from eventsrc.ros.library import BagTopic, MessageTypes
from eventsrc.ros.named_classes import nearest
from eventsrc.ros.wire import RmwWire

from .importers.bag_files import BagContents, sampled
from .importers.bag_streams import BagOptions, Choice, Chooser
from .transport.session import Received, Session

_TOKENS_S: Final = 2.0
_LOOK_EVERY_S: Final = 0.5
_SETTLED_S: Final = 1.0
"""How long the graph is looked at at least, for transforms of several nodes."""
_SAMPLES_S: Final = 5.0
_MOST_TOPICS: Final = 10_000
_MOST_SAMPLES: Final = 300
MAP_FRAME: Final = "map"


def find_topics(
    session: Session,
    wire: RmwWire,
    types: MessageTypes,
    options: BagOptions,
    namespace: str,
    *,
    stop: threading.Event,
    note: Callable[[str], None],
) -> Choice | None:
    """The topics to record and their uses, as soon as somebody publishes detections under
    ``namespace``; None if ``stop`` is set before.

    ``note`` is called with a line while nobody does. The frame of the map is ``map`` unless the
    options name another: a localiser may publish it later. Raises MisuseError for an option that
    names a topic that nobody publishes, or one of another type.
    """
    name = namespace.strip("/").replace("/", "-") or "ros"
    under = f"/{namespace.strip('/')}/" if namespace.strip("/") else "/"
    contents = _announced(session, wire, options, under, stop=stop, note=note)
    if contents is None or not _sample(session, wire, contents, stop):
        return None
    contents.first_ns = time.time_ns()
    given = tuple(options.detections) or tuple(
        sorted(topic for topic in _of_type(contents, ros.DETECTIONS) if topic.startswith(under))
    )
    chosen = replace(options, detections=given, map_frame=options.map_frame or MAP_FRAME)
    choice = Chooser(name, contents, types, chosen, "the graph").choose()
    choice.streams = [
        replace(stream, classes=_class_topics(stream.detections, contents, options))
        for stream in choice.streams
    ]
    return choice


def _announced(
    session: Session,
    wire: RmwWire,
    options: BagOptions,
    under: str,
    *,
    stop: threading.Event,
    note: Callable[[str], None],
) -> BagContents | None:
    """The topics that have publishers, as soon as the detections' are among them."""
    waiting = False
    while not stop.is_set():
        topics: dict[str, BagTopic] = {}
        for token in session.tokens(wire.all_tokens(), timeout_s=_TOKENS_S)[:_MOST_TOPICS]:
            found = wire.read_token(token)
            if found is not None:
                topics.setdefault(found.topic, BagTopic(found.topic, found.type_name, "", "", 0))
        contents = BagContents(topics)
        there = _of_type(contents, ros.DETECTIONS)
        wanted = options.detections or [each for each in there if each.startswith(under)]
        if wanted and all(topic in topics for topic in wanted):
            return contents
        if not waiting:
            waiting = True
            note(_waiting(wire, options, under, topics))
        stop.wait(_LOOK_EVERY_S)
    return None


def _waiting(wire: RmwWire, options: BagOptions, under: str, topics: dict[str, BagTopic]) -> str:
    what = " and ".join(map(visible, options.detections)) or ros.DETECTIONS
    where = f"domain {wire.domain}" + ("" if under == "/" else f", under {visible(under)}")
    seen = counted(len(topics), "topic") if topics else "no topic at all"
    return (
        f"waiting for a publisher of {what} in {where}; there is {seen} so far. If that stays so: "
        "check --domain and --namespace, that the nodes run with RMW_IMPLEMENTATION=rmw_zenoh_cpp,"
        " and that --connect names their router"
    )


def _sample(session: Session, wire: RmwWire, contents: BagContents, stop: threading.Event) -> bool:
    """Receive the samples that `Chooser` needs; False if ``stop`` is set before."""
    wanted = [topic for topic in contents.topics.values() if sampled(topic.type_name, 0)]

    def keep(topic: BagTopic) -> Callable[[Received], None]:
        def receive(message: Received) -> None:
            if len(topic.samples) < _MOST_SAMPLES and sampled(topic.type_name, topic.count):
                topic.samples.append(message.payload)
            topic.count += 1

        return receive

    subscriptions = [session.subscribe(wire.key(each.name), keep(each)) for each in wanted]
    try:
        session.confirm()
        for topic in wanted:
            for selector in wire.cache_selectors(topic.name):
                for message in session.cached(selector, timeout_s=_TOKENS_S, most=_MOST_SAMPLES):
                    keep(topic)(message)
        began = time.monotonic()
        while (looked_s := time.monotonic() - began) < _SAMPLES_S:
            if looked_s > _SETTLED_S and all(topic.samples for topic in wanted):
                break
            if stop.wait(_LOOK_EVERY_S / 5):
                return False
    finally:
        for subscription in subscriptions:
            subscription.close()
    return True


def _of_type(contents: BagContents, type_name: str) -> list[str]:
    return [each.name for each in contents.topics.values() if each.type_name == type_name]


def _class_topics(detections: str, contents: BagContents, options: BagOptions) -> tuple[str, ...]:
    """The topics whose later messages name classes: those of the options, else the one LabelInfo
    nearest to the detections."""
    if options.classes:
        return options.classes
    near = nearest(detections, _of_type(contents, ros.LABELS))
    return tuple(near) if len(near) == 1 else ()
