"""Options and input that the commands which ask about crops share."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from projections.errors import QuestionError
from projections.relocalize import Camera, Crop, parse_question

QuestionArgument = Annotated[
    str,
    typer.Argument(
        metavar="QUERY",
        help="JSON file with the crops: an envelope, a list of detections, or an object with"
        " crops; - reads stdin.",
    ),
]
HfovOption = Annotated[
    float, typer.Option("--hfov", help="Horizontal field of view of the robot's camera, degrees.")
]
ImageOption = Annotated[
    str, typer.Option("--image", metavar="WxH", help="Size of the camera's pictures in pixels.")
]
_MAX_BYTES = 16 * 1024 * 1024


def question_from(query: str) -> tuple[Crop, ...]:
    """The crops of a file or of stdin. Raises QuestionError that names the file."""
    try:
        payload = sys.stdin.buffer.read(_MAX_BYTES + 1) if query == "-" else _read(Path(query))
    except OSError as error:
        raise QuestionError(f"{query}: {error.strerror}; give a JSON file, or -") from None
    if len(payload) > _MAX_BYTES:
        raise QuestionError(f"{query}: more than {_MAX_BYTES} bytes; send fewer crops")
    try:
        return parse_question(payload)
    except QuestionError as error:
        raise QuestionError(f"{query}: {error}") from None


def _read(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(_MAX_BYTES + 1)


def camera_from(hfov: float, image: str) -> Camera:
    """The camera the options describe. Raises a misuse error for sizes that are none."""
    width, _, height = image.lower().partition("x")
    try:
        return Camera(float(width), float(height), hfov)
    except ValueError:
        raise QuestionError(f"--image {image}: write it as 640x400, in pixels") from None
