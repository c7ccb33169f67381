"""The executor for many machines: jobs as Ray tasks. All nodes see the sweep's folder under the same path."""

from __future__ import annotations

import functools
import os
import socket
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from arm5dof.errors import UserError
from arm5dof.runtime import files
from arm5dof.sweeps.local import ATTEMPTS, Jobs
from arm5dof.sweeps.worker import Job, Worker

try:
    import ray
except ImportError:  # An extra; the module can be imported without.
    ray = None

PATIENCE_S = 5.0


class RayExecutor:
    """Runs jobs as tasks of a Ray cluster, each with one CPU, or one GPU where the cluster has some. A task whose
    worker or node dies is begun again elsewhere, and goes on from its runs' checkpoints.

    Args:
        workers: How many tasks at once; None for as many as the cluster has CPUs or GPUs.
        address: Of the cluster; None for one that is at hand, or else a local one, which ends with the sweep.

    Raises:
        UserError: Ray is not installed, or the cluster cannot be reached.
    """

    def __init__(self, workers: int | None = None, address: str | None = None) -> None:
        if ray is None:
            raise UserError("the executor ray takes Ray: pip install 'arm5dof[ray]'")
        self._ours = not ray.is_initialized()
        if self._ours:
            _reach(address or os.environ.get("RAY_ADDRESS"))
            try:
                ray.init(address=address, log_to_driver=False, logging_level="ERROR")
            except Exception as error:  # Ray raises many types.
                raise UserError(f"cannot reach a Ray cluster ({' '.join(str(error).split())[:200]})") from None
        resources = ray.cluster_resources()
        self.gpus = int(resources.get("GPU", 0))
        self.workers = workers or self.gpus or max(int(resources.get("CPU", 1)), 1)

    def __enter__(self) -> RayExecutor:
        return self

    def __exit__(self, *_: object) -> None:
        if self._ours:
            ray.shutdown()

    def run(self, jobs: Jobs, lost: Callable[[Job], None]) -> Iterator[Job]:
        """See `Executor`."""
        paths = os.pathsep.join(dict.fromkeys([*filter(None, sys.path), str(files.PACKAGE.parent)]))
        task = ray.remote(_work).options(
            num_cpus=0 if self.gpus else 1,
            num_gpus=1 if self.gpus else 0,
            max_retries=ATTEMPTS - 1,
            runtime_env={"env_vars": {"PYTHONPATH": paths}},
        )
        running: dict[Any, Job] = {}
        more = True
        while True:
            while more and len(running) < self.workers:
                job = jobs.next(None)
                more = job is not None
                if job is not None:
                    absolute = Job(**{**vars(job), "folder": str(Path(job.folder).absolute())})
                    running[task.remote(absolute.dumps(), str(Path.cwd()))] = job
            if not running:
                return
            for done in ray.wait(list(running))[0]:
                job = running.pop(done)
                try:
                    ray.get(done)
                except Exception:  # Its workers died, all of them.
                    lost(job)
                yield job


def _reach(address: str | None) -> None:
    """Raise `UserError` if nobody listens at an address, which Ray takes minutes to say."""
    host, colon, port = (address or "").removeprefix("ray://").rpartition(":")
    if not colon or not port.isdigit():
        return
    try:
        socket.create_connection((host, int(port)), PATIENCE_S).close()
    except OSError as error:
        raise UserError(f"cannot reach a Ray cluster at {address} ({error.strerror or error})") from None


@functools.cache
def _worker() -> Worker:
    """One for each process: it keeps its compiled program from task to task."""
    from arm5dof.runtime import xla

    xla.enable_compilation_cache()
    return Worker()


def _work(job: str, folder: str) -> None:
    os.chdir(folder)
    _worker().work(Job.loads(job))
