"""Work on many views at a time, with results in the order of the views."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

_T = TypeVar("_T")


def map_in_order(work: Callable[[int], _T], n: int, threads: int) -> Iterator[_T]:
    """Yield work(0), ..., work(n - 1) in this order while up to `threads` of them are computed at a time.

    The others go on while the caller uses a result. No more than `threads` results wait to be taken. What `work` raises is raised
    where its result would have come.
    """
    if threads <= 1:
        yield from map(work, range(n))
        return
    with ThreadPoolExecutor(threads) as pool:
        waiting = deque(pool.submit(work, i) for i in range(min(threads, n)))
        try:
            for i in range(n):
                result = waiting.popleft().result()
                if i + threads < n:
                    waiting.append(pool.submit(work, i + threads))
                yield result
        finally:  # the caller may have stopped asking
            for left in waiting:
                left.cancel()
