"""One thread for matrices that are too small for more."""

from __future__ import annotations

import functools
from contextlib import AbstractContextManager

from threadpoolctl import ThreadpoolController


@functools.cache
def _controller() -> ThreadpoolController:
    return ThreadpoolController()


def one_thread() -> AbstractContextManager:
    """Within it BLAS takes one thread: on matrices of a hundred rows more of them wait for each other."""
    return _controller().limit(limits=1, user_api="blas")
