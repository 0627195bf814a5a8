"""Jobs side by side: a process of train.py each, on CPU cores or on the GPUs named; what is complete is not run again."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from multiprocessing.process import BaseProcess
from pathlib import Path

from mosa.experiments.commits import commit
from mosa.experiments.processes import begun
from mosa.experiments.specification import COMMIT, FAILED, MINUTES, PRESSED, Job, in_turn
from mosa.system.whole_files import write_whole
from mosa.training.jobs import held_back

PROGRAM = "mosa.cli.train:main"
WAIT = 0.2
"""Seconds between looks at the running jobs."""


def words_of(job: Job) -> list[str]:
    """Of a run with the job's overrides in its folder, which goes on from a checkpoint that it finds there."""
    folder = str(job.folder.resolve()).replace("'", "\\'")
    return [*job.overrides, "resume=auto", f"hydra.run.dir='{folder}'"]


def run_jobs(
    jobs: Sequence[Job],
    devices: Sequence[int | None],
    side_by_side: int,
    ended: Callable[[Job, bool], None] = lambda job, failed: None,
) -> dict[str, str]:
    """Run what is not complete; {folder: reason} of the jobs that failed. devices: GPUs, [None] for the CPU; ended: told of each
    job whether it failed.

    Of jobs that share their films, or a reconstruction, the first runs without the others until these are made, and they find them
    in the cache."""
    waiting = in_turn([job for job in jobs if not job.finished], devices)
    known: set[str] = (
        set()
    )  # what was made in earlier goes is found in the cache, or made again where that is another machine
    free = dict.fromkeys(devices, side_by_side)
    running: dict[BaseProcess, tuple[Job, int | None, float]] = {}
    failed: dict[str, str] = {}
    done, total = 0, len(waiting)
    try:
        while waiting or running:
            for process in [p for p in running if p.exitcode is not None]:
                job, device, began = running.pop(process)
                free[device] += side_by_side if job.alone else 1
                known |= {job.film, job.first} - in_making(job)
                done += 1
                if process.exitcode != 0 or not job.finished:
                    failed[job.folder.name] = reason(job, process.exitcode)
                    write_whole(job.folder / FAILED, failed[job.folder.name] + "\n")
                outcome = "failed" if job.folder.name in failed else "complete"
                minutes = (time.perf_counter() - began) / 60
                if outcome == "complete":
                    write_whole(job.folder / MINUTES, f"{minutes:.3f}\n")
                print(
                    f"[{done}/{total}] {job.folder.name}: {outcome} after {minutes:.1f} min",
                    flush=True,
                )
                ended(job, outcome == "failed")
            making = {what for job, _, _ in running.values() for what in in_making(job)} - known
            ready = next((job for job in waiting if not {job.film, job.first} & making), None)
            device = max(devices, key=free.get)  # of several the one with the fewest jobs
            places = side_by_side if ready is not None and ready.alone else 1
            if ready is not None and free[device] >= places:
                waiting.remove(ready)
                free[device] -= places
                with held_back():  # a stop that falls in here ends this job too
                    running[begin(ready, device)] = (ready, device, time.perf_counter())
            else:
                time.sleep(WAIT)
    finally:
        for process in running:  # Ctrl-C: each writes its checkpoint and ends
            process.terminate()
        try:
            for process in running:
                process.join()
        except KeyboardInterrupt:  # a second one: at once
            for process in running:
                process.kill()
            raise
    return failed


def begin(job: Job, device: int | None) -> BaseProcess:
    job.folder.mkdir(parents=True, exist_ok=True)
    for name in (FAILED, PRESSED):  # of the run that was here before
        (job.folder / name).unlink(missing_ok=True)
    write_whole(job.folder / COMMIT, commit() + "\n")
    environment = dict(os.environ)
    environment.setdefault("OMP_NUM_THREADS", "1")
    if device is not None:
        listed = [part for part in environment.get("CUDA_VISIBLE_DEVICES", "").split(",") if part]
        environment["CUDA_VISIBLE_DEVICES"] = (
            listed[device] if device < len(listed) else str(device)
        )
    return begun(PROGRAM, words_of(job), job.folder / "screen.log", environment)


def in_making(job: Job) -> set[str]:
    """What a running job shares with others and does not have yet: its films, its reconstruction."""
    said = (job.folder / "screen.log").read_text(errors="replace")
    return {
        what
        for what, stage in ((job.film, "data"), (job.first, "reconstruction"))
        if f"{stage} took" not in said
    }


def reason(job: Job, code: int) -> str:
    """The last line with a message of what a failed job had on the screen."""
    lines = (job.folder / "screen.log").read_text(errors="replace").splitlines()
    said = [line.strip() for line in lines if "Error" in line or "Diverged" in line]
    return said[-1][:300] if said else f"exit code {code}, see {Path(job.folder) / 'screen.log'}"
