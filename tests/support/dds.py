"""Messages of ROS over DDS, by Cyclone DDS: types made from definitions, a writer that is a program
of its own, a reader of the raw CDR.

    python -m tests.support.dds TAG KEYFRAMES        writes a drive, and keeps it until it is killed
"""

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from cyclonedds._clayer import ddspy_take
from cyclonedds.core import InstanceState, Policy, Qos, SampleState, ViewState
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct, make_idl_struct
from cyclonedds.idl.annotations import final
from cyclonedds.idl.types import (
    array,
    float32,
    float64,
    int8,
    int16,
    int32,
    int64,
    sequence,
    uint8,
    uint16,
    uint32,
    uint64,
)
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from tests.support.ros_messages import TYPES

_DOMAIN = 91
_LOOPBACK = """<CycloneDDS><Domain Id="any">
<General><Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General>
<Discovery><Tag>{tag}</Tag><Peers><Peer address="127.0.0.1"/></Peers>
<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>50</MaxAutoParticipantIndex>
</Discovery></Domain></CycloneDDS>"""
QOS = Qos(
    Policy.Reliability.Reliable(duration(seconds=30)),
    Policy.Durability.TransientLocal,
    Policy.History.KeepAll,
    Policy.DataRepresentation(use_cdrv0_representation=True),
)
_NUMBERS = {
    "bool": bool, "byte": uint8, "char": uint8, "octet": uint8, "string": str,
    "int8": int8, "int16": int16, "int32": int32, "int64": int64,
    "uint8": uint8, "uint16": uint16, "uint32": uint32, "uint64": uint64,
    "float32": float32, "float64": float64,
}  # fmt: skip
_made: dict[str, type[IdlStruct]] = {}


def dds_name(type_name: str) -> str:
    """``tf2_msgs::msg::dds_::TFMessage_``, as ROS names its types in DDS."""
    package, _, name = type_name.split("/")
    return f"{package}::msg::dds_::{name}_"


def idl_type(type_name: str) -> type[IdlStruct]:
    """Cyclone's own type of a message, from its definition."""
    if type_name not in _made:
        _, fields = TYPES._store.fielddefs[type_name]
        made = make_idl_struct(
            type_name.rpartition("/")[2],
            dds_name(type_name),
            {name: _field(kind) for name, kind in fields},
        )
        final(made)
        _made[type_name] = made
    return _made[type_name]


def _field(kind: Any) -> Any:
    tag, about = int(kind[0]), kind[1]
    if tag == 1:  # a number or a text
        return _NUMBERS[about[0]]
    if tag == 2:
        return idl_type(about)
    item, length = about
    return array[_field(item), length] if tag == 3 else sequence[_field(item)]


def to_idl(message: Any) -> Any:
    """The message of rosbags as Cyclone's."""
    _, fields = TYPES._store.fielddefs[message.__msgtype__]
    return idl_type(message.__msgtype__)(
        **{name: _value(getattr(message, name)) for name, _ in fields}
    )


def _value(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, list):
        return [_value(each) for each in value]
    return to_idl(value) if hasattr(value, "__msgtype__") else value


@contextmanager
def participant(tag: str) -> Iterator[DomainParticipant]:
    """A participant that speaks over loopback only, and only with participants of its own tag:
    another run of the tests on this machine has the same domain."""
    owner = Domain(_DOMAIN, _LOOPBACK.format(tag=tag))
    yield DomainParticipant(_DOMAIN)
    del owner


def topic(on: DomainParticipant, name: str, type_name: str) -> Topic:
    """The DDS topic of a topic of ROS."""
    return Topic(on, f"rt{name}", idl_type(type_name), qos=QOS)


def raw_samples(reader: DataReader) -> list[bytes]:
    """The CDR of what a reader has received, as it came; without notices that a writer has left."""
    any_state = SampleState.Any | ViewState.Any | InstanceState.Any
    taken = ddspy_take(reader._ref, any_state, 10_000)
    return (
        [] if isinstance(taken, int) else [bytes(cdr) for cdr, about in taken if about.valid_data]
    )


def main() -> None:
    """Write a drive, and keep it for readers until the process is killed."""
    from tests.support.ros2dds import KINDS, drive

    with participant(sys.argv[1]) as own:
        writers = {name: DataWriter(own, topic(own, name, KINDS[name]), qos=QOS) for name in KINDS}
        for name, message in drive(int(sys.argv[2])):
            writers[name].write(to_idl(message))
        signal.pause()  # a writer that leaves early may leave before a reader has found it


if __name__ == "__main__":
    main()
