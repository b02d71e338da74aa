"""One thread for matrices that are too small for more."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import ThreadpoolController


@functools.cache
def _controller() -> ThreadpoolController:
    return ThreadpoolController()


@contextmanager
def one_thread() -> Iterator[None]:
    """Run BLAS on one thread in the block, or in the function that this decorates.

    On matrices of some hundred rows several threads wait for each other: the spectrum of a tile of 26 × 36 pixels whose
    lobes overlap took 5 s instead of 0.7 s on two idle cores, and up to thirteen times as long on busy ones.
    """
    with _controller().limit(limits=1, user_api="blas"):
        yield
