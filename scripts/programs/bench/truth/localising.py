"""Re-localisation against the truth: the questions of ``scripts/bench_truth --localise``.

Run a of a robot in a building makes the map; runs b and c ask it, and so do as many questions of
the same robot in another building, which no map can know. A question is *known* if a true instance
of its crops is in the map; about half of what a second drive sees is not.
"""

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from types import ModuleType
from typing import Any

from eventsrc.base.text import counted
from eventsrc.envelope.ingest import Accepted
from projections.fold.settings import CameraSettings, Settings
from projections.localize.evaluate.questions import (
    ScoredQuestion,
    make_questions,
    make_view_questions,
    spread,
)
from projections.localize.evaluate.scores import (
    auroc,
    calibration_floor,
    expected_calibration_error,
    percentile,
)
from projections.localize.evaluate.trials import (
    RIGHT_WITHIN_M,
    Trial,
    TrialRunner,
    known_of_sessions,
)
from projections.localize.relocalize import UNKNOWN_BELOW
from projections.map.view import MapView

from .calibrating import calibrated_settings
from .folding import fold_into
from .worlds import Case

PLACES = {"eps_m": 0.75, "min_samples": 8}
"""Settings of the places: with the defaults most buildings are one place."""
MAPS = ("page", "evidence")
CROPS, VIEWS = (1, 3), (1, 3, 5)


@dataclass(frozen=True, slots=True)
class Scores:
    """Of one kind of question. Errors in metres, over known questions; None where there are none.

    ``place_p50_m`` is that of the plain method, which answers with a place's centroid. A floor is
    the calibration error to expect of true probabilities. ``session_…`` are of `known` after ten
    questions of a session or more.
    """

    questions: int
    known: int
    p50_m: float | None
    p90_m: float | None
    plain_p50_m: float | None
    plain_p90_m: float | None
    place_p50_m: float | None
    within: float | None
    plain_within: float | None
    auroc: float | None
    cosine_auroc: float | None
    known_called_unknown: float | None
    unknown_called_known: float | None
    known_ece: float
    known_floor: float
    confidence_ece: float
    confidence_floor: float
    session_known_called_unknown: float | None
    session_unknown_called_known: float | None
    session_ece: float | None
    cpu_ms: float

    @property
    def against_plain(self) -> float | None:
        """Our median error divided by that of the ten nearest observations."""
        if self.p50_m is None or not self.plain_p50_m:
            return None
        return self.p50_m / self.plain_p50_m


@dataclass(frozen=True, slots=True)
class LocaliseRow:
    """A robot in a building, mapped by one rule; scores by kind of question. ``hfov_deg`` is the
    true field of view of its camera and ``camera`` what the settings of the map say of it."""

    name: str
    map: str
    scores: Mapping[str, Scores]
    hfov_deg: float
    camera: CameraSettings

    def document(self) -> dict[str, Any]:
        """As JSON."""
        return {
            "name": self.name,
            "map": self.map,
            "scores": {kind: asdict(scores) for kind, scores in self.scores.items()},
            "hfov_deg": self.hfov_deg,
            "camera": self.camera.model_dump(),
        }


def stranger_of(generator: ModuleType, half: str, world: str) -> str:
    """The building whose questions are unknown in ``world``: the next one of the half."""
    worlds: list[str] = {"develop": generator.DEVELOP, "validate": generator.VALIDATE}[half]
    others = [each for each in worlds if each != world]
    return others[worlds.index(world) % len(others)] if world in worlds else others[0]


def first_run(case: Case) -> list[Accepted]:
    """The envelopes that the map is made of."""
    return [each for each in case.events if each.envelope.run_id == case.first_run]


def later_runs(case: Case) -> list[Accepted]:
    """The envelopes that ask."""
    return [each for each in case.events if each.envelope.run_id != case.first_run]


def make_map(case: Case, rule: str, *, ask: bool = True, stated: bool = True) -> MapView:
    """Run a with fusion=page, uncalibrated, or by evidence with the map's own constants; those of
    re-localisation too, unless the map is not to be asked. A camera that is not ``stated`` is
    estimated."""
    events = first_run(case)
    settings = Settings(camera=case.camera_settings if stated else CameraSettings(), **PLACES)
    if rule == "evidence":
        settings = settings.model_copy(update={"fusion": "evidence"})
        settings, _ = calibrated_settings(events, settings, ask=ask)
    view = MapView(settings)
    for _ in fold_into(view, events):
        pass
    return view


def asked(
    case: Case, stranger: Case, every: int, crops: Sequence[int] = CROPS
) -> dict[str, tuple[list[ScoredQuestion], ...]]:
    """By kind, of as many crops or views: every n-th question of the case's later runs, and as many
    of the stranger's."""
    found = {}
    for word, make, counts in (
        ("crop", make_questions, crops),
        ("view", make_view_questions, VIEWS),
    ):
        for count in counts:
            own = make(later_runs(case), case.truth, count)[::every]
            others = make(later_runs(stranger), stranger.truth, count)
            found[counted(count, word)] = own, spread(others, len(own))
    return found


def localise(
    case: Case, stranger: Case, rules: Sequence[str], every: int, *, stated: bool = True
) -> list[LocaliseRow]:
    """Map, ask and score. If the camera is not ``stated``, neither questions nor map know it."""
    camera = case.camera if stated else None
    kinds = asked(case, stranger, every)
    rows = []
    for rule in rules:
        view = make_map(case, rule, stated=stated)
        runner = TrialRunner(view, case.truth, camera=camera, method="joint")
        scores = {}
        for kind, (own, others) in kinds.items():
            start = time.process_time()
            trials = runner.run([*own, *others])
            spent = time.process_time() - start
            scores[kind] = score(trials, 1000.0 * spent / max(1, len(trials)))
        said = view.settings.camera
        rows.append(LocaliseRow(case.name, rule, scores, case.camera.hfov_deg, said))
    return rows


def score(trials: Sequence[Trial], cpu_ms: float = 0.0) -> Scores:
    """Scores of trials of one kind."""
    known = [trial for trial in trials if trial.known]
    unknown = [trial for trial in trials if not trial.known]
    sure = [trial.answer.confidence for trial in trials]
    in_map = [trial.answer.known for trial in trials]
    session = known_of_sessions(trials)
    return Scores(
        len(trials),
        len(known),
        percentile(_present(t.pose_error_m for t in known), 0.5),
        percentile(_present(t.pose_error_m for t in known), 0.9),
        percentile(_present(t.plain_error_m for t in known), 0.5),
        percentile(_present(t.plain_error_m for t in known), 0.9),
        percentile(_present(t.plain_place_error_m for t in known), 0.5),
        _share(t.correct for t in known),
        _share(t.plain_error_m is not None and t.plain_error_m <= RIGHT_WITHIN_M for t in known),
        auroc([t.answer.known for t in known], [t.answer.known for t in unknown]),
        auroc([t.best_cosine for t in known], [t.best_cosine for t in unknown]),
        _share(t.answer.unknown for t in known),
        _share(not t.answer.unknown for t in unknown),
        expected_calibration_error(in_map, [t.known for t in trials]),
        calibration_floor(in_map),
        expected_calibration_error(sure, [t.correct for t in trials]),
        calibration_floor(sure),
        _share(p < UNKNOWN_BELOW for p, is_known in session if is_known),
        _share(p >= UNKNOWN_BELOW for p, is_known in session if not is_known),
        expected_calibration_error(*zip(*session, strict=True)) if session else None,
        cpu_ms,
    )


def _present(values: Iterable[float | None]) -> list[float]:
    return [value for value in values if value is not None]


def _share(holds: Iterable[bool]) -> float | None:
    every = list(holds)
    return sum(every) / len(every) if every else None
