"""Hostile names and keys, printed by every command that prints what a log holds."""

import json
from pathlib import Path

import pytest

from eventsrc.log import LogWriter
from eventsrc.record.append import append_payload
from tests.support.commands import Commands, Said
from tests.support.envelopes import detection, envelope, payload
from tests.unit.test_text_escaping import control_characters

CONTROL = "\x1b]0;owned\x07\x9b2J\n       9  forged line"
BIDI = "\u202e\u2066[red][link=file:///etc/passwd]\u2028"
"""What an id may hold: no control characters, but these."""
RUN = f"run{BIDI}"
KEY = f"k/{CONTROL}{BIDI}"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Commands:
    """Commands in a folder with a log L."""
    folder = tmp_path_factory.mktemp("hostile")
    with LogWriter(folder / "L") as writer:
        for k, x in enumerate([0.0, 0.1, 0.2, 4.0, 4.1, 4.2, 1.4, 2.8]):
            seen = [detection(f"cup{BIDI}", [1.0, 2.0], det_id=f"d{k}{BIDI}")]
            append_payload(writer, KEY, payload(envelope(k, x, run_id=RUN, detections=seen)))
        append_payload(writer, KEY, payload({**envelope(9), CONTROL: float("nan")}))
        append_payload(writer, KEY, CONTROL.encode())
        writer.append("mapfold/loss", payload({"publisher": CONTROL, "count": 1, "cause": "rot"}))
        append_payload(writer, f"other/{CONTROL}", payload(envelope(10, run_id="b")))
    return Commands.in_folder(folder)


def check(said: Said) -> Said:
    assert control_characters(said.out + said.err) <= {"\n"}
    assert not any(line.startswith("       9  forged") for line in said.out.splitlines())
    assert "Traceback" not in said.err
    return said


@pytest.mark.parametrize(
    "command",
    [
        "log info L",
        "log cat L",
        "log verify L",
        "state L",
        "merges L",
        "merges L --show 1",
        "diff L 0 end",
        "whatif L --set eps_m=1.0",
        "bisect L place_count>=1",
        "evaluate --map L --query L",
        "find L --all",
        "room L p0",
        "path L 0,0 p0",
        "changes L",
    ],
)
def test_a_command_prints_nothing_that_a_terminal_obeys(run: Commands, command: str) -> None:
    check(run(*command.split(), code=None))


@pytest.mark.parametrize(
    "command", ["log info L --json", "state L --json", "merges L --json", "log verify L --json"]
)
def test_json_is_exact(run: Commands, command: str) -> None:
    text = check(run(*command.split(), code=None)).out
    assert json.loads(text) is not None


def test_the_names_themselves_are_in_the_json(run: Commands) -> None:
    assert KEY in run("log", "info", "L", "--json").json["keys"]
    events = check(run("log", "cat", "L", "--json")).lines
    assert events[0]["key"] == KEY
    assert events[0]["payload"]["run_id"] == RUN
    assert run("state", "L", "--json").json["keyframes"][0]["run_id"] == RUN


def test_the_story_of_a_place(run: Commands) -> None:
    place = run("state", "L", "--json").json["places"][0]["place_id"]
    check(run("why", "L", place))
    check(run("why", "L", f"no such place {BIDI}", code=None))


def test_a_recorder_and_an_import_say_nothing_else_either(run: Commands, tmp_path: Path) -> None:
    lines = [payload({**envelope(1), CONTROL + BIDI: float("inf")}), CONTROL.encode(), b"{}"]
    name = tmp_path / "[red][link=x]\x1b]0;x\x07.jsonl"
    name.write_bytes(b"\n".join(lines))
    said = check(run("import", "M", name, code=3))
    assert "holds NaN or infinity" in said.err
    check(run("log", "cat", "M", "--key", f"no{CONTROL}", code=None))
    check(run("import", "M", "L", code=None))
    check(run("log", "info", f"N{CONTROL}", code=None))
