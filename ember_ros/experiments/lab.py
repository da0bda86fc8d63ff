"""Runs the trials of experiments: each once, those that others start from first, two at a time.

What was run before is not run again, so an experiment that was stopped goes on where it was.
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
"""So that two workers do not fight over two cores."""
SAFE_PATH = {"PYTHONSAFEPATH": "1"}
"""So that they begin with no module of the working directory; from Python 3.11 on."""

_stopped: Event | None = None


def _begin(stopped: Event) -> None:
    """Make a process a worker: it stops when it is told, and ends when its parent is gone."""
    global _stopped
    _stopped = stopped
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)  # what waits for a queue of a dead parent waits for ever


def go_on() -> bool:
    """Return whether a worker is to go on: to be asked at every cycle."""
    return _stopped is None or not _stopped.is_set()


def _job(trial: Trial, folder: Path) -> bool:
    return run_trial(trial, folder, go_on)


def _nothing() -> None:
    """Have a worker begun."""


@contextmanager
def _deaf() -> Iterator[None]:
    """Begin processes that do not hear the terminal.

    Its Ctrl-C and its end go to them too, and it is the parent that tells what that means.
    """
    signals = {signal.SIGINT, signal.SIGHUP}
    signal.pthread_sigmask(signal.SIG_BLOCK, signals)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, signals)


@contextmanager
def workers() -> Iterator[tuple[concurrent.futures.Executor, Event]]:
    """Start the processes that experiments run in, and an event that tells them to stop."""
    context = multiprocessing.get_context("spawn")
    before = {name: os.environ.get(name) for name in (*ONE_THREAD, *SAFE_PATH)}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1") | SAFE_PATH)
    try:
        with _deaf():
            stop = context.Event()  # begins a process too
        with concurrent.futures.ProcessPoolExecutor(
            WORKERS, mp_context=context, initializer=_begin, initargs=(stop,)
        ) as pool:
            with _deaf():
                for _ in range(WORKERS):
                    pool.submit(_nothing)
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


def in_order(trials: Iterable[Trial]) -> list[Trial]:
    """Return all trials and what they start from, each once, starts first."""
    order: dict[str, Trial] = {}

    def add(trial: Trial) -> None:
        if trial.start is not None:
            add(trial.start)
        order.setdefault(trial.key, trial)

    for trial in trials:
        add(trial)
    return list(order.values())


def cost(trial: Trial) -> int:
    """Return about how long a trial takes: walkers have four legs to look after."""
    return trial.cycles * (3 if trial.world == "walker" else 1)


def run_all(trials: Iterable[Trial], folder: Path, say: Callable[[int, int], bool]) -> bool:
    """Run all trials that were not run before.

    Args:
        trials: what is needed; what they start from is run too.
        folder: of all trials.
        say: told now and then how much is done of how much, in ``cost``; returns whether to go on.

    Returns:
        Whether all were run.
    """
    order = in_order(trials)
    ready = {trial.key for trial in order if is_done(trial, folder)}
    waiting = [trial for trial in order if trial.key not in ready]
    total = sum(map(cost, order))
    spent = total - sum(map(cost, waiting))
    if not waiting:
        return say(spent, total)
    running: dict[concurrent.futures.Future[Any], Trial] = {}
    with workers() as (pool, stop):
        while waiting or running:
            for trial in list(waiting):
                if len(running) >= WORKERS:
                    break
                if trial.start is None or trial.start.key in ready:
                    running[pool.submit(_job, trial, folder)] = trial
                    waiting.remove(trial)
            ended, _ = concurrent.futures.wait(running, 0.5, concurrent.futures.FIRST_COMPLETED)
            for future in ended:
                trial = running.pop(future)
                try:
                    whole = future.result()
                except concurrent.futures.process.BrokenProcessPool as error:
                    raise EmberError(
                        f"a worker process died in trial {trial.key} ({trial.world}, seed "
                        f"{trial.seed}); start again: what was run is not run again"
                    ) from error
                if whole:
                    ready.add(trial.key)
                    spent += cost(trial)
            if not say(spent, total):
                stop.set()
                waiting.clear()
    return len(ready) == len(order)


def each_seed(
    job: Callable[[int], dict[str, Any]], seeds: int, say: Callable[[int, int], bool]
) -> list[dict[str, Any]]:
    """Run a job for the seeds from 0 on, and return what came of each, in order of seed.

    Args:
        job: a function of a module, or a ``functools.partial`` of one; it asks ``go_on``, and what
            it returns after a no is left out.
        seeds: how many.
        say: told now and then how many seeds are done of how many; returns whether to go on.
    """
    with workers() as (pool, stop):
        jobs = [pool.submit(job, seed) for seed in range(seeds)]
        whole: set[concurrent.futures.Future[dict[str, Any]]] = set()
        while len(whole) < seeds and not any(job.exception() for job in whole):
            whole, _ = concurrent.futures.wait(jobs, 0.5)
            if not say(len(whole), seeds):
                stop.set()
                pool.shutdown(cancel_futures=True)
                break
        return [job.result() for job in jobs if job in whole]
