"""Bags of ROS 2 that are cut off, damaged, no bags, or hold what is none of its type."""

import contextlib
import hashlib
import json
import shutil
import sqlite3
from pathlib import Path
from typing import Any

import pytest
import zstandard

from eventsrc.base.errors import MapfoldError, MisuseError
from eventsrc.envelope.system_events import (
    EXCERPT_BYTES,
    MAX_KEPT_BYTES,
    REJECTED_KEY,
    RejectedPayload,
)
from tests.support import ros_messages as ros
from tests.support.commands import MOST_MIB, run_measured
from tests.support.fixtures_log import read_log
from tests.support.ros_bags import DRIVE, RUN, Raw, envelopes, imported, write_bag
from tests.support.ros_messages import SECOND, START, flat

# Hostile bags


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """One drive by storage."""
    folder = tmp_path_factory.mktemp("drives")
    return {
        storage: write_bag(folder / storage / "drive", DRIVE.messages(), storage)
        for storage in ("mcap", "sqlite")
    }


def test_a_bag_cut_off_at_any_place_gives_what_was_before_it(
    drives: dict[str, Path], tmp_path: Path
) -> None:
    (file,) = drives["mcap"].glob("*.mcap")
    whole = file.read_bytes()
    for number, size in enumerate((len(whole) - 1, len(whole) // 2, 300, 40)):
        bag = tmp_path / str(number) / "drive"
        bag.mkdir(parents=True)
        (bag / "drive_0.mcap").write_bytes(whole[:size])
        log = tmp_path / str(number) / "log"
        with pytest.raises(MapfoldError) as damage:
            imported(log, bag)
        found = envelopes(log)
        before = "what was made of the messages before it is in the log"
        assert (before if found else "no message before it could be read") in str(damage.value)
        assert found == [json.loads(e) for e in DRIVE.envelopes(RUN)][: len(found)]
        assert len(found) == DRIVE.pictures or number > 0


def test_a_damaged_database_gives_what_was_before_the_damage(
    drives: dict[str, Path], tmp_path: Path
) -> None:
    (file,) = drives["sqlite"].glob("*.db3")
    whole = file.read_bytes()
    damaged = [
        whole[: len(whole) // 2],
        whole[:100],
        whole[:4096] + b"\xff" * 4096 + whole[8192:],
        whole[: len(whole) // 2] + b"\xff" * (len(whole) // 4) + whole[len(whole) * 3 // 4 :],
    ]
    for number, content in enumerate(damaged):
        bag = tmp_path / str(number) / "drive"
        bag.mkdir(parents=True)
        (bag / "drive_0.db3").write_bytes(content)
        log = tmp_path / str(number) / "log"
        try:
            report = imported(log, bag)
        except MapfoldError as error:
            said = [str(error)]
        else:
            said = report.bags[0].notes
        assert any("drive_0.db3" in each for each in said)


def test_what_is_no_bag_whatever_its_name_is_refused(tmp_path: Path) -> None:
    bag = tmp_path / "drive"
    bag.mkdir()
    (bag / "metadata.yaml").write_text("rosbag2_bagfile_information: {}")
    with pytest.raises(MisuseError, match=r"no \.db3 or \.mcap file"):
        imported(tmp_path / "log", bag)
    with pytest.raises(MisuseError, match="give its folder"):
        imported(tmp_path / "log", bag / "metadata.yaml")
    for content in (b"", b"hello", b"\x28\xb5\x2f\xfdrubbish"):
        (bag / "drive_0.db3").write_bytes(content)
        with pytest.raises(MisuseError, match="neither SQLite nor MCAP"):
            imported(tmp_path / "log", bag)
    (bag / "drive_0.db3").unlink()
    with sqlite3.connect(bag / "drive_0.db3") as other:
        other.execute("CREATE TABLE songs(title TEXT)")
    other.close()
    with pytest.raises(MapfoldError, match=r"drive_0\.db3"):
        imported(tmp_path / "log", bag)


def test_a_database_is_known_by_its_content_whatever_its_path(
    drives: dict[str, Path], tmp_path: Path
) -> None:
    (file,) = drives["sqlite"].glob("*.db3")
    odd = tmp_path / "100%41? #1"
    odd.mkdir()
    for number, name in enumerate(("drive_0.sqlite", "drive_0.db3", "drive")):
        shutil.copy(file, odd / name)
        log = tmp_path / f"log{number}"
        assert imported(log, odd / name).accepted == DRIVE.pictures
        assert envelopes(log)[0]["run_id"] == RUN


def test_messages_that_were_not_written_into_the_database_are_not_passed_over(
    drives: dict[str, Path], tmp_path: Path
) -> None:
    bag = tmp_path / "drive"
    shutil.copytree(drives["sqlite"], bag)
    (bag / "drive.db3-wal").write_bytes(b"x")
    with pytest.raises(MisuseError, match="wal_checkpoint"):
        imported(tmp_path / "log", bag)


def test_a_database_in_the_middle_of_a_transaction_is_not_read(
    drives: dict[str, Path], tmp_path: Path
) -> None:
    bag = tmp_path / "drive"
    shutil.copytree(drives["sqlite"], bag)
    with contextlib.closing(sqlite3.connect(bag / "drive.db3", isolation_level=None)) as recorder:
        recorder.executescript("PRAGMA cache_size = 2; BEGIN EXCLUSIVE")
        recorder.execute("UPDATE messages SET data = zeroblob(9000)")
        with pytest.raises(MisuseError, match="a transaction of the bag's recorder has not ended"):
            imported(tmp_path / "log", bag)
    assert imported(tmp_path / "log", bag).accepted == DRIVE.pictures, "it was taken back"


def test_messages_that_are_none_of_their_type_are_kept_as_rejected(tmp_path: Path) -> None:
    kind = "vision_msgs/msg/Detection2DArray"
    good = ros.TYPES.encode(ros.detections(START, "camera"), kind)
    lying = bytearray(good)
    lying[-4:] = (2**31).to_bytes(4, "little")  # the number of detections
    tf = Raw("tf2_msgs/msg/TFMessage", b"\0\1\0\0\xff\xff\xff\xff")
    far = ros.detections(0, "camera")
    far.header.stamp.sec = -1
    bag = write_bag(
        tmp_path / "drive",
        [
            ("/detections", START, Raw(kind, bytes(lying))),
            ("/detections", START, Raw(kind, b"")),
            ("/detections", START, Raw(kind, b"\0\7\0\0")),
            ("/detections", START, Raw(kind, good[:-3])),
            ("/detections", START, Raw(kind, good)),
            ("/tf", START, tf),
            ("/detections", START, far),
        ],
    )
    report = imported(tmp_path / "log", bag)
    assert (report.accepted, report.rejected) == (1, 6)
    refused = [e for e in read_log(tmp_path / "log") if e.key == "mapfold/rejected"]
    kept = [RejectedPayload.model_validate_json(event.payload) for event in refused]
    assert kept[0].raw == bytes(lying)
    assert "/detections: no vision_msgs/msg/Detection2DArray in CDR" in kept[0].reason


@pytest.mark.seconds
@pytest.mark.slow
def test_of_a_large_message_in_sqlite_an_excerpt_is_kept(
    drives: dict[str, Path], tmp_path: Path
) -> None:
    bag = tmp_path / "drive"
    shutil.copytree(drives["sqlite"], bag)
    size = 100_000_000
    with sqlite3.connect(bag / "drive.db3") as database:
        ((row,),) = database.execute(
            "SELECT min(m.id) FROM messages m JOIN topics t ON t.id = topic_id "
            "WHERE name = '/detections'"
        )
        database.execute("UPDATE messages SET data = zeroblob(?) WHERE id = ?", (size, row))
    database.close()
    log = tmp_path / "log"
    ran = run_measured("import", log, bag)
    assert (ran.code, ran.peak_mib < MOST_MIB / 2) == (3, True), ran
    (refused,) = [e for e in read_log(log) if e.key == "mapfold/rejected"]
    kept = RejectedPayload.model_validate_json(refused.payload)
    assert (kept.size, kept.raw) == (size, bytes(EXCERPT_BYTES))
    assert kept.sha256 == hashlib.sha256(bytes(size)).hexdigest()
    assert len(envelopes(log)) == DRIVE.pictures - 1


def test_a_compressed_message_that_is_too_large_is_kept_compressed(tmp_path: Path) -> None:
    kind = "vision_msgs/msg/Detection2DArray"
    bomb = zstandard.ZstdCompressor().compress(bytes(MAX_KEPT_BYTES + 1))
    sent = [ros.detections(START + each * SECOND, "camera") for each in (0, 1)]
    good = [("/detections", each.header.stamp.sec * SECOND, each) for each in sent]
    for storage in ("sqlite", "mcap"):
        hidden = ("/detections", START, Raw(kind, bomb))
        bag = write_bag(tmp_path / storage / "drive", [good[0], hidden, good[1]], storage)
        report = imported(tmp_path / storage / "log", bag)
        assert (report.accepted, report.rejected) == (2, 1)
        (refused,) = [e for e in read_log(tmp_path / storage / "log") if e.key == REJECTED_KEY]
        kept = RejectedPayload.model_validate_json(refused.payload)
        assert (kept.raw, kept.size) == (bomb, None)
        assert "holds more than 67,108,864 bytes" in kept.reason


@pytest.mark.parametrize("name", ["schema", "message_definitions"])
def test_a_view_whose_rows_have_no_end_is_not_read(
    drives: dict[str, Path], tmp_path: Path, name: str
) -> None:
    bag = tmp_path / "drive"
    shutil.copytree(drives["sqlite"], bag)
    with sqlite3.connect(bag / "drive.db3") as database:
        columns = [row[1] for row in database.execute(f"PRAGMA table_info({name})")]
        database.execute(f"DROP TABLE {name}")
        endless = ", ".join(f"x AS {column}" for column in columns)
        database.execute(
            f"CREATE VIEW {name} AS WITH RECURSIVE n(x) AS (SELECT 4 UNION ALL SELECT x FROM n) "
            f"SELECT {endless} FROM n"
        )
    database.close()
    with pytest.raises(MapfoldError, match=f"{name} is no table"):
        imported(tmp_path / "log", bag)


def test_a_topic_whose_name_is_no_text_is_one_line(drives: dict[str, Path], tmp_path: Path) -> None:
    bag = tmp_path / "drive"
    shutil.copytree(drives["sqlite"], bag)
    with sqlite3.connect(bag / "drive.db3") as database:
        database.execute("UPDATE topics SET name = x'ff' WHERE name = '/tf'")
    database.close()
    with pytest.raises(MapfoldError, match="a topic whose name or type is no text"):
        imported(tmp_path / "log", bag)


def test_a_type_is_read_as_the_bag_defines_it_and_a_broken_definition_is_told(
    drives: dict[str, Path], tmp_path: Path
) -> None:
    (file,) = drives["sqlite"].glob("*.db3")
    bag = tmp_path / "drive"
    bag.mkdir()
    shutil.copy(file, bag / "drive_0.db3")
    with sqlite3.connect(bag / "drive_0.db3") as database:
        database.execute(
            "UPDATE message_definitions SET encoded_message_definition = 'import os; os.abort()' "
            "WHERE topic_type = 'tf2_msgs/msg/TFMessage'"
        )
    database.close()
    report = imported(tmp_path / "log", bag)
    assert (report.accepted, report.rejected) == (DRIVE.pictures, 0)
    assert "definition of tf2_msgs/msg/TFMessage cannot be read" in report.bags[0].notes[0]


@pytest.mark.seconds
def test_very_many_transforms_a_second_are_read_in_bounded_memory(tmp_path: Path) -> None:
    messages: list[tuple[str, int, Any]] = []
    kind = "tf2_msgs/msg/TFMessage"
    for number in range(3_000):
        at = START + number * SECOND // 100_000
        if number < 50 or number % 1_000 == 0:
            links = [ros.transform(f"f{i}", f"f{i + 1}", at, flat(0, 0, 0)) for i in range(20)]
            payload = Raw(kind, ros.TYPES.encode(ros.tf(*links), kind))
        messages.append(("/tf", at, payload))
    messages.insert(1_500, ("/detections", START, ros.detections(START, "f20")))
    report = imported(
        tmp_path / "log",
        write_bag(tmp_path / "drive", messages),
        map_frame="f0",
        base_frame="f19",
    )
    assert report.accepted == 1
    assert report.bags[0].streams["/detections"].without_pose == 0
