"""Work on several views at a time."""

import threading
import time

import pytest

from iif_core.numerics.parallel import map_in_order


@pytest.mark.parametrize("threads", [1, 2, 3, 9])
def test_results_come_in_order_and_few_wait(threads):
    lock, begun, taken, most = threading.Lock(), 0, 0, 0

    def work(i):
        nonlocal begun, most
        with lock:
            begun += 1
            most = max(most, begun - taken)
        time.sleep(0.002 * (i % 3))
        return i

    found = []
    for value in map_in_order(work, 7, threads):
        found.append(value)
        with lock:
            taken += 1
    assert found == list(range(7))
    assert most <= threads + (threads > 1), "those that are computed or wait, and the one that is being used"
    assert list(map_in_order(work, 0, threads)) == []


def test_work_goes_on_while_a_result_is_used():
    started = threading.Event()

    def work(i):
        if i == 2:
            started.set()
        return i

    results = map_in_order(work, 4, 2)
    next(results)
    assert started.wait(20), "the third is computed before the second was asked for"
    results.close()


@pytest.mark.parametrize("threads", [1, 2])
def test_an_error_is_raised_where_its_result_would_come(threads):
    def work(i):
        if i == 2:
            raise ValueError("two")
        return i

    results = map_in_order(work, 5, threads)
    assert [next(results), next(results)] == [0, 1]
    with pytest.raises(ValueError, match="two"):
        next(results)
