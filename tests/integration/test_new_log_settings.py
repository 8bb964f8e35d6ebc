"""A log's settings, said once: the first event of a new log, from every kind of input."""

import itertools
import shutil
import signal
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from eventsrc.envelope.commands import UseSettings, parse_command
from eventsrc.envelope.system_events import COMMAND_KEY, MAP_KEY
from eventsrc.log import LogReader, LogWriter
from eventsrc.log.durable_files import ALWAYS
from projections.fold.settings import Settings
from projections.map.parsing import read_corrections
from projections.surfaces.cli.new_log import LogStart, NewLogOptions
from tests.support.commands import PROGRAM, Commands
from tests.support.envelopes import detection, envelope, payload
from tests.support.fixtures_log import KEY, read_log
from tests.support.fixtures_zenoh import DEADLINE_S, Program
from tests.support.logs import write_log
from tests.support.power_loss import Tracer, power_cuts
from tests.support.ros_bags import Drive, write_bag
from tests.support.thorough import mostly_slow, stride

LINES = b"\n".join(payload(envelope(k)) for k in range(1, 6))
CLASSIC, ROOMS = Settings(), Settings(places="rooms")
FULL = Settings(places="rooms", fusion="evidence")


@pytest.fixture
def run(tmp_path: Path) -> Commands:
    """Commands in a folder with JSON lines and a bag of ROS 2."""
    (tmp_path / "run.jsonl").write_bytes(LINES)
    write_bag(tmp_path / "bag", Drive(3).messages())
    return Commands.in_folder(tmp_path)


def said_by(log: Path) -> Settings | None:
    """The settings of a log; checks that they are its first event and said once."""
    with LogReader(log) as reader:
        commands = [(e.offset, parse_command(e.payload)) for e in reader.read(keys={COMMAND_KEY})]
        settings = read_corrections(reader).settings
    assert [(at, command.kind) for at, command in commands] == (
        [] if settings is None else [(0, "use-settings")]
    )
    return settings


UNSTATED = "no camera is stated by the keyframe at offset "


def test_a_camera_that_nothing_states_is_named_once_by_what_records_it(run: Commands) -> None:
    """And by `log info`; neither for a classic log, nor where the settings or envelopes say it."""
    seen = [detection("cup")]
    stated = {"hfov_deg": 60.0, "width_px": 640.0, "height_px": 480.0}
    for name, more in (("silent", {}), ("more", {}), ("stated", {"camera": stated})):
        lines = [envelope(n, run_id=name, detections=seen, **more) for n in (1, 2)]
        (run.folder / name).write_bytes(b"\n".join(map(payload, lines)))
    full = ("--preset", "full")
    for log, source, options, is_named in (
        ("log", "silent", full, True),
        ("log", "more", (), False),
        ("other", "stated", full, False),
        ("classic", "silent", (), False),
        ("said", "silent", (*full, "--set", "camera.hfov_deg=60"), False),
    ):
        assert (UNSTATED in run("import", log, source, *options).err) is is_named
    line = next(e for e in run("log", "info", "log").err.splitlines() if e.startswith(UNSTATED))
    assert line.startswith(f"{UNSTATED}1, so boxes are read as if of 69.4° and 640 × 400 pixels: ")
    assert "; `mapfold calibrate log` says whether the map's revisits can estimate it" in line
    told = line[line.index("`mapfold ") + 1 :].split("`")[0]
    for name, value in (("hfov_deg", "60"), ("width_px", "640"), ("height_px", "480")):
        told = told.replace(f"{name}=…", f"{name}={value}")
    run(*told.split()[1:])
    for command in ("state", "log info"):
        assert UNSTATED not in run(*command.split(), "log").err


@pytest.mark.parametrize(
    ("source", "options", "settings", "told"),
    mostly_slow(
        [
            ("bag", (), FULL, "a new log with --preset full, for input of ROS, said at offset 0"),
            ("run.jsonl", (), None, "a new log of --preset classic; with --preset full places are"),
            (
                "bag",
                ("--set", "eps_m=1"),
                Settings(eps_m=1.0),
                "a new log with --set eps_m=1, said",
            ),
            ("bag", ("--preset", "classic"), CLASSIC, "with --preset classic, said at offset 0"),
            ("run.jsonl", ("--preset", "full"), FULL, "a new log with --preset full, said at"),
            ("run.jsonl", ("--preset", "page"), CLASSIC, "a new log with --preset page, said at"),
        ],
        quick=2,
    ),
)
def test_what_a_new_log_says(
    run: Commands, source: str, options: tuple[str, ...], settings: Settings | None, told: str
) -> None:
    said = run("import", "log", source, *options).err.splitlines()
    (line,) = [each for each in said if each.startswith("log: a new log")]
    assert told in line
    assert said_by(run.folder / "log") == settings
    state = run("state", "log", "--json").json
    assert Settings.model_validate(state["settings"]) == (settings or CLASSIC)
    assert state["counts"]["keyframes"] == (3 if source == "bag" else 5)
    again = run("import", "log", source, *options).err  # the same, or nothing, is fine
    assert "a new log" not in again
    assert said_by(run.folder / "log") == settings


def test_a_bag_among_lines_and_a_file_of_a_bag_make_a_full_log(run: Commands) -> None:
    run("import", "both", "run.jsonl", "bag")
    assert said_by(run.folder / "both") == FULL
    write_bag(run.folder / "lite", Drive(2).messages(), "sqlite")
    (file,) = (run.folder / "lite").glob("*.db3")
    run("import", "file", file)
    assert said_by(run.folder / "file") == FULL


def told(said: str) -> list[str]:
    """The words of the `edit` that a text names."""
    return ["edit", *said.partition("`mapfold edit ")[2].partition("`")[0].split()]


def test_the_advised_command_changes_a_classic_log(run: Commands) -> None:
    run(*told(run("import", "log", "run.jsonl").err))
    assert run("state", "log", "--json").json["settings"]["fusion"] == "evidence"
    write_log(run.folder / "old", [envelope(1)])
    said = run("import", "old", "bag").err
    assert "old: a log of --preset classic; with --preset full places are rooms" in said
    assert said_by(run.folder / "old") is None
    assert told(said) == ["edit", "old", "use-settings", "--preset", "full", "--reason", "WHY"]


def test_other_settings_than_a_log_has_are_refused_with_the_edit_that_changes_them(
    run: Commands,
) -> None:
    run("import", "log", "bag")
    before = read_log(run.folder / "log")
    for options, differing in (
        (("--preset", "rooms"), "fusion=evidence, not page"),
        (("--set", "eps_m=1"), "eps_m=1.5, not 1.0"),
        (("--preset", "full", "--set", "rooms.cell_m=0.5"), "rooms.cell_m=0.75, not 0.5"),
    ):
        words = f"mapfold edit log use-settings {' '.join(options)} --reason WHY"
        said = run("import", "log", "run.jsonl", *options, code=2).err
        assert said == (
            f"mapfold: log has {differing}; a log's settings are said when it is made. To change"
            f" them: `{words}`\n"
        )
        assert said == run("record", "log", *options, "--listen", "tcp/127.0.0.1:0", code=2).err
    assert read_log(run.folder / "log") == before
    run("edit", "log", "use-settings", "--preset", "rooms", "--reason", "WHY")
    run("import", "log", "run.jsonl", "--preset", "rooms")
    write_log(run.folder / "old", [envelope(1)])
    assert "old has fusion=page, not evidence, places=page, not rooms" in (
        run("import", "old", "run.jsonl", "--preset", "full", code=2).err
    )


def test_wrong_settings_make_no_log(run: Commands) -> None:
    for options, told in (
        (("--preset", "house"), "--preset: no preset 'house'; there are classic, rooms, full"),
        (("--set", "eps_m=wide"), "--set eps_m=wide: input should be a valid number"),
    ):
        for words in (("import", "log", "run.jsonl"), ("record", "log")):
            assert told in run(*words, *options, code=2).err
        assert told in run("simulate", "--out", "s.jsonl", *options, code=2).err
    assert not (run.folder / "log").exists()
    assert not (run.folder / "s.jsonl").exists()


def test_an_empty_log_is_new(run: Commands) -> None:
    LogWriter(run.folder / "log").close()
    run("import", "log", "-", "--preset", "rooms", stdin=b"")
    assert said_by(run.folder / "log") == ROOMS


def test_a_map_comes_after_the_settings_and_times_do_not_go_back(run: Commands) -> None:
    (run.folder / "map.pgm").write_bytes(b"P5 2 2 255\n" + bytes([0, 254, 205, 254]))
    (run.folder / "map.yaml").write_text(
        "{image: map.pgm, resolution: 0.5, origin: [0, 0, 0], negate: 0, occupied_thresh: 0.65,"
        " free_thresh: 0.2}"
    )
    run("import", "log", "--map", "map.yaml", "run.jsonl", "--preset", "rooms")
    events = read_log(run.folder / "log")
    assert [event.key for event in events[:3]] == [COMMAND_KEY, MAP_KEY, KEY]
    assert len({event.logged_ns for event in events[:3]}) == 1
    assert "all good" in run("log", "verify", "log").err


def test_a_copy_of_a_log_begins_as_that_one(run: Commands) -> None:
    run("import", "a", "bag")
    run("import", "b", "bag", "--run-id", "other")
    run("import", "both", "a", "b")
    assert said_by(run.folder / "both") == FULL
    dump = run("log", "cat", "b", "--json").out.encode()
    said = run("import", "cat", "-", stdin=dump).err
    assert "cat: a new log with the settings that its source begins with" in said
    assert said_by(run.folder / "cat") == FULL
    said = run("import", "told", "b", "--preset", "rooms").err
    assert "other settings than were chosen for the new log" in said
    assert said_by(run.folder / "told") == ROOMS


def test_settings_of_a_source_are_compared_by_what_they_mean(run: Commands) -> None:
    run("import", "plain", "run.jsonl")
    run("import", "classic", "bag", "--preset", "classic")
    said = run("import", "plain", "classic").err
    assert "passed over: mapfold/command: 1 message, in the log already" in said
    run("import", "full", "bag", "--run-id", "other")
    said = run("import", "plain", "full", code=3).err
    assert (
        "rejected: the source has fusion=evidence, places=rooms, this log has not; to change it:"
        " `mapfold edit plain use-settings --preset full --reason WHY`" in said
    )
    assert said_by(run.folder / "plain") is None
    run(*told(said))
    again = run("import", "plain", "full").err
    assert "2 messages" not in again
    assert "passed over: mapfold/command: 1 message, in the log already" in again
    run("import", "own", "bag", "--set", "rooms.cell_m=0.5")
    said = run("import", "plain", "own", code=3).err
    assert "the source has fusion=page, places=page, rooms.cell_m=0.5, this log has not" in said
    run(*told(said))
    assert "rejected: " not in run("import", "plain", "own").err
    # written by another version: a default less
    text = run("log", "cat", "full", "--json").out.replace('"min_samples":3,', "", 1)
    assert "passed over: mapfold/command: 1" in (
        run("import", "full", "-", stdin=text.encode()).err
    )


def test_a_source_with_settings_that_no_fold_can_use_does_not_begin_a_log(run: Commands) -> None:
    command = UseSettings(command_id="c", issued_by="b", settings={"eps_m": -1.0})
    line = '{"offset":0,"logged_ns":1,"stamp_ns":1,"key":"mapfold/command","payload":%s}\n'
    text = (line % command.model_dump_json()).encode() + LINES
    said = run("import", "log", "-", stdin=text, code=3).err
    assert "rejected: settings that no map can have: eps_m is -1.0: " in said
    assert said_by(run.folder / "log") is None


def test_a_file_of_a_simulated_run_says_them(run: Commands) -> None:
    run("simulate", "--seed", "3", "--out", "s.jsonl", "--preset", "full")
    run("import", "log", "s.jsonl")
    assert said_by(run.folder / "log") == FULL
    said = run("simulate", "--preset", "full", code=2).err
    assert "--preset goes into a file of --out; where a recorder makes the log" in said


Start = Callable[..., Program]


def test_a_recorder_says_them_before_its_first_message(
    start: Start, publish: Start, endpoint: str, tmp_path: Path
) -> None:
    log = tmp_path / "log"
    for offset in (1, 2):
        words = ("--connect", endpoint, "--preset", "full", "--max-events", "1")
        recorder = start("record", str(log), *words)
        assert f"to {log} from offset {offset}" in recorder.wait_for("recording")
        publish(KEY, payload(envelope(offset, detections=[detection("cup")])).decode())
        assert recorder.wait() == 0
        assert len([each for each in recorder.lines if UNSTATED in each]) == 2 - offset
        told = [line for line in recorder.lines if "a new log" in line]
        assert told == [f"{log}: a new log with --preset full, said at offset 0"][: 2 - offset]
    assert said_by(log) == FULL


def test_a_recorder_of_a_bridge_makes_a_full_log_and_one_of_lines_a_classic_one(
    start: Start, endpoint: str, tmp_path: Path
) -> None:
    for options, settings in (("--ros2dds",), FULL), ((), None):
        log = tmp_path / f"log{len(options)}"
        recorder = start("record", str(log), "--connect", endpoint, *options)
        recorder.wait_for("from offset")
        assert recorder.end(signal.SIGINT) in (0, 3)
        assert said_by(log) == settings


@pytest.fixture
def tracer(tmp_path: Path) -> Iterator[Tracer]:
    with pytest.MonkeyPatch.context() as patch:
        yield Tracer(tmp_path / "log", patch)


def test_a_power_cut_leaves_a_new_log_or_one_that_says_them(
    tracer: Tracer, quick_path: Path
) -> None:
    options = NewLogOptions(preset="full")
    log = tracer.folder
    with LogWriter(log, fsync=ALWAYS) as writer:
        LogStart.of(log, writer, options, is_ros=False).record(writer)
        tracer.promise = writer.durable_offset
        writer.append(KEY, payload(envelope(1)))
        tracer.promise = writer.durable_offset
    said = 0
    cuts = power_cuts(tracer.end(), lambda name: name == "lock")
    for call, promised, files in itertools.islice(cuts, 0, None, stride(20)):
        left = quick_path / "left"
        left.mkdir()
        for name, content in (files or {}).items():
            (left / name).write_bytes(content)
        with LogWriter(left, fsync=ALWAYS) as writer:
            start = LogStart.of(left, writer, options, is_ros=False)
            assert start.is_new is (writer.next_offset == 0), call
            assert not (start.is_new and promised), call
            said += not start.is_new
            if start.is_new:
                start.record(writer)
        assert said_by(left) == FULL, call
        shutil.rmtree(left)
    assert said > 5


def test_a_killed_recorder_has_said_them(start: Start, endpoint: str, tmp_path: Path) -> None:
    log = tmp_path / "log"
    recorder = start("record", str(log), "--connect", endpoint, "--preset", "full")
    recorder.wait_for("a new log")
    recorder.process.kill()
    recorder.process.wait(DEADLINE_S)
    recorder = start("record", str(log), "--connect", endpoint)
    assert "from offset 1" in recorder.wait_for("recording")
    assert recorder.end(signal.SIGINT) == 0
    assert said_by(log) == FULL


@pytest.mark.parametrize("events", mostly_slow([3, 5_000]))
def test_a_killed_import_has_said_them_or_made_a_new_log(run: Commands, events: int) -> None:
    """With three events nothing is synced yet, with 5,000 a first part is."""
    log = run.folder / "log"
    lines = b"\n".join([*(payload(envelope(k)) for k in range(events)), b"junk", b""])
    program = subprocess.Popen(
        [PROGRAM, "import", "log", "-", "--preset", "full"],
        cwd=run.folder,
        env=dict(run.env),
        stdin=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    assert program.stdin is not None
    assert program.stderr is not None
    program.stdin.write(lines)
    program.stdin.flush()
    assert b"rejected" in program.stderr.readline()  # so the lines before it were appended
    program.kill()
    program.communicate(timeout=DEADLINE_S)
    LogWriter(log).close()
    left = read_log(log)
    assert [event.key for event in left[:1]] == ([COMMAND_KEY] if events > 4_096 else [])
    run("import", "log", "-", "--preset", "full", stdin=lines, code=3)
    assert said_by(log) == FULL
