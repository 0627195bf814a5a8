"""Jobs side by side, each a run of train.py in a worker process, on CPU cores or on the GPUs named; complete ones are skipped."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait

from mosa.experiments import specification as spec
from mosa.experiments.commits import commit
from mosa.experiments.specification import COMMIT, FAILED, MINUTES, PRESSED, Job
from mosa.experiments.workers import Worker
from mosa.system.whole_files import write_whole
from mosa.training.jobs import held_back

PROGRAM = "mosa.cli.train:main"
WAIT = 0.2  # seconds between looks at what the running jobs have made


def words_of(job: Job) -> list[str]:
    """Of a run with the job's overrides in its folder, which goes on from a checkpoint that it finds there."""
    folder = str(job.folder.resolve()).replace("'", "\\'")
    return [*job.overrides, "resume=auto", f"hydra.run.dir='{folder}'"]


def run_jobs(
    jobs: Sequence[Job], devices: Sequence[int | None], side_by_side: int
) -> dict[str, str]:
    """Run the jobs that are not complete; {folder: reason} of those that failed. devices: GPUs, [None] for the CPU.

    Of jobs that share their films, or a reconstruction, the first runs without the others until these are made; the others find
    them in the cache."""
    waiting = spec.in_turn([job for job in jobs if not job.finished], devices)
    # what earlier commands made is found in the cache, or made again where that is another machine
    known: set[str] = set()
    free = {d: [Worker(environment(d)) for _ in range(side_by_side)] for d in devices}
    running: dict[Future[int], tuple[Job, int | None, list[Worker], float]] = {}
    failed: dict[str, str] = {}
    done, total = 0, len(waiting)

    def next_job() -> Job | None:
        """The first that shares nothing with what a running job is making."""
        making = {what for job, *_ in running.values() for what in in_making(job)} - known
        return next((job for job in waiting if not {job.film, job.first} & making), None)

    def time_left() -> str:
        """By the complete jobs: the experiments' files know neither overrides nor this machine."""
        kind, now = spec.device_kind(devices), time.perf_counter()
        if (rate := spec.pace(jobs, kind)) is None or not (waiting or running):
            return ""
        begun = [(job, (now - began) / 60) for job, *_, began in running.values()]
        whole = [(job, 0.0) for job in waiting]
        left = [max(0.0, rate * job.minutes[kind] - gone) for job, gone in [*begun, *whole]]
        return f", about {spec.minutes_left(left, len(devices) * side_by_side):.1f} min left"

    try:
        while waiting or running:
            while (job := next_job()) is not None:
                device = max(devices, key=lambda d: len(free[d]))  # the one with the fewest jobs
                count = side_by_side if job.alone else 1
                if len(free[device]) < count:
                    break
                waiting.remove(job)
                # the worker that ended a job last has the libraries imported
                places = [free[device].pop() for _ in range(count)]
                with held_back():  # a stop that falls in here ends this job too
                    running[begin(job, places[0])] = (job, device, places, time.perf_counter())
            for future in wait(running, WAIT, FIRST_COMPLETED).done:
                job, device, places, began = running.pop(future)
                known |= {job.film, job.first} - in_making(job)
                minutes = (time.perf_counter() - began) / 60
                done += 1
                killed = future.exception() is not None
                if job_failed := killed or future.result() != 0 or not job.finished:
                    places[0].end()  # a GPU that has raised an error answers no further job
                    failed[job.folder.name] = reason(job, future)
                    write_whole(job.folder / FAILED, failed[job.folder.name] + "\n")
                else:
                    write_whole(job.folder / MINUTES, f"{minutes:.3f}\n")
                free[device] += reversed(places)
                outcome = "failed" if job_failed else "complete"
                said = f"{outcome} after {minutes:.1f} min{time_left()}"
                print(f"[{done}/{total}] {job.folder.name}: {said}", flush=True)
    finally:
        at_work = [places[0] for _, _, places, _ in running.values()]
        for worker in at_work:  # Ctrl-C: each job writes its checkpoint and ends
            worker.stop()
        try:
            wait(running)
        except KeyboardInterrupt:  # a second one: at once
            for worker in at_work:
                worker.end(at_once=True)
            raise
        for worker in [*at_work, *(worker for each in free.values() for worker in each)]:
            worker.end()
    return failed


def environment(device: int | None) -> dict[str, str]:
    """Variables of a worker: of the GPUs that this process sees, the one of that number."""
    if device is None:
        return {}
    listed = [part for part in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if part]
    return {"CUDA_VISIBLE_DEVICES": listed[device] if device < len(listed) else str(device)}


def begin(job: Job, worker: Worker) -> Future[int]:
    job.folder.mkdir(parents=True, exist_ok=True)
    for name in (FAILED, PRESSED):  # of the run that was here before
        (job.folder / name).unlink(missing_ok=True)
    write_whole(job.folder / COMMIT, commit() + "\n")
    return worker.begin(PROGRAM, words_of(job), job.folder / "screen.log")


def in_making(job: Job) -> set[str]:
    """What a running job shares with others and does not have yet: its films, its reconstruction."""
    said = (job.folder / "screen.log").read_text(errors="replace")
    stages = {"data": job.film, "reconstruction": job.first}
    return {what for stage, what in stages.items() if f"{stage} took" not in said}


def reason(job: Job, future: Future[int]) -> str:
    """Why a job failed: the last line of its output with an error, else how its process ended."""
    lines = (job.folder / "screen.log").read_text(errors="replace").splitlines()
    if said := [line.strip() for line in lines if "Error" in line or "Diverged" in line]:
        return said[-1][:300]
    if future.exception() is not None:
        ended = "its process was killed, which the system does where memory runs out"
    else:
        ended = f"exit code {future.result()}"
    return f"{ended}; see {job.folder / 'screen.log'}"
