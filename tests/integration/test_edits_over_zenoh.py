"""Commands that come to a recorder over Zenoh: recorded once, durable before the reply, or refused
with the log as it was."""

import json
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import pytest

from eventsrc.base.errors import LogDamaged
from eventsrc.envelope.commands import (
    MAX_COMMAND_BYTES,
    Command,
    ForgetRun,
    InvalidCommand,
    UseSettings,
    encode_command,
    parse_command,
)
from eventsrc.envelope.model import RunId
from eventsrc.envelope.system_events import COMMAND_KEY, REJECTED_KEY, RejectedPayload
from eventsrc.log import Event, LogReader, LogWriter
from eventsrc.record.recorder.edits import (
    MAX_EDITS_WAITING,
    CommandRefused,
    Declined,
    EditRequest,
    Edits,
    KnownCommands,
    NewerCommand,
    NoAnswer,
    edit_key,
    send_command,
)
from eventsrc.record.recorder.queue import MessageQueue
from eventsrc.record.recorder.recorder import Recorder
from eventsrc.record.transport.session import Received, Session
from projections.fold.corrections import check_settings
from tests.support.envelopes import envelope, payload
from tests.support.fixtures_zenoh import DEADLINE_S, Program

Sessions = Callable[[], Session]
KEY = "tb/detections"


def _forget(command_id: str, run: str = "run-1") -> ForgetRun:
    return ForgetRun(command_id=command_id, issued_by="me@here", reason="why", run_id=RunId(run))


@contextmanager
def recording(session: Session, log: Path, *, accept: bool = True) -> Iterator[str]:
    """A recorder at work; gives the log's id."""
    stop = threading.Event()
    with LogWriter(log) as writer, ThreadPoolExecutor(1) as thread:
        with LogReader(log) as reader:
            known = KnownCommands.of(reader)
        edits = Edits(writer, known, check_settings) if accept else None
        recorder = Recorder(session, writer, [KEY], edits=edits)
        done = thread.submit(recorder.run, stop)
        try:
            yield writer.log_id
        finally:
            stop.set()
            done.result(DEADLINE_S)


def _events(log: Path, key: str = COMMAND_KEY) -> list[Event]:
    with LogReader(log) as reader:
        return list(reader.read(keys={key}))


def _commands(log: Path) -> list[Command]:
    return [parse_command(event.payload) for event in _events(log)]


def _send(session: Session, log_id: str, command: Command, known_at: int) -> int:
    return send_command(session, log_id, command, known_at, timeout_s=DEADLINE_S).offset


def test_it_is_in_the_log_when_the_reply_comes(connected: Sessions, tmp_path: Path) -> None:
    log, session = tmp_path / "log", connected()
    with recording(connected(), log) as log_id:
        for number in range(5):
            command = _forget(f"id-{number}")
            offset = _send(session, log_id, command, number)
            with LogReader(log) as reader:  # while the recorder holds the log
                (event,) = reader.read(offset, offset + 1)
            assert (event.key, parse_command(event.payload)) == (COMMAND_KEY, command)


def test_between_envelopes_every_command_has_its_own_offset(
    connected: Sessions, publish: Callable[..., Program], tmp_path: Path
) -> None:
    log, session = tmp_path / "log", connected()
    sent = [payload(envelope(k)) for k in range(200)]
    with recording(connected(), log) as log_id:
        robot = publish(KEY, *(p.decode() for p in sent))
        offsets = [
            send_command(session, log_id, _forget(f"id-{n}"), 10**9, timeout_s=DEADLINE_S).offset
            for n in range(20)
        ]
        assert robot.wait() == 0
    assert [event.offset for event in _events(log)] == offsets
    assert [event.payload for event in _events(log, KEY)] == sent


def test_the_same_command_twice_is_recorded_once(connected: Sessions, tmp_path: Path) -> None:
    log, session = tmp_path / "log", connected()
    command = _forget("id-1")
    with recording(connected(), log) as log_id:
        first = send_command(session, log_id, command, 0, timeout_s=DEADLINE_S)
        again = send_command(session, log_id, command, 0, timeout_s=DEADLINE_S)
    with recording(connected(), log) as log_id:  # and by another recorder
        later = send_command(session, log_id, command, 0, timeout_s=DEADLINE_S)
        with pytest.raises(CommandRefused, match="that of another command, at offset 0"):
            _send(session, log_id, _forget("id-1", "run-2"), 9)
    assert (first.offset, again.offset, later.offset) == (0, 0, 0)
    assert [first.repeated, again.repeated, later.repeated] == [False, True, True]
    assert _commands(log) == [command]


def test_two_at_once_with_one_id_are_recorded_once(connected: Sessions, tmp_path: Path) -> None:
    log = tmp_path / "log"
    sessions = [connected() for _ in range(4)]
    with recording(connected(), log) as log_id, ThreadPoolExecutor(4) as threads:
        sent = [threads.submit(_send, s, log_id, _forget("one"), 0) for s in sessions]
        assert {future.result() for future in sent} == {0}
    assert _commands(log) == [_forget("one")]


def test_a_sender_that_does_not_know_the_last_command_is_told(
    connected: Sessions, tmp_path: Path
) -> None:
    log, session = tmp_path / "log", connected()
    with recording(connected(), log) as log_id:
        _send(session, log_id, _forget("id-1"), 0)
        with pytest.raises(NewerCommand) as caught:
            _send(session, log_id, _forget("id-2", "run-2"), 0)
        assert caught.value.offset == 0
        assert _send(session, log_id, _forget("id-2", "run-2"), 1) == 1
    assert len(_commands(log)) == 2


def test_of_many_at_once_only_those_that_know_the_others_are_recorded(
    connected: Sessions, tmp_path: Path
) -> None:
    """As `mapfold edit` does: who is behind looks again and sends again."""
    log = tmp_path / "log"

    def edit(session: Session, log_id: str, name: str) -> None:
        known_at = 0
        while True:
            try:
                _send(session, log_id, _forget(name, name), known_at)
            except NewerCommand as newer:
                known_at = newer.offset + 1
            else:
                return

    sessions = [connected() for _ in range(5)]
    with recording(connected(), log) as log_id, ThreadPoolExecutor(5) as threads:
        done = [threads.submit(edit, session, log_id, f"{i}") for i, session in enumerate(sessions)]
        for future in done:
            future.result()
    assert sorted(c.command_id for c in _commands(log)) == ["0", "1", "2", "3", "4"]


def test_a_recorder_that_was_not_told_to_accept_edits_does_not_answer(
    connected: Sessions, tmp_path: Path
) -> None:
    log, session = tmp_path / "log", connected()
    with (
        recording(connected(), log, accept=False) as log_id,
        pytest.raises(NoAnswer),
    ):
        _send(session, log_id, _forget("id"), 0)
    assert _commands(log) == []


def test_a_recorder_of_another_log_does_not_answer(connected: Sessions, tmp_path: Path) -> None:
    session = connected()
    with recording(connected(), tmp_path / "log"), pytest.raises(NoAnswer):
        _send(session, "another", _forget("id"), 0)


@pytest.mark.parametrize(
    ("sent", "says"),
    [
        (b"", "the command: "),
        (b"{", "the command: "),
        (b"null", "the command: "),
        (b"\xff\xfe", "the command: "),
        (b'{"kind": "destroy"}', "kind"),
        (b'{"kind": "forget-run", "command_id": "a", "issued_by": "b"}', "run_id"),
        (b'{"kind":"undo","command_id":"a\\u0007","issued_by":"b","undone":"c"}', "U+0007"),
        (
            b'{"kind":"undo","command_id":"a","issued_by":"b","undone":"c","more":1}',
            "Extra inputs",
        ),
        (b"[" * 100_000, "the command: "),
        (
            b'{"kind":"use-settings","command_id":"a","issued_by":"b","settings":{"eps":1}}',
            "no setting 'eps'",
        ),
        (
            b'{"kind":"use-settings","command_id":"a","issued_by":"b","settings":'
            + b'{"a":' * 5_000 + b"1" + b"}" * 5_000 + b"}",
            "recursion",
        ),
        (
            b'{"kind":"use-settings","command_id":"a","issued_by":"b","settings":{"eps_m":1e999}}',
            "eps_m",
        ),
    ],
)  # fmt: skip
def test_what_is_no_command_is_refused_and_the_recorder_goes_on(
    connected: Sessions, tmp_path: Path, sent: bytes, says: str
) -> None:
    log, session = tmp_path / "log", connected()
    with recording(connected(), log) as log_id:
        ((good, reply),) = session.get_replies(edit_key(log_id), sent, timeout_s=DEADLINE_S)
        assert not good
        assert says in Declined.model_validate_json(reply).error
        assert _send(session, log_id, _forget("after"), 0) == 0
    assert _commands(log) == [_forget("after")]


def test_a_command_that_is_too_large_is_not_read(connected: Sessions, tmp_path: Path) -> None:
    log, session = tmp_path / "log", connected()
    with recording(connected(), log) as log_id:
        for selector, size in (
            (edit_key(log_id), MAX_COMMAND_BYTES + 1),
            (f"{edit_key(log_id)}?known_at={'0' * 5_000}", 10),
        ):
            ((good, reply),) = session.get_replies(selector, b"x" * size, timeout_s=DEADLINE_S)
            assert not good
            assert "are taken" in Declined.model_validate_json(reply).error
    assert _events(log) == []


@pytest.mark.parametrize("known_at", ["", "?known_at=", "?known_at=-1", "?known_at=x", "?other=1"])
def test_without_known_at_a_command_is_recorded_whatever_came_before(
    connected: Sessions, tmp_path: Path, known_at: str
) -> None:
    log, session = tmp_path / "log", connected()
    with recording(connected(), log) as log_id:
        _send(session, log_id, _forget("id-1"), 0)
        selector = f"{edit_key(log_id)}{known_at}"
        sent = encode_command(_forget("id-2"))
        ((good, _),) = session.get_replies(selector, sent, timeout_s=DEADLINE_S)
        assert good
    assert len(_commands(log)) == 2


def test_a_command_published_as_data_is_rejected_and_is_no_command(
    connected: Sessions, tmp_path: Path
) -> None:
    log = tmp_path / "log"
    forged = encode_command(_forget("forged"))
    stop = threading.Event()
    with LogWriter(log) as writer, ThreadPoolExecutor(1) as thread:
        known = KnownCommands()
        recorder = Recorder(
            connected(), writer, ["**"], max_events=2, edits=Edits(writer, known, check_settings)
        )
        done = thread.submit(recorder.run, stop)
        session = connected()
        for key in (COMMAND_KEY, edit_key(writer.log_id)):
            publisher = session.publisher(key)
            assert publisher.wait_for_subscriber(DEADLINE_S)
            publisher.put(forged)
        done.result(DEADLINE_S)
    assert _commands(log) == []
    kept = [RejectedPayload.model_validate_json(e.payload) for e in _events(log, REJECTED_KEY)]
    assert [k.raw for k in kept] == [forged, forged]
    assert all("reserved" in k.reason for k in kept)


def test_a_log_whose_commands_cannot_be_read_takes_none(
    connected: Sessions, tmp_path: Path
) -> None:
    log, session = tmp_path / "log", connected()
    with LogWriter(log) as writer:
        writer.append(COMMAND_KEY, b"{}")
    with LogReader(log) as reader, pytest.raises(LogDamaged, match="offset 0 is no command"):
        KnownCommands.of(reader)
    stop = threading.Event()
    with LogWriter(log) as writer, ThreadPoolExecutor(1) as thread:
        recorder = Recorder(connected(), writer, [KEY], edits=Edits(writer, "it cannot be read"))
        done = thread.submit(recorder.run, stop)
        with pytest.raises(CommandRefused, match="it cannot be read"):
            _send(session, writer.log_id, _forget("id"), 1)
        stop.set()
        done.result(DEADLINE_S)
    assert len(_events(log)) == 1


class _Query:
    """What an `EditRequest` reads of a query."""

    def __init__(self, command: Command) -> None:
        self.key = "mapfold/edit/x"
        self.payload = encode_command(command)
        self.size, self.selector_size = len(self.payload), len(self.key)
        self.parameters: dict[str, str] = {}
        self.replies: list[tuple[bool, dict[str, object]]] = []

    def reply(self, _key: str, payload: bytes) -> None:
        self.replies.append((True, json.loads(payload)))

    def reply_error(self, payload: bytes) -> None:
        self.replies.append((False, json.loads(payload)))


def test_only_so_many_wait_and_messages_still_fit() -> None:
    queue = MessageQueue(1_000)
    requests = [EditRequest(_Query(_forget(str(n)))) for n in range(MAX_EDITS_WAITING + 1)]  # type: ignore[arg-type]
    assert [queue.put_edit(r) for r in requests] == [True] * MAX_EDITS_WAITING + [False]
    queue.put(Received(KEY, b"x"))
    assert len(queue.get(1_000, 0)) == MAX_EDITS_WAITING + 1
    assert queue.put_edit(requests[-1])
    queue.close()
    assert not queue.put_edit(requests[0]), "it would not be answered"


def test_nothing_is_answered_before_it_is_durable(tmp_path: Path) -> None:
    query = _Query(_forget("id"))
    with LogWriter(tmp_path / "log") as writer:
        edits = Edits(writer, KnownCommands())
        edits.append(EditRequest(query))  # type: ignore[arg-type]
        repeated = _Query(_forget("id"))
        edits.append(EditRequest(repeated))  # type: ignore[arg-type]
        edits.reply_to_durable(writer.durable_offset)
        assert (query.replies, repeated.replies) == ([], []), "a repetition waits as well"
        edits.reply_to_durable(writer.sync())
    assert query.replies == [(True, {"command_id": "id", "offset": 0, "repeated": False})]
    assert repeated.replies == [(True, {"command_id": "id", "offset": 0, "repeated": True})]


def test_what_was_lost_with_a_file_is_refused_and_so_is_all_that_follows(tmp_path: Path) -> None:
    lost, later = _Query(_forget("lost")), _Query(_forget("later"))
    with LogWriter(tmp_path / "log") as writer:
        edits = Edits(writer, KnownCommands())
        edits.append(EditRequest(lost))  # type: ignore[arg-type]
        edits.refuse_lost([(0, 1)])
        edits.append(EditRequest(later))  # type: ignore[arg-type]
        edits.reply_to_durable(writer.sync())
    for query in (lost, later):
        ((good, reply),) = query.replies
        assert not good
        assert "start the recorder again" in str(reply["error"])


def test_the_error_of_a_log_goes_to_those_who_wait(tmp_path: Path) -> None:
    query = _Query(_forget("id"))
    with LogWriter(tmp_path / "log") as writer:
        edits = Edits(writer, KnownCommands())
        edits.append(EditRequest(query))  # type: ignore[arg-type]
        edits.refuse_all("no space left")
    ((good, reply),) = query.replies
    assert not good
    assert "no space left" in str(reply["error"])


def test_settings_that_no_fold_could_have_are_no_command(tmp_path: Path) -> None:
    bad = UseSettings(command_id="id", issued_by="me", settings={"eps_m": -1.0})
    query = _Query(bad)
    with LogWriter(tmp_path / "log") as writer:
        Edits(writer, KnownCommands(), check_settings).append(EditRequest(query))  # type: ignore[arg-type]
        assert writer.next_offset == 0
    assert "eps_m" in str(query.replies[0][1]["error"])


def test_a_known_id_with_other_content_is_another_command() -> None:
    known = KnownCommands()
    known.add(_forget("id"), 4)
    assert known.find(_forget("id")) == 4
    assert known.find(_forget("other")) is None
    assert known.end == 5
    with pytest.raises(InvalidCommand, match="offset 4"):
        known.find(_forget("id", "run-2"))
