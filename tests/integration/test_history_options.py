"""The kept history as a person meets it: options, notes, and what `log info` says."""

from pathlib import Path

import pytest

from projections.store.timeline_cache import MIN_EVENTS
from tests.support.commands import Commands
from tests.support.envelopes import envelope
from tests.support.thorough import rounds
from tests.support.walks import write_log

ASKED = (["merges"], ["state"], ["why", "run-a_p0"], ["diff", "10"], ["bisect", "place_count > 1"])


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Long enough for its history to be kept."""
    folder = tmp_path_factory.mktemp("long")
    drive = [envelope(n, 0.9 * (n * 7 % 31), 0.0) for n in range(MIN_EVENTS + 10)]
    return write_log(folder / "log", drive)


@pytest.mark.seconds
def test_every_command_answers_the_same_with_and_without_it(log: Path) -> None:
    run = Commands.in_folder(log.parent)
    kept = log.with_name("log.history")

    def answers(*options: str, count: int = rounds(len(ASKED), 2)) -> list[str]:
        asked = ASKED[:count]
        return [run(*each[:1], log, *each[1:], *options, "--json").out for each in asked]

    plain = answers("--no-cache")
    assert not kept.exists()
    assert answers() == plain
    assert sorted(path.suffix for path in kept.iterdir()) == [".digest", ".fold", ".npz"]
    (part,) = kept.glob("*.npz")
    made = part.stat().st_ino
    assert answers(count=1) == plain[:1]
    assert part.stat().st_ino == made, "it was made once"

    size = sum(path.stat().st_size for path in kept.iterdir())
    told = run("log", "info", log)
    assert f"cache     log.history: {size:,} bytes, safe to delete\n" in told.out
    assert run("log", "info", log, "--json").json["caches"]["log.history"] == size

    part.write_bytes(b"garbage")
    said = run("merges", log, "--json")
    assert said.out == plain[0]
    assert f"{part} is not used: " in said.err
    assert run("merges", log, "--json").err == "", "said once, and made again"


def test_state_without_its_digest(log: Path) -> None:
    run = Commands.in_folder(log.parent)
    whole, short = (run("state", log, "--at", "50", *more) for more in ([], ["--no-digest"]))
    lines = whole.out.splitlines()
    assert short.out.splitlines() == [line for line in lines if not line.startswith("digest")]
    assert len(short.out.splitlines()) == len(lines) - 1
    assert run("state", log, "--at", "50", "--no-digest", "--json").json["digest"] is None
    said = run("state", log, "--digest", "--no-digest", code=2)
    assert "--digest and --no-digest exclude each other" in said.err
