"""Zenoh of other versions: the lowest that pyproject.toml allows, and one between it and ours.

Each is installed from the registry into an environment of its own. A peer of that version speaks
plain Zenoh, without mapfold; and mapfold itself runs on it, with ours at the other end.
"""

import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import threading
import tomllib
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path

import pytest

from eventsrc.log import LogReader
from eventsrc.record.transport.session import Session, ZenohOptions, open_session
from projections.fold.settings import Settings
from projections.postgres import rebuild
from projections.postgres.connection import Targets
from projections.surfaces.serve import Answerer, FairQueue, Pools, ZenohService
from tests.support.envelopes import payload
from tests.support.logs import walk, write_log

ROOT = Path(__file__).resolve().parents[2]
UV = Path(sys.executable).with_name("uv")
OUR_VERSION = version("eclipse-zenoh")
BETWEEN = "1.9.0"
COUNT = 40
DEADLINE_S = 60.0

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]


def lowest() -> str:
    """The lowest version that pyproject.toml allows, as a release."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    (bound,) = (d for d in project["dependencies"] if d.startswith("eclipse-zenoh"))
    found = re.fullmatch(r"eclipse-zenoh>=(\d+\.\d+)", bound)
    assert found, bound
    return f"{found[1]}.0"


class Other:
    """An environment with one version of Zenoh and nothing else."""

    def __init__(self, folder: Path, version: str) -> None:
        self.version = version
        self.python = folder / "bin" / "python"
        for arguments in (
            ["venv", "--python", sys.executable, folder],
            ["pip", "install", "--python", self.python, f"eclipse-zenoh=={version}"],
        ):
            done = subprocess.run(
                [UV, *arguments, "--quiet"], capture_output=True, text=True, check=False
            )
            assert done.returncode == 0, done.stderr
        (self.packages,) = (folder / "lib").glob("python*/site-packages")

    def plain(self, code: str, *arguments: str, stdin: bytes = b"") -> str:
        """What a program prints that runs here, without mapfold; it prints its version first."""
        done = subprocess.run(
            [self.python, "-c", PLAIN + code, *arguments],
            input=stdin, capture_output=True, timeout=2 * DEADLINE_S, env=clean(), check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr.decode()
        used, _, rest = done.stdout.decode().partition("\n")
        assert used == self.version
        return rest

    @property
    def env(self) -> dict[str, str]:
        """The environment variables by which our Python takes this version in place of ours."""
        return clean() | {"PYTHONPATH": f"{self.packages}{os.pathsep}{ROOT}"}


def clean() -> dict[str, str]:
    """Our environment variables, without those that name databases or modules."""
    return {k: v for k, v in os.environ.items() if not k.startswith(("MAPFOLD_", "PYTHON"))}


@pytest.fixture(scope="module", params=["lowest", "between"])
def other(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Other:
    wanted = lowest() if request.param == "lowest" else BETWEEN
    assert wanted != OUR_VERSION
    return Other(tmp_path_factory.mktemp("zenoh") / "venv", wanted)


class Recording:
    """`mapfold record` in a process of its own, on our Zenoh or on another one."""

    def __init__(self, log: Path, endpoint: str, env: dict[str, str]) -> None:
        self.log = log
        self.process = subprocess.Popen(
            [sys.executable, "-m", "projections.surfaces.cli", "record", log, "--connect",
            endpoint], env=env, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert self.process.stderr is not None
        timer = threading.Timer(DEADLINE_S, self.process.kill)
        timer.start()
        said = []
        for line in self.process.stderr:
            said.append(line)
            if "recording" in line:
                break
        timer.cancel()
        assert any("recording" in line for line in said), said

    def finish(self) -> list[bytes]:
        """Stop it; the payloads that it has recorded, in order."""
        self.process.send_signal(signal.SIGINT)
        _, said = self.process.communicate(timeout=DEADLINE_S)
        assert self.process.returncode == 0, said
        with LogReader(self.log) as reader:
            return [event.payload for event in reader.read()]


@pytest.fixture
def record(tmp_path: Path, endpoint: str) -> Iterator[Callable[[dict[str, str]], Recording]]:
    started: list[Recording] = []

    def start(env: dict[str, str]) -> Recording:
        started.append(Recording(tmp_path / "log", endpoint, env))
        return started[-1]

    yield start
    for each in started:
        if each.process.poll() is None:
            each.process.kill()
            each.process.communicate()


PLAIN = """
import json, sys, threading, time, zenoh
from importlib.metadata import version
print(version("eclipse-zenoh"), flush=True)

def opened(endpoint):
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)
"""

PUBLISH = """
import hashlib
payloads = sys.stdin.buffer.read().splitlines()
wanted = {hashlib.sha256(each).hexdigest() for each in payloads}
named, all_named = [], threading.Event()

def on_ack(sample):
    named.extend(json.loads(sample.payload.to_bytes())["sha256"])
    if wanted <= set(named):
        all_named.set()

with opened(sys.argv[1]) as session:
    acks = session.declare_subscriber("mapfold/ack/*", on_ack)
    publisher = session.declare_publisher(
        "tb/detections", congestion_control=zenoh.CongestionControl.BLOCK
    )
    end = time.monotonic() + 30
    while not publisher.matching_status.matching:
        assert time.monotonic() < end, "no recorder"
    for each in payloads:
        publisher.put(each)
    assert all_named.wait(30), f"{len(set(named) & wanted)} of {len(wanted)} acknowledged"
print(json.dumps(sorted(set(named))))
"""

ASK = """
asked = sys.stdin.buffer.read()
with opened(sys.argv[1]) as session:
    places = "mapfold/state/places?x=0;y=0"
    for selector, payload in (("mapfold/relocalize", asked), (places, None)):
        (reply,) = session.get(selector, payload=payload, timeout=30.0)
        if reply.ok is None:
            sys.exit(reply.err.payload.to_string())
        print(reply.ok.payload.to_string())
    (reply,) = session.get("mapfold/relocalize", payload=b"no question", timeout=30.0)
    print(reply.err.payload.to_string())
"""

ROBOT = """
import sys
from importlib.metadata import version
from pathlib import Path
from eventsrc.record.robot.publisher import EnvelopePublisher
from eventsrc.record.transport.session import ZenohOptions

endpoint, spool = sys.argv[1:]
with EnvelopePublisher(ZenohOptions(connect=(endpoint,)), Path(spool)) as publisher:
    for each in sys.stdin.buffer.read().splitlines():
        publisher.publish(each)
    print(version("eclipse-zenoh"), publisher.flush(30.0), publisher.unacknowledged)
"""


def drive() -> list[bytes]:
    """Payloads of a drive, one of them larger than Zenoh sends in one piece."""
    documents = walk(COUNT, detections=4)
    documents[5]["note"] = "x" * 100_000
    return [payload(document) for document in documents]


def robot(endpoint: str, spool: Path, env: dict[str, str], payloads: list[bytes]) -> str:
    """What mapfold's publisher says at its end: its version of Zenoh, whether all are acknowledged,
    how many are not."""
    done = subprocess.run(
        [sys.executable, "-c", ROBOT, endpoint, spool],
        input=b"\n".join(payloads), env=env, capture_output=True, timeout=2 * DEADLINE_S,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr.decode()
    return done.stdout.decode().strip()


OURS = clean() | {"PYTHONPATH": str(ROOT)}


def test_a_plain_publisher_of_another_version_is_recorded_and_acknowledged(
    other: Other, endpoint: str, record: Callable[[dict[str, str]], Recording]
) -> None:
    recording, payloads = record(OURS), drive()
    said = other.plain(PUBLISH, endpoint, stdin=b"\n".join(payloads))
    assert recording.finish() == payloads
    assert json.loads(said) == sorted(hashlib.sha256(each).hexdigest() for each in payloads)


@pytest.mark.parametrize("which", ["robot", "recorder", "both"])
def test_mapfold_on_another_version_publishes_records_and_acknowledges(
    which: str,
    other: Other,
    endpoint: str,
    record: Callable[[dict[str, str]], Recording],
    tmp_path: Path,
) -> None:
    recording = record(other.env if which != "robot" else OURS)
    payloads = drive()
    of_robot = other.env if which != "recorder" else OURS
    said = robot(endpoint, tmp_path / "spool", of_robot, payloads)
    used = OUR_VERSION if which == "recorder" else other.version
    assert said == f"{used} True 0"
    assert recording.finish() == payloads


def test_mapfold_on_another_version_counts_what_is_lost(
    other: Other, endpoint: str, record: Callable[[dict[str, str]], Recording], tmp_path: Path
) -> None:
    """Keyframes that are missing are told by their numbers, whatever the version."""
    recording = record(other.env)
    documents = walk(10)
    kept = [payload(each) for each in documents[:4] + documents[6:]]
    assert robot(endpoint, tmp_path / "spool", OURS, kept).endswith("True 0")
    recording.process.send_signal(signal.SIGINT)
    _, said = recording.process.communicate(timeout=DEADLINE_S)
    assert recording.process.returncode == 3, said
    assert "8 recorded, 0 rejected, 0 lost, 2 keyframes missing" in said


@pytest.fixture(scope="module")
def answering(
    tmp_path_factory: pytest.TempPathFactory, module_database: Targets
) -> Iterator[Answerer]:
    log = write_log(tmp_path_factory.mktemp("map") / "log", walk(60, seed=3))
    rebuild(log, module_database, Settings())
    with Pools(module_database, 2) as pools:
        yield Answerer(pools, per_second=10_000.0)


def test_a_plain_client_of_another_version_asks_the_service(
    other: Other, endpoint: str, connected: Callable[[], Session], answering: Answerer
) -> None:
    asked = next(d for d in walk(30, seed=9, run_id="run-b") if d["detections"])
    with (
        FairQueue(2, max_wait_s=DEADLINE_S) as queue,
        ZenohService(connected(), answering, queue),
        open_session(ZenohOptions(connect=(endpoint,)), mode="client") as ours,
    ):
        said = other.plain(ASK, endpoint, stdin=payload(asked))
        (reply,) = ours.raw.get("mapfold/relocalize", payload=payload(asked), timeout=DEADLINE_S)
    answer, places, error = map(json.loads, said.splitlines())
    assert answer == json.loads(reply.ok.payload.to_string())
    assert answer["places"]
    assert places["places"]
    assert "no question" not in error
    assert error["error"]


OWN_MESSAGE = """
config = zenoh.Config()
config.insert_json5("listen/endpoints", '["tcp/127.0.0.1:0"]')
config.insert_json5("scouting/multicast/enabled", "false")
seen, came = [], threading.Event()

def note(sample):
    seen.append(sample.source_info is None)
    came.set()

with zenoh.open(config) as session:
    subscriber = session.declare_subscriber("a/b", note)
    session.put("a/b", b"x")
    assert came.wait(30)
print(seen[0])
"""


def test_the_version_before_the_lowest_lacks_what_recording_needs(tmp_path: Path) -> None:
    """`sequence_number` in record/transport/declarations.py tells messages without a number by
    their source_info, None since 1.7; before, mapfold's recorder and publisher fail at each."""
    major, minor, _ = lowest().split(".")
    before = Other(tmp_path / "before", f"{major}.{int(minor) - 1}.1")
    assert before.plain(OWN_MESSAGE).strip() == "False"
    assert Other(tmp_path / "lowest", lowest()).plain(OWN_MESSAGE).strip() == "True"
