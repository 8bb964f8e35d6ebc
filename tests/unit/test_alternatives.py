"""Settings of a what-if from --set, --try and --grid."""

import pytest

from projections.fold.map_errors import SettingsError
from projections.fold.settings import Settings
from projections.history.whatif import alternatives, settings_name

BASE = Settings()


def names(*args: list[str]) -> list[str]:
    return [settings_name(BASE, each) for each in alternatives(BASE, *args)]


def test_all_sets_are_one_alternative() -> None:
    assert names(["eps_m=1.0", "min_samples=8"], [], []) == ["eps_m=1.0 min_samples=8"]


def test_each_try_is_one_alternative() -> None:
    assert names([], ["eps_m=1.0, min_samples=8", "eps_m=0.5"], []) == [
        "eps_m=1.0 min_samples=8",
        "eps_m=0.5",
    ]


def test_a_grid_is_every_combination_on_top_of_the_sets() -> None:
    assert names(["fusion_radius_m=2"], [], ["eps_m=0.5,1", "min_samples=3,5"]) == [
        "eps_m=0.5 fusion_radius_m=2.0",
        "eps_m=0.5 min_samples=5 fusion_radius_m=2.0",
        "eps_m=1.0 fusion_radius_m=2.0",
        "eps_m=1.0 min_samples=5 fusion_radius_m=2.0",
    ]


def test_the_same_settings_are_tried_once() -> None:
    assert names(["eps_m=1"], ["eps_m=1.0", "eps_m=1.00"], []) == ["eps_m=1.0"]


def test_no_alternatives_for_no_options() -> None:
    assert names([], [], []) == []


def test_a_bad_try_is_refused_as_one() -> None:
    with pytest.raises(SettingsError, match=r"^--try eps=1: no setting 'eps'"):
        alternatives(BASE, [], ["eps=1"], [])


@pytest.mark.parametrize(
    ("grid", "says"),
    [
        (["eps_m"], "write it as name=value,value"),
        (["eps_m="], "write it as name=value,value"),
        (["eps=1,2"], "no setting 'eps'"),
        (["eps_m=1,x"], "should be a valid number"),
        ([f"min_samples={','.join(map(str, range(1, 202)))}"], "201 combinations"),
    ],
)
def test_a_bad_grid_is_refused(grid: list[str], says: str) -> None:
    with pytest.raises(SettingsError, match=r"^--grid") as caught:
        alternatives(BASE, [], [], grid)
    assert says in str(caught.value)
