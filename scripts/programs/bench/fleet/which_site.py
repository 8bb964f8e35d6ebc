"""Which building is a robot in: the probabilities of `fleet relocalize`, beside plain baselines.

Each robot's first run maps each building of the half; later runs ask all its maps. Every question
is scored once with its own building among the sites and once without.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from projections.adapters.fleet.site_databases import which_site
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
    instances_of,
)
from projections.localize.evaluate.trials import best_cosine
from projections.localize.relocalize import Answer, ExactIndex, rank
from scripts.programs.bench.truth.localising import later_runs, make_map
from scripts.programs.bench.truth.worlds import Case, load_generator, make_case, pairs

KINDS = ("1 crop", "3 crops", "3 views")


@dataclass(frozen=True, slots=True)
class Asked:
    """A question's building and kind, whether that building's map knows what it shows, and of each
    building the answer and the greatest cosine."""

    profile: str
    world: str
    kind: str
    known: bool
    answers: Mapping[str, Answer]
    cosines: Mapping[str, float]


def compare(half: str, questions: int) -> None:
    """Print the scores of each kind of question and of each robot."""
    asked = list(_ask(half, questions))
    for kind in (*KINDS, "all"):
        _print_scores(kind, [a for a in asked if kind in ("all", a.kind)])
    for profile in dict.fromkeys(a.profile for a in asked):
        known = [a for a in asked if a.profile == profile and a.known]
        print(f"{profile}: {_right_shares(known)}")


def _ask(half: str, questions: int) -> Iterator[Asked]:
    generator = load_generator()
    chosen = pairs(generator, half)
    for profile in dict.fromkeys(profile for profile, _ in chosen):
        worlds = [world for each, world in chosen if each == profile]
        cases = {world: make_case(generator, profile, world) for world in worlds}
        maps, instances = {}, {}
        for world, case in cases.items():
            view = make_map(case, "evidence")
            maps[world] = ExactIndex(view)
            instances[world] = {i for _, i in instances_of(view, case.truth) if i is not None}
        for world, case in cases.items():
            camera = case.camera
            for kind, question in _questions(case, questions):
                found = {name: index.search(question.crops) for name, index in maps.items()}
                yield Asked(
                    profile,
                    world,
                    kind,
                    any(i in instances[world] for i in question.instances if i is not None),
                    {n: rank(question.asked, c, camera=camera) for n, c in found.items()},
                    {name: best_cosine(c.matches) for name, c in found.items()},
                )


def _questions(case: Case, number: int) -> Iterator[tuple[str, ScoredQuestion]]:
    runs = later_runs(case)
    for kind, made in (
        (KINDS[0], make_questions(runs, case.truth, 1)),
        (KINDS[1], make_questions(runs, case.truth, 3)),
        (KINDS[2], make_view_questions(runs, case.truth, 3)),
    ):
        for question in spread(made, number):
            yield kind, question


def _right_shares(known: list[Asked]) -> str:
    ours = [which_site(a.answers).sites[0].name == a.world for a in known]
    cosine = [max(a.cosines, key=a.cosines.__getitem__) == a.world for a in known]
    place = [max(a.answers, key=lambda w, a=a: _place(a.answers[w])) == a.world for a in known]
    return (
        f"{len(known)} known; named first is right {_share(ours)}, by the greatest cosine"
        f" {_share(cosine)}, by the greatest score of a place {_share(place)}"
    )


def _place(answer: Answer) -> float:
    return answer.places[0].score if answer.places else 0.0


def _print_scores(kind: str, asked: list[Asked]) -> None:
    known = [a for a in asked if a.known]
    with_own = [which_site(a.answers) for a in known]
    without = [
        which_site({name: each for name, each in a.answers.items() if name != a.world})
        for a in asked
    ]
    own = [max(a.cosines.values()) for a in known]
    others = [max(c for name, c in a.cosines.items() if name != a.world) for a in asked]
    told = [(each.probability, each.name == a.world) for a, w in zip(known, with_own, strict=True)
            for each in w.sites]  # fmt: skip
    told += [(w.none, False) for w in with_own]
    told += [(each.probability, False) for w in without for each in w.sites]
    told += [(w.none, True) for w in without]
    probabilities, right = [p for p, _ in told], [r for _, r in told]
    named = [(w.best, a.world) for a, w in zip(known, with_own, strict=True)]
    none = auroc([w.none for w in without], [w.none for w in with_own])
    print(f"{kind}: {len(asked)} questions, {_right_shares(known)}")
    print(
        f"  none of them: AUROC {_number(none)},"
        f" of the greatest cosine {_number(auroc(own, others))};"
        f" called none though there {_share([best is None for best, _ in named])},"
        f" another named {_share([best is not None and best.name != w for best, w in named])};"
        f" without its building called none {_share([w.best is None for w in without])}"
    )
    print(
        f"  calibration error {expected_calibration_error(probabilities, right):.3f}"
        f" (floor {calibration_floor(probabilities):.3f})",
        flush=True,
    )


def _share(holds: list[bool]) -> str:
    return _number(sum(holds) / len(holds) if holds else None)


def _number(value: float | None) -> str:
    return "-" if value is None or math.isnan(value) else f"{value:.3f}"
