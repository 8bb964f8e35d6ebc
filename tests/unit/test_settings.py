"""Settings: assignments from the command line, fingerprints, messages of refusals."""

import pytest

from projections.errors import SettingsError
from projections.settings import Settings


def test_assignments_change_what_they_name() -> None:
    changed = Settings().with_assignments(["eps_m=1.0", "min_samples = 8", "embedding_model=a=b"])
    assert changed == Settings(eps_m=1.0, min_samples=8, embedding_model="a=b")


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


def test_a_neighbourhood_changes_the_fingerprint_and_none_keeps_that_of_older_versions() -> None:
    """The first two were in checkpoints before the setting was there."""
    assert Settings().fingerprint() == "4bd37ebd4fe729af"
    assert Settings(eps_m=0.75, min_samples=8).fingerprint() == "9356e0fc03e32754"
    rules = [None, "same side", "same side, 2 m"]
    assert len({Settings(neighbourhood=rule).fingerprint() for rule in rules}) == len(rules)


def test_no_command_can_name_a_neighbourhood() -> None:
    with pytest.raises(SettingsError, match="no setting 'neighbourhood'"):
        Settings().with_assignments(["neighbourhood=walls"])
