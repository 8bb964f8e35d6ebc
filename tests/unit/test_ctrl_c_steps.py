"""`ctrl_c_between_steps`: Ctrl-C takes effect between two steps."""

import signal

import pytest

from projections.surfaces.cli.signals import ctrl_c_between_steps

_HANDLER = signal.getsignal(signal.SIGINT)


def _ctrl_c() -> None:
    signal.raise_signal(signal.SIGINT)


def test_ctrl_c_in_a_step_takes_effect_after_it() -> None:
    done = []
    with pytest.raises(KeyboardInterrupt), ctrl_c_between_steps() as step:  # noqa: PT012
        for number in range(9):
            with step:
                if number == 2:
                    _ctrl_c()
                done.append(number)
    assert done == [0, 1, 2]
    assert signal.getsignal(signal.SIGINT) is _HANDLER


def test_ctrl_c_outside_of_steps_takes_effect_at_once() -> None:
    with pytest.raises(KeyboardInterrupt), ctrl_c_between_steps():
        _ctrl_c()


def test_a_second_ctrl_c_takes_effect_at_once() -> None:
    reached = []
    with pytest.raises(KeyboardInterrupt), ctrl_c_between_steps() as step, step:  # noqa: PT012
        _ctrl_c()
        reached.append("after the first")
        _ctrl_c()
        reached.append("after the second")
    assert reached == ["after the first"]
