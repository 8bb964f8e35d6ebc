"""Ctrl-C ends a work between two of its steps."""

import signal

import pytest

from projections.cli.signals import ctrl_c_between_steps

_HANDLER = signal.getsignal(signal.SIGINT)


def _ctrl_c() -> None:
    signal.raise_signal(signal.SIGINT)


def test_a_step_is_done_before_it_ends() -> None:
    done = []
    with pytest.raises(KeyboardInterrupt), ctrl_c_between_steps() as step:  # noqa: PT012
        for number in range(9):
            with step:
                if number == 2:
                    _ctrl_c()
                done.append(number)
    assert done == [0, 1, 2]
    assert signal.getsignal(signal.SIGINT) is _HANDLER


def test_outside_of_steps_it_ends_at_once() -> None:
    with pytest.raises(KeyboardInterrupt), ctrl_c_between_steps():
        _ctrl_c()


def test_the_second_one_does_not_wait() -> None:
    reached = []
    with pytest.raises(KeyboardInterrupt), ctrl_c_between_steps() as step, step:  # noqa: PT012
        _ctrl_c()
        reached.append("after the first")
        _ctrl_c()
        reached.append("after the second")
    assert reached == ["after the first"]
