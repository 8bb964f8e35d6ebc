"""The trial data ``worlds`` beside the repository: generated into a cache folder, then read.

``make_worlds.py`` writes the runs of a profile in a building, the truth and the true objects; the
same arguments give the same bytes, so what is in the cache is not made again. Nothing of it is ever
copied into the repository.
"""

import gzip
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tempfile
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from eventsrc.envelope.ingest import Accepted, Rejected, ingest_all
from projections.fold.settings import CameraConstants, CameraSettings
from projections.localize.evaluate.truth import Truth, read_truth
from tests.support.shared_data import DATA, WORLDS

CACHE = Path(
    os.environ.get(
        "MAPFOLD_BENCH_CACHE",
        Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "mapfold-bench-truth",
    )
)
LIMIT, QUICK_LIMIT = 420, 200
SEED = 0


class NoWorldsError(Exception):
    """The trial data or what was asked of it is not there; the message says what to do."""


@dataclass(frozen=True, slots=True)
class TrueThing:
    """An instance: where it stands, and where from run b on if it is moved."""

    instance: str
    x: float
    y: float
    moved_to: tuple[float, float] | None = None
    class_name: str = ""


@dataclass(frozen=True, slots=True)
class Case:
    """The runs of one robot in one building as one log, with the truth.

    ``looks_again`` is, for each moved thing, how many keyframes after run a had its old spot in
    view.
    """

    name: str
    camera: CameraConstants
    events: list[Accepted]
    truth: Truth
    things: dict[str, TrueThing]
    first_run: str
    looks_again: dict[str, int]

    @property
    def camera_settings(self) -> CameraSettings:
        """The camera as settings state it."""
        return CameraSettings.model_validate(self.camera.model_dump())


def load_generator(folder: Path = WORLDS) -> ModuleType:
    """``make_worlds.py`` as a module. Raises NoWorldsError where it is absent."""
    path = folder / "make_worlds.py"
    if not path.exists():
        raise NoWorldsError(
            f"the trial data {path} is absent; give its folder by --worlds DIR or "
            "MAPFOLD_SHARED_WORLDS"
        )
    spec = importlib.util.spec_from_file_location("make_worlds", path)
    if spec is None or spec.loader is None:
        raise NoWorldsError(f"{path} is no Python module")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def pairs(
    generator: ModuleType,
    half: str,
    worlds: Iterable[str] = (),
    profiles: Iterable[str] = (),
    *,
    quick: bool = False,
) -> list[tuple[str, str]]:
    """(profile, world) to run: those named, for the rest those of the half; with ``quick`` every
    world once, with profiles in turn."""
    of_half = {"develop": generator.DEVELOP, "validate": generator.VALIDATE}[half]
    known = {*generator.DEVELOP, *generator.VALIDATE}
    wanted = list(worlds) or of_half
    chosen = list(profiles) or [p for p, v in generator.PROFILES.items() if v["use"] == half]
    for name, names in ((w, known) for w in wanted):
        _check("world", name, names)
    for name in chosen:
        _check("profile", name, generator.PROFILES)
    if quick:
        return [(chosen[i % len(chosen)], world) for i, world in enumerate(wanted)]
    return [(profile, world) for profile in chosen for world in wanted]


def _check(kind: str, name: str, names: Iterable[str]) -> None:
    if name not in names:
        raise NoWorldsError(f"--{kind} {name}: unknown; there are {', '.join(sorted(names))}")


def make_case(
    generator: ModuleType,
    profile: str,
    world: str,
    *,
    moved: float = 0.0,
    limit: int = LIMIT,
    seed: int = SEED,
    cache: Path = CACHE,
    embeddings: bool = True,
    session_shift: float = 1.0,
) -> Case:
    """The runs of a profile in a world, generated unless the cache has them; without
    ``embeddings`` as a bare detector sees them. ``session_shift`` multiplies what embeddings have
    of their run."""
    kept = case_folder(generator, profile, world, moved, limit, seed, cache, session_shift)
    return read_case(kept, profile, world, embeddings=embeddings)


def case_folder(
    generator: ModuleType,
    profile: str,
    world: str,
    moved: float,
    limit: int,
    seed: int,
    cache: Path,
    session_shift: float = 1.0,
) -> Path:
    """The folder of the generator's files, generated unless the cache has them."""
    source = Path(str(generator.__file__))
    layout = source.parent / "layouts" / f"{world}.json"
    version = zlib.crc32(layout.read_bytes(), zlib.crc32(source.read_bytes()))
    name = f"{version:08x}-seed{seed}-moved{moved:g}-limit{limit}"
    name += "" if session_shift == 1.0 else f"-session{session_shift:g}"
    kept = cache / name / profile / world
    if not (kept / "looks-again.json").exists():
        _generate(source, generator, profile, world, moved, limit, seed, session_shift, kept)
    return kept


_GENERATOR = """
import sys
from pathlib import Path
sys.path.insert(0, str(Path(sys.argv[1]).parent))
import make_worlds
for family in make_worlds.FAMILIES.values():
    for part in ("session", "day"):
        family[part] *= float(sys.argv[2])
del sys.argv[1:3]
make_worlds.main()
"""


def _generate(
    source: Path,
    generator: ModuleType,
    profile: str,
    world: str,
    moved: float,
    limit: int,
    seed: int,
    session_shift: float,
    kept: Path,
) -> None:
    """Into a temporary folder first, so that what is in the cache is complete."""
    kept.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=kept.parent) as temporary:
        command = [sys.executable, "-c", _GENERATOR, str(source), str(session_shift), temporary]
        command += ["--world", world, "--profile", profile]
        command += ["--moved", str(moved), "--limit", str(limit), "--seed", str(seed)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise NoWorldsError(f"{' '.join(command)} failed:\n{done.stderr}")
        made = Path(temporary) / profile / world
        looks = _looks_again(generator, made, profile, world, moved, seed) if moved else {}
        (made / "looks-again.json").write_text(json.dumps(looks))
        if kept.exists():
            shutil.rmtree(kept)
        made.rename(kept)


def _looks_again(
    generator: ModuleType, made: Path, profile: str, world: str, moved: float, seed: int
) -> dict[str, int]:
    """How many keyframes after run a had the old spot of a moved thing in view.

    The generator's own camera looks from each recorded pose at the things as they stand in run b,
    and at the moved ones where they stood. One counts whose box would be whole and half unhidden.
    """
    building = generator.World(world)
    before = building.objects
    chance = generator.np.random.default_rng(generator.crc(world, "moved", seed))
    after = generator.moved(building, moved, chance)
    ghosts = [old for old, new in zip(before, after, strict=True) if new.get("moved")]
    stated = {t.instance for t in _things(made) if t.moved_to is not None}
    if {f"{world}/{ghost['id']}" for ghost in ghosts} != stated:
        raise NoWorldsError(f"{made}: other things are moved than the generator says")
    building.objects = after
    building.place()
    camera = generator.Camera(generator.PROFILES[profile], building, [*after, *ghosts])
    looks = dict.fromkeys(sorted(stated), 0)
    for path in _runs(made, world)[1:]:
        for document in _documents(path):
            pose = document["map_x"], document["map_y"], document["map_yaw"]
            for index, _, share, clipped, *_ in camera.see(*pose):
                if index >= len(after) and share >= 0.5 and not clipped:
                    looks[f"{world}/{ghosts[index - len(after)]['id']}"] += 1
    return looks


def read_case(folder: Path, profile: str, world: str, *, embeddings: bool = True) -> Case:
    """A case from the generator's files and ``looks-again.json``."""
    runs = _runs(folder, world)
    camera = json.loads((folder / "camera.json").read_text())
    return Case(
        f"{profile} {world}",
        CameraConstants(
            hfov_deg=camera["hfov_deg"], width_px=camera["width"], height_px=camera["height"]
        ),
        [accepted for path in runs for accepted in _accepted(path, embeddings=embeddings)],
        read_truth([path.with_name(path.name.replace(".jsonl", ".truth.jsonl")) for path in runs]),
        {thing.instance: thing for thing in _things(folder)},
        f"{world}-{profile}-a",
        json.loads((folder / "looks-again.json").read_text()),
    )


def house_case(run: str = "house-a", *, embeddings: bool = True) -> Case | None:
    """A run of the trial house beside the repository; None where it is absent."""
    path = DATA / "house" / f"{run}.jsonl.gz"
    if not path.exists():
        return None
    truth = read_truth([path.with_name(f"{run}.truth.jsonl.gz")])
    things = {thing.instance: thing for thing in _things(path.parent)}
    events = _accepted(path, embeddings=embeddings)
    return Case(run, CameraConstants(), events, truth, things, run, {})


def _runs(folder: Path, world: str) -> list[Path]:
    """The files of runs a, b, … in order."""
    return sorted(p for p in folder.glob(f"{world}-?.jsonl.gz") if "truth" not in p.name)


def _documents(path: Path) -> list[dict[str, Any]]:
    with gzip.open(path) as lines:
        return [json.loads(line) for line in lines]


def _accepted(path: Path, *, embeddings: bool) -> list[Accepted]:
    with gzip.open(path) as lines:
        payloads = lines.read().splitlines()
    if not embeddings:
        payloads = [_without_embeddings(payload) for payload in payloads]
    outcomes = ingest_all(payloads)
    for number, outcome in enumerate(outcomes, start=1):
        if isinstance(outcome, Rejected):
            raise NoWorldsError(f"{path}, line {number}: {outcome.reason}")
    return [outcome for outcome in outcomes if isinstance(outcome, Accepted)]


def _without_embeddings(payload: bytes) -> bytes:
    envelope = json.loads(payload)
    for detection in envelope["detections"]:
        for name in ("embedding", "embedding_dim", "embedding_model"):
            detection.pop(name, None)
    return json.dumps(envelope).encode()


_ONE_LOOK = np.ones(1, np.float32)


def as_if_alike(accepted: Accepted) -> Accepted:
    """The same detections with one and the same embedding."""
    looks = (_ONE_LOOK,) * len(accepted.vectors)
    return Accepted(accepted.envelope, accepted.det_ids, looks)


def _things(folder: Path) -> list[TrueThing]:
    found = json.loads((folder / "objects.json").read_text())
    return [
        TrueThing(
            thing["id"],
            thing["x"],
            thing["y"],
            (to["x"], to["y"]) if (to := thing.get("moved_in_b")) else None,
            thing["cls"] if "cls" in thing else thing["class_name"],
        )
        for thing in found
    ]
