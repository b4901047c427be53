"""
Jobs on a cluster of dask.distributed, whose machines see the same files under the same names.

Each worker takes as many bags at a time as it has threads; those of one machine share its cores.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import replace
import socket

from depth_deblur_ros.core.data import InputError
from depth_deblur_ros.job import Done, Job, run_apart
from depth_deblur_ros.many import cores
from distributed import Client, get_worker

PATIENCE_S = 15.0  # for the scheduler and its first worker


class Cluster:
    """The workers of a scheduler; an exception inside `with` takes back what has not begun."""

    def __init__(self, scheduler: str, threads: int | None = None) -> None:
        try:
            self._client = Client(scheduler, timeout=PATIENCE_S, set_as_default=False)
        except (OSError, ValueError) as error:  # a timeout is an OSError
            raise InputError(f'no scheduler answers at {scheduler}: {error}') from error
        try:
            self._client.wait_for_workers(1, PATIENCE_S)
        except TimeoutError as error:
            self._client.close()
            raise InputError(f'the scheduler at {scheduler} has no workers') from error
        self._threads = threads
        self._executor = self._client.get_executor(pure=False)
        self.shares = self._count_shares()

    def __enter__(self) -> Cluster:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._executor.shutdown(wait=kind is None)
        self._client.close()

    def submit(self, job: Job) -> Future[Done]:
        """Let a job be done when there is room."""
        future: Future[Done] = self._executor.submit(on_worker, job, self.shares, self._threads)
        return future

    def _count_shares(self) -> dict[str, int]:
        """Give the cores for one bag of each worker that is there, by its address."""
        machines, threads = self._client.run(machine), self._client.nthreads()
        slots: Counter[str] = Counter()
        for worker, (name, _) in machines.items():
            slots[name] += threads.get(worker, 1)
        return {worker: max(1, n // slots[name]) for worker, (name, n) in machines.items()}


def machine() -> tuple[str, int]:
    """Give the name of this machine and the cores of this process."""
    return socket.gethostname(), cores()


def on_worker(job: Job, shares: Mapping[str, int], threads: int | None) -> Done:
    """Do a job on a worker, by so many threads; None: by this worker's share of its cores."""
    worker = get_worker()
    count = threads or shares.get(worker.address) or max(1, cores() // worker.state.nthreads)
    return run_apart(replace(job, params=replace(job.params, threads=count)))
