"""Message types, messages in CDR, and SQLite bags, by rosbags. Only this module imports it.

rosbags is in the extra ``[ros]`` and imported when it is first used. It decodes with code generated
from message definitions, so names in a bag's definitions are checked before they get into code.
"""

import json
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from eventsrc.base.errors import MapfoldError
from eventsrc.envelope.system_events import MAX_KEPT_BYTES, Excerpt

if TYPE_CHECKING:
    import apsw
    from rosbags.typesys.store import Typestore

_HEADER: Final = "std_msgs/Header header\n"
VISION_MSGS: Final[Mapping[str, str]] = {
    "vision_msgs/msg/Point2D": "float64 x\nfloat64 y\n",
    "vision_msgs/msg/Pose2D": "vision_msgs/Point2D position\nfloat64 theta\n",
    "vision_msgs/msg/BoundingBox2D": (
        "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n"
    ),
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n"
    ),
    "vision_msgs/msg/Detection2D": (
        f"{_HEADER}vision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox2D bbox\nstring id\n"
    ),
    "vision_msgs/msg/Detection2DArray": f"{_HEADER}vision_msgs/Detection2D[] detections\n",
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "vision_msgs/msg/Detection3D": (
        f"{_HEADER}vision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox3D bbox\nstring id\n"
    ),
    "vision_msgs/msg/Detection3DArray": f"{_HEADER}vision_msgs/Detection3D[] detections\n",
    "vision_msgs/msg/VisionClass": "uint16 class_id\nstring class_name\n",
    "vision_msgs/msg/LabelInfo": (
        f"{_HEADER}vision_msgs/VisionClass[] class_map\nfloat32 threshold\n"
    ),
    "vision_msgs/msg/VisionInfo": (
        f"{_HEADER}string method\nstring database_location\nint32 database_version\n"
    ),
}
"""The definitions of vision_msgs 4, which ROS does not ship with its own messages. Those of version
3 differ in the name of a nested type only: in CDR both are the same bytes."""


_LINE: Final = "=" * 80 + "\n"
_IDL_MARK: Final = f"{_LINE}IDL: "


_HASHED: Final = "RIHS01_"


class NoRosbags(MapfoldError):
    """rosbags is not installed."""


_MOST_SHOWN: Final = 160
_TYPE_NAME: Final = re.compile(r"[A-Za-z]\w*(/[A-Za-z]\w*)+", re.ASCII)
_FIELD_NAME: Final = re.compile(r"[A-Za-z]\w*", re.ASCII)


def _checked(type_name: str, fields: list[tuple[str, Any]]) -> tuple[list[Any], list[Any]]:
    """Check the names of a type, which rosbags puts into generated code without checking all of
    them. Returns the type without its constants. Raises ValueError."""
    for name in (type_name, *(name for _, kind in fields for name in _names_in(kind))):
        if not _TYPE_NAME.fullmatch(name):
            raise ValueError(f"{name[:80]!r} is no name of a type")
    for name, _ in fields:
        if not _FIELD_NAME.fullmatch(name):
            raise ValueError(f"{name[:80]!r} is no name of a field")
    return [], fields


def _names_in(kind: Any) -> Iterator[str]:
    """The type names in rosbags' description of a field: a pair of a node kind and a name, a basic
    type with its length, or an inner description with its length."""
    node, inner = kind
    if isinstance(inner, str):
        yield inner
    elif isinstance(inner[0], tuple):
        yield from _names_in(inner[0])
    elif node.name != "BASE" or not inner[0].isalnum():
        raise ValueError(f"{kind!r:.80} is no field")


def _not_installed(error: ImportError) -> NoRosbags:
    return NoRosbags(
        f"rosbags is not installed ({error}), which reads messages of ROS 2: "
        "pip install 'mapfold[ros]'"
    )


class Undecodable(ValueError):
    """Bytes that are no message of the type, or a type or definition that is unknown or invalid."""


class MessageTypes:
    """Types of messages: those of ROS 2 itself, of vision_msgs, and what `define` adds."""

    def __init__(self) -> None:
        try:
            from rosbags.serde import SerdeError
            from rosbags.typesys import (
                Stores,
                TypesysError,
                get_types_from_idl,
                get_types_from_msg,
                get_typestore,
            )
        except ImportError as error:
            raise _not_installed(error) from None
        self._parse: Callable[[str, str], Any] = get_types_from_msg
        self._parse_idl: Callable[[str], Any] = get_types_from_idl
        self._faults = (SerdeError, TypesysError, KeyError)
        self._store: Typestore = get_typestore(Stores.ROS2_JAZZY)
        for name, text in VISION_MSGS.items():
            self.define(name, text)

    def define(self, type_name: str, text: str, *, is_idl: bool = False) -> None:
        """Add a type and all others that the same text defines, in place of known types of these
        names. Raises Undecodable for a text that cannot be read or defines nothing."""
        try:
            parsed = self._types_of_idl(text) if is_idl else self._parse(text, type_name)
            types = {name: _checked(name, fields) for name, (_, fields) in parsed.items()}
            for name in types:
                if self._store.fielddefs.get(name) != types[name]:
                    self._store.fielddefs.pop(name, None)
                    self._store.cache.clear()
            self._store.register(types)
        except (*self._faults, *_FAULTS, RecursionError, SyntaxError, ValueError) as error:
            reason = " ".join(str(error).split())[:_MOST_SHOWN]
            raise Undecodable(f"the definition of {type_name} cannot be read: {reason}") from None

    def _types_of_idl(self, text: str) -> dict[str, Any]:
        """The types of a text in IDL, or of several texts with the separator lines of bags."""
        if not text.startswith(_IDL_MARK):
            return dict(self._parse_idl(text))
        types: dict[str, Any] = {}
        for part in text.split(_LINE)[1:]:
            types.update(self._parse_idl(part.partition("\n")[2]))
        return types

    def definition(self, type_name: str, type_hash: str | None = None) -> str:
        """The text that defines a type and all types in it, as bags keep it.

        ``type_hash`` is what the publisher says of its own definition: ``RIHS01_…``, or another
        text where it has no hash, as in Humble, which is ignored. Raises Undecodable, also for the
        hash of another definition.
        """
        try:
            text, _ = self._store.generate_msgdef(type_name, ros_version=2)
            known = self._store.hash_rihs01(type_name)
        except self._faults as error:
            raise Undecodable(f"{type_name:.80}: no such type is known ({error})") from None
        if type_hash is not None and type_hash.startswith(_HASHED) and type_hash != known:
            raise Undecodable(
                f"{type_name:.80}: its publisher has another definition than ROS 2 Jazzy: its hash "
                f"is {type_hash:.80}, not {known}"
            )
        return text

    def hash_of(self, type_name: str) -> str:
        """The hash that ROS gives a type, ``RIHS01_…``."""
        return self._store.hash_rihs01(type_name)

    def knows(self, type_name: str) -> bool:
        """Whether the type has a definition."""
        return type_name in self._store.fielddefs

    def decode(self, payload: bytes, type_name: str) -> Any:
        """The message in CDR, as an object with the attributes of its type. Raises Undecodable."""
        if not self.knows(type_name):
            raise Undecodable(f"{type_name:.80}: no such type is known")
        try:
            return self._store.deserialize_cdr(payload, type_name)
        except (*self._faults, MemoryError, IndexError, TypeError) as error:
            raise Undecodable(f"no {type_name:.80} in CDR: {error}") from None

    def encode(self, message: Any, type_name: str) -> bytes:
        """The message in CDR."""
        return bytes(self._store.serialize_cdr(message, type_name))

    def make(self, type_name: str, **fields: Any) -> Any:
        """A message of a type with these fields."""
        return self._store.types[type_name](**fields)


class BadBag(ValueError):
    """A bag's database cannot be read, or not to its end; the message is the reason."""


@dataclass
class BagTopic:
    """A topic of a bag: the text that defines the type of its messages (``ros2msg`` or ``ros2idl``;
    empty if the bag has none), the number of its messages, and some of the first."""

    name: str
    type_name: str
    definition: str
    definition_encoding: str
    count: int = 0
    samples: list[bytes] = field(default_factory=list)


_MESSAGES: Final = """
    SELECT topics.id, messages.rowid, messages.timestamp, length(messages.data),
           CASE WHEN typeof(messages.data) = 'blob' AND length(messages.data) <= ?
                THEN messages.data END
      FROM messages JOIN topics ON messages.topic_id = topics.id
     WHERE topics.id IN (SELECT value FROM json_each(?))
     ORDER BY timestamp
"""
"""As rosbags asks, but for data that is too large, which is read in pieces."""
_UNUSUAL_TABLES: Final = """
    SELECT name FROM sqlite_master
     WHERE name IN ('messages', 'topics', 'schema', 'message_definitions')
       AND (type != 'table' OR sql LIKE 'CREATE VIRTUAL%')
"""
"""Views, whose rows may have no end."""
_PIECE_BYTES: Final = 1024 * 1024


class SqliteBag:
    """One ``.db3`` file of a bag. It is opened for reading and never changed. What takes more than
    `MAX_KEPT_BYTES` is not read into memory."""

    def __init__(self, path: Path) -> None:
        try:
            import apsw
            from rosbags.interfaces import MessageDefinitionFormat
            from rosbags.rosbag2 import Reader, ReaderError
        except ImportError as error:
            raise _not_installed(error) from None
        self._faults = (ReaderError, apsw.Error, OSError, *_FAULTS)
        self._idl = MessageDefinitionFormat.IDL
        self._none = MessageDefinitionFormat.NONE
        apsw.connection_hooks.append(limit := _bounded(apsw.SQLITE_LIMIT_LENGTH))
        try:
            flags = apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
            self._database = apsw.Connection(f"file:{path}?immutable=1", flags=flags)
            for (name,) in self._database.execute(_UNUSUAL_TABLES):
                raise BadBag(f"it cannot be opened: {name} is no table")
            self._reader = Reader(path)
            self._reader.open()
            for each in self._reader.connections:
                names: tuple[object, ...] = (each.topic, each.msgtype)
                if not all(isinstance(name, str) for name in names):
                    raise BadBag("it cannot be opened: a topic whose name or type is no text")
        except self._faults as error:
            raise BadBag(f"it cannot be opened: {error}") from None
        finally:
            apsw.connection_hooks.remove(limit)

    def topics(self) -> list[BagTopic]:
        """The topics by name."""
        return [
            BagTopic(
                each.topic,
                each.msgtype,
                each.msgdef.data if each.msgdef.format != self._none else "",
                "ros2idl" if each.msgdef.format == self._idl else "ros2msg",
                each.msgcount,
            )
            for each in sorted(
                self._reader.connections, key=lambda each: (each.topic, each.msgtype)
            )
        ]

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, str, int, bytes | Excerpt]]:
        """Yield topic, type, time of receipt and bytes of each message, in order of receipt. Raises
        BadBag after the last readable one."""
        chosen = {each.id: each for each in self._reader.connections if each.topic in topics}
        if not chosen:
            return
        try:
            rows = self._database.execute(_MESSAGES, (MAX_KEPT_BYTES, json.dumps([*chosen])))
            for topic_id, row, received_ns, size, read in rows:
                payload = read
                if payload is None and isinstance(size, int) and size > MAX_KEPT_BYTES:
                    payload = Excerpt.of(self._pieces(row))
                if not isinstance(received_ns, int) or not isinstance(payload, bytes | Excerpt):
                    raise BadBag("a message has no bytes or no time")
                yield chosen[topic_id].topic, chosen[topic_id].msgtype, received_ns, payload
        except self._faults as error:
            raise BadBag(str(error)) from None

    def _pieces(self, row: int) -> Iterator[bytes]:
        """The data of a message."""
        with self._database.blob_open("main", "messages", "data", row, False) as blob:
            while piece := blob.read(_PIECE_BYTES):
                yield piece

    def span(self) -> tuple[int, ...]:
        """The times of receipt of first and last message, int nanoseconds; empty without any."""
        if not self._reader.message_count:
            return ()
        return self._reader.start_time, self._reader.end_time - 1

    def close(self) -> None:
        """Close the file."""
        self._reader.close()
        self._database.close()


def _bounded(what: int) -> "Callable[[apsw.Connection], None]":
    """A hook that bounds the length of the texts, blobs and rows that a new connection reads."""

    def limit(connection: "apsw.Connection") -> None:
        connection.limit(what, MAX_KEPT_BYTES + _PIECE_BYTES)

    return limit


_FAULTS: Final = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    LookupError,
    MemoryError,
    TypeError,
    UnicodeError,
)
"""Exceptions of rosbags for damaged files."""
