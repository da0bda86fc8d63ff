"""Run the trials of experiments in two worker processes; a trial whose results exist is skipped.

An experiment that was stopped can therefore be continued. Trials that others start from run first.
"""

from __future__ import annotations

import concurrent.futures
import concurrent.futures.process
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

from ember_ros.errors import EmberError
from ember_ros.experiments.trial import Trial, is_done, run_trial

WORKERS = 2
ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
"""Variables that limit numerical libraries to one thread, since every worker uses one core."""
SAFE_PATH = {"PYTHONSAFEPATH": "1"}
"""Setting with which workers import no module from the working directory; from Python 3.11 on."""

_stopped: Event | None = None


def _initialize_worker(stopped: Event) -> None:
    """Prepare a worker process: it stops when ``stopped`` is set and ends when its parent ends."""
    global _stopped
    _stopped = stopped
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Wait for the end of the parent process, then end this process."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)  # the main thread would wait for the parent's queue forever


def go_on() -> bool:
    """Return whether a worker may continue its job; to be called in every cycle."""
    return _stopped is None or not _stopped.is_set()


def _run_job(trial: Trial, folder: Path) -> bool:
    """Run one trial in a worker; return whether it was completed."""
    return run_trial(trial, folder, go_on)


def _empty_job() -> None:
    """Do nothing; the pool starts a worker for it."""


@contextmanager
def _signals_blocked() -> Iterator[None]:
    """Block SIGINT and SIGHUP in the processes that are started within this context.

    The terminal sends these signals to all processes. Only the parent handles them, and then stops
    the workers.
    """
    signals = {signal.SIGINT, signal.SIGHUP}
    signal.pthread_sigmask(signal.SIG_BLOCK, signals)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, signals)


@contextmanager
def workers() -> Iterator[tuple[concurrent.futures.Executor, Event]]:
    """Start the worker processes; yield their pool and an event that stops them when it is set."""
    context = multiprocessing.get_context("spawn")
    before = {name: os.environ.get(name) for name in (*ONE_THREAD, *SAFE_PATH)}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1") | SAFE_PATH)
    try:
        with _signals_blocked():
            stop = context.Event()  # starts a process, too
        with concurrent.futures.ProcessPoolExecutor(
            WORKERS, mp_context=context, initializer=_initialize_worker, initargs=(stop,)
        ) as pool:
            with _signals_blocked():
                for _ in range(WORKERS):
                    pool.submit(_empty_job)
            try:
                yield pool, stop
            except BaseException:
                stop.set()
                pool.shutdown(cancel_futures=True)
                raise
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def in_dependency_order(trials: Iterable[Trial]) -> list[Trial]:
    """Return all trials and the trials that they start from, each once, after its start."""
    order: dict[str, Trial] = {}

    def add(trial: Trial) -> None:
        if trial.start is not None:
            add(trial.start)
        order.setdefault(trial.key, trial)

    for trial in trials:
        add(trial)
    return list(order.values())


def cost(trial: Trial) -> int:
    """Return the approximate cost of a trial; a cycle of a walker costs 3, of a trainer 1."""
    return trial.cycles * (3 if trial.world == "walker" else 1)


def run_all(
    trials: Iterable[Trial], folder: Path, report_progress: Callable[[int, int], bool]
) -> bool:
    """Run all trials whose results do not exist yet.

    Args:
        trials: the trials; those that they start from are run, too.
        folder: folder of all trials.
        report_progress: is called regularly with the completed and the total ``cost``; the run
            stops if it returns False.

    Returns:
        Whether the results of all trials exist now.

    Raises:
        EmberError: a worker process died.
    """
    order = in_dependency_order(trials)
    completed = {trial.key for trial in order if is_done(trial, folder)}
    waiting = [trial for trial in order if trial.key not in completed]
    total = sum(map(cost, order))
    cost_done = total - sum(map(cost, waiting))
    if not waiting:
        return report_progress(cost_done, total)
    running: dict[concurrent.futures.Future[Any], Trial] = {}
    with workers() as (pool, stop):
        while waiting or running:
            for trial in list(waiting):
                if len(running) >= WORKERS:
                    break
                if trial.start is None or trial.start.key in completed:
                    running[pool.submit(_run_job, trial, folder)] = trial
                    waiting.remove(trial)
            finished, _ = concurrent.futures.wait(running, 0.5, concurrent.futures.FIRST_COMPLETED)
            for future in finished:
                trial = running.pop(future)
                try:
                    done = future.result()
                except concurrent.futures.process.BrokenProcessPool as error:
                    raise EmberError(
                        f"a worker process died in trial {trial.key} ({trial.world}, seed "
                        f"{trial.seed}); start the command again: completed trials are not repeated"
                    ) from error
                if done:
                    completed.add(trial.key)
                    cost_done += cost(trial)
            if not report_progress(cost_done, total):
                stop.set()
                waiting.clear()
    return len(completed) == len(order)


def run_seeds(
    job: Callable[[int], dict[str, Any]], seeds: int, report_progress: Callable[[int, int], bool]
) -> list[dict[str, Any]]:
    """Run a job for each seed from 0 on.

    Args:
        job: a function of a module, or a ``functools.partial`` of one. It gets the seed and stops
            when ``go_on`` returns False; what it then returns is ignored.
        seeds: number of seeds.
        report_progress: is called regularly with the number of completed seeds and of all seeds;
            the run stops if it returns False.

    Returns:
        The results of the completed seeds, in the order of the seeds.
    """
    with workers() as (pool, stop):
        jobs = [pool.submit(job, seed) for seed in range(seeds)]
        done: set[concurrent.futures.Future[dict[str, Any]]] = set()
        while len(done) < seeds and not any(job.exception() for job in done):
            done, _ = concurrent.futures.wait(jobs, 0.5)
            if not report_progress(len(done), seeds):
                stop.set()
                pool.shutdown(cancel_futures=True)
                break
        return [job.result() for job in jobs if job in done]
