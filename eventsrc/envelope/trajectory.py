"""Trajectory files: corrected poses of a run, by keyframe id or by stamp.

    TUM         stamp x y z qx qy qz qw      a line each; # begins a comment
    CSV         with a header that names its columns
    JSON lines  an object a line

CSV and JSON lines name ``keyframe_id`` or ``stamp`` (or ``timestamp``), then ``x``, ``y`` and
``yaw`` (or ``map_x``, ``map_y``, ``map_yaw``), or instead of yaw the quaternion ``qx``, ``qy``,
``qz``, ``qw``. Metres, radians and seconds; poses of the robot in the map frame, whose z axis is
up. Other columns are ignored. The format follows from the first line, or from the file's suffix
where that line fits several.
"""

import csv
import math
from collections.abc import Callable, Iterator, Mapping
from itertools import chain, pairwise
from pathlib import Path
from typing import BinaryIO, Final, Literal, NamedTuple, TypeAlias

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import visible
from eventsrc.base.user_files import FileFault, open_file, parse_json

from .model import MAX_POSITION_M, MAX_TIMESTAMP_S

MAX_LINE: Final = 4_096
"""Bound of a line's length in characters."""
MAX_POSES: Final = 1_000_000
MAX_SHOWN: Final = 60
_QUATERNION: Final = ("qx", "qy", "qz", "qw")
_NORM_SLACK: Final = 0.1
_KEYFRAMES: Final = ("keyframe_id",)
_STAMPS: Final = ("stamp", "timestamp")
_XS, _YS, _YAWS = ("x", "map_x"), ("y", "map_y"), ("yaw", "map_yaw")

Key: TypeAlias = Literal["keyframe", "stamp"]
Format: TypeAlias = Literal["TUM", "CSV", "JSON lines"]
_SUFFIXES: Final[Mapping[str, Format]] = {
    ".tum": "TUM",
    ".csv": "CSV",
    ".jsonl": "JSON lines",
    ".ndjson": "JSON lines",
    ".json": "JSON lines",
}


class TrajectoryPose(NamedTuple):
    """A pose at a key, which is a keyframe id or a stamp in seconds; metres and radians."""

    key: float
    x: float
    y: float
    yaw: float
    line: int


class Trajectory(NamedTuple):
    """The poses of a file, in ascending order of their keys, each key once.

    ``is_open`` if the last line has no end, so that its last number may be cut.
    """

    name: str
    by: Key
    poses: list[TrajectoryPose]
    is_open: bool = False


class _Line(NamedTuple):
    by: Key
    key: float
    x: float
    y: float
    yaw: float


class TrajectoryError(MisuseError):
    """A file that is no trajectory; the message names the file and the line."""


class _LineError(ValueError):
    """A line that is no pose; the message says why."""


def read_trajectory(path: Path) -> Trajectory:
    """The trajectory in a file. Raises TrajectoryError."""
    name = visible(str(path))
    try:
        with open_file(path) as file:
            return _read(name, path.suffix.lower(), file)
    except FileFault as fault:
        raise TrajectoryError(f"{name}: {fault}; give a trajectory file") from None
    except OSError as error:
        raise TrajectoryError(f"{name}: {error.strerror}; give a trajectory file") from None


def _read(name: str, suffix: str, file: BinaryIO) -> Trajectory:
    lines = _Lines(name, file)
    first = next(lines, None)
    if first is None:
        raise TrajectoryError(f"{name}: no pose in it; {_formats()}")
    kind = _format_of(first[1], suffix)
    if kind is None:
        raise TrajectoryError(
            f"{name}, line {first[0]}: {_shown(first[1])} begins no trajectory; {_formats()}"
        )
    parsed = list(_parsed(name, kind, first, lines))
    if not parsed:
        raise TrajectoryError(f"{name}: no pose in it; {_formats()}")
    poses = sorted(pose for _, pose in parsed)
    by = parsed[0][0]
    for one, other in pairwise(poses):
        if one.key == other.key:
            raise TrajectoryError(
                f"{name}, line {other.line}: {by} {one.key!r} is on line {one.line} too; "
                "keep one of them"
            )
    return Trajectory(name, by, poses, lines.is_open and kind != "JSON lines")


def _parsed(
    name: str, kind: Format, first: tuple[int, str], lines: Iterator[tuple[int, str]]
) -> Iterator[tuple[Key, TrajectoryPose]]:
    number = first[0]
    count = 0
    key: Key | None = None
    try:
        parse = {"TUM": _parse_tum, "JSON lines": _parse_json}.get(kind) or _csv_parser(first[1])
        for number, text in lines if kind == "CSV" else chain([first], lines):
            line = parse(text)
            key = _same_key(key, line.by)
            count = _counted(count)
            yield line.by, TrajectoryPose(line.key, line.x, line.y, line.yaw, number)
    except _LineError as error:
        raise TrajectoryError(f"{name}, line {number}: {error}") from None


def _same_key(before: Key | None, found: Key) -> Key:
    if before not in (None, found):
        raise _LineError(f"a {found} here and a {before} before; use one of them")
    return found


def _counted(count: int) -> int:
    if count == MAX_POSES:
        raise _LineError(f"more than {MAX_POSES:,} poses; split the file")
    return count + 1


class _Lines(Iterator[tuple[int, str]]):
    """Yields number, from 1, and text of each line that is neither empty nor a comment."""

    def __init__(self, name: str, file: BinaryIO) -> None:
        self._name, self._file = name, file
        self._number = 0
        self.is_open = False
        """Whether the last line has no end."""

    def __next__(self) -> tuple[int, str]:
        while raw := self._file.readline(MAX_LINE + 1):
            self._number += 1
            self.is_open = not raw.endswith(b"\n")
            text = self._decoded(raw).strip()
            if text and not text.startswith("#"):
                return self._number, text
        raise StopIteration

    def _decoded(self, raw: bytes) -> str:
        place = f"{self._name}, line {self._number}"
        if len(raw) > MAX_LINE:
            raise TrajectoryError(f"{place}: longer than {MAX_LINE:,} characters; {_formats()}")
        try:
            return raw.decode("utf-8-sig" if self._number == 1 else "utf-8")
        except UnicodeDecodeError:
            raise TrajectoryError(f"{place}: no UTF-8 text; {_formats()}") from None


def _format_of(text: str, suffix: str) -> Format | None:
    if text.startswith("{"):
        return "JSON lines"
    if "," in text and any(c.isalpha() for c in text):
        return "CSV"
    if "," not in text and _is_number(text.split()[0]):
        return "TUM"
    return _SUFFIXES.get(suffix)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _formats() -> str:
    return (
        "a trajectory is TUM (stamp x y z qx qy qz qw), CSV with a header such as "
        "keyframe_id,x,y,yaw, or JSON lines with these names"
    )


def _parse_tum(text: str) -> _Line:
    words = text.split()
    if len(words) != 8:
        raise _LineError(
            f"{len(words)} numbers instead of 8 (stamp x y z qx qy qz qw): {_shown(text)}"
        )
    names = ("stamp", "x", "y", "z", *_QUATERNION)
    values = {name: _number(name, word) for name, word in zip(names, words, strict=True)}
    return _Line("stamp", _stamped(values["stamp"]), *_pose(values))


def _stamped(stamp: float) -> float:
    if not 0.0 <= stamp <= MAX_TIMESTAMP_S:
        hint = "; it looks like nanoseconds" if stamp > MAX_TIMESTAMP_S else ""
        raise _LineError(f"stamp {stamp:.15g}: not seconds from 0 to {MAX_TIMESTAMP_S:.0f}{hint}")
    return stamp


def _csv_parser(header: str) -> Callable[[str], _Line]:
    names = [name.strip().lower() for name in _cells(header)]
    if len(set(names)) < len(names):
        raise _LineError(f"a column stands twice: {_shown(header)}")
    _check_names(names)

    def parse(text: str) -> _Line:
        cells = _cells(text)
        if len(cells) != len(names):
            raise _LineError(
                f"{len(cells)} columns instead of the {len(names)} of the header: {_shown(text)}"
            )
        return _record(dict(zip(names, cells, strict=True)))

    return parse


def _cells(text: str) -> list[str]:
    try:
        return next(csv.reader([text], strict=True))
    except csv.Error as error:
        raise _LineError(f"no CSV: {error}: {_shown(text)}") from None


def _parse_json(text: str) -> _Line:
    try:
        record = parse_json(text)
    except FileFault as fault:
        raise _LineError(f"no JSON: {fault}: {_shown(text)}") from None
    if not isinstance(record, dict):
        raise _LineError(f"no JSON object: {_shown(text)}")
    _check_names(list(record))
    return _record(record)


def _check_names(names: list[str]) -> None:
    there = set(names)
    if not there & {*_KEYFRAMES, *_STAMPS}:
        raise _LineError(f"neither keyframe_id nor stamp among {_shown(', '.join(names))}")
    for options in (_XS, _YS):
        if not there & set(options):
            raise _LineError(f"no {options[0]} among {_shown(', '.join(names))}")
    if not there & set(_YAWS) and not there.issuperset(_QUATERNION):
        raise _LineError(f"neither yaw nor qx, qy, qz, qw among {_shown(', '.join(names))}")


def _record(record: Mapping[str, object]) -> _Line:
    values: dict[str, float] = {}
    for name, options in (("x", _XS), ("y", _YS), ("yaw", _YAWS)):
        given = _first(record, options)
        if given is not None:
            values[name] = _number(given, record[given])
    if "yaw" not in values:
        values |= {name: _number(name, record.get(name)) for name in _QUATERNION}
    if _first(record, _KEYFRAMES) is not None:
        return _Line("keyframe", _keyframe_id(record["keyframe_id"]), *_pose(values))
    stamp = _first(record, _STAMPS) or "stamp"
    return _Line("stamp", _stamped(_number(stamp, record.get(stamp))), *_pose(values))


def _first(record: Mapping[str, object], options: tuple[str, ...]) -> str | None:
    return next((name for name in options if record.get(name) not in (None, "")), None)


def _keyframe_id(value: object) -> int:
    number = _converted(int, value) if isinstance(value, int | str) else None
    if number is None or isinstance(value, bool):
        raise _LineError(f"keyframe_id is no whole number: {_shown(repr(value))}")
    if not -(2**63) <= number < 2**63:
        raise _LineError(f"keyframe_id {_shown(str(number))} has more than 64 bits")
    return int(number)


def _number(name: str, value: object) -> float:
    number = _converted(float, value) if isinstance(value, int | float | str) else None
    if number is None or isinstance(value, bool):
        raise _LineError(f"{name} is no number: {_shown(repr(value))}")
    if not math.isfinite(number):
        raise _LineError(f"{name} is {number}")
    return number


def _converted(kind: type[int] | type[float], value: float | str) -> float | None:
    if isinstance(value, str) and ("_" in value or not value.strip().isascii()):
        return None  # Python reads 1_000 and other scripts' digits, other programs do not
    try:
        return kind(value)
    except (ValueError, OverflowError):
        return None


def _pose(values: Mapping[str, float]) -> tuple[float, float, float]:
    for name in ("x", "y"):
        if name not in values:
            raise _LineError(f"{name} is empty")
        if abs(values[name]) > MAX_POSITION_M:
            raise _LineError(f"{name} is {values[name]:.15g}, beyond ±{MAX_POSITION_M:,.0f} m")
    if "yaw" in values:
        return values["x"], values["y"], values["yaw"]
    qx, qy, qz, qw = (values[name] for name in _QUATERNION)
    norm = math.sqrt(math.fsum((qx * qx, qy * qy, qz * qz, qw * qw)))
    if not abs(norm - 1.0) <= _NORM_SLACK:
        raise _LineError(f"the quaternion has length {norm:.3g} instead of 1")
    qx, qy, qz, qw = (q / norm for q in (qx, qy, qz, qw))
    yaw = math.atan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))
    return values["x"], values["y"], yaw


def _shown(text: str) -> str:
    cut = text if len(text) <= MAX_SHOWN else f"{text[: MAX_SHOWN - 1]}…"
    return visible(cut)
