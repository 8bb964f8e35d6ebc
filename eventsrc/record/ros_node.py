"""A node of our own in a ROS 2 graph over rmw_zenoh: publishers and services; and the topics to
record in that graph, found as those of a bag are.

`ros2 node list`, `ros2 topic list` and `ros2 service list` find it by its liveliness tokens. A
latched publisher keeps a message for late subscribers, which need not be the last one sent: beside
messages that tell what changed it is one that tells all. Zenoh's threads only put queries into a
bounded queue; the node's thread answers them.

Publishers announce topic and type by liveliness tokens. A few messages of each topic that may be
used are received and forgotten: their frames say which camera belongs to which detections
(`eventsrc.record.importers.bag_streams`).
"""

import contextlib
import functools
import hashlib
import queue
import threading
import time
from collections.abc import Callable, Collection
from dataclasses import replace
from typing import Any, Final, Self

from eventsrc.base.errors import MapfoldError
from eventsrc.base.text import counted, visible
from eventsrc.ros import messages as ros
from eventsrc.ros.library import BagTopic, MessageTypes
from eventsrc.ros.named_classes import nearest
from eventsrc.ros.pictures import IMAGES
from eventsrc.ros.stream import Stream
from eventsrc.ros.wire import RmwNode, RmwWire, attachment, end_of_key, reply_attachment

from .importers.bag_files import BagContents, sampled
from .importers.bag_streams import NONE, TF_POSE, BagOptions, Choice, Chooser
from .transport.session import Query, Received, Session, Subscription

TRIGGER: Final = "std_srvs/srv/Trigger"
TRIGGER_HASH: Final = "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f"
"""rosbags has no services, and does not compute their hashes."""
TRIGGERED: Final = "std_srvs/msg/Triggered"
"""The response of a Trigger as a message, which rosbags can write."""
_TRIGGERED_TEXT: Final = "bool success\nstring message\n"
_MOST_QUERIES: Final = 1_000
_MOST_BYTES: Final = 4_096
"""Of a query that waits, with its attachment."""
_LEAST_ATTACHMENT: Final = 17
"""Fewest bytes of a request's attachment."""


class RosNode:
    """A node in ``domain`` with this name, under ``namespace`` (``/bot1``, or empty).

    Names of topics that begin with ``~/`` are under the node's own. A context manager; closing it
    ends the node, but not the session.
    """

    def __init__(
        self, session: Session, types: MessageTypes, domain: int, namespace: str, name: str
    ) -> None:
        types.define(TRIGGERED, _TRIGGERED_TEXT)
        self.session, self.types = session, types
        self.names = RmwNode(domain, session.id, namespace, name)
        self._count = 0
        self._queries: queue.Queue[Callable[[], None] | None] = queue.Queue(_MOST_QUERIES)
        self._thread = threading.Thread(target=self._answer_queries, name="ros-node")
        self._thread.start()
        self._declared: list[Subscription] = [session.declare_token(self.names.token())]

    def full_name(self, topic: str) -> str:
        """The name of a topic in the graph."""
        bare = f"/{self.names.name}/{topic[2:]}" if topic.startswith("~/") else topic
        return f"{self.names.namespace}{bare}"

    def publisher(self, topic: str, type_name: str, *, latched: bool = False) -> "RosPublisher":
        """Declare a publisher."""
        self._count += 1
        return RosPublisher(self, self._count, self.full_name(topic), type_name, latched=latched)

    def trigger(self, service: str, answer: Callable[[], tuple[bool, str]]) -> None:
        """Offer a service of the type std_srvs/Trigger. ``answer`` runs in the node's thread and
        says whether it succeeded, and why not; it may raise a MapfoldError."""
        self._count += 1
        end = end_of_key(TRIGGER, TRIGGER_HASH)
        key = self.names.key(self.full_name(service), end)

        def reply(query: Query) -> None:
            if len(query.attachment) < _LEAST_ATTACHMENT:
                query.reply_error(b'"a request needs the attachment of a client of ROS"')
                return
            try:
                success, message = answer()
            except MapfoldError as error:
                success, message = False, str(error)
            made = self.types.make(TRIGGERED, success=success, message=message)
            attached = reply_attachment(query.attachment, time.time_ns())
            query.reply_attached(key, self.types.encode(made, TRIGGERED), attached)

        self.answer(key, reply)
        token = self.names.end_token("SS", self._count, self.full_name(service), end)
        self.announce(token)

    def answer(self, key: str, reply: Callable[[Query], None]) -> None:
        """Answer the queries under a key in the node's thread."""

        def receive(query: Query) -> None:
            if query.size + len(query.attachment) > _MOST_BYTES:
                query.reply_error(b'"the query is too large"')
                return
            try:
                self._queries.put_nowait(lambda: reply(query))
            except queue.Full:
                query.reply_error(b'"too many queries wait; ask again later"')

        self._declared.append(self.session.queryable(key, receive))

    def announce(self, token: str) -> None:
        """Declare a liveliness token, until the node ends."""
        self._declared.append(self.session.declare_token(token))

    def close(self) -> None:
        """Leave the graph, and answer the queries that wait."""
        for each in reversed(self._declared):
            each.close()
        self._declared = []
        self._queries.put(None)
        self._thread.join()

    def _answer_queries(self) -> None:
        while (reply := self._queries.get()) is not None:
            reply()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class RosPublisher:
    """A publisher of a node: reliable, in order, blocking while the network is full."""

    def __init__(
        self, node: RosNode, number: int, topic: str, type_name: str, *, latched: bool
    ) -> None:
        self.topic, self._type, self._types = topic, type_name, node.types
        end = end_of_key(type_name, node.types.hash_of(type_name))
        key = node.names.key(topic, end)
        token = node.names.end_token("MP", number, topic, end, latched=latched)
        self._id = hashlib.blake2b(token.encode(), digest_size=16).digest()
        self._sent = 0
        self._kept: tuple[bytes, bytes] | None = None
        self._sender = node.session.publisher(key)
        if latched:
            cache = node.names.cache(key, number)
            node.answer(cache, lambda query: self._reply(key, query))
            node.announce(cache)
        node.announce(token)

    def publish(self, message: Any, *, kept: Any = None) -> None:
        """Send a message. Late subscribers of a latched topic get ``kept`` instead, if given."""
        self._sent += 1
        attached = attachment(self._sent, time.time_ns(), self._id)
        payload = self._types.encode(message, self._type)
        whole = payload if kept is None else self._types.encode(kept, self._type)
        self._kept = whole, attached  # before it is sent: who subscribes now gets one of the two
        self._sender.put(payload, attached)

    def wait_for_subscriber(self, timeout_s: float) -> bool:
        """Wait for a subscriber; False if none came within ``timeout_s``."""
        return self._sender.wait_for_subscriber(timeout_s)

    def _reply(self, key: str, query: Query) -> None:
        if self._kept is None:
            query.close()
        else:
            query.reply_attached(key, *self._kept)


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
