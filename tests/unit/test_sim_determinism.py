"""The same bytes on machines whose C libraries differ in the last bit of a sine."""

import math
import random
from collections.abc import Callable
from types import ModuleType, SimpleNamespace

import pytest

from eventsrc.adapters.sim import detector, drive, simulate_run
from tests.support.logs import simulated
from tests.support.thorough import stride

Function = Callable[..., float]


def _off_by_a_bit(function: Function, chance: random.Random) -> Function:
    """``function`` as another library may have it: right, or off by one in the last place."""

    def other(*arguments: float) -> float:
        value = function(*arguments)
        return math.nextafter(value, chance.choice((-math.inf, math.inf, value, value)))

    return other


def _another_library(seed: int) -> SimpleNamespace:
    chance = random.Random(seed)
    names = {name: getattr(math, name) for name in dir(math) if not name.startswith("_")}
    for name in ("sin", "cos", "tan", "atan2"):
        names[name] = _off_by_a_bit(names[name], chance)
    return SimpleNamespace(**names)


@pytest.mark.parametrize(("seed", "run"), [(7, "a"), (2, "a"), (1, "b")][:: stride(3)])
@pytest.mark.seconds
def test_last_bits_of_a_sine_change_no_byte(
    seed: int, run: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = list(simulated(seed, run).payloads)
    elsewhere = _another_library(seed)
    modules: tuple[ModuleType, ...] = (drive, detector)
    for module in modules:
        monkeypatch.setattr(module, "math", elsewhere)
    assert list(simulate_run(seed, run).payloads) == here


@pytest.mark.slow
def test_without_slack_at_the_thresholds_they_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drive, "_SLACK", 0.0)
    here = list(simulate_run(2, "a").payloads)
    monkeypatch.setattr(drive, "math", _another_library(0))
    assert list(simulate_run(2, "a").payloads) != here
