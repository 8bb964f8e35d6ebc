"""The process that `prefork` has fork: it imports modules, then forks at each request.

    python -m tests.support.prefork_server FD        FD is a listening socket; ends when stdin does

Each connection is one program. Its one message comes with four file descriptors: a JSON object
(``argv``, ``env``, ``cwd``, and ``entry`` as ``module:function`` or ``code``), stdin, stdout and
stderr. The answers are the process id and, when the program has ended, its exit code.
"""

import atexit
import contextlib
import ctypes
import gc
import importlib
import io
import json
import os
import select
import signal
import socket
import sys
import threading
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pydantic
import typer

from projections.surfaces import cli
from projections.surfaces.cli import COMMANDS, terminal

MODULES = (
    *(f"projections.surfaces.cli.{place.partition(':')[0]}" for place in COMMANDS.values()),
    "apsw",
    "cv2",
    "email.policy",
    "fastapi.responses",
    "matplotlib.figure",
    "matplotlib.patheffects",
    "mcap.reader",
    "mcap.writer",
    "onnxruntime",
    "prometheus_client",
    "projections.adapters.drawing",
    "projections.adapters.export",
    "projections.adapters.scene",
    "rich._emoji_codes",
    "rich.progress",
    "rosbags.rosbag2",
    "rosbags.typesys.stores.ros2_jazzy",
    "typer._adapters",
    "typer._click._textwrap",
    "typer._click.decorators",
    "typer.testing",
    "uvicorn.protocols.http.h11_impl",
)
"""Those of the commands, and what these import when they run."""

HUGE_PAGE = 2 << 20
MADV_COLLAPSE = 25  # linux/mman.h; mmap has no name for it


def _use_huge_pages() -> None:
    """Collapse the process's own memory into huge pages where the kernel can (Linux 6.1).

    That is 70 of 95 MB. A fork then copies 6,500 entries of page tables, not 23,500: with the end
    of the process it takes 5 ms, not 13.
    """
    madvise = ctypes.CDLL(None).madvise
    for line in Path("/proc/self/maps").read_text().splitlines():
        addresses, permissions, _, _, inode, *name = line.split()
        if permissions != "rw-p" or inode != "0" or name not in ([], ["[heap]"]):
            continue
        begin, end = (int(address, 16) for address in addresses.split("-"))
        begin, end = -(-begin // HUGE_PAGE) * HUGE_PAGE, end // HUGE_PAGE * HUGE_PAGE
        if begin < end:
            madvise(ctypes.c_void_p(begin), ctypes.c_size_t(end - begin), MADV_COLLAPSE)


def _make_programs() -> None:
    """Make the program of each command, and that of all, once for all processes that are forked.

    That is half of what a short command costs, and the only thing that a wrong one does.
    """
    make = cli.command_line
    programs = {names: make(names) for names in [(name,) for name in COMMANDS]}
    programs[tuple(COMMANDS)] = make()
    parsers = {program: typer.main.get_command(program) for program in programs.values()}
    for parser in parsers.values():
        _make_ready(parser)

    def made(names: Iterable[str] = COMMANDS) -> typer.Typer:
        return programs.get(tuple(names)) or make(names)

    def parser_of(program: typer.Typer) -> Any:
        return parsers.get(program) or get_command(program)

    get_command = typer.main.get_command
    cli.command_line = made  # type: ignore[assignment]
    typer.main.get_command = parser_of


def _make_ready(parser: Any) -> None:
    """Have all options make what reads their values, which they put off until they are read."""
    for parameter in parser.params:
        parameter.get_runtime_param()
    for command in getattr(parser, "commands", {}).values():
        _make_ready(command)


def _serve(listener: socket.socket) -> Mapping[str, Any]:
    """Fork for each request until stdin ends; a child returns its request from here."""
    running: dict[int, tuple[int, socket.socket]] = {}
    while True:
        ready, _, _ = select.select([sys.stdin.fileno(), listener, *running], [], [])
        for pidfd in ready:
            if pidfd in running:
                pid, answer = running.pop(pidfd)
                os.close(pidfd)
                code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
                with answer, contextlib.suppress(OSError):  # the test may have gone
                    answer.send(str(code).encode())
        if sys.stdin.fileno() in ready:
            sys.exit(0)
        if listener not in ready:
            continue
        answer, _ = listener.accept()
        message, fds, _, _ = socket.recv_fds(answer, 100, 4)
        if not message:
            answer.close()
            continue
        pid = os.fork()
        if pid == 0:
            listener.close()
            answer.close()
            for pidfd, (_, other) in running.items():
                os.close(pidfd)
                other.close()
            with os.fdopen(fds[0], "rb") as file:
                file.seek(0)
                request: Mapping[str, Any] = json.load(file)
            _become(request, fds[1:])
            return request
        for fd in fds:
            os.close(fd)
        answer.send(str(pid).encode())
        running[os.pidfd_open(pid)] = (pid, answer)


def _become(request: Mapping[str, Any], fds: list[int]) -> None:
    """Take on the folder, the environment and the streams of a request."""
    main = sys.modules["__main__"]
    main.__spec__, main.__package__ = None, ""  # so that usage texts name argv[0]
    for number, fd in enumerate(fds):
        os.dup2(fd, number)
    for fd in fds:
        os.close(fd)
    text = {"encoding": sys.stdout.encoding, "errors": sys.stdout.errors}
    through = bool(request["env"].get("PYTHONUNBUFFERED"))
    sys.stdin = os.fdopen(0, closefd=False, **text)
    raw = os.fdopen(1, "wb", 0 if through else -1, closefd=False)
    sys.stdout = io.TextIOWrapper(raw, write_through=through, line_buffering=os.isatty(1), **text)
    sys.stderr = os.fdopen(2, "w", 1, errors="backslashreplace", closefd=False)
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["env"])
    sys.argv = request["argv"]
    terminal.people.__init__()  # a console of rich looks at the environment


def _run(request: Mapping[str, Any]) -> int:
    """The exit code of a program, which may have asked for it or raised anything."""
    try:
        _call(request)
    except SystemExit as error:
        if error.code is None or isinstance(error.code, int):
            return error.code or 0
        print(error.code, file=sys.stderr)
        return 1
    except BaseException as error:  # noqa: BLE001 - as the interpreter does
        sys.excepthook(type(error), error, error.__traceback__)
        if isinstance(error, KeyboardInterrupt):
            signal.signal(signal.SIGINT, signal.SIG_DFL)
            os.kill(os.getpid(), signal.SIGINT)
        return 1
    return 0


def _call(request: Mapping[str, Any]) -> None:
    if "code" in request:
        exec(compile(request["code"], "<string>", "exec"), {"__name__": "__main__"})
        return
    module, function = request["entry"].split(":")
    getattr(importlib.import_module(module), function)()


if __name__ == "__main__":
    gc.disable()  # while modules are imported, of which nothing is freed
    for module in MODULES:
        importlib.import_module(module)
    pydantic.create_model("First")  # has pydantic look for its plugins
    _make_programs()
    gc.collect()
    gc.freeze()
    gc.enable()
    _use_huge_pages()
    with socket.socket(fileno=int(sys.argv[1])) as accepting:
        _request = _serve(accepting)
    _code = _run(_request)
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError as _error:
            os.write(2, f"Exception ignored in: {stream}\nOSError: {_error}\n".encode())
            _code = 120  # as the interpreter says and ends
    # Not the interpreter's way out: freeing every object copies every page that is shared, which
    # takes as long as a short command does.
    os._exit(_code)
