"""What `mapfold serve` sends over HTTP is what /openapi.json describes."""

import itertools
import json
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_type_hints
from urllib.parse import urlencode

import pytest
from pydantic import TypeAdapter

from projections.postgres import rebuild
from projections.postgres.connection import Targets
from projections.surfaces.serve import Answerer, Pools, models
from tests.support import services as described_maps
from tests.support.logs import write_log
from tests.support.services import Service, documents

CROPS = [crop for document in documents(4) for crop in document["detections"]]
CLASS = {"crops": [{"class": "toilet"}]}
ASKED = (
    ("/relocalize", {"crops": CROPS}, models.AnswerShape),
    ("/relocalize?method=plain", {"crops": CROPS}, models.AnswerShape),
    ("/relocalize?session=a", {"crops": CROPS}, models.AnswerShape),
    ("/relocalize?top=1", CLASS, models.AnswerShape),
    ("/relocalize", [{"embedding": [1.0] * 512}], models.AnswerShape),
    ("/state/places", None, models.PlacesShape),
    ("/state/objects?limit=3", None, models.ObjectsShape),
    ("/state/objects", None, models.ObjectsShape),
    ("/state/places?x=5&y=5&radius=100", None, models.PlacesShape),
    ("/state/objects?x=5&y=5&radius=100&limit=5", None, models.ObjectsShape),
    ("/state/objects?x=5000&y=5", None, models.ObjectsShape),
    ("/health", None, models.Health),
)


def test_every_answer_has_the_shape_described_and_every_described_key_is_sent(
    service: Service,
) -> None:
    sent: dict[str, set[str]] = defaultdict(set)
    for path, body, model in ASKED:
        data = None if body is None else json.dumps(body).encode()
        code, headers, content = service.get(path, data)
        assert (code, headers["content-type"]) == (200, "application/json"), (path, content)
        TypeAdapter(model).validate_json(content, strict=True, extra="forbid")
        _keys(json.loads(content), model.__name__, sent)
    for name, keys in sent.items():
        shape = getattr(models, f"{name}Shape", None) or getattr(models, name)
        wanted = set(get_type_hints(shape))
        assert keys == wanted, (name, wanted ^ keys)
    assert set(sent) >= {"Answer", "RankedPlace", "Evidence", "Pose", "Track", "Place", "MapObject"}


PARTS = {
    ("Answer", "places"): "RankedPlace",
    ("Answer", "pose"): "Pose",
    ("Answer", "track"): "Track",
    ("RankedPlace", "evidence"): "Evidence",
    ("Places", "places"): "Place",
    ("Objects", "objects"): "MapObject",
}


def _keys(document: Any, name: str, sent: dict[str, set[str]]) -> None:
    sent[name] |= set(document)
    for key, value in document.items():
        part = PARTS.get((name, key))
        for item in value if isinstance(value, list) else [value]:
            if part and item is not None:
                _keys(item, part, sent)


def test_the_description_is_made_of_these_models(described: Any) -> None:
    shapes = described["components"]["schemas"]
    for model in (
        models.AnswerShape,
        models.PlacesShape,
        models.ObjectsShape,
        models.Health,
        models.RefusalShape,
    ):
        schema = TypeAdapter(model).json_schema(ref_template="#/components/schemas/{model}")
        parts = schema.pop("$defs", {})
        assert shapes[model.__name__] == schema
        for name, part in parts.items():
            assert shapes[name] == part
    answers = {
        path: operation["responses"]["200"]["content"]
        for path, operations in described["paths"].items()
        for operation in operations.values()
    }
    refs = re.findall(r"schemas/(\w+)", json.dumps(answers))
    asked = ["ChangesPage", "DrivenPath", "FoundObject", "FoundPage", "GoalPose", "Room"]
    assert sorted(refs) == sorted(["Answer", "Health", "Objects", "Places", *asked])


def test_the_examples_work(service: Service, described: Any) -> None:
    question = described["paths"]["/relocalize"]["post"]
    examples = question["requestBody"]["content"]["application/json"]["examples"]
    assert len(examples) == 4
    for each in examples.values():
        answer = service.document("/relocalize", each["value"])
        assert answer["places"]
    for path, model in (
        ("/relocalize", models.AnswerShape),
        ("/state/{what}", models.PlacesShape),
        ("/health", models.Health),
    ):
        (operation,) = described["paths"][path].values()
        shown = operation["responses"]["200"]["content"]["application/json"]["example"]
        TypeAdapter(model).validate_python(shown, strict=True, extra="forbid")


def test_the_description_says_which_parameters_of_the_state_go_together(
    service: Service, described: Any
) -> None:
    _, selection = described["paths"]["/state/{what}"]["get"]["parameters"]
    assert (selection["style"], selection["explode"]) == ("form", True)
    forms = [
        (set(form["required"]), set(form["properties"])) for form in selection["schema"]["anyOf"]
    ]
    names = sorted(set().union(*(known for _, known in forms)))
    outcomes = set()
    for chosen in itertools.product([False, True], repeat=len(names)):
        given = {name for name, taken in zip(names, chosen, strict=True) if taken}
        code, _, content = service.get(f"/state/places?{'&'.join(f'{n}=1' for n in sorted(given))}")
        allowed = any(required <= given <= known for required, known in forms)
        assert code == (200 if allowed else 400), (given, content)
        outcomes.add(code)
    assert outcomes == {200, 400}
    for shown in selection["examples"].values():
        service.document(f"/state/objects?{urlencode(shown['value'])}")


def test_every_option_goes_with_every_other_in_the_query_and_in_the_body(
    service: Service, described: Any
) -> None:
    parameters = described["paths"]["/relocalize"]["post"]["parameters"]
    values = {"top": 2, "method": "plain", "session": "together"}
    assert {parameter["name"] for parameter in parameters} == set(values)
    question = {"crops": CROPS}
    plain = service.document("/relocalize?method=plain&top=2", question)
    for number, chosen in enumerate(itertools.product([False, True], repeat=len(values))):
        in_query = {n: v for (n, v), taken in zip(values.items(), chosen, strict=True) if taken}
        in_body = {n: v for n, v in values.items() if n not in in_query}
        answer = service.document(f"/relocalize?{urlencode(in_query)}", {**question, **in_body})
        track = answer.pop("track")
        assert answer == plain
        assert track["questions"] == number + 1
        assert track["pose"] is not None


@pytest.mark.parametrize("what", ["places", "objects"])
def test_pages_are_all_there_is_in_one_order(service: Service, what: str) -> None:
    everything = service.document(f"/state/{what}?limit=1000")[what]
    near = service.document(f"/state/{what}?x=0&y=0&radius=100000000")[what]
    key = f"{what[:-1]}_id"
    assert {thing[key] for thing in near} == {thing[key] for thing in everything}
    for limit in (1, 7, len(everything)):
        pages = list(_pages(service, what, limit))
        assert [thing for page in pages for thing in page] == everything
        assert {len(page) for page in pages[:-1]} <= {limit}
        assert 1 <= len(pages[-1]) <= limit
    nearest = service.document(f"/state/{what}?x=0&y=0&radius=100000000&limit=1")
    assert nearest == {what: near[:1]}
    past = service.document(f"/state/{what}?cursor=99999999999999")
    assert past == {what: [], "next": None}


def _pages(service: Service, what: str, limit: int) -> Iterator[list[Any]]:
    cursor: str | None = "0"
    while cursor is not None:
        page = service.document(f"/state/{what}?limit={limit}&cursor={cursor}")
        yield page[what]
        cursor = page["next"]


def test_pages_while_the_map_grows_have_everything_once(
    one_database: Targets, tmp_path: Path
) -> None:
    seen = documents()
    log = write_log(tmp_path / "log", seen[:20])
    rebuild(log, one_database, described_maps.SETTINGS)
    with Pools(one_database, 1) as pools:
        answerer = Answerer(pools, per_second=10_000.0)
        page = answerer.state("objects", {"limit": "5"})
        before = answerer.state("objects", {})["objects"]
        found = page["objects"]
        write_log(log, seen[20:])
        rebuild(log, one_database, described_maps.SETTINGS)
        while page["next"] is not None:
            page = answerer.state("objects", {"limit": "5", "cursor": page["next"]})
            found += page["objects"]
        after = answerer.state("objects", {})["objects"]
    ids = [thing["object_id"] for thing in found]
    assert len(ids) == len(set(ids))
    stayed = {o["object_id"] for o in before} & {o["object_id"] for o in after}
    assert stayed <= set(ids)
    assert len(after) > len(before) > 5


def test_the_page_loads_nothing_from_elsewhere(service: Service) -> None:
    code, fields, content = service.get("/docs")
    page = content.decode()
    assert (code, fields["content-type"]) == (200, "text/html; charset=utf-8")
    policy = fields["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "script-src 'self';" in policy
    assert "://" not in policy
    loaded = re.findall(r'(?:src|href)="([^"]+)"', page)
    assert len(loaded) == 5
    for url in loaded:
        assert url.startswith(("/", "data:,"))
        if url.startswith("/"):
            assert service.get(url)[0] == 200
    assert not re.search(r"<script>|<style|\son\w+=", page)
    assert service.get("/redoc")[0] == 404


def test_metrics_count_what_was_asked(service: Service) -> None:
    def numbers() -> dict[str, float]:
        code, fields, content = service.get("/metrics")
        assert (code, fields["content-type"].partition(";")[0]) == (200, "text/plain")
        lines = (line.rpartition(" ") for line in content.decode().splitlines())
        return {name: float(value) for name, _, value in lines if not name.startswith("#")}

    labels = 'question="{}",result="{}",transport="http"'
    answered = f"mapfold_serve_questions_total{{{labels.format('objects', 'answered')}}}"
    wrong = f"mapfold_serve_questions_total{{{labels.format('objects', 'bad_question')}}}"
    missing = 'mapfold_serve_http_responses_total{status="404"}'
    took = 'mapfold_serve_question_seconds_count{question="objects",transport="http"}'
    before = numbers()
    service.document("/state/objects")
    service.get("/state/objects?x=1")
    service.get("/nothing")
    after = numbers()
    for name, more in ((answered, 1), (wrong, 1), (missing, 1), (took, 2)):
        assert after[name] - before.get(name, 0.0) == more, name
    assert after["mapfold_serve_database_up"] == 1
    assert after["mapfold_serve_queue_size"] == 64
