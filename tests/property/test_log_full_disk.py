"""A full disk at any step of recording, sealing, restart and recovery: what was recorded is there,
and with free space everything goes on."""

import contextlib
import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from eventsrc.base.errors import MapfoldError
from eventsrc.envelope.system_events import LOSS_KEY
from eventsrc.log import ALWAYS, LogWriter, recover_log, verify_log
from tests.support.fixtures_log import KEY, envelope, read_log
from tests.support.thorough import stride

CALLS = ("open", "write", "fdatasync", "fsync", "pwrite", "ftruncate", "rename", "replace", "link")
EVENTS = 12


class FullDisk:
    """From the call ``at`` on, counted from 1, every call that may need space fails; with ``once``
    only that one. None fails if ``at`` is None."""

    def __init__(self, patch: pytest.MonkeyPatch, at: int | None, *, once: bool) -> None:
        self.calls = 0
        self._at, self._once = at, once
        for name in CALLS:
            if hasattr(os, name):
                patch.setattr(os, name, self._failing(name, getattr(os, name)))

    def _failing(self, name: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **options: Any) -> Any:
            if name == "open" and not args[1] & os.O_CREAT:
                return real(*args, **options)
            self.calls += 1
            at = self.calls + 1 if self._at is None else self._at
            if self.calls == at or (self.calls > at and not self._once):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            return real(*args, **options)

        return call


def killed_log(path: Path) -> None:
    """Sealed segments, a finished one and a growing one."""
    with LogWriter(path, fsync=ALWAYS, rotate_events=3) as writer:
        for number in range(8):
            writer.append(KEY, envelope(number))
    writer = LogWriter(path, fsync=ALWAYS, rotate_events=3)
    writer._sealer.submit = lambda *_, **__: None  # type: ignore[method-assign]
    for number in range(8, EVENTS):
        writer.append(KEY, envelope(number))
    writer._active.close()
    writer._lock.release()


def leave(_: Path) -> None:
    pass


def flip_in_the_second(log: Path) -> None:
    path = sorted(log.glob("*.mcap"))[1]
    data = bytearray(path.read_bytes())
    data[len(data) // 4] ^= 1
    path.write_bytes(data)


def cut_the_last(log: Path) -> None:
    for active in log.glob("*.active"):
        active.unlink()
    path = max(log.glob("*.mcap"))
    os.truncate(path, path.stat().st_size // 4)


def record(log: Path, recorded: dict[int, bytes]) -> None:
    """Note what was recorded, by offset."""
    with LogWriter(log, fsync=ALWAYS, rotate_events=2) as writer:
        for number in range(20, 25):
            recorded[writer.append(KEY, envelope(number))] = envelope(number)


def recover(log: Path, _: dict[int, bytes]) -> None:
    recover_log(log)


CASES = {
    "record": (leave, record, 0),
    "recover": (leave, recover, 0),
    "recover a flipped bit": (flip_in_the_second, recover, 3),
    "recover a cut segment": (cut_the_last, recover, 2),
}


@pytest.mark.parametrize("once", [True, False])
@pytest.mark.parametrize("case", CASES)
def test_a_full_disk_at_any_step(
    quick_path: Path, monkeypatch: pytest.MonkeyPatch, case: str, once: bool
) -> None:
    damage, use, lost = CASES[case]
    whole = quick_path / "whole"
    killed_log(whole)
    damage(whole)

    def after_full_disk(at: int | None) -> int:
        """How many calls there were; the log must be whole when there is space again."""
        log, recorded = quick_path / f"full at {at}", dict[int, bytes]()
        shutil.copytree(whole, log)
        with monkeypatch.context() as patch, contextlib.suppress(MapfoldError):
            disk = FullDisk(patch, at, once=once)
            use(log, recorded)
        if lost:
            recover_log(log)
        with LogWriter(log) as writer:
            writer.append(KEY, envelope(99))
        events = read_log(log)
        assert all(events[offset].payload == payload for offset, payload in recorded.items())
        assert sum(event.key == LOSS_KEY for event in events) == lost
        found = {f.kind for f in verify_log(log).findings} - {"duplicate", "time"}
        assert found == ({"loss"} if lost else set())
        shutil.rmtree(log)
        return disk.calls

    calls = after_full_disk(None)
    assert calls > EVENTS
    for at in range(1, calls + 1, stride(17)):
        after_full_disk(at)
