"""Bands in threads: order, bounded haste, faults."""

import threading
import time

import pytest

from nlights_core.machine import band_threads
from nlights_core.machine.band_threads import in_order


@pytest.fixture(autouse=True)
def three_cores(monkeypatch):
    monkeypatch.setattr(band_threads, "cores", lambda: 3)


def test_results_come_in_order_however_long_each_takes():
    def slow_at_first(i):
        time.sleep(0.002 * (5 - i) if i < 5 else 0)
        return i

    assert list(in_order(slow_at_first, range(20))) == list(range(20))


def test_bands_are_worked_on_at_the_same_time():
    meeting = threading.Barrier(3, timeout=10)
    assert len(list(in_order(lambda band: meeting.wait(), range(3)))) == 3


def test_no_more_bands_are_begun_than_there_is_room_for():
    begun = []
    results = in_order(lambda i: begun.append(i), range(100))
    next(results)
    time.sleep(0.05)
    assert len(begun) <= 4
    results.close()
    assert len(begun) <= 4


def test_a_fault_is_raised_where_its_result_was_due():
    results = in_order(lambda i: 6 // (i - 2), range(5))
    assert [next(results), next(results)] == [-3, -6]
    with pytest.raises(ZeroDivisionError):
        next(results)
