"""Find the topics to record in a running ROS 2 graph over rmw_zenoh, as those of a bag are found.

Publishers announce topic and type by liveliness tokens. A few messages of each topic that may be
used are received and forgotten: their frames say which camera belongs to which detections
(`eventsrc.record.importers.bag_streams`).
"""

import contextlib
import functools
import threading
import time
from collections.abc import Callable, Collection
from dataclasses import replace
from typing import Final

from eventsrc.base.text import counted, visible
from eventsrc.ros import messages as ros
from eventsrc.ros.library import BagTopic, MessageTypes
from eventsrc.ros.named_classes import nearest
from eventsrc.ros.pictures import IMAGES
from eventsrc.ros.stream import Stream
from eventsrc.ros.wire import RmwWire

from .importers.bag_files import BagContents, sampled
from .importers.bag_streams import NONE, TF_POSE, BagOptions, Choice, Chooser
from .transport.session import Received, Session

_TOKENS_S: Final = 2.0
_LOOK_EVERY_S: Final = 0.5
_SETTLED_S: Final = 1.0
"""How long the graph is looked at at least, for transforms of several nodes."""
_SAMPLES_S: Final = 5.0
_MOST_TOPICS: Final = 10_000
_MOST_WANTED: Final = 1_000
_MOST_SAMPLES: Final = 300
MAP_FRAME: Final = "map"
_GRID: Final = "/map"
_TRANSFORMS: Final = ("/tf", "/tf_static")


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

    ``note`` is called once with a line if the topic of detections has no publisher yet. Topics
    without a publisher yet are recorded, too: poses come from transforms in the frame ``map`` if
    there is a topic of transforms or no topic of poses, walls from ``/map`` if there is no topic of
    grids. Raises MisuseError for an option that names a topic without a publisher, or one of
    another type.
    """
    name = namespace.strip("/").replace("/", "-") or "ros"
    under = f"/{namespace.strip('/')}/" if namespace.strip("/") else "/"
    contents = _announced(session, wire, options, under, stop=stop, note=note)
    if contents is None or not _sample(session, wire, contents, options, stop):
        return None
    contents.first_ns = time.time_ns()
    given = tuple(options.detections) or tuple(contents.detections(under))
    by_transforms = TF_POSE if _of_type(contents, ros.TF) else None
    chosen = replace(
        options,
        detections=given,
        pose=options.pose or by_transforms,
        map_frame=options.map_frame or MAP_FRAME,
    )
    choice = Chooser(name, contents, types, chosen, "the graph").choose()
    choice.streams = [_with_later(stream, contents, options, choice) for stream in choice.streams]
    if len(contents.topics) >= _MOST_TOPICS or _wanted_topics(contents, options)[_MOST_WANTED:]:
        choice.notes.append(
            f"there are very many topics; only the first {_MOST_TOPICS:,}, and messages of"
            f" {_MOST_WANTED:,}, were looked at: name the topics by options"
        )
    if options.grid is None and not _of_type(contents, ros.GRID):
        choice.grids = [_GRID]
        choice.use(_GRID, "map, as soon as it has a publisher")
    return choice


def _with_later(
    stream: Stream, contents: BagContents, options: BagOptions, choice: Choice
) -> Stream:
    """The stream, with ``/tf`` and ``/tf_static`` if no topic of transforms has a publisher yet,
    and with the topics that name classes."""
    classes = _class_topics(stream.detections, contents, options)
    tf, tf_static = stream.tf, stream.tf_static
    if options.pose != NONE and stream.pose is None and not _of_type(contents, ros.TF):
        tf, tf_static = tf or _TRANSFORMS[0], tf_static or _TRANSFORMS[1]
        for topic in {tf, tf_static} - contents.topics.keys():
            choice.use(topic, "transforms, as soon as it has a publisher")
    return replace(stream, classes=classes, tf=tf, tf_static=tf_static)


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
    contents = BagContents()
    while not stop.is_set():
        _add_announced(session, wire, contents, options.detections)
        topics = contents.topics
        wanted = options.detections or contents.detections(under)
        if wanted and all(topic in topics for topic in wanted):
            return contents
        if not waiting:
            waiting = True
            note(_waiting(wire, options, under, topics))
        stop.wait(_LOOK_EVERY_S)
    return None


def _add_announced(
    session: Session, wire: RmwWire, contents: BagContents, named: Collection[str]
) -> None:
    """Add the topics that have publishers now, of our own nodes only those that are ``named``."""
    for token in session.tokens(wire.all_tokens(), timeout_s=_TOKENS_S):
        found = wire.read_token(token)
        if found is None or (found.is_own and found.topic not in named):
            continue
        if len(contents.topics) < _MOST_TOPICS:
            topic = BagTopic(found.topic, found.type_name, "", "", 0)
            contents.topics.setdefault(found.topic, topic)


def _waiting(wire: RmwWire, options: BagOptions, under: str, topics: dict[str, BagTopic]) -> str:
    what = " and ".join(map(visible, options.detections)) or " or ".join(ros.DETECTION_TYPES)
    where = f"domain {wire.domain}" + ("" if under == "/" else f", under {visible(under)}")
    seen = counted(len(topics), "topic") if topics else "no topic at all"
    return (
        f"waiting for a publisher of {what} in {where}; seen so far: {seen}. If that stays so: "
        "check --domain and --namespace, that the nodes run with RMW_IMPLEMENTATION=rmw_zenoh_cpp,"
        " and that --connect names their router"
    )


def _sample(
    session: Session,
    wire: RmwWire,
    contents: BagContents,
    options: BagOptions,
    stop: threading.Event,
) -> bool:
    """Receive the samples that `Chooser` needs, also of topics that are announced meanwhile; False
    if ``stop`` is set before."""
    wanted: list[BagTopic] = []
    began = time.monotonic()
    with contextlib.ExitStack() as subscriptions:
        while (looked_s := time.monotonic() - began) < _SAMPLES_S:
            _add_announced(session, wire, contents, options.detections)
            there = _wanted_topics(contents, options)  # new ones are behind those of before
            for topic in there[len(wanted) : _MOST_WANTED]:
                if stop.is_set():
                    return False
                wanted.append(topic)
                keep = functools.partial(_keep, topic)
                subscription = session.subscribe(wire.key(topic.name), keep)
                subscriptions.callback(subscription.close)
                for selector in wire.cache_selectors(topic.name):
                    for message in session.cached(
                        selector, timeout_s=_TOKENS_S, most=_MOST_SAMPLES
                    ):
                        keep(message)
            if looked_s > _SETTLED_S and all(topic.samples for topic in wanted):
                break
            if stop.wait(_LOOK_EVERY_S):
                return False
    return True


def _wanted_topics(contents: BagContents, options: BagOptions) -> list[BagTopic]:
    """The topics whose messages say what they may be used for; those of pictures only for crops."""
    unused = IMAGES if options.cut is None else ()
    return [
        topic
        for topic in contents.topics.values()
        if sampled(topic.type_name, 0) and topic.type_name not in unused
    ]


def _keep(topic: BagTopic, message: Received) -> None:
    """Keep a message as a sample if it is one; called by Zenoh's threads."""
    if len(topic.samples) < _MOST_SAMPLES and sampled(topic.type_name, topic.count):
        topic.samples.append(message.payload)
    topic.count += 1


def _of_type(contents: BagContents, type_name: str) -> list[str]:
    return [each.name for each in contents.topics.values() if each.type_name == type_name]


def _class_topics(detections: str, contents: BagContents, options: BagOptions) -> tuple[str, ...]:
    """The topics whose later messages name classes: those of the options, else the one LabelInfo
    nearest to the detections."""
    if options.classes:
        return tuple(topic for topic in options.classes if topic != NONE)
    near = nearest(detections, _of_type(contents, ros.LABELS))
    return tuple(near) if len(near) == 1 else ()
