"""Questions to `mapfold serve`, and how they are asked over Zenoh and HTTP."""

import json
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from eventsrc.record.transport.session import Session
from projections.surfaces.serve import Answerer, FairQueue
from projections.surfaces.serve.guard import Guard
from projections.surfaces.serve.http import create_app
from projections.surfaces.serve.listening import bind, serving
from tests.support.envelopes import detection
from tests.support.logs import WEIRD, walk

DEADLINE_S = 30.0
OTHER_SPACE = json.dumps([detection("x", [1.0, 2.0])]).encode()


@contextmanager
def http_at(answerer: Answerer, queue: FairQueue, port: int = 0) -> Iterator[int]:
    """Serve over HTTP in a ``with`` block; yields the port."""
    app = Guard(create_app(answerer, queue))
    with serving(app, bind("127.0.0.1", port)) as bound:
        yield bound


def question(number: int = 0) -> bytes:
    """A keyframe of another run as a question."""
    documents = [d for d in walk(30, seed=9, run_id="run-b") if d["detections"]]
    return json.dumps(documents[number % len(documents)]).encode()


def tracked_question(number: int, moved: tuple[float, float, float], name: str) -> bytes:
    """A question of the session ``name``, after driving ``moved``."""
    crops = json.loads(question(number))["detections"]
    dx, dy, dyaw = moved
    asked = {"dx": dx, "dy": dy, "dyaw": dyaw, "crops": crops, "session": name}
    return json.dumps(asked).encode()


def _forms() -> dict[str, bytes]:
    first, second = (json.loads(question(n))["detections"] for n in (0, 1))
    moved = {"dx": 0.5, "dy": 0.0, "dyaw": 0.25, "crops": second}
    text = {"embedding": first[0]["embedding"], "text": True}
    forms: dict[str, Any] = {
        "views": {"views": [{"crops": first}, moved], "camera": CAMERA},
        "classes": {"crops": [{"class": WEIRD[0]}, {"class": WEIRD[1]}]},
        "both": [*first, {"class": WEIRD[2]}],
        "text": [text],
    }
    return {name: json.dumps(form).encode() for name, form in forms.items()}


CAMERA = {"hfov_deg": 90.0, "width_px": 640.0, "height_px": 480.0}
FORMS = _forms()


def ask(session: Session, selector: str, payload: bytes | None = None) -> tuple[bool, Any]:
    ((good, answer),) = session.get_replies(selector, payload, timeout_s=DEADLINE_S)
    return good, json.loads(answer)


def fetch(url: str, data: bytes | None = None) -> tuple[int, Any]:
    """Status and JSON body of one request; POST when there is data."""
    try:
        with urllib.request.urlopen(url, data, timeout=DEADLINE_S) as answer:
            return answer.status, json.loads(answer.read())
    except urllib.error.HTTPError as error:
        with error:
            return error.code, json.loads(error.read())
