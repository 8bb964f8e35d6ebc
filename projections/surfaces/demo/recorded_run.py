"""The demo's folder, and run A recorded into it: one process publishes, another records, over a
router in this process.

Meanwhile a tail in a thread of this process writes the log into the databases. `Children` are
mapfold commands as child processes, which end with the demo, even when it is killed. On a busy
machine a fixed deadline would end work that proceeds: waiting ends when nothing has changed for
`STALLED_S`.

The folder is emptied at the start, if a demo made it, which a file named ``MARKER`` says. The
database server's files in it are kept, because making them takes longest and a replay replaces what
is in them. A running demo holds a lock on ``MARKER``: a second one would remove its log.
"""

import contextlib
import fcntl
import shutil
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Hashable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final, Self

from eventsrc.adapters.sim import House, SimulatedRun, occupancy_map
from eventsrc.base.errors import MapfoldError, MisuseError
from eventsrc.base.text import advised
from eventsrc.envelope.commands import UseSettings, encode_command
from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.envelope.system_events import COMMAND_KEY, MAP_KEY
from eventsrc.log import LogReader, LogWriter
from eventsrc.record.log_info import log_info
from eventsrc.record.transport.session import Router, ZenohOptions
from projections.fold.presets import PRESETS
from projections.fold.settings import Settings
from projections.postgres import rebuild, tail
from projections.postgres.connection import Targets

SETTINGS: Final = Settings().with_assignments([*PRESETS["full"], "camera.hfov_deg=69.4"])
"""Rooms, objects by evidence, and the camera of the simulated robot."""
MARKER: Final = ".mapfold-demo"
STALLED_S: Final = 180.0
_END_S: Final = 10.0
_POLL_S: Final = 0.05
_ANY_PORT: Final = ZenohOptions(listen=("tcp/127.0.0.1:0",))
_WAIT_S: Final = 600
"""Seconds that the publisher waits for the recorder, which is running already."""
_GENERATED: Final = ("map.png", "question-*.json", "record.txt", "simulate.txt")


@contextlib.contextmanager
def fresh_folder(path: Path) -> Iterator[Path]:
    """An empty demo folder at ``path``, locked until the end.

    Raises MisuseError when something else is there, or another demo is at work in it.
    """
    with contextlib.ExitStack() as held:
        try:
            if path.exists() and not (path / MARKER).exists() and any(path.iterdir()):
                raise MisuseError(
                    f"{path}: not empty and not made by the demo; choose another --out or remove it"
                )
            path.mkdir(parents=True, exist_ok=True)
            mark = held.enter_context((path / MARKER).open("a"))
            fcntl.flock(mark, fcntl.LOCK_EX | fcntl.LOCK_NB)
            mark.truncate(0)
            mark.write("made by mapfold demo; the next one removes it\n")
            mark.flush()
            if (path / "log").exists():
                shutil.rmtree(path / "log")
            for pattern in _GENERATED:
                for old in path.glob(pattern):
                    old.unlink()
        except BlockingIOError:
            raise MisuseError(
                f"{path}: another demo is at work there; wait for it or choose another --out"
            ) from None
        except OSError as error:
            raise MisuseError(f"{path}: {error.strerror}; choose another --out") from None
        yield path


def begin_log(writer: LogWriter, house: House, logged_ns: int | None = None) -> None:
    """Begin a log with the settings, as ``mapfold edit LOG use-settings`` records them,
    and the walls, as ``mapfold import --map`` does."""
    command = UseSettings(
        command_id="settings",
        issued_by="demo@mapfold",
        reason="places are rooms; the robot's camera",
        settings=SETTINGS.model_dump(mode="json"),
    )
    writer.append(COMMAND_KEY, encode_command(command), logged_ns=logged_ns)
    writer.append(MAP_KEY, occupancy_map(house).encode(), logged_ns=logged_ns)


class Children:
    """Child processes that end with the ``with`` block: terminated, after 10 s killed."""

    def __init__(self) -> None:
        self._all: dict[str, tuple[subprocess.Popen[bytes], Path]] = {}

    def start(self, name: str, arguments: Sequence[str], stderr: Path) -> None:
        """Start ``mapfold *arguments``; its stderr goes to the file ``stderr``."""
        program = [sys.executable, "-m", "projections.surfaces.cli", "--ends-with-stdin"]
        with stderr.open("wb") as errors:
            child = subprocess.Popen(  # noqa: S603  # our own program and arguments
                [*program, *arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=errors,
            )
        self._all[name] = child, stderr

    def wait(
        self,
        done: Callable[[], bool],
        observe: Callable[[], Hashable] = lambda: None,
        stalled_s: float = STALLED_S,
        at_last: str = "",
    ) -> None:
        """Wait until ``done``. Raises MapfoldError if a child fails, or if for ``stalled_s`` s
        no child ends or writes to stderr and ``observe`` returns the same; it names the children
        that run, or ``at_last``."""
        pause, seen, since = threading.Event(), None, time.monotonic()
        while not done():
            self._check()
            each = ((p.poll(), err.stat().st_size) for p, err in self._all.values())
            now = observe(), tuple(each)
            if now != seen:
                seen, since = now, time.monotonic()
            elif time.monotonic() - since > stalled_s:
                names = self.running
                file = names and self._all[names[-1]][1]
                who = f"mapfold {' and '.join(names)}; see {file}" if names else at_last
                raise MapfoldError(f"no progress for {stalled_s:g} s by {who}")
            pause.wait(_POLL_S)
        self._check()

    def wait_for_output(self, name: str, text: str, stalled_s: float = STALLED_S) -> None:
        """Wait until ``name`` has written ``text`` to stderr; raises as `wait` does."""
        _, file = self._all[name]
        self.wait(lambda: text in file.read_text("utf-8", "replace"), stalled_s=stalled_s)

    @property
    def running(self) -> list[str]:
        """The names of the children that have not ended."""
        return [name for name, (process, _) in self._all.items() if process.poll() is None]

    def _check(self) -> None:
        for name, (process, stderr) in self._all.items():
            if code := process.poll():
                lines = stderr.read_text("utf-8", "replace").strip().splitlines()
                last_line = lines[-1] if lines else "no output"
                raise MapfoldError(f"mapfold {name} ended with exit {code}: {last_line}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        processes = [process for process, _ in self._all.values()]
        for process in processes:
            process.terminate()  # does nothing to one that has ended
        for process in processes:
            try:
                process.wait(_END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            if process.stdin is not None:
                process.stdin.close()  # not before: the end of its stdin is another SIGTERM


def record_run(
    run: SimulatedRun, speed: float, folder: Path, targets: Targets
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Publish run A, record it into ``folder/log``, a new log, and tail it into the databases,
    which begin empty. Returns the numbers of ``record`` and ``tail`` of the report."""
    started, log, count = time.monotonic(), folder / "log", len(run.envelopes)
    with LogWriter(log) as writer:
        begin_log(writer, run.house)
        end = writer.next_offset + count
    rebuild(log, targets, SETTINGS, until=FIRST_OFFSET)
    commits: list[tuple[Offset, int]] = []
    """The number of events in the databases after each commit, and its time in ns."""
    stop = threading.Event()

    def at_end() -> bool:
        return bool(commits) and commits[-1][0] >= end

    with (
        Router(_ANY_PORT) as router,
        Children() as children,
        ThreadPoolExecutor(1, thread_name_prefix="tail") as pool,
    ):
        connect = ("--connect", router.endpoints[0])
        recorder = ("record", str(log), *connect, "--max-events", str(count))
        children.start("record", recorder, folder / "record.txt")
        children.wait_for_output("record", "recording")
        robot = ("simulate", "--seed", str(run.house.seed), "--run", "a", *connect)
        paced = ("--speed", str(speed), "--wait", str(_WAIT_S))
        try:  # the tail ends however this does, also by a signal while it is started
            tailing = pool.submit(
                tail,
                log,
                targets,
                SETTINGS,
                stop=stop,
                on_batch=lambda report: commits.append((report.next_offset, time.time_ns())),
            )
            children.start("simulate", (*robot, *paced), folder / "simulate.txt")
            children.wait(
                lambda: tailing.done() or (not children.running and at_end()),
                observe=lambda: len(commits),
                at_last=f"the databases; run `{advised('status', log)}`",
            )
        finally:
            stop.set()
        report = tailing.result()  # raises the tail's error
    seconds, info = time.monotonic() - started, log_info(log)
    payloads, delays, reached = [], [], iter(commits)
    until, committed_ns = next(reached)
    with LogReader(log) as reader:
        for event in reader.read():
            while until <= event.offset:
                until, committed_ns = next(reached)
            if event.is_envelope:
                payloads.append(event.payload)
                delays.append((committed_ns - event.logged_ns) / 1e9)
    recorded = {
        "run_id": run.run_id,
        "published": count,
        "recorded": len(payloads),
        "intact": payloads == list(run.payloads),
        "rejected": info.rejected,
        "lost": info.lost,
        "drive_seconds": run.true_poses[-1].time_s,
        "log_bytes": info.size_bytes,
        "seconds": seconds,
    }
    return recorded, {
        "events": len(delays),
        "batches": report.batches,
        "median_delay_s": statistics.median(delays),
        "worst_delay_s": max(delays),
    }
