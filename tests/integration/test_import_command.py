"""`mapfold import` and `mapfold log` as a person runs them."""

import gzip
import json
from datetime import datetime
from pathlib import Path

import pytest

from tests.support.commands import Commands
from tests.support.envelopes import envelope, payload
from tests.support.fixtures_log import flip, read_log

PAYLOADS = [payload(envelope(i)) for i in range(1, 6)]


@pytest.fixture
def run(tmp_path: Path) -> Commands:
    """Commands in an empty folder."""
    return Commands.in_folder(tmp_path)


def payloads_of(run: Commands, log: str) -> list[bytes]:
    return [event.payload for event in read_log(run.folder / log)]


def test_plain_gzip_and_standard_input_give_the_same_log(run: Commands) -> None:
    lines = b"\n".join(PAYLOADS) + b"\r\n\n"
    (run.folder / "plain.jsonl").write_bytes(lines)
    (run.folder / "packed").write_bytes(gzip.compress(lines))
    run("import", "a", "plain.jsonl")
    run("import", "b", "packed")
    run("import", "c", "-", stdin=lines)
    run("import", "d", "-", stdin=gzip.compress(lines))
    for name in "abcd":
        assert payloads_of(run, name) == PAYLOADS


def test_a_folder_without_a_bag_and_without_a_log_is_refused(run: Commands) -> None:
    (run.folder / "pictures").mkdir()
    said = run("import", "a", "pictures", code=2)
    assert said.err == "mapfold: pictures: neither a bag of ROS 2 nor a log; check the path\n"
    assert not (run.folder / "a").exists()


def test_a_log_and_its_segments_import_into_the_same_events(run: Commands) -> None:
    said = run("import", "a", "-", stdin=b"\n".join([*PAYLOADS, b"junk"]), code=3)
    assert said.err.strip().endswith("`mapfold log cat a --key mapfold/rejected` shows them")
    run("import", "b", "a")
    run("import", "c", "a/00000000000000000000.mcap")
    assert read_log(run.folder / "a") == read_log(run.folder / "b") == read_log(run.folder / "c")


def test_import_prints_its_counts(run: Commands) -> None:
    report = run("import", "a", "-", "--json", stdin=b"\n".join([*PAYLOADS, b"junk"]), code=3).json
    assert report == {
        "log": "a",
        "accepted": 5,
        "rejected": 1,
        "system": 0,
        "skipped": 0,
        "maps": 0,
        "passed_over": [],
        "verbatim": 0,
        "repeated": 0,
        "first_offset": 0,
        "next_offset": 6,
        "recovered_segments": 0,
        "recovered_events": 0,
        "torn_bytes": 0,
        "torn_events": 0,
    }


def test_options_for_bags_without_a_bag_are_said_to_be_unused(run: Commands) -> None:
    lines = b"\n".join(PAYLOADS)
    said = run("import", "log", "-", "--detections", "/d", stdin=lines).err.splitlines()
    assert said[0].startswith("no bag of ROS 2 among the files: --detections and the other options")
    assert said[-1].startswith("imported ")


def test_what_the_log_has_already_is_passed_over(run: Commands) -> None:
    first, other = b"\n".join(PAYLOADS), payload(envelope(77))
    assert "imported 5 envelopes into a, offsets" in run("import", "a", "-", stdin=first).err
    before = read_log(run.folder / "a")
    said = run("import", "a", "-", "--key", "other/key", stdin=first).err
    assert "imported 0 envelopes into a, 5 messages passed over, 0 rejected" in said
    assert "passed over: other/key: 5 messages, in the log already" in said
    assert "nothing is new: the first recording of a keyframe counts, so only other" in said
    assert read_log(run.folder / "a") == before
    said = run("import", "a", "-", "--json", stdin=b"\n".join([*PAYLOADS[:2], other, other]))
    # of one source all is kept: it may have recorded a keyframe twice
    assert (said.json["accepted"], said.json["repeated"], said.json["skipped"]) == (2, 1, 2)
    assert "(1 new, 1 of keyframes that it has already)" in said.err
    assert "nothing is new" not in said.err


def test_other_bytes_of_a_known_keyframe_are_kept_as_a_conflict(run: Commands) -> None:
    run("import", "a", "-", stdin=b"\n".join(PAYLOADS))
    changed = payload(envelope(1, map_x=77.0))
    assert changed != PAYLOADS[0]
    said = run("import", "a", "-", stdin=b"\n".join([changed, *PAYLOADS[1:]])).err
    assert "imported 1 envelope into a (0 new, 1 of keyframes that it has already)" in said
    assert run("state", "a", "--json").json["counts"]["conflicts"] == 1


def test_an_interrupted_import_can_be_run_again(run: Commands) -> None:
    run("import", "whole", "-", stdin=b"\n".join(PAYLOADS))
    run("import", "parts", "-", stdin=b"\n".join(PAYLOADS[:3]))
    run("import", "parts", "-", stdin=b"\n".join(PAYLOADS))
    assert read_log(run.folder / "parts") == read_log(run.folder / "whole")


def test_rejections_are_appended_again_and_nothing_in_a_file_is_said(run: Commands) -> None:
    for events in (1, 2):
        assert run("import", "a", "-", "--json", stdin=b"junk", code=3).json["next_offset"] == (
            events
        )
    said = run("import", "a", "-", stdin=b"\n").err
    assert said.endswith("what was given has no messages\n")


def test_classes_that_are_all_numbers_are_said_to_have_no_names(run: Commands) -> None:
    def lines(first: int, *classes: str) -> bytes:
        each = [
            envelope(k, detections=[{"class": name, "confidence": 0.9, "bbox": [0, 0, 9, 9]}])
            for k, name in enumerate(classes, first)
        ]
        return b"\n".join(map(payload, each))

    line = "all classes are numbers: `mapfold edit a relabel --labels FILE` names them"
    said = run("import", "a", "-", stdin=lines(1, "17", "3"))
    assert line in said.err.splitlines()
    assert line in run("state", "a").err.splitlines()
    assert line in run("import", "a", "-", "--json", stdin=lines(3, "5")).err
    assert "all classes" not in run("import", "b", "-", stdin=lines(1, "17", "cup")).err
    run("edit", "a", "relabel", "17=chair")
    assert "all classes" not in run("import", "a", "-", stdin=lines(4, "17")).err
    assert "all classes" not in run("state", "a").err
    assert "all classes" not in run("import", "copy", "a").err, "it has the names"
    assert "all classes" not in run("import", "none", "-", stdin=payload(envelope(1))).err


def test_a_damaged_log_grows_without_that_count(run: Commands) -> None:
    run("import", "a", "-", stdin=b"\n".join(PAYLOADS))
    flip(run.folder / "a" / "00000000000000000000.mcap", 500)
    said = run("import", "a", "-", "--json", stdin=PAYLOADS[0])
    assert (said.json["accepted"], said.json["repeated"]) == (1, None)
    assert "keyframes that the log has already are not counted" in said.err


def test_torn_gzip_keeps_what_came_before(run: Commands) -> None:
    whole = gzip.compress(b"\n".join(PAYLOADS * 2000) + b"\n")
    (run.folder / "torn.gz").write_bytes(whole[: len(whole) // 2])
    said = run("import", "a", "torn.gz", code=1)
    assert "torn.gz" in said.err
    assert 0 < len(payloads_of(run, "a")) < 10_000


def test_no_log_is_created_when_a_file_is_missing(run: Commands) -> None:
    run("import", "a", "missing.jsonl", code=2)
    assert not (run.folder / "a").exists()


def test_an_unreadable_file_is_one_line(run: Commands) -> None:
    said = run("import", "L2", "x" * 300, code=2)
    assert said.err.endswith("File name too long; check the path\n")
    assert said.err.count("\n") == 1
    assert not (run.folder / "L2").exists()


def test_info_and_cat(run: Commands) -> None:
    run("import", "a", "-", "--key", "k", stdin=b"\n".join(PAYLOADS))
    info = run("log", "info", "a", "--json").json
    logged = datetime.fromisoformat(info["first_logged"])
    assert logged.timestamp() == pytest.approx(info["first_logged_ns"] / 1e9, abs=1e-6)
    assert (info["events"], info["keys"], info["rejected"]) == (5, {"k": 5}, 0)
    assert "k: 5" in run("log", "info", "a").out
    shown = run("log", "cat", "a", "--json", "--from", "run-a:2", "--to", "run-a:3").lines
    assert [(e["offset"], e["payload"]) for e in shown] == [
        (1, json.loads(PAYLOADS[1])),
        (2, json.loads(PAYLOADS[2])),
    ]
    times = {"logged_ns", "logged", "stamp_ns", "stamp"}
    assert set(shown[0]) == {"offset", "key", "payload"} | times
    assert len(run("log", "cat", "a", "--from", "3").out.splitlines()) == 2
    assert run("log", "cat", "a", "--key", "absent").out == ""
    assert "after" in run("log", "cat", "a", "--from", "3", "--to", "1", code=2).err
