"""A node of our own in a ROS 2 graph over rmw_zenoh: publishers and services.

`ros2 node list`, `ros2 topic list` and `ros2 service list` find it by its liveliness tokens. A
latched publisher keeps a message for late subscribers, which need not be the last one sent: beside
messages that tell what changed it is one that tells all. Zenoh's threads only put queries into a
bounded queue; the node's thread answers them.
"""

import hashlib
import queue
import threading
import time
from collections.abc import Callable
from typing import Any, Final, Self

from eventsrc.base.errors import MapfoldError
from eventsrc.ros.library import MessageTypes
from eventsrc.ros.wire import RmwNode, attachment, end_of_key, reply_attachment

from .transport.session import Query, Session, Subscription

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
