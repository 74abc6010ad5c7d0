"""Work on the next items while the last ones are used."""

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def prefetch(
    function: Callable[[Item], Result], items: Iterable[Item], workers: int
) -> Generator[Result, None, None]:
    """Apply a function to items in threads, a few items ahead of the consumer.

    Parameters
    ----------
    function : callable
        Called with one item. Should spend its time where the interpreter is not needed: reading,
        decompressing, numpy.
    workers : int
        Threads, 1 or more; one item more than these is worked on, or waits for the consumer.
    """
    with ThreadPoolExecutor(workers) as pool:
        waiting: deque[Future[Result]] = deque()
        for item in items:
            waiting.append(pool.submit(function, item))
            if len(waiting) > workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
