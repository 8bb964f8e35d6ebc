"""The map that the service keeps: one question reads a new one, others are answered meanwhile."""

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from projections.fold.settings import Settings
from projections.postgres.queries.live_view import LiveView
from projections.surfaces.serve.asked import MapMemory


def unread() -> LiveView:
    raise AssertionError("the map was read again")


def test_a_map_is_read_once_for_a_checkpoint() -> None:
    memory, old, new = MapMemory(), LiveView(Settings()), LiveView(Settings())
    assert memory.view(1, lambda: old) is old
    assert memory.view(1, unread) is old
    assert memory.view(2, lambda: new) is new
    assert memory.view(2, unread) is new


def test_while_a_new_map_is_read_others_get_the_one_at_hand() -> None:
    memory, old, new = MapMemory(), LiveView(Settings()), LiveView(Settings())
    memory.view(1, lambda: old)
    begun, answered = threading.Event(), threading.Event()

    def read() -> LiveView:
        begun.set()
        assert answered.wait(30)
        return new

    with ThreadPoolExecutor(1) as pool:
        first = pool.submit(memory.view, 2, read)
        assert begun.wait(30)
        try:
            assert memory.view(2, unread) is old
        finally:
            answered.set()
        assert first.result() is new
    assert memory.view(2, unread) is new


def test_the_first_questions_wait_for_the_first_map() -> None:
    memory, only = MapMemory(), LiveView(Settings())
    begun, go_on = threading.Event(), threading.Event()

    def read() -> LiveView:
        begun.set()
        assert go_on.wait(30)
        return only

    with ThreadPoolExecutor(2) as pool:
        first = pool.submit(memory.view, 1, read)
        assert begun.wait(30)
        second = pool.submit(memory.view, 1, unread)
        go_on.set()
        assert first.result() is second.result() is only


def test_after_a_failed_reading_the_next_question_reads() -> None:
    memory, only = MapMemory(), LiveView(Settings())

    def fail() -> LiveView:
        raise ConnectionError

    with pytest.raises(ConnectionError):
        memory.view(1, fail)
    assert memory.view(1, lambda: only) is only
