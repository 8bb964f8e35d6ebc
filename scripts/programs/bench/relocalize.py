"""Speed of questions at 300,000 observations: library call, with several views and with classes
alone too; Zenoh, eight clients; and recall. Beside each the load of the machine.

Generated buildings side by side, so that crops have look-alikes everywhere. The first call builds
log and databases in ``--data`` (minutes: the HNSW index alone takes most of them); later calls
measure only.

    scripts/bench_relocalize [--data DIR] [--observations N]
    scripts/bench_relocalize --commands       # instead: processor time of find, room, path and
                                              # changes on 100,200 keyframes of 334
                                              # buildings, 20,000 Objects
"""

import argparse
import base64
import json
import os
import resource
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import psycopg
from pgvector.psycopg import register_vector

from eventsrc.log import NEVER, LogWriter
from eventsrc.record.transport.session import ZenohOptions, open_session
from projections.fold.settings import Settings
from projections.localize.relocalize import Question, QuestionCrop, QuestionView, rank
from projections.postgres import rebuild
from projections.postgres.connection import Targets
from projections.postgres.embedded import EmbeddedServer
from projections.postgres.queries.candidate_search import CandidateReader
from tests.support.buildings import Building, drive
from tests.support.scenes import crops_of

APART_M = 60.0
KEYFRAMES = 4_000
CROPS, QUESTIONS, CLIENTS = 3, 300, 8
BUILDINGS, KEYFRAMES_OF_MANY = 334, 300
ENDPOINT = "tcp/127.0.0.1:7462"


def building(number: int) -> Building:
    """Building ``number``; all share classes and what is common to all crops."""
    return Building(500 + number, kin=500)


def envelopes(number: int, keyframes: int = KEYFRAMES) -> Iterator[tuple[bytes, int]]:
    """The payloads of a building's run and how many observations each has."""
    for keyframe in drive(building(number), f"bench-{number}", number, keyframes):
        document = msgspec.to_builtins(keyframe.accepted.envelope)
        document["map_x"] += number * APART_M
        for seen, vector in zip(document["detections"], keyframe.accepted.vectors, strict=True):
            assert vector is not None
            seen["embedding"] = base64.b64encode(vector.tobytes()).decode()
            seen |= {"embedding_dim": len(vector), "embedding_model": "bench"}
        yield json.dumps(document).encode(), len(keyframe.instances)


def prepare(data: Path, observations: int) -> None:
    """Write the log and rebuild the databases from it, unless that was done before."""
    log = data / "log"
    if not (data / "ready").exists():
        began, count, number = time.perf_counter(), 0, 0
        with LogWriter(log, fsync=NEVER) as writer:
            while count < observations:
                for payload, seen in envelopes(number):
                    writer.append("tb/detections", payload)
                    count += seen
                number += 1
                print(f"building {number}: {count:,} observations", file=sys.stderr)
        server = EmbeddedServer(data)
        server.start()
        try:
            rebuild(log, Targets(server.url, server.url), Settings())
        finally:
            server.stop()
        (data / "ready").write_text(str(number))
        print(f"prepared in {time.perf_counter() - began:.0f} s", file=sys.stderr)


def questions(data: Path) -> list[tuple[QuestionCrop, ...]]:
    """Crops of other sessions through some of the buildings."""
    found: list[tuple[QuestionCrop, ...]] = []
    for number in range(min(10, int((data / "ready").read_text()))):
        session = drive(building(number), f"lost-{number}", 9_000 + number, 150)
        found += [tuple(crops_of(k)[:CROPS]) for k in session if len(k.instances) >= CROPS]
    rng = np.random.default_rng(1)
    return [found[i] for i in rng.permutation(len(found))[:QUESTIONS]]


def percentiles(seconds: Sequence[float]) -> str:
    """p50 and p99 in milliseconds."""
    cuts = statistics.quantiles(seconds, n=100)
    return f"p50 {1000 * cuts[49]:.1f} ms, p99 {1000 * cuts[98]:.1f} ms"


def library(targets: Targets, asked: Sequence[tuple[QuestionCrop, ...]]) -> None:
    """Candidates and ranking in this process, one question after the other."""
    with CandidateReader(targets) as reader:
        for crops in asked[:20]:
            rank(crops, reader.candidates(crops))
        fetched, ranked = [], []
        for crops in asked:
            began = time.perf_counter()
            candidates = reader.candidates(crops)
            fetched.append(time.perf_counter() - began)
            rank(crops, candidates)
            ranked.append(time.perf_counter() - began)
    both = f"{percentiles(ranked)} (search: {percentiles(fetched)})"
    print(f"library call, {CROPS} crops: {both}{load()}")


def other_questions(targets: Targets, asked: Sequence[tuple[QuestionCrop, ...]]) -> None:
    """Questions of several views with `CROPS` crops each, and of one class or two."""
    views = [QuestionView(0.3, 0.0, 0.5, crops) for crops in asked]
    kinds = {
        f"library call, {count} views": [
            Question((replace(views[start], dx=0.0, dyaw=0.0), *views[start + 1 : start + count]))
            for start in range(len(views) // 3)
        ]
        for count in (1, 2, 3)
    }
    names = sorted({crop.class_name for crops in asked for crop in crops if crop.class_name})
    classes = [QuestionCrop(None, None, name) for name in names]
    for count in (1, 2):
        kinds[f"library call, classes alone, {count}"] = [
            Question.of(tuple(classes[start : start + count]))
            for start in range(len(classes) - count + 1)
        ]
    with CandidateReader(targets) as reader:
        for kind, questions_of_it in kinds.items():
            for question in questions_of_it[:10]:
                rank(question, reader.candidates(question.crops))
            seconds = []
            for question in questions_of_it:
                began = time.perf_counter()
                rank(question, reader.candidates(question.crops))
                seconds.append(time.perf_counter() - began)
            print(f"{kind}: {percentiles(seconds)}{load()}")


def load() -> str:
    """The load of the machine in the last minute, in words."""
    return f", at a load of {os.getloadavg()[0]:.1f}"


def recall(targets: Targets, asked: Sequence[tuple[QuestionCrop, ...]]) -> None:
    """Share of the true nearest that the index finds, at ten and at all that are fetched."""
    with CandidateReader(targets) as reader:
        indexed = [reader.candidates(crops) for crops in asked[:40]]
        reader.disable_index()
        exact = [reader.candidates(crops) for crops in asked[:40]]
    for count in (10, len(exact[0].matches[0])):
        shares = []
        for ours, true in zip(indexed, exact, strict=True):
            for row, best in zip(ours.matches, true.matches, strict=True):
                wanted = {m.observation for m in best[:count]}
                shares.append(len(wanted & {m.observation for m in row}) / len(wanted))
        print(f"recall at {count}: {statistics.mean(shares):.4f}")


def with_conditions(targets: Targets, asked: Sequence[tuple[QuestionCrop, ...]]) -> None:
    """Ten nearest of some classes, through the index and as docs/projections.md says."""
    chance = np.random.default_rng(5)
    names = sorted({crop.class_name for crops in asked for crop in crops if crop.class_name})
    questions = [
        (crops[0].vector, list(chance.choice(names, int(chance.integers(1, 4)), replace=False)))
        for crops in asked[:100]
    ]
    answers: list[list[set[str]]] = []
    with psycopg.connect(targets.vector_url, autocommit=True) as connection:
        register_vector(connection)
        for way, more in (("exact", ""), ("through the index", "::halfvec(512)")):
            statement = (
                "SELECT det_id FROM detection_embeddings WHERE class_name = ANY(%s)"
                f" ORDER BY embedding{more} <=> %s LIMIT 10"
            )
            found, seconds = [], []
            for vector, classes in questions:
                began = time.perf_counter()
                rows = connection.execute(statement.encode(), (classes, vector)).fetchall()
                seconds.append(time.perf_counter() - began)
                found.append({str(row[0]) for row in rows})
            answers.append(found)
            shares = [len(f & e) / len(e) for f, e in zip(found, answers[0], strict=True)]
            share = f"{statistics.mean(shares):.3f} of the ids"
            print(f"nearest of some classes, {way}: {percentiles(seconds)}, {share}{load()}")


def on_a_large_map(data: Path) -> None:
    """Commands on a kept history, beside the floor: reading its columns with numpy."""
    log = data / "many-buildings"
    if not log.exists():
        with LogWriter(log, fsync=NEVER) as writer:
            for number in range(BUILDINGS):
                for content, _ in envelopes(number, KEYFRAMES_OF_MANY):
                    writer.append("tb/detections", content)
    kept = f"import numpy, pathlib; of = pathlib.Path({str(log.with_suffix('.history'))!r})"
    kept += "; z = numpy.load(max(of.glob('*.npz'), key=lambda p: p.stat().st_mtime))"
    kept += "; [z[name] for name in z.files]"
    run = [sys.executable, "-m", "projections.surfaces.cli"]
    full = [str(log), "--preset", "full"]
    point, room = f"{100 * APART_M},5", "bench-100_p0"
    commands = {
        "kept, not counted": [*run, "find", *full, "class 3"],
        "floor: python reads what is kept": [sys.executable, "-c", kept],
        "find CLASS": [*run, "find", *full, "class 3"],
        "find CLASS --near X,Y": [*run, "find", *full, "class 3", "--near", point],
        "find CLASS --in PLACE": [*run, "find", *full, "class 3", "--in", room],
        "find CLASS --from X,Y": [*run, "find", *full, "class 3", "--from", point],
        "find CLASS --at W": [*run, "find", *full, "class 3", "--at", "50000"],
        "find CLASS --goal json": [*run, "find", *full, "class 3", "--goal", "json"],
        "changes": [*run, "changes", *full],
        "changes --since W": [*run, "changes", *full, "--since", "50000"],
        "room PLACE": [*run, "room", *full[:1], room, *full[1:]],
        "path X,Y X,Y": [*run, "path", *full[:1], point, f"{100 * APART_M + 3},6", *full[1:]],
    }
    for what, command in commands.items():
        spent = [_processor_s(command) for _ in range(1 if "not counted" in what else 5)]
        print(f"{what}: least {min(spent):.2f} s, median {statistics.median(spent):.2f} s of CPU")


def _processor_s(command: Sequence[str]) -> float:
    """Processor time of a whole command."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def payload(crops: Sequence[QuestionCrop]) -> bytes:
    """A question as a robot sends it."""
    seen: list[dict[str, Any]] = [
        {
            "embedding": base64.b64encode(c.vector.tobytes()).decode(),
            "bbox": list(c.bbox or ()),
            "class": c.class_name,
        }
        for c in crops
    ]
    return json.dumps({"crops": seen}).encode()


def over_zenoh(targets: Targets, asked: Sequence[tuple[QuestionCrop, ...]]) -> None:
    """One client, then eight, against ``mapfold serve`` in a process of its own."""
    command = [sys.executable, "-m", "projections.surfaces.cli", "serve", "--listen", ENDPOINT]
    command += ["--db", targets.graph_url, "--rate", "100000"]
    service = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert service.stderr is not None
    try:
        while "Ctrl-C" not in service.stderr.readline():
            assert service.poll() is None, "the service ended"
        payloads = [payload(crops) for crops in asked]
        client(payloads[:30], [])
        seconds: list[float] = []
        client(payloads, seconds)
        print(f"over Zenoh, one client: {percentiles(seconds)}{load()}")
        seconds.clear()
        threads = [
            threading.Thread(target=client, args=(payloads[i::2], seconds)) for i in range(CLIENTS)
        ]
        began = time.perf_counter()
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        rate = len(seconds) / (time.perf_counter() - began)
        print(
            f"over Zenoh, {CLIENTS} clients: {rate:.0f} questions/s, {percentiles(seconds)}{load()}"
        )
    finally:
        service.terminate()
        service.wait()


def client(payloads: Sequence[bytes], seconds: list[float]) -> None:
    """Ask one question after the other; every answer must be one."""
    with open_session(ZenohOptions(connect=(ENDPOINT,)), mode="client") as session:
        for question in payloads:
            began = time.perf_counter()
            ((good, answer),) = session.get_replies("mapfold/relocalize", question, timeout_s=30.0)
            seconds.append(time.perf_counter() - began)
            assert good, answer


def main() -> None:
    """Prepare if need be, then measure."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--data", type=Path, default=Path(".mapfold/bench-relocalize"))
    parser.add_argument("--observations", type=int, default=300_000)
    parser.add_argument("--commands", action="store_true", help="Measure commands instead.")
    arguments = parser.parse_args()
    arguments.data.mkdir(parents=True, exist_ok=True)
    if arguments.commands:
        return on_a_large_map(arguments.data)
    prepare(arguments.data, arguments.observations)
    asked = questions(arguments.data)
    server = EmbeddedServer(arguments.data)
    server.start()
    try:
        targets = Targets(server.url, server.url)
        library(targets, asked)
        other_questions(targets, asked)
        recall(targets, asked)
        with_conditions(targets, asked)
        over_zenoh(targets, asked)
    finally:
        server.stop()


if __name__ == "__main__":
    main()
