"""`mapfold simulate`, a simulated robot and its detector; `mapfold demo`, which maps its run."""

from pathlib import Path
from typing import Annotated, Any, Final

from eventsrc.adapters.sim import DEFAULT_SEED, SimulatedRun, simulate_run
from eventsrc.adapters.sim.simulation import publish_run, write_run
from eventsrc.base.errors import MisuseError
from eventsrc.base.text import counted
from eventsrc.record.transport.config import check_key
from eventsrc.record.transport.session import ZenohOptions, open_session

from .new_log import NewLogOptions
from .options import Databases, JsonOption, PublishKeyOption, ZenohPeer, option
from .signals import stop_on_signals
from .terminal import emit, finish, say

_MAX_NAME: Final = 100


def simulate(
    *,
    seed: Annotated[int, option("N", "Which house.", min=0)] = DEFAULT_SEED,
    run: Annotated[
        str, option("NAME", "Which run: a explores, b, c … are other sessions and tours.")
    ] = "a",
    out: Annotated[
        Path | None,
        option("FILE", "Write FILE.jsonl or .jsonl.gz (and its truth); publish nothing."),
    ] = None,
    key: PublishKeyOption = "tb/detections",
    speed: Annotated[float, option("X", "Times real time; 0: without waiting.", min=0.0)] = 10.0,
    new_log: NewLogOptions,
    wait: Annotated[float, option("SECONDS", "How long to wait for a subscriber.", min=0.0)] = 30.0,
    json_: JsonOption = False,
    peer: ZenohPeer,
) -> None:
    """Simulate a run through a house, over Zenoh or into files.

    A robot drives through a house generated from a seed; its keyframes are published or written to
    a file. The ground truth (room and instance) goes to a file beside --out, never into the
    messages.
    """
    if not run.isprintable() or not 1 <= len(run) <= _MAX_NAME:
        raise MisuseError(f"--run {run!r}: give a name of 1 to {_MAX_NAME} printable characters")
    check_key(key, "--key")
    settings = new_log.for_file(out)
    if settings is not None:  # the same file each time
        settings = settings.model_copy(update={"command_id": f"sim-{seed}-{run}-settings"})
    simulated = simulate_run(seed, run)
    document = _numbers(simulated)
    if out is not None:
        truth = write_run(simulated, out, settings)
        say(f"{_summary(document)}: wrote {out}, truth in {truth}")
        document |= {"out": str(out), "truth": str(truth)}
    else:
        options = peer.zenoh
        document["published"] = _publish(simulated, options, key, speed, wait)
        say(f"{_summary(document)}: published {document['published']} on {key}")
    if json_:
        emit(document)
    finish(findings=document.get("published", document["keyframes"]) < document["keyframes"])


def _publish(
    simulated: SimulatedRun, options: ZenohOptions, key: str, speed: float, wait_s: float
) -> int:
    with stop_on_signals() as stop, open_session(options, mode=options.mode) as session:
        return publish_run(session, simulated, key, speed=speed, wait_s=wait_s, stop=stop)


def _numbers(simulated: SimulatedRun) -> dict[str, Any]:
    return {
        "run_id": simulated.run_id,
        "keyframes": len(simulated.envelopes),
        "detections": sum(len(envelope["detections"]) for envelope in simulated.envelopes),
        "seconds": round(simulated.true_poses[-1].time_s, 1),
    }


def _summary(document: dict[str, Any]) -> str:
    return (
        f"{document['run_id']}: {counted(document['keyframes'], 'keyframe')}, "
        f"{counted(document['detections'], 'detection')} in {document['seconds']} s of driving"
    )


def demo(
    *,
    out: Annotated[Path, option("DIR", "Folder for the log, the databases and map.png.")] = Path(
        "logs/demo"
    ),
    seed: Annotated[int, option("N", "Which simulated house.", min=0)] = DEFAULT_SEED,
    speed: Annotated[float, option("X", "Times real time.", min=1.0, max=1000.0)] = 30.0,
    databases: Databases,
    json_: JsonOption = False,
) -> None:
    """Record, replay, map and re-localise a simulated robot on this machine.

    A robot explores a simulated house and is recorded through a Zenoh router; the log is replayed
    into databases; a second, lost robot asks where it is. The databases are the demo's own, in DIR,
    and yours are not touched; but in those that --db and --vector-db name, the demo's map replaces
    the one that is there.

    Exit 3 when log, databases and fold do not agree.
    """
    # Here and not above: the demo alone needs nearly everything, and that takes a while to import.
    from projections.surfaces.demo.play import run_demo

    numbers = run_demo(out, seed, speed, databases.db, databases.vector_db, say)
    if json_:
        emit(numbers)
    finish(findings=not numbers["sound"])
