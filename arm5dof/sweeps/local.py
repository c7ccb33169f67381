"""The executor for one machine: a process for each share of the CPU's cores, or for each GPU."""

from __future__ import annotations

import contextlib
import os
import selectors
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import IO, Protocol

from arm5dof.runtime import files, xla
from arm5dof.sweeps.worker import Job

ATTEMPTS = 4
"""How often a job is begun or resumed before its members are given up: its worker may be killed."""

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Jobs(Protocol):
    """Where jobs come from."""

    def next(self, group: int | None) -> Job | None:
        """A job to do, of the given program shape if there is one; None if there is none left."""
        ...

    def ended(self, job: Job) -> None:
        """A job has ended."""
        ...


class LocalExecutor:
    """Runs jobs in worker processes.

    Args:
        workers: How many; None for one a core, or one a GPU, of which each has one at most.
        gpus: How many GPUs there are to share out; 0 shares out the cores.
    """

    keep_open: int | None = None
    """A file descriptor that every worker holds open too, so that a lock on it lasts as long as they do."""

    def __init__(self, workers: int | None = None, gpus: int = 0) -> None:
        self.workers = min(workers or gpus, gpus) if gpus else workers or xla.cores()
        self.gpus = gpus

    def run(self, jobs: Jobs, lost: Callable[[Job], None]) -> Iterator[Job]:
        """Do all jobs, and yield each when it has ended.

        Args:
            jobs: The jobs.
            lost: Told of one whose worker died too often; it is yielded then, too.
        """
        selector = selectors.DefaultSelector()
        processes: dict[int, _Process] = {}
        running: dict[int, Job] = {}
        deaths: dict[Job, int] = {}
        again: list[Job] = []

        def give(number: int) -> None:
            """A worker's next job, if there is one; a process is started when there is none to do it."""
            process = processes.get(number)
            job = again.pop() if again else jobs.next(process.group if process else None)
            if job is None:
                return
            if process is None:
                process = processes[number] = self._start(number)
                selector.register(process.answers, selectors.EVENT_READ, number)
            process.give(job)
            running[number] = job

        def end(number: int) -> None:
            process = processes.pop(number)
            selector.unregister(process.answers)
            process.close()

        try:
            while True:
                for number in range(self.workers):
                    if number not in running:
                        give(number)
                if not running:
                    return
                for number in [key.data for key, _ in selector.select()]:
                    answered = processes[number].answers.readline()
                    job = running.pop(number, None)
                    if not answered:  # The worker is dead.
                        end(number)
                        if job is not None:
                            deaths[job] = deaths.get(job, 0) + 1
                    if job is not None and not answered and deaths[job] < ATTEMPTS:
                        again.append(job)
                    elif job is not None:
                        if not answered:
                            lost(job)
                        yield job
        finally:
            for process in processes.values():
                process.kill()
            selector.close()

    def _start(self, number: int) -> _Process:
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(filter(None, [*sys.path, str(files.PACKAGE.parent)])),
        }
        cores: Sequence[int] = ()
        if self.gpus:
            visible = os.environ.get("CUDA_VISIBLE_DEVICES", "")
            environment["CUDA_VISIBLE_DEVICES"] = visible.split(",")[number] if visible else str(number)
            environment.pop("XLA_PYTHON_CLIENT_PREALLOCATE", None)
        elif hasattr(os, "sched_setaffinity"):
            own = sorted(os.sched_getaffinity(0))
            cores = own[number :: self.workers] or [own[number % len(own)]]
            environment |= dict.fromkeys(THREADS, str(len(cores)))
        return _Process(environment, cores, [] if self.keep_open is None else [self.keep_open])


class _Process:
    """A worker process, told jobs by one pipe and answering by another."""

    def __init__(self, environment: dict[str, str], cores: Sequence[int], descriptors: Sequence[int]) -> None:
        pinned = "" if not cores else f"import os; os.sched_setaffinity(0, {list(cores)}); "
        self._process = subprocess.Popen(
            [sys.executable, "-c", f"{pinned}from arm5dof.sweeps.worker import main; main()"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment,
            pass_fds=descriptors,
            start_new_session=True,  # Ctrl-C is for whoever started it, who ends it.
        )
        assert self._process.stdin and self._process.stdout
        self._jobs: IO[bytes] = self._process.stdin
        self.answers: IO[bytes] = self._process.stdout
        self.group: int | None = None

    def give(self, job: Job) -> None:
        """Send a job. If the process is dead its answer's end will tell."""
        self.group = job.group
        with contextlib.suppress(BrokenPipeError):
            self._jobs.write(job.dumps().encode() + b"\n")
            self._jobs.flush()

    def close(self) -> None:
        """Let it end."""
        with contextlib.suppress(BrokenPipeError):
            self._jobs.close()
        self.answers.close()
        self._process.wait()

    def kill(self) -> None:
        """End it now: its runs can be resumed."""
        self._process.send_signal(signal.SIGKILL)
        self.close()
