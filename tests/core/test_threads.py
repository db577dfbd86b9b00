import gc
import sys
import threading
import time
from collections.abc import Iterator

import pytest

from segslam.core.threads import at_once, in_other_thread


@pytest.mark.parametrize("max_waiting", [1, 8])
@pytest.mark.parametrize("slow", ["making", "work", "asking"])
def test_the_order_is_that_of_the_items_whichever_is_slow(max_waiting: int, slow: str) -> None:
    def items() -> Iterator[int]:
        for item in range(20):
            time.sleep(0.002 * (slow == "making"))
            yield item

    def work(item: int) -> int:
        time.sleep(0.002 * (slow == "work"))
        return item * item

    done = []
    for result in in_other_thread(items(), work, max_waiting=max_waiting):
        time.sleep(0.002 * (slow == "asking"))
        done.append(result)
    assert done == [item * item for item in range(20)]


def test_items_are_made_while_others_are_worked_on_and_no_more_than_may_wait() -> None:
    """The work on the first ends only when as many more as may wait have been made."""
    made, three_more = [], threading.Event()

    def items() -> Iterator[int]:
        for item in range(9):
            made.append(item)
            if len(made) == 4:
                three_more.set()
            yield item

    def work(item: int) -> bool:
        return item > 0 or three_more.wait(10.0)

    results = in_other_thread(items(), work, max_waiting=3)
    assert next(results)
    assert len(made) == 4
    assert all(results)
    assert made == list(range(9))


def test_items_are_produced_by_the_calling_thread_and_processed_by_one_other() -> None:
    def items() -> Iterator[int]:
        for _ in range(6):
            yield threading.get_ident()

    pairs = list(in_other_thread(items(), lambda maker: (maker, threading.get_ident()), max_waiting=2))
    assert {maker for maker, _ in pairs} == {threading.get_ident()}
    assert len({worker for _, worker in pairs} - {threading.get_ident()}) == 1


def test_failed_work_raises_in_order_and_stops_the_others() -> None:
    worked = []

    def work(item: int) -> int:
        worked.append(item)
        if item == 3:
            time.sleep(0.05)
            raise ArithmeticError(item)
        return item

    done = []
    with pytest.raises(ArithmeticError):
        done.extend(in_other_thread(range(100), work, max_waiting=2))
    assert worked == [0, 1, 2, 3]


def test_what_was_made_before_a_failed_item_is_worked_on() -> None:
    def items() -> Iterator[int]:
        yield 1
        yield 2
        raise ArithmeticError

    worked = []
    with pytest.raises(ArithmeticError):
        list(in_other_thread(items(), worked.append, max_waiting=4))
    assert worked == [1, 2][: len(worked)], "in order, and none twice; those that still waited are dropped"


def test_an_early_end_stops_the_work() -> None:
    worked = []
    results = in_other_thread(range(1_000_000), worked.append, max_waiting=3)
    next(results)
    results.close()
    num_worked = len(worked)
    time.sleep(0.02)
    assert len(worked) == num_worked <= 5


def test_a_forgotten_one_may_be_closed_by_its_own_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    problems: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", problems.append)
    second, forgotten, collected = threading.Event(), threading.Event(), threading.Event()
    made = []

    def items() -> Iterator[int]:
        try:
            for item in range(10):
                if item == 2:
                    second.set()
                yield item
        finally:
            made.append("closed")

    def work(item: int) -> int:
        if item == 0:
            second.wait(5.0)
        if item == 1:
            forgotten.wait(5.0)
            gc.collect()
            collected.set()
        return item

    gc.disable()
    try:
        results: list[object] = [in_other_thread(items(), work, max_waiting=2)]
        next(results[0])  # type: ignore[call-overload]
        results.append(results)  # a cycle, as an exception and its frames are one
        del results
        forgotten.set()
        assert collected.wait(5.0)
    finally:
        gc.enable()
    assert problems == []
    assert made == ["closed"]


def test_both_are_done_at_the_same_time_and_given_in_their_order() -> None:
    meeting = threading.Barrier(2, timeout=5.0)

    def meet(result: str) -> str:
        meeting.wait()
        return result

    assert at_once(lambda: meet("first"), lambda: meet("second")) == ("first", "second")


@pytest.mark.parametrize("divisors", [(0, 1), (1, 0)])
def test_what_raises_in_either_raises(divisors: tuple[int, int]) -> None:
    with pytest.raises(ZeroDivisionError):
        at_once(lambda: 1 / divisors[0], lambda: 1 / divisors[1])
