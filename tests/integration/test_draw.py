"""`mapfold draw` on a log of a simulated run."""

import os
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from eventsrc.log import LogWriter
from eventsrc.record.append import append_payload
from tests.support.commands import Commands, Said
from tests.support.envelopes import envelope
from tests.support.logs import simulated, write_log
from tests.support.thorough import mostly_slow


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("logs") / "drive"
    with LogWriter(path) as writer:
        for payload in list(simulated(7, "b").payloads)[:120]:
            append_payload(writer, "tb/detections", payload)
    return path


def _draw(*arguments: str) -> Said:
    return Commands(Path.cwd(), os.environ)("draw", *arguments, code=None)


@pytest.mark.slow
def test_a_picture_of_any_point_with_other_settings(log: Path, tmp_path: Path) -> None:
    whole, part = tmp_path / "whole.svg", tmp_path / "part.svg"
    done = _draw(str(log), "--house", "7", "--merges", "--out", str(whole))
    assert (done.code, done.out) == (0, "")
    assert f"wrote {whole}" in done.err
    arguments = ("--at", "40", "--set", "eps_m=0.75", "--set", "min_samples=8")
    assert _draw(str(log), *arguments, "--out", str(part)).code == 0
    assert "drive after 120 events" in whole.read_text("utf-8")
    assert "ε 1.5 m, min_samples 3" in whole.read_text("utf-8")
    assert "drive after 40 events" in part.read_text("utf-8")
    assert "ε 0.75 m, min_samples 8" in part.read_text("utf-8")


@pytest.mark.slow
def test_a_picture_by_evidence_shows_where_objects_stand(log: Path, tmp_path: Path) -> None:
    out = tmp_path / "map.svg"
    arguments = ("--at", "90", "--set", "fusion=evidence", "--house", "7")
    assert _draw(str(log), *arguments, "--out", str(out)).code == 0
    text = out.read_text("utf-8")
    assert "drawn where it stands, with the ellipse of two standard errors" in text
    assert "drawn where the robot saw it from" not in text


@pytest.mark.slow
def test_the_title_of_the_log_one_is_in(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``.`` has no name of its own."""
    monkeypatch.chdir(log)
    assert _draw(".", "--at", "1", "--out", str(tmp_path / "here.svg")).code == 0
    assert "drive after 1 event" in (tmp_path / "here.svg").read_text("utf-8")


@pytest.mark.parametrize(
    ("arguments", "says"),
    mostly_slow(
        [
            (("--out", "map.bmp"), "a picture is .png, .svg or .pdf"),
            (("--set", "epsilon=1"), "no setting 'epsilon'"),
            (("--at", "nowhere"), "nowhere"),
        ]
    ),
)
def test_misuse_is_one_line_and_exit_2(log: Path, arguments: tuple[str, ...], says: str) -> None:
    done = _draw(str(log), *arguments)
    assert done.code == 2
    assert says in done.err
    assert "Traceback" not in done.err


@pytest.mark.seconds
@pytest.mark.parametrize("kind", ["svg", "pdf"])
def test_names_that_a_format_cannot_hold_are_drawn(tmp_path: Path, kind: str) -> None:
    frames = [envelope(k, 0.1 * k) for k in range(4)]
    log, out = write_log(tmp_path / "log\ufeff\ufffe", frames), tmp_path / f"map.{kind}"
    done = _draw(str(log), "--out", str(out))
    assert done.code == 0, done.err
    if kind == "svg":
        assert "log\ufffd\ufffd" in "".join(ET.parse(out).getroot().itertext())
