"""Settings: assignments from the command line, fingerprints, messages of refusals."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from projections.fold.evidence import EvidenceConstants
from projections.fold.map_errors import SettingsError
from projections.fold.settings import (
    CameraConstants,
    CameraSettings,
    LocalizerConstants,
    RoomsConstants,
    Settings,
    assignment_texts,
    settings_by_name,
)


def test_assignments_change_what_they_name() -> None:
    changed = Settings().with_assignments(["eps_m=1.0", "min_samples = 8", "embedding_model=a=b"])
    assert changed == Settings(eps_m=1.0, min_samples=8, embedding_model="a=b")


def test_a_setting_given_twice_is_refused_with_both_values() -> None:
    for texts, told in (
        (["min_samples=3", "eps_m=1", "min_samples=5"], "min_samples=5: min_samples is given as 3"),
        (["preset=full", "preset=rooms"], "preset=rooms: preset is given as full too"),
        (["evidence.sizes_m.a=b=1", "evidence.sizes_m.a=b=2"], "sizes_m.a=b is given as 1 too"),
    ):
        with pytest.raises(SettingsError, match=r"^--set ") as caught:
            Settings().with_assignments(texts)
        assert told in str(caught.value)
    assert Settings().with_assignments(["eps_m=1", "eps_m = 1"]) == Settings(eps_m=1.0)
    on_top = Settings(places="rooms")
    for order in (["preset=full", "fusion=page"], ["fusion=page", "preset=full"]):
        assert Settings().with_assignments(order) == on_top


def test_none_gives_a_setting_back() -> None:
    pinned = Settings(embedding_model="m", embedding_dim=4)
    assert pinned.with_assignments(["embedding_model=none", "embedding_dim="]) == Settings()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("eps_m", "write it as name=value"),
        ("eps=1", "no setting 'eps'; there are embedding_dim, embedding_model, eps_m"),
        ("eps_m=wide", "--set eps_m=wide: input should be a valid number"),
        ("eps_m=0", "--set eps_m=0: input should be greater than 0"),
        ("eps_m=nan", "--set eps_m=nan"),
        ("min_samples=2.5", "--set min_samples=2.5"),
        ("eps_m=\x1b[2J", r"--set eps_m='\x1b[2J': input should be a valid number"),
        ("embedding_model=\ud800", "--set embedding_model='\\ud800': "),
        (f"eps_m={'x' * 9_999}", f"--set eps_m='{'x' * 76}...: "),
        (f"{'x' * 9_999}=1", f"no setting '{'x' * 76}...; there are"),
    ],
)
def test_a_wrong_assignment_is_refused_in_words(text: str, says: str) -> None:
    with pytest.raises(SettingsError, match="--set") as caught:
        Settings().with_assignments([text])
    assert says in str(caught.value)
    assert caught.value.exit_code == 2


def test_the_option_that_was_given_is_named() -> None:
    for text in ("eps", "eps=1", "eps_m=wide"):
        with pytest.raises(SettingsError, match=r"^--try eps"):
            Settings().with_assignments([text], "--try")


def test_settings_out_of_a_document() -> None:
    assert Settings.from_document({"eps_m": 1}) == Settings(eps_m=1.0)
    saved = Settings(min_samples=8).model_dump(mode="json")
    assert Settings.from_document(saved) == Settings(min_samples=8)


@pytest.mark.parametrize(
    ("document", "says"),
    [
        ([1], 'no JSON object; write one such as {"eps_m": 1.0}'),
        ({"eps": 1}, "no setting 'eps'; there are embedding_dim, embedding_model, eps_m"),
        ({"eps_m": "wide"}, "eps_m is 'wide': input should be a valid number"),
        ({"neighbourhood": "walls"}, "no setting 'neighbourhood'; there are"),
        (
            {"embedding_model": "\x07"},
            "embedding_model is '\\x07': has the control character U+",
        ),
        ({"embedding_model": "x" * 300}, f"embedding_model is '{'x' * 76}...: is 300 characters"),
        ({"eps_m": ["x"] * 9_999}, "eps_m is ['x', "),
    ],
)
def test_a_wrong_document_is_refused_in_words(document: object, says: str) -> None:
    with pytest.raises(SettingsError) as caught:
        Settings.from_document(document)
    assert str(caught.value).startswith(says)
    assert len(str(caught.value)) < 500


def test_the_fingerprint_tells_settings_apart() -> None:
    settings = [Settings(), Settings(eps_m=1.0), Settings(min_samples=4), Settings(embedding_dim=4)]
    assert len({s.fingerprint() for s in settings}) == len(settings)
    assert Settings(eps_m=1.5).fingerprint() == Settings().fingerprint()


def test_fingerprints_are_those_in_checkpoints_of_older_versions() -> None:
    assert Settings().fingerprint() == "4bd37ebd4fe729af"
    assert Settings(eps_m=0.75, min_samples=8).fingerprint() == "9356e0fc03e32754"


def test_documents_of_older_versions_may_hold_a_neighbourhood_that_is_none() -> None:
    assert Settings.from_document({"eps_m": 1.0, "neighbourhood": None}) == Settings(eps_m=1.0)
    with pytest.raises(SettingsError, match="no setting 'neighbourhood'"):
        Settings().with_assignments(["neighbourhood=none"])


def test_dotted_names_change_one_value_of_a_group() -> None:
    changed = Settings().with_assignments(
        [
            "fusion=evidence",
            "camera.hfov_deg=90",
            "evidence.range_m = 1.3",
            "evidence.sizes_m.potted plant=0.4",
            "evidence.sizes_m.no. 7=x=0.5",
            "evidence.side_by=heading",
        ]
    )
    assert changed.fusion == "evidence"
    assert changed.camera == CameraSettings(hfov_deg=90.0)
    assert changed.evidence.range_m == 1.3
    assert changed.evidence.sizes_m == {"no. 7=x": 0.5, "potted plant": 0.4}
    assert changed.evidence.side_by == "heading"
    fewer = changed.with_assignments(["evidence.sizes_m.no. 7=x=none"])
    assert fewer.evidence.sizes_m == {"potted plant": 0.4}
    assert fewer.changed_from(changed) == {"evidence.sizes_m.no. 7=x": None}
    assert hash(fewer) != hash(changed)
    assert {fewer, changed, fewer} == {changed, fewer}


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("fusion=magic", "--set fusion=magic: input should be 'page' or 'evidence'"),
        (
            "camera=90",
            "camera=90: it has several values; give one of them, such as camera.hfov_deg=90",
        ),
        ("evidence.sizes_m=1", "give one of them, such as evidence.sizes_m.chair=0.9"),
        ("camera.hfov_deg=0", "--set camera.hfov_deg=0: input should be greater than or equal to"),
        ("camera.fov=9", "no setting 'camera.fov'; there are camera.height_px, camera.hfov_deg"),
        ("evidence.sizes_m.chair=-1", "--set evidence.sizes_m.chair=-1: input should be greater"),
        ("evidence.sizes_m.=1", "--set evidence.sizes_m.=: is empty"),
        ("evidence.reach=1", ", evidence.sizes_m.CLASS"),
        ("places=magic", "--set places=magic: input should be 'page' or 'rooms'"),
        ("rooms=1", "give one of them, such as rooms.cell_m=0.5"),
        ("rooms.drive_m=20", "rooms.drive_m=20: should be at most 20 times cell_m, which is 0.75"),
        (
            "rooms.cell_m=0.01",
            "rooms.drive_m=4.0: should be at most 20 times cell_m, which is 0.01",
        ),
        ("eps_m.x=1", "no setting 'eps_m.x'; there are embedding_dim, embedding_model, eps_m"),
        ("where=1", "text_encoder_sha256, camera.NAME, evidence.NAME, localizer.NAME, rooms.NAME"),
        ("eps_m.neighbourhood=x", "no setting 'eps_m.neighbourhood'"),
    ],
)
def test_a_wrong_dotted_assignment_is_refused_in_words(text: str, says: str) -> None:
    with pytest.raises(SettingsError, match="--set") as caught:
        Settings().with_assignments([text])
    assert says in str(caught.value)


@pytest.mark.parametrize(
    ("document", "says"),
    [
        ({"camera": {"hfov_deg": "wide"}}, "camera.hfov_deg is 'wide': input should be a valid"),
        ({"camera": {"zoom": 2}}, "no setting 'camera.zoom'; there are camera.height_px"),
        ({"camera": 5}, "camera is 5: input should be"),
        ({"evidence": {"sizes_m": {"cup": 0}}}, "evidence.sizes_m.cup is 0: input should be"),
        ({"evidence": {"range_m": None}}, "evidence.range_m is None: input should be"),
    ],
)
def test_a_wrong_group_in_a_document_is_refused_in_words(document: object, says: str) -> None:
    with pytest.raises(SettingsError) as caught:
        Settings.from_document(document)
    assert str(caught.value).startswith(says)


_NAMES = st.text(st.characters(exclude_categories=["C"]), min_size=1, max_size=9)
_CHANGED = st.builds(
    Settings,
    eps_m=st.floats(0.1, 9.0),
    embedding_model=st.none() | st.just("clip"),
    fusion=st.sampled_from(["page", "evidence"]),
    camera=st.builds(
        CameraSettings,
        hfov_deg=st.none() | st.floats(1.0, 170.0),
        hfov_error_deg=st.sampled_from([None, 0.5]),
        yaw_rad=st.floats(-7.0, 7.0),
    ),
    evidence=st.builds(
        EvidenceConstants,
        range_m=st.floats(0.1, 9.0),
        sizes_m=st.dictionaries(_NAMES.map(str.strip).filter(bool), st.floats(0.1, 9.0)),
        different=st.none() | st.floats(-1.0, 0.9),
    ),
    localizer=st.builds(
        LocalizerConstants, known_shift=st.floats(-9.0, 9.0), known_count=st.integers(0, 99)
    ),
    places=st.sampled_from(["page", "rooms"]),
    rooms=st.builds(RoomsConstants, cell_m=st.floats(0.3, 9.0), drive_m=st.floats(0.1, 5.0)),
)


@given(_CHANGED, _CHANGED)
def test_changed_settings_by_name_are_the_assignments_between_two(
    base: Settings, other: Settings
) -> None:
    """So commands that name them give the same map, and documents leave nothing out."""
    changed = other.changed_from(base)
    texts = [f"{name}={'none' if value is None else value}" for name, value in changed.items()]
    assert base.with_assignments(texts) == other
    assert (changed == {}) is (base == other)
    assert Settings.from_document(other.model_dump(mode="json")) == other
    assert settings_by_name(other.model_dump()).items() <= other.by_name().items()


def test_documents_of_page_maps_name_no_younger_setting() -> None:
    younger = {"fusion", "camera", "evidence", "localizer", "places", "rooms"}
    assert not younger & Settings(eps_m=1.0).model_dump().keys()
    assert Settings(camera=CameraSettings(yaw_rad=1.0)).model_dump()["camera"]["yaw_rad"] == 1.0


def test_documents_of_evidence_maps_name_every_constant() -> None:
    """So their fingerprint changes with a default, on which the map depends."""
    document = Settings(fusion="evidence").model_dump()
    assert document["evidence"] == EvidenceConstants().model_dump()
    assert document["camera"] == CameraSettings().model_dump()
    assert not {"places", "rooms"} & document.keys()


@pytest.mark.parametrize("fusion", ["page", "evidence"])
def test_documents_name_corrections_of_relocalisation_only_where_there_are_any(fusion: str) -> None:
    """The fold does not use them: a map made before they existed keeps its fingerprint."""
    plain = Settings.from_document({"fusion": fusion})
    assert "localizer" not in plain.model_dump()
    corrected = plain.with_assignments(["localizer.known_shift=0.5"])
    assert corrected.model_dump()["localizer"]["known_shift"] == 0.5
    assert corrected.fingerprint() != plain.fingerprint()


def test_many_constants_are_told_by_their_number() -> None:
    changed = {f"localizer.c{n}": n for n in range(5)} | {"eps_m": 1, "evidence.range_m": 2}
    texts = ["eps_m=1", "evidence.range_m=2", "5 constants of localizer"]
    assert assignment_texts(changed) == texts


def test_documents_of_maps_by_rooms_name_every_constant() -> None:
    """And none of fusion by evidence, unless that is in force too."""
    document = Settings(places="rooms").model_dump()
    assert document["rooms"] == RoomsConstants().model_dump()
    assert document["places"] == "rooms"
    assert not {"fusion", "camera", "evidence"} & document.keys()
    both = Settings(places="rooms", fusion="evidence").model_dump()
    assert {"rooms", "camera", "evidence"} <= both.keys()


def test_a_camera_that_is_given_is_no_estimate() -> None:
    estimated = CameraSettings(hfov_deg=61.8, hfov_error_deg=0.4, width_px=800.0)
    settings = Settings(fusion="evidence", camera=estimated)
    assert not CameraSettings().is_stated
    assert not estimated.is_stated
    stated = settings.with_assignments(["camera.hfov_deg=69.4"]).camera
    assert stated == CameraSettings(hfov_deg=69.4, width_px=800.0)
    assert stated.is_stated
    assert stated.constants == CameraConstants(hfov_deg=69.4, width_px=800.0, height_px=400.0)
    assert settings.with_assignments(["camera.hfov_deg=none"]).camera.hfov_deg is None


@pytest.mark.parametrize("fusion", ["page", "evidence"])
def test_a_default_that_is_said_folds_the_same_map(fusion: str) -> None:
    plain = Settings.from_document({"fusion": fusion})
    said = plain.with_assignments(["camera.hfov_deg=69.4", "camera.width_px=640"])
    assert said != plain
    assert said.fingerprint() == plain.fingerprint()
    assert said.with_assignments(["camera.hfov_deg=70"]).fingerprint() != plain.fingerprint()


def test_fingerprints_of_evidence_maps_are_those_of_versions_without_rooms() -> None:
    assert Settings(fusion="evidence").fingerprint() == "74343062d28faa20"
    assert Settings(fusion="evidence", eps_m=0.75).fingerprint() == "9d6c33759e6735bc"
