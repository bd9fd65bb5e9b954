"""Work on threads."""

import itertools
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def ordered_map(function: Callable[[Item], Result], items: Iterable[Item], *, workers: int) -> Iterator[Result]:
    """`map` on threads, for work that releases the interpreter lock: in order, at most 2 x `workers` ahead."""
    remaining = iter(items)
    with ThreadPoolExecutor(workers) as pool:
        futures: deque[Future[Result]] = deque(
            pool.submit(function, item) for item in itertools.islice(remaining, 2 * workers)
        )
        try:
            while futures:
                result = futures.popleft().result()
                for item in itertools.islice(remaining, 1):
                    futures.append(pool.submit(function, item))
                yield result
        finally:
            for future in futures:
                future.cancel()
