"""Occupancy maps: a grid of cells that are free, occupied or unknown, as `mapfold/map` events.

A map is validated when it comes in, kept as an event of the log, and in force for the events after
it. `eventsrc.envelope.grid_messages` makes one from a nav_msgs/OccupancyGrid,
`eventsrc.record.importers.map_yaml` from the map.yaml of a map server.
"""

import hashlib
import json
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
import pybase64
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from .grey_images import BadImage, decode_grey_png, encode_png
from .model import Floor, Position, Text, describe_error

MAX_MAP_CELLS = 16_000_000
"""Bound of the cells of a map: 16 MB in memory, and twice that beside it while it is read."""
MAX_MAP_BYTES = 32 * 1024 * 1024
"""Bound of an event's JSON; noise of ``MAX_MAP_CELLS`` cells takes 22 MB."""
UNKNOWN = 255
OCCUPIED = 100
SCANS = "scans"
"""The source of maps that the fold makes of the robots' own range scans."""
MIN_WALL = 65
"""Percent from which a cell counts as occupied, the default of map servers."""

MAX_MAP_SIDE = 10_000
"""Bound of a map's width and height in cells."""
Resolution = Annotated[float, Field(ge=0.001, le=10.0)]
"""The side of a map's cell in metres."""
MapYaw = Annotated[float, Field(ge=-7.0, le=7.0)]


class OccupancyMapEvent(BaseModel):
    """The content of a ``mapfold/map`` event: an occupancy grid, as nav_msgs/OccupancyGrid has it.

    ``resolution`` is the side of a cell in metres, ``origin`` x, y and yaw of the outer corner of
    the grid's first cell in the map frame. ``png`` is base64 of an 8-bit grey PNG of ``width`` by
    ``height`` cells, its last row the one of the first cell: 0 is free, 100 occupied, between them
    how likely occupied in percent, 255 unknown. ``source`` is the file or key that it came from.
    """

    model_config = ConfigDict(strict=True, frozen=True, extra="ignore", allow_inf_nan=False)

    map_id: Text | None = None
    resolution: Resolution
    origin: tuple[Position, Position, MapYaw]
    width: Annotated[int, Field(ge=1, le=MAX_MAP_SIDE)]
    height: Annotated[int, Field(ge=1, le=MAX_MAP_SIDE)]
    png: str
    source: Text
    floor: Floor = None
    """The floor that it is of; without it the one that the log is of first."""


Cells = NDArray[np.uint8]


class InvalidMap(ValueError):
    """Data that is no occupancy map; the message names the field, its value and the rule."""


@dataclass(frozen=True, eq=False)
class OccupancyMap:
    """An occupancy grid; immutable.

    ``cells`` has shape (height, width), with values as in the event; its first row is at the
    origin, unlike the image's, whose last row is. ``resolution`` is in metres, ``origin`` x, y
    (metres) and yaw (radians). ``floor`` is the name of the floor that it shows; None stands for
    the first floor in the log.
    """

    map_id: str | None
    resolution: float
    origin: tuple[float, float, float]
    source: str
    cells: Cells
    floor: str | None = None

    @property
    def width(self) -> int:
        """Cells in a row."""
        return int(self.cells.shape[1])

    @property
    def height(self) -> int:
        """Rows."""
        return int(self.cells.shape[0])

    def digest(self) -> str:
        """SHA-256 of the cells, resolution and origin, as 64 hex digits; not of id, source and
        floor."""
        return self._digest

    @cached_property
    def _digest(self) -> str:
        head = (self.resolution, *self.origin, self.width, self.height)
        text = ",".join(map(repr, head)).encode()
        return hashlib.sha256(text + b"\n" + self.cells.tobytes()).hexdigest()

    def encode(self) -> bytes:
        """The JSON of the event. Raises InvalidMap for a map that breaks the event's bounds."""
        check_size(self.width, self.height)
        allowed = (self.cells <= OCCUPIED) | (self.cells == UNKNOWN)
        if not allowed.all():
            raise InvalidMap(f"a cell has the value {int(self.cells[~allowed][0])}: {_VALUES}")
        document = {
            **({} if self.map_id is None else {"map_id": self.map_id}),
            **({} if self.floor is None else {"floor": self.floor}),
            "resolution": self.resolution,
            "origin": list(self.origin),
            "width": self.width,
            "height": self.height,
            "png": pybase64.b64encode(encode_png(self.cells[::-1])).decode(),
            "source": self.source,
        }
        try:
            encoded = json.dumps(document, allow_nan=False, separators=(",", ":")).encode()
        except ValueError:
            given = f"got {self.resolution}, {self.origin}"
            raise InvalidMap(f"resolution or origin is NaN or infinite ({given})") from None
        _parse(encoded)
        return encoded


_SMALLER = "make the cells larger or cut the map to what the robot reaches"
_VALUES = "0 is free, 100 occupied, 255 unknown"


def decode_map(payload: bytes) -> OccupancyMap:
    """The map of a ``mapfold/map`` event. Raises InvalidMap."""
    event = _parse(payload)
    try:
        raw = pybase64.b64decode(event.png, None, True)
    except ValueError:
        raise InvalidMap("png: is not base64") from None
    try:
        rows = decode_grey_png(raw, event.width, event.height)
    except BadImage as error:
        raise InvalidMap(f"png: {error}") from None
    cells = rows[::-1]
    if ((cells > OCCUPIED) & (cells != UNKNOWN)).any():
        raise InvalidMap(f"png: it has other values than allowed: {_VALUES}")
    about = event.map_id, event.resolution, event.origin, event.source
    return OccupancyMap(*about, cells, event.floor)


def read_map_head(payload: bytes) -> OccupancyMapEvent:
    """The fields of a ``mapfold/map`` event; its image is not decoded. Raises InvalidMap."""
    return _parse(payload)


def check_size(width: int, height: int) -> None:
    """Raise InvalidMap for a map that is too large."""
    if not (1 <= width <= MAX_MAP_SIDE and 1 <= height <= MAX_MAP_SIDE):
        step = "give one that has cells" if 0 in (width, height) else _SMALLER
        raise InvalidMap(
            f"it has {width:,} × {height:,} cells; a side has 1 to {MAX_MAP_SIDE:,}; {step}"
        )
    if width * height > MAX_MAP_CELLS:
        raise InvalidMap(
            f"it has {width:,} × {height:,} cells, more than {MAX_MAP_CELLS:,}; {_SMALLER}"
        )


def _parse(payload: bytes) -> OccupancyMapEvent:
    if len(payload) > MAX_MAP_BYTES:
        raise InvalidMap(f"it has {len(payload):,} bytes, more than {MAX_MAP_BYTES:,}")
    try:
        event = OccupancyMapEvent.model_validate_json(payload)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=True)[0]
        field = ".".join(map(str, first["loc"])) or "the map"
        raise InvalidMap(f"{field}: {_fault(first)}") from None
    check_size(event.width, event.height)
    return event


def _fault(error: ErrorDetails) -> str:
    text = "required field is missing" if error["type"] == "missing" else describe_error(error)
    given = error["input"]
    return f"{text} (got {given!r})" if isinstance(given, int | float) else text
