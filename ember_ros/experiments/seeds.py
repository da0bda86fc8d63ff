"""Runs one job a seed, two processes at once."""

from __future__ import annotations

import concurrent.futures
import multiprocessing
from collections.abc import Callable
from typing import Any

from ember_ros.report.recorder import Record

TILT_RAD, LOW_M = 0.3, 0.36
"""A cycle with more tilt or lower hips than this is counted as outside, fall or no fall."""
WORKERS = 2


def each_seed(
    job: Callable[[int], dict[str, Any]], seeds: int, say: Callable[[int, int], bool]
) -> list[dict[str, Any]]:
    """Run a job for the seeds from 0 on, and return what came of each, in order of seed.

    Args:
        job: a function of a module, or a ``functools.partial`` of one.
        seeds: how many.
        say: told how many seeds are done; returns whether to go on.
    """
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(WORKERS, mp_context=context) as pool:
        jobs = [pool.submit(job, seed) for seed in range(seeds)]
        for done, _ in enumerate(concurrent.futures.as_completed(jobs), 1):
            if not say(done, 0):
                pool.shutdown(cancel_futures=True)
                break
        return [job.result() for job in jobs if job.done() and not job.cancelled()]


def outside(record: Record) -> float:
    """Return the share of cycles with too much tilt or hips too low."""
    rows = record.body_rows()
    bad = sum((r.tilt_max_rad or 0) > TILT_RAD or (r.height_min_m or 0) < LOW_M for r in rows)
    return bad / len(rows)
