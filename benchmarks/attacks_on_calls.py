"""Attacks by what a user says: overrides, colliders, calls of a twin, whole processes."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from attacks import ROOT, Attack, composed, cube, put, refuse

from mosa.config.build import build_world, rehearse


def configured(config: dict):
    """What a run checks of its configuration before anything else."""
    rehearse(config)


def overrides(_: Path) -> Iterator[Attack]:
    wrong = {
        "+": ["foo=1", "world.foo=1", "simulation.foo=1", "fit.foo=1", "rendering.foo=1", "trainer.max_epochs=1", "adapter.alfa=1",
              "logger._target_=nonsense", "evaluation.foo=1", "prior.parameters.mu=5", "prior.foo=1", "reconstruction.foo=1",
              "fit.joint.foo=1", "heterogeneity.foo=1", "losses.colour=1", "prior.options.foo=1"],
        "": [f"{key}={value}" for key in ("seed", "fit.views", "fit.prior.iterations", "fit.prior.lr", "simulation.particles",
                                          "simulation.stride", "simulation.courant", "adapter.strain", "heterogeneity.amplitude",
                                          "reconstruction.resolution", "reconstruction.points", "losses.image",
                                          "prior.parameters.E",
                                          "rendering.margin", "evaluation.samples", "logger.images_every")
             for value in ("-1", "abc", ".nan", ".inf", "true", "[1]", "null")]
            + [f"{key}=5" for key in ("fit.prior", "reconstruction.static", "prior.law", "adapter.name", "world.walls",
                                      "scene.cache",
                                      "world.colliders", "prior.parameters", "ckpt_path", "rendering.backend", "losses")]
            + ["optimized_metric=nope", "world.walls={}", "simulation.stride=1000000", "reconstruction.resolution=100000",
               "simulation.precision=16", "+adapter.alpha=1", "prior.law=jelly", "fit.joint.start=foo"]
            + [f"{key}={value}" for key in ("seed", "simulation.particles", "prior.parameters.E")
               for value in ("0x10", "1e400", "05", "0o17", "0b11", "1:30", "2026-11-23", "no", "off", "''", "5%", "5mm", "1/2",
                             "{a:5}", "1d3", "1e3f", "1__0")]
            + ["reconstruction.neighbours=1", "reconstruction.neighbours=100000", "reconstruction.margin=1000000",
               "reconstruction.ridge_passes=1000000000", "rendering.margin=100000", "heterogeneity.wavelength=1e-9",
               "heterogeneity.amplitude=1.0", "heterogeneity.most=0", "identification.threads=-1",
               "reconstruction.carried.degree=4",
               "reconstruction.static.max_points=5", "prior.parameters.nu=0.5000001", "simulation.courant=1.5",
               "world.walls=separate"],
    }  # fmt: skip
    for plus, each in wrong.items():
        for override in each:
            yield plus + override, lambda o=plus + override: configured(composed(o))
    for key in (
        "seed",
        "fit",
        "world",
        "simulation.stride",
        "fit.views",
        "scene",
        "losses",
        "trainer",
        "evaluation",
    ):
        yield f"~{key}", lambda k=key: configured(put(composed(), k, ...))


def colliders(_: Path) -> Iterator[Attack]:
    body = cube()
    ball = {"type": "sphere", "radius": 0.05, "position": [0, -0.3, 0]}
    for key, values in {
        "radius": [0, -1, math.inf, math.nan, True, "a", [1], 1e300], "thickness": [0.02, "a"],
        "friction": [math.inf, -1, "a", 0.5], "mode": ["bouncy", ["slip"], 5], "type": ["cone", ["sphere"], None, 5],
        "position": [[0, 0], "abc", [0, True, 0], [0, math.nan, 0], 5],
        "rotation": [[0, 0, 0, 1], [1, 0, 0], "abc", [math.nan] * 4],
        "motion": [5, {"velocity": "abc"}, {"velocity": [1, 2]}, {"speed": 1}, {"waypoints": []}, {"waypoints": [5, 6]},
                   {"velocity": [math.inf, 0, 0]}, {"velocity": [1, 0, 0], "times": [1, 0]}, {"waypoints": [{"time": 0}] * 2}],
        "size": [1], "name": [5], "path": ["x"],
    }.items():  # fmt: skip
        for value in values:
            yield (
                f"{key}={value}",
                lambda k=key, v=value: body.simulate(frames=2, colliders=[ball | {k: v}]),
            )
    for item in (
        {"type": "box", "size": [1, 1]},
        {"type": "box", "size": [9, 9, 9]},
        {"type": "sphere", "radius": 5},
        5,
        "ball",
        {"type": "plane", "normal": [0, 1, 0], "position": [0, 9, 0]},
        {"type": "mesh", "path": "none.obj"},
    ):
        yield f"{item}", lambda i=item: body.simulate(frames=2, colliders=[i])
    for walls in (
        {},
        {"friction": math.inf, "mode": "separate"},
        {"mode": 5},
        {"foo": 1},
        {"friction": True},
    ):
        yield (
            f"walls {walls}",
            lambda w=walls: build_world(
                {
                    "ground": None,
                    "gravity": [0, -9.8, 0],
                    "up": [0, 1, 0],
                    "box": [[-1] * 3, [1] * 3],
                    "walls": w,
                }
            ),
        )


def calls(_: Path) -> Iterator[Attack]:
    for key, values in {
        "rotation": [np.diag([1.2, 1, 0.8]).tolist(), np.diag([1.0, 1, -1]).tolist(), [0, 0, 0, 1], "abc", [1, 2],
                     [math.nan] * 4, 5],
        "height": ["a", math.nan, math.inf, -1, True, [1]],
        "velocity": ["abc", [1, 2], [math.inf, 0, 0], [True] * 3, {}, 5, [1e30] * 3],
        "angular_velocity": ["abc", [1, 2], [math.nan, 0, 0], 5], "frames": [2.5, 0, -1, True, "3", 10**12, None, math.nan],
        "variant": ["none", 5, ["prior"], None], "colliders": ["ball", 5, {"type": "sphere"}],
    }.items():  # fmt: skip
        for value in values:
            yield f"{key}={value}", lambda k=key, v=value: cube().simulate(**{"frames": 2, k: v})


def runs(folder: Path) -> Iterator[Attack]:
    """Whole processes: an exit code of 2 with one message counts as one."""

    def train(*arguments: str, code: int = 2):
        flags = [argument for argument in arguments if argument.startswith("-")]
        keys = [
            f"hydra.run.dir={folder}/run",
            "debug=default",
            *(argument for argument in arguments if argument not in flags),
        ]
        found = subprocess.run(
            [sys.executable, "train.py", *flags, *keys], cwd=ROOT, capture_output=True, text=True
        )
        if found.returncode != code or "Traceback" in found.stderr:
            raise AssertionError(f"{found.returncode}: {found.stderr[-300:]}")
        refuse("one message")

    (folder / "text.ckpt").write_text("hello")
    for override in (
        "+foo=1",
        "adapter=null",
        "fit.prior=5",
        f"ckpt_path={folder}/text.ckpt",
        "simulation.dx=1e-6",
        "world.colliders=[{type: box, size: [9,9,9]}]",
        "simulation.particles=100000000",
    ):
        yield override, lambda o=override: train(o)
    yield (
        "a sweep of failures",
        lambda: train("-m", f"hydra.sweep.dir={folder}/sweep", "seed=-1,-2", code=1),
    )
