"""When the robot sends a probe, and when it sends everything again."""

from eventsrc.record.robot.publisher import ResendTimer

RESEND_AFTER_S = 2.0


class Clock:
    """A clock that stands still until it is moved."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def _waits(timer: ResendTimer, clock: Clock) -> float:
    """Move the clock in steps of 0.25 s until the timer expires; returns the seconds."""
    begin_s = clock.now_s
    while not timer.expired():
        clock.now_s += 0.25
    return clock.now_s - begin_s


def test_unanswered_probes_back_off_exponentially_up_to_30_s() -> None:
    clock = Clock()
    timer = ResendTimer(RESEND_AFTER_S, clock)
    pauses = [_waits(timer, clock)]
    for _ in range(6):
        assert not timer.recorder_answers
        timer.on_probe_sent()
        pauses.append(_waits(timer, clock))
    assert pauses == [2.0, 4.0, 8.0, 16.0, 30.0, 30.0, 30.0]


def test_an_ack_without_a_probe_is_no_answer_to_one() -> None:
    clock = Clock()
    timer = ResendTimer(RESEND_AFTER_S, clock)
    clock.now_s += 1.5
    timer.on_oldest_answered()
    assert _waits(timer, clock) == 2.0, "the time runs from the last ack"
    assert not timer.recorder_answers


def test_acks_of_younger_envelopes_do_not_delay_the_oldest() -> None:
    clock = Clock()
    timer = ResendTimer(RESEND_AFTER_S, clock)
    began_s = clock.now_s
    while not timer.expired():
        timer.on_younger_answered()
        clock.now_s += 0.25
    assert (clock.now_s - began_s, timer.recorder_answers) == (2.0, True)
    for _ in range(4):
        timer.on_probe_sent()
    timer.on_younger_answered()
    assert _waits(timer, clock) == 2.0, "not the half minute"


def test_after_an_answered_probe_the_rest_is_due_soon() -> None:
    clock = Clock()
    timer = ResendTimer(RESEND_AFTER_S, clock)
    _waits(timer, clock)
    timer.on_probe_sent()
    timer.on_oldest_answered()
    assert _waits(timer, clock) == 0.5
    assert timer.recorder_answers
    timer.restart()
    assert not timer.recorder_answers
    assert _waits(timer, clock) == 2.0
