"""Rendering on an existing Dask cluster (the extra `cluster`).

Each band of a pass is a task. A worker loads the scene once per rendering and traces one task at a time with all of its
threads. Results are added in the order of the passes, so that the sum is identical, bit for bit, to the sum on a single
machine. At most two tasks per initial worker are in flight. Dask reassigns the tasks of a lost worker.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections import deque
from collections.abc import Generator, Iterator
from concurrent import futures
from contextlib import contextmanager, suppress
from functools import lru_cache

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..errors import RequestError, pip_install
from .passes import Job, Tracer, trace_band, versions
from .trace_pass import LightOfBands

# Held while a pass is traced: it uses all threads of Dr.Jit, and two at a time would only need more memory.
pass_lock = threading.Lock()
CONNECT_TIMEOUT = 30  # seconds
MAX_PASSES_PER_WORKER = 2  # in flight


def trace_on(address: str) -> Tracer:
    """Return a tracer for `render` that uses the workers of a Dask cluster.

    All workers need the same versions, the scene and its files under the same path (a shared disk) and, for identical
    bits, the same type of processor.

    Args:
        address: of the scheduler, such as `tcp://10.0.0.1:8786`.

    Raises:
        RuntimeError: if `distributed` is not installed; while rendering, if the scheduler or the workers are
            unreachable or lost, have other versions or files, or a pass fails, with the cause on one line.
    """
    try:
        import distributed
    except ImportError:
        raise RuntimeError(f"a Dask cluster needs the package distributed: {pip_install('cluster')}") from None

    def trace(job: Job, scene: mi.Scene, first: int) -> Generator[NDArray[np.float32], None, None]:
        try:
            distributed.comm.parse_address(address, strict=True)
            asyncio.run(_check_scheduler(address))
            client = distributed.Client(address, timeout=CONNECT_TIMEOUT, set_as_default=False)
        except (OSError, ValueError, TimeoutError, asyncio.TimeoutError) as error:
            raise RuntimeError(f"no Dask scheduler at {address}: {str(error) or 'it does not answer'}") from error
        with _silent_client_log(), client:
            waiting: deque[distributed.Future] = deque()
            try:
                client.wait_for_workers(1, timeout=CONNECT_TIMEOUT)
                max_waiting = MAX_PASSES_PER_WORKER * len(client.nthreads())
                total = len(job.samples) * len(job.bands)
                for index in range(first, total):
                    while len(waiting) < max_waiting and index + len(waiting) < total:
                        task = client.submit(_trace_on_worker, job, index + len(waiting), pure=False)
                        waiting.append(task)
                    traced = waiting[0].result()
                    waiting.popleft()
                    yield traced
                    del traced
            except (distributed.TimeoutError, TimeoutError):
                raise RuntimeError(f"the Dask scheduler at {address} has no workers") from None
            except (asyncio.CancelledError, futures.CancelledError, distributed.comm.CommClosedError):
                raise RuntimeError(f"the Dask scheduler at {address} is gone") from None
            except distributed.KilledWorker as error:
                raise RuntimeError(f"workers of {address} die while tracing: {error}") from None
            except ImportError as error:
                raise RuntimeError(f"a worker of {address} lacks a package: {error}") from None
            finally:
                with suppress(distributed.TimeoutError, TimeoutError, OSError):
                    client.cancel(list(waiting), force=True)

    return trace


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

    if versions() != job.versions:
        raise RuntimeError(f"a worker has {', '.join(versions())}; wanted {', '.join(job.versions)}")
    with pass_lock:
        mi.set_variant(job.variant)
        threads = distributed.get_worker().state.nthreads
        if dr.thread_count() != threads:
            dr.set_thread_count(threads)
        return trace_band(job, scene_of(job), index, light_of(job))


@lru_cache(maxsize=1)
def scene_of(job: Job) -> mi.Scene:
    """Load the scene of a job, once; raise RuntimeError if the scene or one of its files differs from the job."""
    try:
        scene, content = job.scene.load(), job.scene.digest()
    except (RequestError, OSError) as error:
        raise RuntimeError(f"a worker cannot load the scene: {error}") from None
    if content != job.content:
        raise RuntimeError(f"{job.scene.path}: on a worker, the scene or a file that it references is different")
    return scene


@lru_cache(maxsize=1)
def light_of(job: Job) -> LightOfBands:
    """Return the light of the passes of a job, kept while a worker traces bands of the same pass."""
    return LightOfBands(job.bands)
