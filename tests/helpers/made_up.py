"""An experiment that no run is made for: three methods, two scenes, figures of one's own."""

import json
from dataclasses import replace
from pathlib import Path

from mosa.experiments.specification import (
    SPECIFICATIONS,
    Experiment,
    Figure,
    Option,
    experiment_names,
    jobs_of,
)

CONF = Path(__file__).parents[2] / "conf"
PAPER = SPECIFICATIONS
NAMES = experiment_names(PAPER)


def experiment(**changes) -> Experiment:
    """Three rows, of which two read the same runs, by two scenes and two seeds."""
    axes = {
        "method": (Option("prior", ("adapter=operator",), "prior/"), Option("box", ("adapter=direct",), cost=2.0),
                   Option("ours", ("adapter=operator",))),
        "scene": (Option("a", ("scene=a",)), Option("b", ("scene=b",))),
    }  # fmt: skip
    figures = (
        Figure("PSNR", "test/psnr_crop", best="most"),
        Figure("rms [mm]", "test/rms_m", 1e3, 1, "least"),
    )
    made = Experiment(
        "made",
        "Made up",
        axes,
        "method",
        "scene",
        figures,
        seeds=(0, 1),
        minutes={"cpu": 3.0, "gpu": 1.0},
    )
    return replace(made, **changes)


def write_metrics(job, rms=0.010, prior=0.020, **more) -> None:
    job.folder.mkdir(parents=True, exist_ok=True)
    figures = {"test/rms_m": rms, "prior/test/rms_m": prior, "test/psnr_crop": 30.0 - 100 * rms, "prior/test/psnr_crop": 25.0,
               "time/fit_s": 60.0, "time/data_s": 60.0, "time/device": "a machine", **more}  # fmt: skip
    (job.folder / "metrics.json").write_text(json.dumps(figures))


def made_up(tmp_path) -> tuple[Experiment, list]:
    found = experiment()
    jobs = jobs_of(found, tmp_path)
    for job in jobs:
        scene = job.places[0]["scene"].name
        if job.places[0]["method"].name == "box" and scene == "b":
            continue  # it failed
        write_metrics(job, rms=(0.010 if scene == "a" else 0.030) + 0.002 * job.seed, prior=0.020)
    return found, jobs
