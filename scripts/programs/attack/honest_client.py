"""Honest questions to the service, one after the other, with the time each answer took."""

import json
import threading
import time
import urllib.request
from types import TracebackType
from typing import Any, Self

from scripts.programs.attack.tally import Tally
from tests.support.logs import walk

PAUSE_S = 0.1
PATIENCE_S = 30.0


def question() -> bytes:
    """What a lost robot asks of the map of `tests.support.logs.walk`."""
    document = next(d for d in walk(30, seed=9, run_id="run-b") if d["detections"])
    return json.dumps(document).encode()


def ask(url: str, payload: bytes | None) -> Any:
    """The answer as JSON. Raises OSError for every refusal."""
    with urllib.request.urlopen(url, payload, timeout=PATIENCE_S) as answer:
        return json.loads(answer.read())


class HonestClient:
    """Asks from a thread while the block runs; every answer must be that of the first question."""

    def __init__(self, url: str, tally: Tally) -> None:
        self._url, self._tally = f"{url}/relocalize", tally
        self._expected = ask(self._url, question())
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._ask)

    def _ask(self) -> None:
        while not self._stop.wait(PAUSE_S):
            begun = time.monotonic()
            try:
                answer = ask(self._url, question())
            except OSError as error:
                self._tally.complaints.append(f"an honest question was not answered: {error}")
                continue
            self._tally.answered(time.monotonic() - begun)
            if answer != self._expected:
                self._tally.complaints.append("an honest question got another answer than before")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()
