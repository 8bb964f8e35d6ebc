"""Words that are no class, by a text encoder whose space is that of the map's embeddings."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from eventsrc.adapters.detector.text_tower import TextTower
from eventsrc.base.errors import MapfoldError, MisuseError
from projections.ask.find import Wanted, find
from projections.ask.words import ObjectVectors, scores
from projections.fold.settings import Settings
from projections.map.view import MapView
from projections.postgres.connection import Targets
from projections.surfaces.python import fold
from projections.surfaces.serve import Answerer, Pools
from projections.surfaces.serve.asked import FindQuery
from projections.surfaces.text_encoders import ELSEWHERE, words_of
from tests.support.commands import Commands
from tests.support.logs import SAMPLE
from tests.support.models import text_tower

SPACE = "mapfold-simulated-512"


def backwards(name: str) -> str:
    """A word for a class that no rule takes for its name."""
    return "q" + name[::-1].replace(" ", "")


@pytest.fixture(scope="module")
def view() -> MapView:
    return fold(SAMPLE, preset="full").view


@pytest.fixture(scope="module")
def words(view: MapView) -> dict[str, Any]:
    """A vector for each class, the mean of its detections, moved by a constant; by its name and by
    another word."""
    embedded = view.embedded()
    rows = view.vectors(embedded) / 2**20
    names = np.array([view.observations[n].class_name for n in embedded.tolist()])
    moved = np.random.default_rng(5).normal(size=rows.shape[1]) / rows.shape[1] ** 0.5
    means = {name: rows[names == name].mean(axis=0) + moved for name in sorted(set(names.tolist()))}
    spoken = {name.replace(" ", ""): vector for name, vector in means.items()}
    return spoken | {backwards(name): vector for name, vector in means.items()}


@pytest.fixture
def model(tmp_path: Path, words: dict[str, Any], view: MapView) -> Path:
    (tmp_path / "models").mkdir()
    space = view.observations[int(view.embedded()[0])].embedding_model or ""
    return text_tower(tmp_path / "models" / "text.onnx", words, space, prompt="a photo of a {}")


@pytest.fixture
def mapfold(tmp_path: Path) -> Commands:
    shutil.copytree(SAMPLE, tmp_path / "log")
    return Commands.in_folder(tmp_path)


def recall_at_3(found: list[str], right: set[str]) -> float:
    return len(right.intersection(found[:3])) / min(3, len(right))


def test_words_find_what_a_picture_finds(view: MapView, model: Path) -> None:
    """By the recall of the first three answers, within 2 % of the mean over pictures of each
    class."""
    vectors, tower = ObjectVectors.of(view), TextTower(model)
    classes: dict[str, list[Any]] = {}
    for each in view.objects.values():
        classes.setdefault(each.class_name, []).append(each)

    def ranked(vector: Any) -> list[str]:
        found = vectors.cosines(vector)
        return sorted(found, key=lambda each: -found[each])

    by_words, by_pictures = [], []
    for name, things in classes.items():
        right = {each.object_id for each in things}
        by_words.append(recall_at_3(ranked(tower.encode(backwards(name))), right))
        seen = np.array([number for each in things for number in each.observations][:20])
        crops = view.vectors(seen[np.isin(seen, view.embedded())]) / 2**20
        by_pictures.append(np.mean([recall_at_3(ranked(crop), right) for crop in crops]))
    assert np.mean(by_words) >= np.mean(by_pictures) - 0.02


def test_scores_are_relative_to_the_map() -> None:
    assert scores({"a": 0.21, "b": 0.19}) == {"a": 1.0, "b": -1.0}
    assert scores({"a": 0.2, "b": 0.2}) == {"a": 0.0, "b": 0.0}
    assert scores({}) == {}


@pytest.fixture
def said(mapfold: Commands, model: Path) -> Commands:
    """A log whose settings name the text encoder."""
    named = "--set", f"text_encoder={model}"
    mapfold("edit", "log", "use-settings", *named, "--reason", "words")
    return mapfold


@pytest.mark.seconds
def test_without_a_text_encoder_the_answer_says_so(mapfold: Commands, model: Path) -> None:
    word = backwards("refrigerator")
    refused = mapfold("find", "log", word, code=2).err
    assert "without a text encoder words are compared with names of classes only" in refused
    assert "compared with names of classes only" in mapfold("find", "log", "refrigrator").err
    assert mapfold("find", "log", "refrigerator", "--json").json["text_encoder"] is None
    once = mapfold("find", "log", word, "--text-encoder", model, "--json").json
    assert (once["match"], once["classes"], once["text_encoder"]) == ("look", [], SPACE)
    assert {each["class_name"] for each in once["answers"]} == {"refrigerator"}
    assert {each["match"] for each in once["answers"]} == {"look"}
    assert once["answers"][0]["score"] >= once["answers"][-1]["score"] > 1.0
    elsewhere = Commands.in_folder(mapfold.folder, **{ELSEWHERE: "other.onnx"})
    assert elsewhere("find", "log", word, "--text-encoder", model, "--json").json == once
    gone = mapfold("find", "log", word, "--text-encoder", "gone.onnx", code=2).err
    assert gone.endswith("the text encoder gone.onnx is not here\n")


def test_a_space_that_the_log_does_not_have_is_named(mapfold: Commands) -> None:
    refused = mapfold("find", "log", "chair", "--space", "nope", code=2).err
    assert "this map has no Objects; no detection has a vector of space nope" in refused
    assert "`mapfold log spaces log`" in refused


@pytest.mark.seconds
@pytest.mark.slow
def test_a_new_log_begins_with_what_the_command_would_record(said: Commands, model: Path) -> None:
    named = "--set", f"text_encoder={model.relative_to(said.folder)}"
    again = "import", "new", "one.jsonl", *named
    said("simulate", "--out", "one.jsonl", *named)
    said("import", "copy", "one.jsonl")
    for _ in range(2):  # the second time the log has these settings
        said(*again)
    expected = fold(said.folder / "log").view.settings
    for log in ("copy", "new"):
        found = fold(said.folder / log).view.settings
        assert found.text_encoder_sha256 == expected.text_encoder_sha256 is not None
        assert found.text_encoder == str(model.absolute())
    gone = "--set", "text_encoder=gone.onnx"
    assert "gone.onnx" in said("import", "other", "one.jsonl", *gone, code=2).err
    assert not (said.folder / "other").exists()


@pytest.mark.seconds
@pytest.mark.slow
def test_said_once_it_holds_for_every_surface(said: Commands, one_database: Targets) -> None:
    word, log = backwards("potted plant"), said.folder / "log"
    by_log = said("find", "log", word, "--json").json
    assert by_log["answers"][0]["class_name"] == "potted plant"
    assert json.loads(json.dumps(fold(log).find(word).document())) == by_log
    from projections.surfaces.mcp.cited_maps import LogMaps
    from tests.support.agents import tool

    with LogMaps(log, lambda known: known.settings or Settings()) as maps:
        from projections.surfaces.mcp.agent_server import create_server

        tools = create_server(maps)
        assert tool(tools, "find", what=word)["answer"] == by_log
    assert "--set" not in said("state", "log").err
    said("replay", "log", "--db", one_database.graph_url)
    by_databases = said("find", word, "--db", one_database.graph_url, "--json").json
    with Pools(one_database, 2) as pools:
        answerer = Answerer(pools, per_second=1000.0)
        served = answerer.find(FindQuery.read({"what": word}))
    assert json.loads(json.dumps(served)) == by_databases
    for mine, live in zip(by_log["answers"], by_databases["answers"], strict=True):
        assert mine.pop("score") == pytest.approx(live.pop("score"), abs=1e-3)
    assert by_databases == by_log


def test_words_that_are_a_class_use_the_class_and_what_it_looks_like(said: Commands) -> None:
    found = said("find", "log", "chair", "--all", "--top", "100", "--json").json
    assert (found["match"], found["classes"], found["text_encoder"]) == ("exact", ["chair"], SPACE)
    kinds = [each["match"] for each in found["answers"]]
    assert kinds == sorted(kinds)  # exact before look
    plain = said("find", "log", "chair", "--all", "--top", "100", "--set", "text_encoder=none")
    assert kinds.count("exact") == len(plain.out.splitlines()) - 1
    own = [each["score"] for each in found["answers"] if each["match"] == "exact"]
    missing = [each["missing_in"] for each in found["answers"] if each["match"] == "exact"]
    assert [s for s, m in zip(own, missing, strict=True) if not m] == sorted(
        (s for s, m in zip(own, missing, strict=True) if not m), reverse=True
    )
    assert said("find", "log", "kitchen", code=2).err.startswith("mapfold: 'kitchen' is a place")


@pytest.mark.slow
def test_a_file_elsewhere_must_be_the_same(said: Commands, model: Path, tmp_path: Path) -> None:
    word = backwards("couch")
    folder = model.parent.rename(tmp_path / "elsewhere")
    gone = said("find", "log", word, code=2).err
    assert f"the text encoder text.onnx is not here; {ELSEWHERE}=MODEL.onnx says" in gone
    assert str(tmp_path) not in gone.partition("no class like")[2]
    by_class = said("find", "log", "couch")
    assert "text.onnx is not here" in by_class.err
    assert "couch" in by_class.out
    there = Commands.in_folder(said.folder, **{ELSEWHERE: str(folder / "text.onnx")})
    assert there("find", "log", word, "--json").json["text_encoder"] == SPACE
    described = folder / "text.json"
    described.write_text(described.read_text().replace("a photo of", "no photo of"))
    assert "is another one than the log's: SHA-256" in there("find", "log", word, code=2).err


def test_another_space_is_refused(mapfold: Commands, words: dict[str, Any], model: Path) -> None:
    text_tower(model, words, "another/space")
    options = "--set", f"text_encoder={model}", "--reason", "words"
    refused = mapfold("edit", "log", "use-settings", *options, code=2).err
    assert "text.onnx is of the space another/space, dimension 512, the map's embeddings" in refused
    text_tower(model, {word: vector[:8] for word, vector in words.items()}, SPACE)
    assert "dimension 8, the" in mapfold("edit", "log", "use-settings", *options, code=2).err
    found = mapfold("find", "log", backwards("couch"), "--text-encoder", model, code=2).err
    assert "dimension 8, the map's embeddings are of" in found
    (model.parent / "tokenizer.json").write_text("{")
    refused = mapfold("edit", "log", "use-settings", *options, code=2).err
    assert "tokenizer.json: no tokenizer of the library tokenizers" in refused
    text_tower(model, words, SPACE)
    tokenizer = model.with_name("tokenizer.json")
    tokenizer.write_text(tokenizer.read_text().replace('"unk_token": "[UNK]"', '"unk_token": "?"'))
    refused = mapfold("find", "log", "qz", "--text-encoder", model, code=2).err
    assert "classes only: tokenizer.json: WordLevel error: Missing [UNK] token" in refused
    long = mapfold("find", "log", "couch", "--set", f"text_encoder={'x' * 300}")
    assert "is not here" in long.err


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("x" * 1_000_000, "1,000,000 characters; give at most 256"),
        (" \t\n ", "there are no words"),
        ("\0\x1b[31m", None),
        ("\udc80\ud800", None),
        ("椅子 كرسي 🪑 \u202e", None),
        ("{}{0} %s $(id)", None),
    ],
)
def test_hostile_words_get_an_answer_or_an_error(
    view: MapView, model: Path, text: str, reason: str | None
) -> None:
    named = view.settings.model_copy(update={"text_encoder": str(model)})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(view, "settings", named)
        if reason is not None:
            with pytest.raises(MisuseError, match=reason):
                find(view, Wanted(what=text), words_of(view))
        else:
            found = find(view, Wanted(what=text), words_of(view))
            assert all(np.isfinite(each.score or 0.0) for each in found.answers)


@pytest.mark.parametrize(
    ("said", "reason"),
    [
        ({"prompt": "a photo"}, "prompt: .*write {} once"),
        ({"context": 0}, "context: "),
        ({"input": "tokens"}, "it has the inputs input_ids, attention_mask; tokens and at most"),
        ({"speed": 1}, "speed: "),
    ],
)
def test_a_wrong_description_is_one_line(
    tmp_path: Path, words: dict[str, Any], said: dict[str, Any], reason: str
) -> None:
    path = text_tower(tmp_path / "text.onnx", words, SPACE, **said)
    with pytest.raises(MapfoldError, match=reason) as caught:
        TextTower(path)
    assert "\n" not in str(caught.value)
