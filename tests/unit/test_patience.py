"""When the robot asks again, and when it sends everything again."""

from eventsrc.robot.sender import Patience

RESEND_AFTER_S = 2.0


class Clock:
    """A clock that stands still until it is moved."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def _waits(patience: Patience, clock: Clock) -> float:
    """Move the clock, a quarter of a second at a time, until patience is over; how long it took."""
    begin_s = clock.now_s
    while not patience.is_over():
        clock.now_s += 0.25
    return clock.now_s - begin_s


def test_every_question_in_vain_doubles_the_pause_up_to_half_a_minute() -> None:
    clock = Clock()
    patience = Patience(RESEND_AFTER_S, clock)
    pauses = [_waits(patience, clock)]
    for _ in range(6):
        assert not patience.somebody_answered
        patience.ask()
        pauses.append(_waits(patience, clock))
    assert pauses == [2.0, 4.0, 8.0, 16.0, 30.0, 30.0, 30.0]


def test_acks_that_come_by_themselves_are_no_answer() -> None:
    clock = Clock()
    patience = Patience(RESEND_AFTER_S, clock)
    clock.now_s += 1.5
    patience.answered()
    assert _waits(patience, clock) == 2.0, "the time runs from the last ack"
    assert not patience.somebody_answered


def test_acks_of_younger_ones_do_not_put_off_the_oldest() -> None:
    clock = Clock()
    patience = Patience(RESEND_AFTER_S, clock)
    began_s = clock.now_s
    while not patience.is_over():
        patience.passed_over()
        clock.now_s += 0.25
    assert (clock.now_s - began_s, patience.somebody_answered) == (2.0, True)
    for _ in range(4):
        patience.ask()
    patience.passed_over()
    assert _waits(patience, clock) == 2.0, "not the half minute"


def test_after_an_answer_the_rest_is_soon_sent_again() -> None:
    clock = Clock()
    patience = Patience(RESEND_AFTER_S, clock)
    _waits(patience, clock)
    patience.ask()
    patience.answered()
    assert _waits(patience, clock) == 0.5
    assert patience.somebody_answered
    patience.begin()
    assert not patience.somebody_answered
    assert _waits(patience, clock) == 2.0
