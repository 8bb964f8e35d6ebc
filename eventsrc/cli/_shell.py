"""What every command shares: data on stdout, people on stderr, findings as an exit code.

Whatever is printed goes through here, and so through `eventsrc.terminal`: keys, names and reasons
come from the network.
"""

import json
import sys
from collections.abc import Iterable
from typing import Any

import typer
from rich.console import Console

from eventsrc.endpoints import is_loopback
from eventsrc.terminal import visible_json, visible_lines

EXIT_FAILED = 1
EXIT_FINDINGS = 3


people = Console(stderr=True, highlight=False, soft_wrap=True, markup=False)
"""Plain text: ids and reasons may hold anything, so markup is off."""


def say(message: str) -> None:
    """One line for people, or lines that were laid out."""
    people.print(visible_lines(message))


def display(text: str) -> None:
    """Lines on stdout for people; an end is added to the last one if it has none."""
    sys.stdout.write(visible_lines(text))
    if text and not text.endswith("\n"):
        sys.stdout.write("\n")


def say_metrics(address: tuple[str, int], port: int) -> None:
    """Where the numbers of ``--metrics`` are, and who can read them."""
    say(f"metrics on http://{address[0]}:{port}/metrics")
    if not is_loopback(address[0]):
        say(
            f"warning: --metrics {address[0]}:{address[1]}: everybody who can reach it reads these"
            " numbers; keep it in a network of your own"
        )


def emit(document: Any) -> None:
    """One JSON document on stdout."""
    encoder = json.JSONEncoder(ensure_ascii=False, allow_nan=False, indent=2)
    for part in encoder.iterencode(document):
        sys.stdout.write(visible_json(part))
    sys.stdout.write("\n")


def emit_lines(documents: Iterable[Any]) -> None:
    """JSON lines on stdout, each as soon as it is there."""
    for document in documents:
        text = json.dumps(document, ensure_ascii=False, allow_nan=False)
        sys.stdout.write(visible_json(text) + "\n")


def finish(*, findings: bool) -> None:
    """End the command with exit 3 when something was lost or found, else let it return 0."""
    if findings:
        raise typer.Exit(EXIT_FINDINGS)
