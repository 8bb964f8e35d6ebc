"""Import of MCAP files: JSON channels in file order; other messages are counted."""

from pathlib import Path

import pytest
from mcap.writer import CompressionType, Writer

from tests.support.commands import Commands
from tests.support.envelopes import envelope, payload
from tests.support.fixtures_log import read_log


@pytest.fixture
def run(tmp_path: Path) -> Commands:
    """Commands in an empty folder with a file other.mcap."""
    with (tmp_path / "other.mcap").open("wb") as file:
        writer = Writer(file, compression=CompressionType.LZ4, chunk_size=200)
        writer.start()
        schema = writer.register_schema("x", "jsonschema", b"{}")
        detections = writer.register_channel("tb/detections", "json", schema)
        images = writer.register_channel("camera", "protobuf", 0)
        for number in range(4):
            writer.add_message(detections, 100 - number, payload(envelope(number)), number)
            writer.add_message(images, 100, b"\x00\x01", 1)
        writer.add_message(detections, 50, b"junk", 50)
        writer.finish()
    return Commands.in_folder(tmp_path)


def test_json_channels_are_imported_unchanged(run: Commands) -> None:
    said = run("import", "L", "other.mcap", code=3)
    assert "4 messages passed over, 1 rejected" in said.err
    assert "passed over: camera: 4 messages, protobuf\n" in said.err
    events = read_log(run.folder / "L")
    assert [e.payload for e in events[:4]] == [payload(envelope(n)) for n in range(4)]
    assert [e.logged_ns for e in events] == [100, 99, 98, 97, 50]
    assert events[0].stamp_ns == 1774357200 * 10**9, "the envelope's own time, not the file's"


def test_a_torn_file_gives_the_messages_before_the_damage(run: Commands) -> None:
    file = run.folder / "other.mcap"
    file.write_bytes(file.read_bytes()[:900])
    said = run("import", "L", "other.mcap", code=1)
    assert "torn, damaged or over a limit" in said.err
    assert 0 < len(read_log(run.folder / "L")) < 5
