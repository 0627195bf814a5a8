"""Time of one step of Adam in each stage of the fit, by part, and beside another version of the program in one run.

    OMP_NUM_THREADS=1 python benchmarks/fit.py [--device cpu|cuda] [--repeats 5] [KEY=VALUE ...]
    OMP_NUM_THREADS=1 python benchmarks/fit.py --against COMMIT [--rounds 2] [KEY=VALUE ...]
    python benchmarks/fit.py --device cuda --kernels 20 KEY=VALUE ...       also the kernels of a joint step that take longest

KEY=VALUE: as train.py takes them; scene=rabbit prior=corotated where not given. The scene, its reconstruction and the starts are
made (or found in the cache) first. A step sees all frames of the training sequence, as the later ones of a stage do. Parts: the
rollout; images and all loss terms; backward through both; update (norms, clipping, Adam). Median (least to most) of the repeats:
CPU time on one thread, on CUDA wall time between synchronisations. The first step of a stage compiles kernels and is not counted.

--against: a commit of this repository, or a folder that holds another checkout; its program is measured by this file in processes
of its own, in turns with this one's.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

HERE = Path(__file__).resolve()
ROOT = HERE.parent.parent
DEFAULTS = ["scene=rabbit", "prior=corotated"]
PARTS = ("rollout", "images", "backward", "update")
Figures = dict[str, dict[str, list[float]]]
"""Seconds by stage and part."""


def assembled(overrides: list[str], device: str):
    """(module that Lightning would fit, cameras of a step), by the program's own functions."""
    import lightning
    from hydra import compose, initialize_config_dir

    from mosa.config.build import plain
    from mosa.training.datamodule import SceneDataModule
    from mosa.training.lit_mosa import LitMosa

    with initialize_config_dir(str(Path.cwd() / "conf"), version_base="1.3"):
        cfg = compose("train", overrides=overrides)
    lightning.seed_everything(cfg.seed, verbose=False)
    module = LitMosa(plain(cfg))
    module.attach(SceneDataModule(cfg, device=device, held_out=False))
    return module, list(range(min(cfg.fit.views, len(module.takes[0].observations.cameras))))


class Steps:
    """Timed steps of one module."""

    def __init__(self, module, views: list[int], device: str) -> None:
        self.module, self.views, self.device = module, views, device
        self.rollout = 0.0
        simulate = module.body.simulate

        def timed(*args, **kwargs):
            began = self.clock()
            result = simulate(*args, **kwargs)
            self.rollout += self.clock() - began
            self.substeps = result.substeps
            return result

        module.body.simulate = timed

    def clock(self) -> float:
        if self.device == "cpu":
            return time.process_time()
        import torch

        torch.cuda.synchronize()
        return time.perf_counter()

    def begin(self, index: int) -> None:
        module = self.module
        module.stage_index, stage = index, module.stages[index]
        module.begin(stage)
        self.optimizer = (
            module.adam(stage)["optimizer"]
            if hasattr(module, "adam")
            else module.configure_optimizers()[index]
        )

    def step(self, index: int) -> dict[str, float]:
        module, optimizer = self.module, self.optimizer
        stage, take = module.stages[index], module.takes[0]
        here = hasattr(module, "adam")  # else a version of before the data module served the views
        self.rollout, times = 0.0, [self.clock()]
        optimizer.zero_grad()
        seen = take.observations.select(self.views) if here else None
        own = SimpleNamespace(observations=seen, views=self.views, extra={}) if here else self.views
        terms, _ = module.terms(stage, own, len(take.cues.positions), take)
        loss = sum(module.weights.get(name, 0.0) * value for name, value in terms.items())
        times.append(self.clock())
        loss.backward()
        times.append(self.clock())
        _ = module.clip_networks(optimizer) if here else module.gradient_norms(optimizer, stage, 0)
        optimizer.step()
        module.body.contact.project()
        times.append(self.clock())
        forward, backward, update = (b - a for a, b in pairwise(times))
        return dict(
            zip(PARTS, (self.rollout, forward - self.rollout, backward, update), strict=True)
        )


def measure(
    overrides: list[str], device: str, repeats: int, kernels: int = 0
) -> tuple[Figures, str]:
    """(seconds of the repeats, one line on what was measured) of the program that is imported as `mosa`."""
    import torch

    torch.set_num_threads(1)
    module, views = assembled(overrides, device)
    steps, figures = Steps(module, views, device), {}
    for index, stage in enumerate(module.stages):
        steps.begin(index)
        steps.step(index)
        made = [steps.step(index) for _ in range(repeats)]
        figures[stage.name] = {part: [each[part] for each in made] for part in PARTS}
    body = module.body
    frames = len(module.takes[0].cues.positions)
    about = f"{len(body.rest)} particles, {frames} frames, {steps.substeps} substeps each, {len(views)} views"
    if kernels:
        print_kernels(steps, len(module.stages) - 1, kernels)
    return figures, about


def print_kernels(steps: Steps, index: int, count: int) -> None:
    """The kernels of one step that take longest, as CUDA tells."""
    from torch.profiler import ProfilerActivity, profile

    with profile(activities=[ProfilerActivity.CUDA]) as found:
        steps.step(index)
        steps.clock()
    kernels: dict[str, list[float]] = {}
    for event in found.events():
        if event.device_type.name == "CUDA":
            kernels.setdefault(event.name, []).append(event.device_time / 1e3)
    total = sum(map(sum, kernels.values()))
    print(
        f"\nkernels of a {steps.module.stages[index].name} step: {total:.1f} ms in {sum(map(len, kernels.values()))} launches"
    )
    print("| ms | launches | kernel |\n|---|---|---|")
    for name, each in sorted(kernels.items(), key=lambda item: -sum(item[1]))[:count]:
        print(f"| {sum(each):.2f} | {len(each)} | {name[:80]} |")


@contextmanager
def checkout(which: str):
    """The folder `which`, or a temporary working tree of the commit of that name."""
    if Path(which, "train.py").is_file():
        yield Path(which).resolve()
        return
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder, "tree")
        git = ["git", "-C", str(ROOT), "worktree"]
        added = subprocess.run(
            [*git, "add", "--detach", str(tree), which], capture_output=True, text=True
        )
        if added.returncode:
            raise SystemExit(
                f"--against: expected a folder with train.py or a commit, found {which!r} ({added.stderr.strip()})"
            )
        try:
            yield tree
        finally:
            subprocess.run([*git, "remove", "--force", str(tree)], check=False)


def measured_in(folder: Path, options: argparse.Namespace) -> tuple[Figures, str]:
    """`measure` of the program in `folder`, in a process of its own."""
    with tempfile.TemporaryDirectory() as place:
        out = Path(place, "figures.json")
        command = [
            sys.executable,
            str(HERE),
            "--write",
            str(out),
            "--device",
            options.device,
            "--repeats",
            str(options.repeats),
        ]
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")]),
        }
        result = subprocess.run([*command, *options.overrides], cwd=folder, env=environment)
        if result.returncode:
            raise SystemExit(
                f"the program in {folder} could not be measured (exit code {result.returncode})"
            )
        return tuple(json.loads(out.read_text()))


def merged(parts: list[Figures]) -> Figures:
    return {
        stage: {part: [s for each in parts for s in each[stage][part]] for part in PARTS}
        for stage in parts[0]
    }


def print_table(named: dict[str, Figures], device: str) -> None:
    unit = "CPU-seconds" if device == "cpu" else "seconds"
    print(
        f"\n{unit} per step, median (least to most)\n| stage | program | step | {' | '.join(PARTS)} |"
    )
    print("|---|---|---|" + "---|" * len(PARTS))
    for stage in next(iter(named.values())):
        for name, figures in named.items():
            parts = figures[stage]
            whole = [sum(each) for each in zip(*parts.values(), strict=True)]
            medians = " | ".join(f"{statistics.median(parts[part]):.3f}" for part in PARTS)
            print(
                f"| {stage} | {name} | {statistics.median(whole):.3f} ({min(whole):.3f} to {max(whole):.3f}) | {medians} |"
            )


def versions(device: str) -> str:
    import torch
    import warp

    what = (
        torch.cuda.get_device_name()
        if device == "cuda"
        else platform.processor() or platform.machine()
    )
    return f"{what}, torch {torch.__version__}, warp {warp.__version__}"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--repeats", type=int, default=5, help="steps of each stage, in each round")
    parser.add_argument(
        "--against",
        metavar="COMMIT|FOLDER",
        help="another version, measured in turns with this one",
    )
    parser.add_argument("--rounds", type=int, default=2, help="turns of each version")
    parser.add_argument("--kernels", type=int, default=0, help="CUDA kernels to list")
    parser.add_argument("--write", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    options.overrides = [
        *(
            d
            for d in DEFAULTS
            if not any(o.startswith(d.split("=")[0] + "=") for o in options.overrides)
        ),
        *options.overrides,
    ]
    if options.write is not None:
        options.write.write_text(
            json.dumps(measure(options.overrides, options.device, options.repeats))
        )
        return
    os.chdir(ROOT)
    sys.path.insert(0, str(ROOT))
    if options.device == "cuda":
        import torch

        if not torch.cuda.is_available():
            raise SystemExit("--device cuda: torch finds no CUDA device; --device cpu runs without")
    print(f"{versions(options.device)}\n{' '.join(options.overrides)}, {options.repeats} repeats")
    if options.against is None:
        figures, about = measure(
            options.overrides, options.device, options.repeats, options.kernels
        )
        print(about)
        print_table({"this one": figures}, options.device)
        return
    with checkout(options.against) as other:
        rounds = {"this one": [], options.against: []}
        for _ in range(options.rounds):
            for name, folder in (("this one", ROOT), (options.against, other)):
                figures, about = measured_in(folder, options)
                rounds[name].append(figures)
                print(f"{name}: {about}", flush=True)
    print_table({name: merged(parts) for name, parts in rounds.items()}, options.device)


if __name__ == "__main__":
    main()
