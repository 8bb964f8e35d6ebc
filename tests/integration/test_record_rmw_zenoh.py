"""Recording what nodes over rmw_zenoh publish: keys, types by hash, losses by number, latched
topics, and topics that are found without options."""

import itertools
import json
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import zenoh

from eventsrc.envelope.model import FIRST_OFFSET
from eventsrc.envelope.system_events import LOSS_KEY
from eventsrc.log import LogReader, LogWriter, follow
from eventsrc.record.gap_history import ledger_of
from eventsrc.record.importers.bag_streams import BagOptions
from eventsrc.record.importers.run import import_files
from eventsrc.record.recorder.bridged import MAX_KEYS, Bridge
from eventsrc.record.recorder.checking import CheckedMessage
from eventsrc.record.recorder.queue import BridgedMessage
from eventsrc.record.ros_node import RosNode, find_topics
from eventsrc.record.transport.session import Router, Session, ZenohOptions, open_session
from eventsrc.ros.library import Undecodable
from eventsrc.ros.messages import DETECTIONS_3D, GRID
from eventsrc.ros.wire import KeyParts, PublisherToken, RmwWire
from projections.surfaces.cli.bridge_options import recording_of
from tests.support import rmw
from tests.support.commands import Commands
from tests.support.fixtures_log import read_log
from tests.support.fixtures_zenoh import DEADLINE_S, LONG_LEASE, LOOPBACK, MAPFOLD, Program
from tests.support.ros2dds import BOXES, KINDS, TF, Sent, drive, static
from tests.support.ros2dds_recordings import (
    check_derived,
    choice,
    digest,
    envelopes,
    expected_envelopes,
    recording,
    verbatim,
)
from tests.support.ros_bags import write_bag
from tests.support.ros_messages import START, TYPES, tf

Sessions = Callable[[], Session]
HASH = rmw.type_hash(TF)


def new_recording(namespace: str = "", **more: Any) -> Bridge:
    how, topics = recording_of(choice(namespace, **more), 0, None)
    return Bridge(how, topics, TYPES, RmwWire(3))


def wait_for_recorder(node: rmw.Node, topic: str) -> None:
    """Until the node's session knows of a subscriber to a topic."""
    matched = threading.Event()
    publisher = node.session.declare_publisher(node.key(topic, KINDS[topic]))
    listener = publisher.declare_matching_listener(
        lambda status: matched.set() if status.matching else None
    )
    assert publisher.matching_status.matching or matched.wait(DEADLINE_S)
    listener.undeclare()
    publisher.undeclare()


def send_all(node: rmw.Node, sent: Sent, *, labelled: bool = False) -> list[tuple[str, bytes]]:
    for topic in dict.fromkeys(topic for topic, _ in sent):
        wait_for_recorder(node, topic)
    return [(node.name(topic), node.send(topic, m, labelled=labelled)) for topic, m in sent]


def losses(log: Path) -> list[tuple[str, int]]:
    found = [json.loads(e.payload) for e in read_log(log) if e.key == LOSS_KEY]
    return [(loss["cause"], loss["count"]) for loss in found]


@pytest.mark.parametrize(
    ("key", "found"),
    [
        (f"3/bot1/tf/{rmw.dds_type(TF)}/{HASH}", KeyParts("/bot1/tf", TF, HASH)),
        (
            f"3/tf/{rmw.dds_type(TF)}/TypeHashNotSupported",
            KeyParts("/tf", TF, "TypeHashNotSupported"),
        ),
        (f"0/tf/{rmw.dds_type(TF)}/{HASH}", None),
        (f"3/t*/{rmw.dds_type(TF)}/{HASH}", None),
        (f"3/tf/std_srvs::srv::dds_::Trigger_/{HASH}", None),
        ("3/tf", None),
        ("**", None),
        ("3/" + "a/" * 5_000, None),
    ],
)
def test_keys(key: str, found: KeyParts | None) -> None:
    assert RmwWire(3).read_key(key) == found


@pytest.mark.parametrize(
    ("token", "found"),
    [
        (f"@ros2_lv/3/f0/0/11/MP/%/%/talker/%tf/{rmw.dds_type(TF)}/{HASH}/::,10:,:,:,,",
         PublisherToken("/tf", TF)),
        (f"@ros2_lv/3/f0/0/11/MP/%/%bot1/talker/%bot1%tf/{rmw.dds_type(TF)}/{HASH}/:1:,1:,:,:,,",
         PublisherToken("/bot1/tf", TF, is_latched=True)),
        (f"@ros2_lv/3/f0/0/11/MP/%mapfold/%/any/%tf/{rmw.dds_type(TF)}/{HASH}/::,10:,:,:,,",
         PublisherToken("/tf", TF, is_own=True)),
        (f"@ros2_lv/0/f0/0/11/MP/%/%/talker/%tf/{rmw.dds_type(TF)}/{HASH}/q", None),
        (f"@ros2_lv/3/f0/0/11/MS/%/%/talker/%tf/{rmw.dds_type(TF)}/{HASH}/q", None),
        ("@ros2_lv/3/f0/0/0/NN/%/%/talker", None),
        (f"@ros2_lv/3/f0/0/11/MP/%/%/talker/tf/{rmw.dds_type(TF)}/{HASH}/q", None),
        ("@ros2_lv/f0/MP/tf/tf2_msgs§msg§TFMessage/:::", None),
    ],
)  # fmt: skip
def test_tokens(token: str, found: PublisherToken | None) -> None:
    wire = RmwWire(3)
    assert wire.read_token(token) == found
    if found is not None:
        (selector,) = wire.token_selectors(found.topic)
        for each in (selector, wire.all_tokens()):
            assert zenoh.KeyExpr(each).includes(zenoh.KeyExpr(token))


def test_attachments() -> None:
    wire, gid = RmwWire(), bytes(range(16))
    for labelled in (False, True):
        whole = rmw.attachment(77, gid, labelled=labelled)
        assert wire.read_attachment(whole) == (gid.hex(), 77)
        assert all(wire.read_attachment(whole[:n]) is None for n in range(len(whole)))
        assert wire.read_attachment(whole + b"x") is None


@pytest.mark.parametrize(("namespace", "labelled"), [("", False), ("/bot1", True)])
def test_messages_are_verbatim_and_make_the_envelopes_and_the_map_of_a_bag(
    log_path: Path,
    tmp_path: Path,
    endpoint: str,
    connected: Sessions,
    namespace: str,
    labelled: bool,
) -> None:
    sent = drive(40)
    with (
        rmw.node(endpoint, 3, namespace) as node,
        recording(connected(), log_path, new_recording(namespace)) as running,
    ):
        node.advertise_all()
        payloads = send_all(node, sent, labelled=labelled)
        running.wait_until(lambda r: r.messages >= len(sent))
    report = running.finish()
    assert (report.recorded, report.messages, report.lost) == (41, len(sent), 0)  # 40, and a map
    assert report.clean
    kept = verbatim(events := read_log(log_path))
    assert [(e.key, e.payload) for e in kept] == payloads
    assert {e.format.schema for e in kept} == {*KINDS.values()}
    assert [e.payload for e in envelopes(events)] == expected_envelopes(sent, namespace)
    check_derived(log_path)
    times = range(START, START + len(sent))
    named = [(node.name(t), n, m) for n, (t, m) in zip(times, sent, strict=True)]
    with LogWriter(tmp_path / "of-bag") as writer:
        import_files(
            writer, [str(write_bag(tmp_path / "bag", named))], bags=BagOptions(run_id="drive")
        )
    assert digest(tmp_path / "of-bag") == digest(log_path)


def test_missing_numbers_are_losses_of_their_publisher(
    log_path: Path, endpoint: str, connected: Sessions
) -> None:
    with (
        rmw.node(endpoint, 3) as node,
        recording(connected(), log_path, new_recording()) as running,
    ):
        node.advertise_all()
        send_all(node, drive(3))
        node.lose("/tf", 4)
        node.send("/tf", tf())
        with rmw.node(endpoint, 3) as other:  # its sequence numbers start at 1 again
            other.advertise("/tf", TF)
            wait_for_recorder(other, "/tf")
            other.send("/tf", tf())
            other.lose("/tf", 1)
            other.send("/tf", tf())
        running.wait_until(lambda r: r.messages >= len(drive(3)) + 3)
    assert running.finish().lost == 5
    assert sorted(losses(log_path)) == [("transport_miss", 1), ("transport_miss", 4)]


@pytest.mark.slow
def test_ten_thousand_messages_over_restarts_are_recorded_or_counted_as_lost(
    log_path: Path, tmp_path: Path
) -> None:
    """500 a second. The router is away while fifty keyframes are sent; the robot starts again; the
    recorder starts again while the robot is silent."""
    sent, rate = drive(2_500), threading.Event()  # never set
    ends = {"router ends": 400, "router returns": 450, "robot": 900, "recorder": 1_700}
    at = {what: 2 + 4 * keyframes for what, keyframes in ends.items()}
    sent.insert(at["robot"], ("/tf_static", static()))  # as it starts again
    at["recorder"] += 1
    assert len(sent) == 10_003

    def send(node: rmw.Node, first: int, last: int) -> None:
        for topic, message in sent[first:last]:
            node.send(topic, message)
            rate.wait(1 / 500)

    def wait(node: rmw.Node) -> None:
        for topic in KINDS:
            wait_for_recorder(node, topic)

    def continued() -> Bridge:
        with LogReader(log_path) as reader:
            ledger = ledger_of(reader)
        how, topics = recording_of(choice(), 0, ledger)
        return Bridge(how, topics, TYPES, RmwWire(3))

    with ExitStack() as stack:
        router = stack.enter_context(Router(LOOPBACK))
        (endpoint,) = router.endpoints
        listening = ZenohOptions(connect=(endpoint,), config_file=LONG_LEASE)
        session = stack.enter_context(open_session(listening, mode="client"))
        with recording(session, log_path, new_recording()) as running:
            with rmw.node(endpoint, 3) as robot:
                robot.advertise_all()
                wait(robot)
                send(robot, 0, at["router ends"])
                router.close()
                send(robot, at["router ends"], at["router returns"])
                again = ZenohOptions(listen=(endpoint,), config_file=LONG_LEASE)
                stack.enter_context(Router(again))
                wait(robot)
                send(robot, at["router returns"], at["robot"])
                running.wait_until(lambda r: r.messages + r.lost >= at["robot"])
            second = stack.enter_context(rmw.node(endpoint, 3))
            second.advertise_all()
            wait(second)
            send(second, at["robot"], at["recorder"])
            running.wait_until(lambda r: r.messages + r.lost >= at["recorder"])
        first = running.finish()
        with recording(session, log_path, continued()) as running:
            wait(second)
            send(second, at["recorder"], len(sent))
            running.wait_until(lambda r: r.messages > len(sent) - at["recorder"])
        last = running.finish()
    events = read_log(log_path)
    kept = verbatim(events)
    assert last.messages == len(sent) - at["recorder"] + 1  # and what is kept of /tf_static
    assert len(kept) == first.messages + last.messages == len(sent) + 1 - first.lost
    assert first.lost >= at["router returns"] - at["router ends"]
    assert last.lost == 0
    assert sum(count for _, count in losses(log_path)) == first.lost
    assert {cause for cause, _ in losses(log_path)} == {"transport_miss"}
    named = [(e.key, e.logged_ns, TYPES.decode(e.payload, KINDS[e.key])) for e in kept]
    with LogWriter(tmp_path / "of-bag") as writer:
        bag = write_bag(tmp_path / "bag", named)
        import_files(writer, [str(bag)], bags=BagOptions(run_id="drive"))
    assert digest(tmp_path / "of-bag") == digest(log_path)


def test_latched_messages_are_recorded_once_from_nodes_that_are_there_and_from_later_ones(
    log_path: Path, endpoint: str, connected: Sessions
) -> None:
    sent = [static(), tf()]
    with rmw.node(endpoint, 3) as early, rmw.node(endpoint, 3) as late:
        early.advertise("/tf_static", TF)
        payloads = [early.send("/tf_static", sent[0])]
        with recording(connected(), log_path, new_recording()) as running:
            running.wait_until(lambda r: r.messages == 1)
            late.advertise("/tf_static", TF)  # sends before it can know of the recorder
            payloads.append(late.send("/tf_static", sent[1]))
            running.wait_until(lambda r: r.messages >= 2)
            wait_for_recorder(late, "/tf_static")
            payloads.append(late.send("/tf_static", sent[0]))
            running.wait_until(lambda r: r.messages >= 3)
    assert running.finish().messages == 3
    assert [e.payload for e in verbatim(read_log(log_path))] == payloads


def test_a_definition_of_another_hash_is_kept_and_counted_and_not_read(
    log_path: Path, endpoint: str, connected: Sessions
) -> None:
    other = "RIHS01_" + "0" * 64
    with pytest.raises(Undecodable, match="another definition"):
        TYPES.definition(BOXES, other)
    assert TYPES.definition(BOXES, rmw.type_hash(BOXES)) == TYPES.definition(BOXES, "Humble's")
    with (
        rmw.node(endpoint, 3) as node,
        recording(connected(), log_path, new_recording()) as running,
    ):
        for topic, kind in KINDS.items():
            node.advertise(topic, kind, other if kind == BOXES else None)
        send_all(node, sent := drive(2))
        running.wait_until(lambda r: r.messages >= len(sent))
    report = running.finish()
    assert [(topic, count) for topic, count, _ in report.unread] == [("/detections", 2)]
    assert "its hash is RIHS01_0" in report.unread[0][2]
    assert not report.clean
    assert envelopes(read_log(log_path)) == []
    assert len(verbatim(read_log(log_path))) == len(sent)


def no_check(_: object) -> Iterator[CheckedMessage]:
    return iter(())


def test_made_up_keys_do_not_fill_the_memory() -> None:
    bridge = new_recording()
    batch = [
        BridgedMessage(f"3/tf/a::msg::dds_::B{number}_/{HASH}", b"x")
        for number in range(MAX_KEYS + 10)
    ]
    bridge.take([*batch, BridgedMessage("3/other/x/y", b"")], START, no_check)
    assert bridge.unknown_keys == 11
    other = bridge.take([BridgedMessage(f"3/map/a::msg::dds_::B_/{HASH}", b"x")], START, no_check)
    assert [message.key for message in other] == ["/map"]


@pytest.mark.seconds
def test_the_command_finds_its_topics_by_itself(
    tmp_path: Path, endpoint: str, start_code: Callable[..., Program]
) -> None:
    log = tmp_path / "log"
    program = start_code(
        MAPFOLD, "record", str(log), "--connect", endpoint, "--ros2", "--run-id", "drive",
        "--domain", "3", "--json",
    )  # fmt: skip
    assert "no topic at all" in program.wait_for("waiting for a publisher of vision_msgs/msg/")
    sent = drive(10)
    with rmw.node(endpoint, 3) as node, rmw.node(endpoint, 4) as other:
        other.advertise("/elsewhere/detections", BOXES)
        node.advertise_all()
        node.send("/tf_static", sent[0][1])
        node.send("/map", sent[1][1])
        program.wait_for("Ctrl-C ends it")
        assert program.wait_for("/detections  ").endswith("keyframes of run drive")
        program.wait_for("/embeddings  embeddings")
        program.wait_for("/map         map")
        send_all(node, sent[2:])
        made = (e for e in follow(log, FIRST_OFFSET, stop=threading.Event()) if e and e.is_envelope)
        assert len([*itertools.islice(made, 10)]) == 10
        assert program.end(signal.SIGINT) == 0
    document = json.loads(program.output())
    assert (document["recorded"], document["messages"]) == (11, len(sent))
    assert [e.payload for e in envelopes(read_log(log))] == expected_envelopes(sent)


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A search for topics that waits 0.1 s for their first messages."""
    monkeypatch.setattr("eventsrc.record.ros_node._SAMPLES_S", 0.1)


@pytest.mark.usefixtures("impatient")
def test_of_several_topics_of_transforms_none_is_taken(endpoint: str, connected: Sessions) -> None:
    with rmw.node(endpoint, 3) as node:
        node.advertise("/detections", BOXES)
        for topic in ("/bot1/tf", "/bot2/tf"):
            node.advertise(topic, TF)
        found = find_topics(
            connected(),
            RmwWire(3),
            TYPES,
            BagOptions(),
            "",
            stop=threading.Event(),
            note=pytest.fail,
        )
    assert found is not None
    assert (found.streams[0].tf, found.streams[0].tf_static) == (None, None)
    assert any("/bot1/tf, /bot2/tf" in note for note in found.notes)


@pytest.mark.usefixtures("impatient")
def test_of_a_map_that_mapfold_shows_under_any_name_nothing_is_taken_unasked(
    endpoint: str, connected: Sessions
) -> None:
    session, stop = connected(), threading.Event()
    with RosNode(connected(), TYPES, 3, "/bot1", "house") as own, rmw.node(endpoint, 3) as robot:
        shown = own.publisher("~/objects", DETECTIONS_3D, latched=True)
        own.publisher("~/walls", GRID, latched=True)
        robot.advertise("/things", DETECTIONS_3D)
        own.session.confirm()
        for options, taken in (
            (BagOptions(), "/things"),
            (BagOptions(detections=(shown.topic,)), shown.topic),
        ):
            found = find_topics(
                session, RmwWire(3), TYPES, options, "", stop=stop, note=pytest.fail
            )
            assert found is not None
            assert [each.detections for each in found.streams] == [taken]
            assert found.grids == ["/map"]


@pytest.mark.usefixtures("impatient")
def test_what_may_come_later_is_recorded_and_other_robots_are_not(
    endpoint: str, connected: Sessions
) -> None:
    with rmw.node(endpoint, 3, "/bot1") as one, rmw.node(endpoint, 3, "/bot2") as two:
        for each in (one, two):
            each.advertise("/detections", BOXES)
        options = BagOptions(run_id="r", classes=("none",))
        stop = threading.Event()
        found = find_topics(
            connected(), RmwWire(3), TYPES, options, "/bot1", stop=stop, note=pytest.fail
        )
    assert found is not None
    (stream,) = found.streams
    assert (stream.detections, stream.tf, stream.tf_static) == (
        "/bot1/detections",
        "/tf",
        "/tf_static",
    )
    assert (found.grids, stream.classes, stream.pose) == (["/map"], (), None)
    assert found.uses["/tf"] == "transforms, as soon as it has a publisher"


def test_the_search_ends_when_it_is_stopped(connected: Sessions) -> None:
    stop = threading.Event()
    said = list[str]()

    def note(line: str) -> None:
        said.append(line)
        stop.set()

    found = find_topics(connected(), RmwWire(3), TYPES, BagOptions(), "/bot1", stop=stop, note=note)
    assert found is None
    assert ["domain 3, under /bot1/" in line for line in said] == [True]


def test_options_of_the_command(tmp_path: Path) -> None:
    run = Commands.in_folder(tmp_path)
    for number in ("300", "x", "-1"):
        elsewhere = Commands.in_folder(tmp_path, ROS_DOMAIN_ID=number)
        assert f"ROS_DOMAIN_ID is {number}" in elsewhere("record", "L", "--ros2", code=2).err
    for wrong, said in (
        (["--ros2", "--ros2dds"], "give the one that the robot has"),
        (["--domain", "3"], "--domain goes with --ros2"),
        (["--ros2dds", "--domain", "3"], "--domain goes with --ros2"),
        (["--ros2", "--namespace", "/a b"], "is no ROS 2 namespace"),
    ):
        assert said in run("record", "L", *wrong, code=2).err
    assert not (tmp_path / "L").exists()
