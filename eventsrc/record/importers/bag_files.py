"""The files of a rosbag2: SQLite or MCAP, compressed or not, with or without a metadata.yaml.

A bag is a folder of files, or one of them. The order of the files follows from their names, their
kind and compression from their first bytes, and compression of single messages from those of the
messages. So a recording that was cut off before its metadata.yaml was written is read like any
other.
"""

import re
import tempfile
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

import zstandard

from eventsrc.base.errors import MapfoldError, MisuseError
from eventsrc.base.text import visible
from eventsrc.envelope.system_events import MAX_KEPT_BYTES, Excerpt
from eventsrc.log.foreign_mcap import ForeignDamage, ForeignMessage, foreign_messages
from eventsrc.ros import messages as ros
from eventsrc.ros.library import BadBag, BagTopic, SqliteBag
from eventsrc.ros.pictures import IMAGES

MCAP_MAGIC: Final = b"\x89MCAP0\r\n"
SQLITE_MAGIC: Final = b"SQLite format 3\0"
ZSTD_MAGIC: Final = b"\x28\xb5\x2f\xfd"
_ROS2_PROFILE: Final = b"\x04\0\0\0ros2"
_PROFILE_AT: Final = len(MCAP_MAGIC) + 9
METADATA: Final = "metadata.yaml"
_SQLITE_SUFFIX: Final = ".db3"
_HOT_JOURNAL: Final = bytes.fromhex("d9d505f920a163d7")
"""The start of a rollback journal whose transaction has not ended."""
_FILE_OF_A_BAG: Final = re.compile(r".*\.(db3|mcap)(\.zstd)?", re.DOTALL)
_SEGMENT_OF_A_LOG: Final = re.compile(r"\d{20}\.mcap")


class BagMessage(NamedTuple):
    """A message of a bag, undecoded. ``received_ns`` is its log time. ``refused`` is the reason if
    it is too large, with an excerpt for a payload unless it is only too large decompressed."""

    topic: str
    type_name: str
    received_ns: int
    payload: bytes | Excerpt
    refused: str | None = None

    def decompressed(self) -> "BagMessage":
        """The message with its payload decompressed, if the bag compresses single messages: no CDR
        begins like zstd. Raises ZstdError."""
        if isinstance(self.payload, Excerpt):
            return self._replace(refused=self.payload.reason())
        if not self.payload.startswith(ZSTD_MAGIC):
            return self
        with zstandard.ZstdDecompressor().stream_reader(self.payload) as stream:
            plain = stream.read(MAX_KEPT_BYTES + 1)
        if len(plain) > MAX_KEPT_BYTES:
            return self._replace(
                refused=f"a compressed message that holds more than {MAX_KEPT_BYTES:,} bytes"
            )
        return self._replace(payload=plain)


_FIRST_TRANSFORMS: Final = 300
_EVERY_TRANSFORM: Final = 101
_LAST_TRANSFORM: Final = 100_000
_FIRST_PARAMETERS: Final = 10_000
_FIRST_WANTED: Final = (
    *(*ros.DETECTION_TYPES, ros.LABELS, ros.VISION_INFO, ros.CAMERA_INFO),
    *(ros.POSE, ros.ODOMETRY),
    *IMAGES,
)


def sampled(type_name: str, number: int) -> bool:
    """Whether the choice of topics needs the message of a type with this number on its topic. Of
    transforms it needs later ones too: a localiser publishes the map frame only once it is
    localised. All nodes announce their parameters on one topic, before they do anything else."""
    if type_name == ros.TF:
        few = number % _EVERY_TRANSFORM == 0 and number < _LAST_TRANSFORM
        return few or number < _FIRST_TRANSFORMS
    if type_name == ros.PARAMETERS:
        return number < _FIRST_PARAMETERS
    return number == 0 and type_name in _FIRST_WANTED


Sampled = Callable[[str, int], bool]
"""Returns whether to keep a message of this type with this number on its topic as a sample."""


_OWN_TOPICS: Final = "/mapfold/"
"""Part of the names of the topics on which `mapfold ros` publishes, in any namespace."""


@dataclass
class BagContents:
    """Topics and time span of a bag. ``first_ns`` and ``last_ns`` are when its first and last
    messages were received; None without any."""

    topics: dict[str, BagTopic] = field(default_factory=dict)
    first_ns: int | None = None
    last_ns: int | None = None
    damage: str | None = None
    """The reason why the bag could not be read to its end."""

    @property
    def count(self) -> int:
        """Number of messages on all topics."""
        return sum(topic.count for topic in self.topics.values())

    def detections(self, under: str = "") -> list[str]:
        """The topics ``under`` a namespace of Detection2DArray; without any, those of
        Detection3DArray, but not of the things that mapfold itself shows. By name."""
        kinds = {t.name: t.type_name for t in self.topics.values() if t.name.startswith(under)}
        in_picture = sorted(name for name, kind in kinds.items() if kind == ros.DETECTIONS)
        return in_picture or sorted(
            name
            for name, kind in kinds.items()
            if kind == ros.DETECTIONS_3D and _OWN_TOPICS not in name
        )

    def span(self, received_ns: int) -> None:
        """Extend the time span by a message's time of receipt."""
        if self.first_ns is None or received_ns < self.first_ns:
            self.first_ns = received_ns
        if self.last_ns is None or received_ns > self.last_ns:
            self.last_ns = received_ns


def is_bag(path: Path) -> bool:
    """Whether a folder holds a bag and not a mapfold log."""
    try:
        names = [each.name for each in path.iterdir()]
    except OSError:
        return False
    return METADATA in names or any(
        _FILE_OF_A_BAG.fullmatch(name) and not _SEGMENT_OF_A_LOG.fullmatch(name) for name in names
    )


def is_file_of_a_bag(start: bytes) -> bool:
    """Whether a file with these first bytes is of a bag: SQLite, or MCAP with a ROS 2 profile."""
    if start.startswith(SQLITE_MAGIC):
        return True
    return start.startswith(MCAP_MAGIC) and start[_PROFILE_AT:].startswith(_ROS2_PROFILE)


START_BYTES: Final = _PROFILE_AT + len(_ROS2_PROFILE)
"""The number of first bytes that `is_file_of_a_bag` needs."""


def bag_name(path: Path) -> str:
    """The name of the bag's folder, or of its file without suffixes and number: rosbag2 names both
    alike."""
    if path.is_dir():
        return path.resolve().name
    return re.sub(r"_\d+$", "", path.name.split(".")[0]) or path.name


class Bag:
    """A bag's files, in order."""

    def __init__(self, path: Path, files: ExitStack) -> None:
        parts = _files_of(path) if path.is_dir() else [path]
        if not parts:
            raise MisuseError(f"{path}: it has a {METADATA}, but no .db3 or .mcap file")
        self._parts = [_open_part(each, files) for each in parts]
        self._sizes = [each.stat().st_size for each in parts]
        self.size_bytes = sum(self._sizes)
        self._at = 0

    def bytes_read(self) -> int:
        """An estimate of how many of ``size_bytes`` `messages` has read."""
        if self._at == len(self._parts):
            return self.size_bytes
        share = self._parts[self._at].share_read()
        return sum(self._sizes[: self._at]) + int(share * self._sizes[self._at])

    def scan(self, sampled: Sampled) -> BagContents:
        """Read the whole bag: its topics, with the messages for which ``sampled`` returns True."""
        contents = BagContents()
        for part in self._parts:
            try:
                part.scan(contents, sampled)
            except _DAMAGE as error:
                contents.damage = contents.damage or f"{part.path.name}: {error}"
        return contents

    def messages(self, topics: Collection[str]) -> Iterator[BagMessage]:
        """The messages of these topics, file by file. Raises MapfoldError where a file is
        damaged."""
        has_any = False
        for at, part in enumerate(self._parts):
            self._at = at
            try:
                for message in part.messages(topics):
                    has_any = True
                    yield message.decompressed()
            except _DAMAGE as error:
                before = (
                    "what was made of the messages before it is in the log"
                    if has_any
                    else "no message before it could be read"
                )
                raise MapfoldError(
                    f"{visible(str(part.path))}: {visible(str(error))}; {before}{part.advice}"
                ) from None
        self._at = len(self._parts)


_DAMAGE: Final = (BadBag, ForeignDamage, zstandard.ZstdError)


class _McapPart:
    """An MCAP file, compressed or not, read and checked by `eventsrc.log.foreign_mcap`."""

    advice = ""
    """The end of messages about damage: how more of the file may be saved."""

    def __init__(self, path: Path, *, compressed: bool) -> None:
        self.path = path
        self._compressed = compressed
        self._size = max(path.stat().st_size, 1)
        self._file: BinaryIO | None = None

    def share_read(self) -> float:
        return 0.0 if self._file is None or self._file.closed else self._file.tell() / self._size

    def scan(self, contents: BagContents, sampled: Sampled) -> None:
        for message in self._all():
            topic = contents.topics.get(message.key)
            if topic is None:
                form = message.form
                text = form.schema_text.decode(errors="replace")
                topic = BagTopic(message.key, form.schema, text, form.schema_encoding)
                contents.topics[message.key] = topic
            if sampled(topic.type_name, topic.count):
                _add_sample(topic, _bag_message(message))
            topic.count += 1
            contents.span(message.logged_ns)

    def messages(self, topics: Collection[str]) -> Iterator[BagMessage]:
        for message in self._all():
            if message.key in topics:
                yield _bag_message(message)

    def _all(self) -> Iterator[ForeignMessage]:
        with self.path.open("rb") as file:
            self._file = file
            if self._compressed:
                stream = zstandard.ZstdDecompressor().stream_reader(file, read_across_frames=True)
                yield from foreign_messages(stream)
            else:
                yield from foreign_messages(file)


class _SqlitePart:
    """An SQLite file, opened at the first use."""

    advice = "; `sqlite3 OLD .recover | sqlite3 NEW.db3` may save more"

    def __init__(self, path: Path, files: ExitStack, *, compressed: bool) -> None:
        self.path = path
        self._files = files
        self._compressed = compressed
        self._bag: SqliteBag | None = None
        self._count, self._read = 1, 0

    def share_read(self) -> float:
        return min(self._read / self._count, 1.0)

    def scan(self, contents: BagContents, sampled: Sampled) -> None:
        bag = self._opened()
        for each in bag.topics():
            topic = contents.topics.setdefault(each.name, replace(each, count=0))
            before, topic.count = topic.count, topic.count + each.count
            if not sampled(topic.type_name, before):
                continue
            for number, message in enumerate(bag.messages([each.name]), before):
                if sampled(topic.type_name, number):
                    _add_sample(topic, BagMessage(*message))
                elif not sampled(topic.type_name, 1):
                    break  # only the first is wanted
        for received_ns in bag.span():
            contents.span(received_ns)

    def messages(self, topics: Collection[str]) -> Iterator[BagMessage]:
        bag = self._opened()
        self._count = max(sum(each.count for each in bag.topics() if each.name in topics), 1)
        for self._read, message in enumerate(bag.messages(topics), 1):
            yield BagMessage(*message)

    def _opened(self) -> SqliteBag:
        if self._bag is None:
            path = self.path
            if self._compressed:
                folder = self._files.enter_context(tempfile.TemporaryDirectory())
                path = Path(folder, f"bag{_SQLITE_SUFFIX}")
                with self.path.open("rb") as packed, path.open("wb") as plain:
                    zstandard.ZstdDecompressor().copy_stream(packed, plain)
            else:
                _refuse_unwritten(path)
                if path.suffix != _SQLITE_SUFFIX or any(mark in str(path) for mark in "?#%"):
                    # rosbags needs the suffix, and puts the path into a URI without quoting it
                    folder = self._files.enter_context(tempfile.TemporaryDirectory())
                    path = Path(folder, f"bag{_SQLITE_SUFFIX}")
                    path.symlink_to(self.path.resolve())
            self._bag = SqliteBag(path)
            self._files.callback(self._bag.close)
        return self._bag


def _refuse_unwritten(path: Path) -> None:
    """Raise MisuseError if the file's write-ahead log has messages that are not in the file, or its
    rollback journal a transaction that has not ended."""
    journal = path.with_name(path.name + "-wal")
    if journal.exists() and journal.stat().st_size:
        raise MisuseError(
            f"{visible(str(journal))}: it holds messages that are not in the bag's file, since the "
            f"recording was cut off; `sqlite3 {visible(str(path))} 'PRAGMA wal_checkpoint'` writes "
            "them there"
        )
    journal = path.with_name(path.name + "-journal")
    if journal.exists():
        with journal.open("rb") as file:
            hot = file.read(len(_HOT_JOURNAL)) == _HOT_JOURNAL
        if hot:
            raise MisuseError(
                f"{visible(str(journal))}: a transaction of the bag's recorder has not ended; end"
                " the recording, or if it was cut off, take the transaction back: `sqlite3"
                f" {visible(str(path))} 'PRAGMA integrity_check'`"
            )


def _add_sample(topic: BagTopic, message: BagMessage) -> None:
    """Keep a message, unless it is too large. Raises ZstdError."""
    plain = message.decompressed()
    if isinstance(plain.payload, bytes) and plain.refused is None:
        topic.samples.append(plain.payload)


def _open_part(path: Path, files: ExitStack) -> _McapPart | _SqlitePart:
    with path.open("rb") as file:
        start = file.read(len(SQLITE_MAGIC))
        compressed = start.startswith(ZSTD_MAGIC)
        if compressed:
            file.seek(0)
            start = _first_bytes(file)
    if start.startswith(MCAP_MAGIC):
        return _McapPart(path, compressed=compressed)
    if start.startswith(SQLITE_MAGIC):
        return _SqlitePart(path, files, compressed=compressed)
    raise MisuseError(
        f"{visible(str(path))}: neither SQLite nor MCAP, whatever its name says; is it whole?"
    )


def _first_bytes(file: BinaryIO) -> bytes:
    try:
        with zstandard.ZstdDecompressor().stream_reader(file, closefd=False) as stream:
            return stream.read(len(SQLITE_MAGIC))
    except zstandard.ZstdError:
        return b""


def _bag_message(message: ForeignMessage) -> BagMessage:
    return BagMessage(message.key, message.schema, message.logged_ns, message.payload)


def _files_of(folder: Path) -> list[Path]:
    """The bag's files, ``…_2`` before ``…_10``."""
    names = (each for each in folder.iterdir() if _FILE_OF_A_BAG.fullmatch(each.name))
    return sorted(names, key=lambda each: _natural(each.name))


def _natural(name: str) -> list[tuple[int, str]]:
    parts = re.split(r"(\d+)", name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]
