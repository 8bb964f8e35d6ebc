"""Certificates and access control of Zenoh, with the configuration of docs/security.md as it stands
there: `mapfold router` and `mapfold record`, two robots, and others who have no business there."""

import functools
import json
import queue
import re
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from eventsrc.base.errors import TransportError
from eventsrc.record.robot.acks import ACK_PREFIX, sent_key
from eventsrc.record.robot.publisher import EnvelopePublisher
from eventsrc.record.transport.session import Received, Session, ZenohOptions, open_session
from tests.docs.console import ROOT
from tests.support.envelopes import envelope, payload
from tests.support.fixtures_log import read_log
from tests.support.fixtures_zenoh import DEADLINE_S, NEVER_S, Program
from tests.support.thorough import mostly_slow

PAGE = (ROOT / "docs" / "security.md").read_text()
NAMES = ("router", "recorder", "robot-1", "robot-2", "stranger")
KEY = "tb/detections"
Start = Callable[..., Program]


def _block(name: str) -> str:
    (block,) = re.findall(rf"^```json5 {name}\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    return str(block)


def _openssl(folder: Path, *arguments: str) -> None:
    subprocess.run(["openssl", *arguments], cwd=folder, check=True, capture_output=True)


def _certificates(folder: Path, authority: str, names: tuple[str, ...]) -> None:
    """``<authority>.pem``, and for each name a certificate of it: ``<name>.pem``."""
    curve = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
    key = ("-keyout", f"{authority}-key.pem", "-out", f"{authority}.pem")
    _openssl(folder, "req", "-x509", *curve, *key, "-subj", f"/CN={authority}", "-days", "2")
    for name in names:
        request = ("-keyout", f"{name}-key.pem", "-out", f"{name}.csr", "-subj", f"/CN={name}")
        _openssl(folder, "req", *curve, *request)
        (folder / "extensions").write_text("subjectAltName=DNS:localhost,IP:127.0.0.1\n")
        _openssl(
            folder,
            *("x509", "-req", "-in", f"{name}.csr", "-out", f"{name}.pem", "-days", "2"),
            *("-CA", f"{authority}.pem", "-CAkey", f"{authority}-key.pem"),
            *("-extfile", "extensions", "-CAcreateserial"),
        )


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Certificates and the page's configurations; the current folder, for their relative paths."""
    _certificates(tmp_path, "ca", NAMES)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "router.json5").write_text(_block("router.json5"))
    for name in NAMES[1:]:
        text = _block("recorder.json5").replace("recorder", name)
        (tmp_path / f"{name}.json5").write_text(text)
    return tmp_path


@pytest.fixture
def endpoint(folder: Path, start: Start) -> str:
    """Where the router of the page listens."""
    router = start("router", "--zenoh-config", "router.json5", "--listen", "tls/127.0.0.1:0")
    listens = router.wait_for("router listening on").split()[3].rstrip(";")
    return listens.replace("127.0.0.1", "localhost")


@pytest.fixture
def options(folder: Path, endpoint: str) -> Callable[[str], ZenohOptions]:
    """How a client with a certificate of that name connects."""
    return lambda name: ZenohOptions(connect=(endpoint,), config_file=folder / f"{name}.json5")


@pytest.fixture
def session(options: Callable[[str], ZenohOptions]) -> Iterator[Callable[[str], Session]]:
    """Opens sessions, by the name in the certificate."""
    with ExitStack() as sessions:
        yield lambda name: sessions.enter_context(open_session(options(name), mode="client"))


@pytest.fixture
def recorder(start: Start, endpoint: str) -> Program:
    """`mapfold record`, subscribed."""
    program = start(
        "record", "log", "--zenoh-config", "recorder.json5", "--connect", endpoint, "--key", KEY
    )
    program.wait_for("recording")
    return program


def test_only_robots_get_into_the_log(
    recorder: Program,
    options: Callable[[str], ZenohOptions],
    session: Callable[[str], Session],
    folder: Path,
) -> None:
    stranger = session("stranger")
    stranger.send(KEY, payload(envelope(1, run_id="stranger")))
    stranger.confirm()
    with EnvelopePublisher(options("robot-1"), folder / "spool", resend_after_s=NEVER_S) as robot:
        for k in range(3):
            robot.publish(envelope(k, run_id="robot-1"))
        assert robot.flush(DEADLINE_S)
        stranger.send(KEY, payload(envelope(2, run_id="stranger")))
        stranger.confirm()
        robot.publish(envelope(3, run_id="robot-1"))
        assert robot.flush(DEADLINE_S)
    assert recorder.end(signal.SIGINT) == 0, recorder.lines
    runs = [json.loads(event.payload)["run_id"] for event in read_log(folder / "log")]
    assert runs == ["robot-1"] * 4


def test_only_the_recorder_can_acknowledge(
    session: Callable[[str], Session],
) -> None:
    heard: queue.Queue[Received] = queue.Queue()
    victim = session("robot-1")
    victim.subscribe(f"{ACK_PREFIX}**", heard.put)
    victim.confirm()
    for name in ("stranger", "robot-2"):
        forger = session(name)
        forger.send(f"{ACK_PREFIX}run", b"forged")
        forger.confirm()
    recorder = session("recorder")
    recorder.send(f"{ACK_PREFIX}run", b"real")
    recorder.confirm()
    assert heard.get(timeout=DEADLINE_S).payload == b"real"
    victim.confirm()
    assert heard.empty()


@pytest.mark.parametrize("key", mostly_slow([KEY, sent_key(KEY), f"{KEY}/@adv/pub/1/2/_"]))
def test_robots_do_not_hear_one_another_and_strangers_hear_nothing(
    session: Callable[[str], Session], key: str
) -> None:
    heard: dict[str, list[bytes]] = {name: [] for name in ("robot-2", "stranger", "recorder")}

    def note(name: str, message: Received) -> None:
        heard[name].append(message.payload)

    listeners = {name: session(name) for name in heard}
    for name, listener in listeners.items():
        # called by the thread that receives, so before the reply of a later `confirm` is read
        listener.subscribe(key, functools.partial(note, name), in_order=True)
        listener.confirm()
    robot = session("robot-1")
    robot.send(key, b"seen")
    robot.confirm()
    for listener in listeners.values():
        listener.confirm()
    assert heard == {"robot-2": [], "stranger": [], "recorder": [b"seen"]}


def test_without_a_certificate_of_the_authority_no_client_connects(
    folder: Path, endpoint: str
) -> None:
    _certificates(folder, "other-ca", ("impostor",))
    text = _block("recorder.json5").replace("recorder", "impostor")
    (folder / "impostor.json5").write_text(text)
    (folder / "none.json5").write_text(
        '{ transport: { link: { tls: { root_ca_certificate: "ca.pem" } } } }'
    )
    for name in ("impostor", "none"):
        options = ZenohOptions(connect=(endpoint,), config_file=folder / f"{name}.json5")
        with pytest.raises(TransportError, match="answers at"):
            open_session(options, mode="client").close()
