"""The clients of docs/clients.md ask a real service, and its tables name what there is."""

import contextlib
import io
import json
import re
import shlex
import shutil
import subprocess
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from eventsrc.record.transport.config import DEFAULT_ENDPOINT
from eventsrc.record.transport.session import Session
from projections.postgres.connection import Targets
from projections.surfaces.serve import Answerer, FairQueue, Pools, ZenohService
from projections.surfaces.serve.guard import Guard
from projections.surfaces.serve.http import create_app
from projections.surfaces.serve.listening import bind, serving
from projections.surfaces.serve.service_metrics import ServiceMetrics
from projections.surfaces.serve.states import DEFAULT_PAGE, MAX_PAGE
from tests.docs.console import ROOT
from tests.support.services import RUN

PAGE = (ROOT / "docs" / "clients.md").read_text("utf-8")
PLACE = f"{RUN}_p0"


@pytest.fixture(scope="module")
def answerer(described_map: Targets) -> Iterator[Answerer]:
    with Pools(described_map, 2) as pools:
        yield Answerer(pools, per_second=10_000.0)


@pytest.fixture(scope="module")
def queue() -> Iterator[FairQueue]:
    with FairQueue(2, max_wait_s=30.0) as queue:
        yield queue


@pytest.fixture(scope="module")
def address(answerer: Answerer, queue: FairQueue) -> Iterator[str]:
    with serving(Guard(create_app(answerer, queue)), bind("127.0.0.1", 0)) as port:
        yield f"127.0.0.1:{port}"


def block(kind: str) -> str:
    (found,) = re.findall(rf"^```{kind}\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    return str(found)


def printed(code: str) -> list[str]:
    """What a Python program prints."""
    with contextlib.redirect_stdout(io.StringIO()) as said:
        exec(compile(code, "docs/clients.md", "exec"), {"__name__": "__main__"})
    return said.getvalue().splitlines()


def test_the_client_over_http(address: str, answerer: Answerer) -> None:
    found, count = printed(block('python title="over_http.py"').replace("127.0.0.1:8080", address))
    assert found.startswith(f"{PLACE} {{'x': ")
    objects = answerer.state("objects", {"limit": "1000"})["objects"]
    assert count == f"{len(objects)} objects"


@pytest.mark.skipif(shutil.which("curl") is None, reason="curl is not installed")
def test_the_commands_of_curl(address: str) -> None:
    answers: list[Any] = []
    for line in block("sh").replace("127.0.0.1:8080", address).splitlines():
        done = subprocess.run(shlex.split(line), capture_output=True, check=True)
        answers.append(json.loads(done.stdout))
    where, near, places, health = answers
    assert where["places"][0]["place_id"] == PLACE
    assert near["objects"][0]["distance_m"] <= 5.0
    assert (places["places"][0]["place_id"], places["next"]) == (PLACE, None)
    assert health == {"status": "ok"}


def test_the_client_over_zenoh(
    answerer: Answerer, queue: FairQueue, connected: Callable[[], Session], endpoint: str
) -> None:
    code = block('python title="over_zenoh.py"')
    assert DEFAULT_ENDPOINT in code
    metrics = ServiceMetrics(answerer, queue)
    with ZenohService(connected(), answerer, queue, metrics.watch):
        assert printed(code.replace(DEFAULT_ENDPOINT, endpoint)) == [PLACE]
        wrong = code.replace('{"class": "toilet"}, ', '{"class": "no such thing"}, ')
        (said,) = printed(wrong.replace(DEFAULT_ENDPOINT, endpoint))
    assert "no object of class 'no such thing'" in said
    counted = metrics.text().decode()
    for result in ("answered", "bad_question"):
        labels = f'question="relocalize",result="{result}",transport="zenoh"'
        assert f"mapfold_serve_questions_total{{{labels}}} 1.0\n" in counted


def test_every_metric_is_on_the_page(answerer: Answerer, queue: FairQueue) -> None:
    text = ServiceMetrics(answerer, queue).text().decode()
    names = set(re.findall(r"^# TYPE (\S+)", text, re.MULTILINE))
    assert set(re.findall(r"`(mapfold_serve_\w+)`", PAGE)) == names


def test_its_limits_are_those_of_the_code() -> None:
    assert f"`limit` is at most {MAX_PAGE:,}, {DEFAULT_PAGE} if not given" in PAGE
