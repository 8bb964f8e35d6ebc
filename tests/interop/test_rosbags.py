"""rosbags, a reader of ROS bags that knows nothing of mapfold, given our logs.

It opens bags only, which a log is not: it also holds what is not of ROS. It says so, and reads the
messages of ROS that the official MCAP library finds in a log, by the types that the log names.
"""

from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader, ReaderError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from eventsrc.log import LogWriter, MessageFormat, NewEvent
from tests.support.logs import walk, write_log
from tests.support.ros2dds import KINDS, drive
from tests.support.ros_messages import TYPES

pytestmark = pytest.mark.slow


def ros_log(path: Path, sent: list[tuple[str, Any]]) -> Path:
    """A log of messages of ROS, as the recorder keeps those of a bridge, with envelopes between."""
    with LogWriter(path) as writer:
        for number, (topic, message) in enumerate(sent):
            name = KINDS[topic]
            form = MessageFormat("cdr", name, "ros2msg", TYPES.definition(name).encode())
            content = TYPES.encode(message, name)
            writer.append_all([NewEvent(topic, content, 10**18 + number, 10**18, 1, form)])
    return write_log(path, walk(10))


def test_it_says_that_a_log_is_no_bag(tmp_path: Path) -> None:
    for log in (ros_log(tmp_path / "ros", drive(2)), write_log(tmp_path / "plain", walk(5))):
        with pytest.raises(FileNotFoundError, match="metadata"):
            Reader(log).open()
        for segment in log.glob("*.mcap"):
            with pytest.raises(ReaderError, match="Profile is not ros2"):
                Reader(segment).open()


def test_it_reads_the_messages_of_ros_by_the_types_that_the_log_names(tmp_path: Path) -> None:
    sent = drive(12)
    log = ros_log(tmp_path / "log", sent)
    read, types = [], get_typestore(Stores.EMPTY)
    for segment in sorted(log.glob("*.mcap")):
        with segment.open("rb") as file:
            for schema, channel, message in make_reader(file).iter_messages(log_time_order=False):
                if channel.message_encoding != "cdr" or schema is None:
                    continue
                assert schema.encoding == "ros2msg"
                defined = get_types_from_msg(schema.data.decode(), schema.name)
                types.register({n: d for n, d in defined.items() if n not in types.fielddefs})
                decoded = types.deserialize_cdr(message.data, schema.name)
                read.append((channel.topic, decoded))
    assert [topic for topic, _ in read] == [topic for topic, _ in sent]
    for (_, ours), (topic, theirs) in zip(sent, read, strict=True):
        name = KINDS[topic]
        assert theirs.__msgtype__ == name
        assert bytes(types.serialize_cdr(theirs, name)) == TYPES.encode(ours, name)
