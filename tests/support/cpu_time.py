"""Processor time of running processes and of the machine, from /proc."""

import os
from pathlib import Path
from typing import NamedTuple

_TICKS = os.sysconf("SC_CLK_TCK")


def cpu_seconds(pid: int) -> float:
    """What a process has used so far with all its threads, those that ended included; 0 where there
    is no /proc."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except FileNotFoundError:
        return 0.0
    fields = stat.rpartition(")")[2].split()  # its name may hold blanks and brackets
    return (int(fields[11]) + int(fields[12])) / _TICKS


def family_cpu_seconds(pid: int) -> float:
    """That of a process and of its children, those that ended and were waited for included."""
    total = 0.0
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except (FileNotFoundError, ProcessLookupError):
            continue  # it has just ended
        if int(stat.parent.name) == pid:
            total += sum(map(int, fields[11:15]))
        elif int(fields[1]) == pid:
            total += sum(map(int, fields[11:13]))
    return total / _TICKS


class UnusedCpu(NamedTuple):
    """Processor time that no program got, in seconds summed over all processors: idle, idle while
    a program waited for the disk, and taken by the host of a virtual machine ("steal")."""

    idle: float
    disk: float
    host: float

    def since(self, before: "UnusedCpu") -> "UnusedCpu":
        """The difference to an earlier reading."""
        return UnusedCpu(*(b - a for a, b in zip(before, self, strict=True)))


def unused_cpu() -> UnusedCpu | None:
    """The machine's unused processor time since its start; None where there is no /proc/stat."""
    try:
        first = Path("/proc/stat").read_text().splitlines()[0]
    except FileNotFoundError:
        return None
    ticks = list(map(int, first.split()[1:]))
    return UnusedCpu(ticks[3] / _TICKS, ticks[4] / _TICKS, ticks[7] / _TICKS)
