"""Rendering on an existing Dask cluster (the extra `cluster`).

Each band of a pass is a task. A worker loads the scene once per rendering and traces one task at a time with all of its
threads. Results are added in the order of the passes, so that the sum is identical, bit for bit, to the sum on a single
machine. At most two tasks per initial worker are in flight. Dask reassigns the tasks of a lost worker; where all are
lost, others are waited for. A worker with other versions or files, or without the package, is left out.
"""

from __future__ import annotations

import asyncio
import importlib.util
import logging
import math
import threading
import time
from collections import deque
from collections.abc import Generator, Iterator
from concurrent import futures
from contextlib import contextmanager, suppress
from functools import lru_cache
from importlib.machinery import ModuleSpec
from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..errors import RequestError, pip_install
from ..variants import use_threads
from .passes import Job, Tracer, content_of, trace_band, versions
from .trace_pass import LightOfBands

if TYPE_CHECKING:
    import distributed

_log = logging.getLogger(__name__)
# Held while a pass is traced: it uses all threads of Dr.Jit, and two at a time would only need more memory.
pass_lock = threading.Lock()
PACKAGE = __name__.partition(".")[0]
CONNECT_TIMEOUT = 30  # seconds
MAX_PASSES_PER_WORKER = 2  # in flight
SECONDS_WITHOUT_WORKERS, SECONDS_BETWEEN_LOOKS = 30.0, 1.0  # until a warning; at the workers


def trace_on(address: str) -> Tracer:
    """Return a tracer for `render` that uses the workers of a Dask cluster.

    All workers need the same versions, the scene and its files under the same path (a shared disk) and, for identical
    bits, the same type of processor.

    Args:
        address: of the scheduler, such as `tcp://10.0.0.1:8786`.

    Raises:
        RuntimeError: if `distributed` is not installed; while rendering, if the scheduler or the workers are
            unreachable, all workers have other versions or files, or a pass fails, with the cause on one line.
    """
    try:
        import distributed
    except ImportError:
        raise RuntimeError(f"a Dask cluster needs the package distributed: {pip_install('cluster')}") from None

    def trace(job: Job, scene: mi.Scene, first: int) -> Generator[NDArray[np.float32] | None, None, None]:
        try:
            distributed.comm.parse_address(address, strict=True)
            asyncio.run(_check_scheduler(address))
            client = distributed.Client(address, timeout=CONNECT_TIMEOUT, set_as_default=False)
        except (OSError, ValueError, TimeoutError, asyncio.TimeoutError) as error:
            raise RuntimeError(f"no Dask scheduler at {address}: {str(error) or 'it does not answer'}") from error
        with _silent_client_log(), client, _Tasks(client, job, first) as tasks:
            try:
                client.wait_for_workers(1, timeout=CONNECT_TIMEOUT)
            except (distributed.TimeoutError, TimeoutError):
                raise RuntimeError(f"the Dask scheduler at {address} has no workers") from None
            try:
                yield from tasks.results(address)
            except (asyncio.CancelledError, futures.CancelledError, distributed.TimeoutError, OSError):
                raise RuntimeError(f"the Dask scheduler at {address} is gone") from None
            except distributed.KilledWorker as error:
                raise RuntimeError(f"workers of {address} die while tracing: {error}") from None
            except ImportError as error:
                raise RuntimeError(f"a worker of {address} lacks a package: {error}") from None

    return trace


class _Tasks:
    """The bands of the passes of a job, as tasks of a cluster; those in flight are cancelled at the end."""

    def __init__(self, client: distributed.Client, job: Job, first: int) -> None:
        self.client, self.job, self.first = client, job, first
        self.waiting: deque[tuple[distributed.Future, set[str]]] = deque()  # with the workers that may trace it
        self.suitable: set[str] = set()  # addresses of workers
        self.unsuitable: set[str] = set()
        self.thread = futures.ThreadPoolExecutor(1)

    def __enter__(self) -> _Tasks:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(TimeoutError, asyncio.TimeoutError, OSError):
            self.cancel()
        self.thread.shutdown(wait=False)

    def cancel(self) -> None:
        self.client.cancel([task for task, _ in self.waiting], force=True)
        self.waiting.clear()

    def results(self, address: str) -> Generator[NDArray[np.float32] | None, None, None]:
        """Yield the results of all tasks in order; while there are no workers, None."""
        total = len(self.job.samples) * len(self.job.bands)
        workers = self._workers()
        if not workers and self.unsuitable:
            raise RuntimeError(f"no worker of {address} has the package {PACKAGE}")
        max_waiting, since, result, is_first = MAX_PASSES_PER_WORKER * len(workers), time.monotonic(), None, True
        while self.first < total:
            if workers and self.waiting and not workers & self.waiting[0][1]:
                self.cancel()
                result = None
            while workers and len(self.waiting) < max_waiting and self.first + len(self.waiting) < total:
                index = self.first + len(self.waiting)
                task = self.client.submit(_trace_on_worker, self.job, index, pure=False, workers=sorted(workers))
                self.waiting.append((task, workers))
            # In a thread, as what takes long to arrive must not be requested again.
            if self.waiting and result is None:
                result = self.thread.submit(self.waiting[0][0].result)
            arrived = result is not None and bool(futures.wait([result], SECONDS_BETWEEN_LOOKS).done)
            workers = self._workers()
            if workers or arrived:
                since = time.monotonic()
            if result is None or not arrived:
                if workers:
                    continue
                if time.monotonic() - since > SECONDS_WITHOUT_WORKERS:
                    _log.warning("the Dask scheduler at %s has no workers left; waiting for others", address)
                    since = math.inf
                if result is None:
                    time.sleep(SECONDS_BETWEEN_LOOKS)
                yield None
                continue
            try:
                traced = result.result()
            except Unsuitable as error:
                where, reason = error.args
                self._leave_out(where, reason)
                workers = workers - self.unsuitable
                if is_first and not workers:
                    raise RuntimeError(reason) from None
                self.cancel()
            else:
                self.waiting.popleft()
                self.first, is_first = self.first + 1, False
                yield traced
                del traced
            result = None

    def _workers(self) -> set[str]:
        """Return the addresses of the workers that may suit the job."""
        threads: dict[str, int] = self.client.sync(self.client.scheduler.ncores, callback_timeout=CONNECT_TIMEOUT)
        # A worker without the package could not read its task, and would end instead of saying so.
        if new := set(threads) - self.suitable - self.unsuitable:
            found = self.client.run(importlib.util.find_spec, PACKAGE, workers=sorted(new), on_error="return")
            for where, spec in found.items():
                if isinstance(spec, ModuleSpec):
                    self.suitable.add(where)
                elif not isinstance(spec, OSError):
                    self._leave_out(where, f"it lacks the package {PACKAGE}")
        return set(threads) & self.suitable

    def _leave_out(self, where: str, reason: str) -> None:
        self.suitable.discard(where)
        self.unsuitable.add(where)
        _log.warning("the worker at %s is left out: %s", where, reason)


class Unsuitable(RuntimeError):
    """A worker does not suit a job: its address, and why."""


@contextmanager
def _silent_client_log() -> Iterator[None]:
    """Silence the log of Dask's client, which repeats each exception that it raises, with a traceback."""
    logger = logging.getLogger("distributed.client")
    before = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        logger.setLevel(before)


async def _check_scheduler(address: str) -> None:
    """Connect to a scheduler once; a client would wait for minutes for a port that accepts but does not answer."""
    import distributed

    comm = await asyncio.wait_for(distributed.comm.connect(address), CONNECT_TIMEOUT)
    await comm.close()


def _trace_on_worker(job: Job, index: int) -> NDArray[np.float32]:
    """Trace a band of a pass on a worker."""
    import distributed

    worker = distributed.get_worker()
    if versions() != job.versions:
        raise Unsuitable(worker.address, f"a worker has {', '.join(versions())}; wanted {', '.join(job.versions)}")
    with pass_lock:
        mi.set_variant(job.variant)
        use_threads(worker.state.nthreads)
        try:
            scene = scene_of(job)
        except RuntimeError as error:
            raise Unsuitable(worker.address, str(error)) from None
        return trace_band(job, scene, index, light_of(job))


@lru_cache(maxsize=1)
def scene_of(job: Job) -> mi.Scene:
    """Load the scene of a job, once; raise RuntimeError if the scene or one of its files differs from the job."""
    try:
        scene = job.scene.load()
        content = content_of(job.scene, scene)
    except (RequestError, OSError) as error:
        raise RuntimeError(f"a worker cannot load the scene: {error}") from None
    if content != job.content:
        raise RuntimeError(f"{job.scene.path}: on a worker, the scene or a file that it references is different")
    return scene


@lru_cache(maxsize=1)
def light_of(job: Job) -> LightOfBands:
    """Return the light of the passes of a job, kept while a worker traces bands of the same pass."""
    return LightOfBands(job.bands)
