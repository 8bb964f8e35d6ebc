"""A log's segments by the readers of npm's `@mcap/core`, which other viewers are built on."""

import base64
import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from eventsrc.log import LogReader
from tests.support.commands import Commands
from tests.support.logs import walk, write_log
from tests.support.maps import write_map_yaml

SAMPLE = Path(__file__).resolve().parents[2] / "logs" / "sample"
PACKAGES = ("@mcap/core@2.2.2", "@mcap/nodejs@1.0.2", "@mcap/support@1.1.0")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not shutil.which("npm"), reason="npm is not installed"),
]


@pytest.fixture(scope="module")
def node(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the script and the packages that it imports."""
    folder = tmp_path_factory.mktemp("node")
    (folder / "package.json").write_text('{"private": true, "type": "module"}')
    shutil.copy(Path(__file__).with_name("read.mjs"), folder)
    command = ["npm", "install", "--silent", "--no-audit", "--no-fund", *PACKAGES]
    subprocess.run(command, cwd=folder, check=True, timeout=240)
    return folder


def read(node: Path, segment: Path) -> Any:
    done = subprocess.run(
        ["node", "read.mjs", segment.resolve()], cwd=node, capture_output=True, check=False
    )
    assert done.returncode == 0, done.stderr.decode()
    return json.loads(done.stdout)


def events_of(log: Path) -> list[tuple[str, int, str, bytes]]:
    with LogReader(log) as reader:
        return [(e.key, e.offset, str(e.logged_ns), e.payload) for e in reader.read()]


def test_the_sample_is_read_message_by_message(node: Path) -> None:
    (segment,) = SAMPLE.glob("*.mcap")
    found = [(t, n, at, base64.b64decode(p)) for t, n, at, p in read(node, segment)["messages"]]
    assert found == events_of(SAMPLE)


def test_segments_with_every_kind_of_event(node: Path, tmp_path: Path) -> None:
    mapfold = Commands.in_folder(tmp_path)
    log = write_log(tmp_path / "log", walk(30))
    walls = write_map_yaml(tmp_path, "### #.# ###")
    mapfold("import", log, "--map", walls, "-", stdin=b'{"not": "an envelope"}\n', code=None)
    mapfold("edit", log, "forget-run", "run-a", "--reason", "a test")
    mapfold("import", log, "-", stdin=b"", code=None)
    mapfold("log", "recover", log, code=None)
    found = []
    for segment in sorted(log.glob("*.mcap")):
        document = read(node, segment)
        first = int(segment.stem)
        found += [(t, first + n, at, base64.b64decode(p)) for t, n, at, p in document["messages"]]
        for name, encoding, text in document["schemas"]:
            assert (bool(name), encoding) == (True, "jsonschema")
            assert "$ref" not in text
            assert "anyOf" not in text
    assert found == events_of(log)
    assert len({topic for topic, *_ in found}) >= 3
