"""A fit shared by two processes is the fit of one (check 24): sequences shared, views shared, resumed."""

import json
import os
import shutil
from pathlib import Path

import forked
import lightning as L
import pytest
import torch
from assembled import assembled

from mosa import parallel
from mosa.callbacks import AtomicCheckpointIO, KeepLast
from mosa.data.datamodule import MultiViewDataModule
from mosa.errors import ConfigError

ADAM = tuple(f"+fit.{stage}.optimizer=adam" for stage in ("prior", "prior_eta"))
"""Gauss-Newton, the default here, does the same work on every rank."""


class KeepFirst(L.Callback):
    def on_train_epoch_end(self, trainer, module) -> None:
        if module.steps_done == 1:
            shutil.copy(Path(trainer.default_root_dir) / "last.ckpt", Path(trainer.default_root_dir) / "first.ckpt")


def fit_alone(cache: Path, folder: Path, *overrides: str, taught=()) -> Path:
    """Folder of last.ckpt, and of first.ckpt: after one step."""
    cfg, _, module = assembled(cache, *overrides, taught=taught)
    data = MultiViewDataModule(module.takes[0].observations, views_per_step=cfg.fit.views,
                               steps=sum(s.iterations for s in module.stages), seed=cfg.seed)
    trainer = L.Trainer(accelerator="cpu", max_epochs=-1, logger=False, callbacks=[KeepLast(folder), KeepFirst()],
                        plugins=[AtomicCheckpointIO()], enable_checkpointing=False, enable_progress_bar=False,
                        enable_model_summary=False, reload_dataloaders_every_n_epochs=1, default_root_dir=folder)
    trainer.fit(module, datamodule=data)
    return folder


def learned(checkpoint: Path) -> torch.Tensor:
    """What the stages step, in one vector: logarithms, logits, stiffness modes, the operator's numbers, all of order 1."""
    state = torch.load(checkpoint, weights_only=True)["state_dict"]
    parts = ("body.material.raw.", "body.contact.", "body.heterogeneity.coefficients", "body.adapter.numbers")
    found = {part: [v.double().flatten() for k, v in state.items() if k.startswith(part)] for part in parts}
    assert all(found.values())
    return torch.cat([vector for each in found.values() for vector in each])


def largest(found: torch.Tensor, expected: torch.Tensor) -> float:
    """Largest difference of an entry, relative where the entry is above 1."""
    return float(((found - expected).abs() / expected.abs().clamp(min=1)).max())


def relative(found: torch.Tensor, expected: torch.Tensor) -> float:
    return float((found - expected).norm() / expected.norm())


@pytest.fixture
def ranks(monkeypatch):
    """Acts a rank of a fit, without its processes."""
    def act(rank: int, world: int) -> None:
        monkeypatch.setattr(parallel, "rank", lambda: rank)
        monkeypatch.setattr(parallel, "world_size", lambda: world)
    return act


@pytest.mark.parametrize("taught, world", [(["test_60"], 2), ([], 2), (["test_60"], 3)])
def test_the_shares_of_a_step_add_up_to_its_gradient(taught, world, cache, ranks):
    _, _, module = assembled(cache, taught=taught)
    module.manual_backward = lambda loss: loss.backward()
    stage, parameters = module.stages[0], [p for p in module.body.parameters() if p.requires_grad]

    def gradient() -> tuple[torch.Tensor, float]:
        module.zero_grad()
        loss = sum(weight * float(module.descend(stage, 0, module.takes[take], views, weight)["loss"])
                   for take, views, weight in parallel.share(len(module.takes), [0, 1, 2]))
        return torch.cat([torch.zeros_like(p).flatten() if p.grad is None else p.grad.flatten() for p in parameters]), loss

    whole, loss = gradient()
    parts = []
    for rank in range(world):
        ranks(rank, world)
        parts.append(gradient())
    assert relative(sum(g for g, _ in parts), whole) < 1e-6
    assert sum(part for _, part in parts) == pytest.approx(loss, rel=1e-6)
    assert all(relative(world * g, whole) > 1e-2 for g, _ in parts)  # no rank could do without the others


def test_every_view_of_every_sequence_is_rendered_once(ranks):
    for takes in range(1, 6):
        for world in range(1, 3 * takes + 1):
            seen, total = [], 0.0
            for rank in range(world):
                ranks(rank, world)
                for take, views, weight in parallel.share(takes, [4, 2, 7]):
                    assert views and weight > 0
                    seen, total = seen + [(take, view) for view in views], total + weight
            assert sorted(seen) == sorted((take, view) for take in range(takes) for view in (4, 2, 7))
            assert total == pytest.approx(1.0, rel=1e-12)


def test_two_processes_share_two_sequences_and_resume(cache, tmp_path):
    """From the first of five steps: Adam in two stages, in which each has a sequence, and Gauss-Newton in the last. That views are
    shared as sequences are is checked above."""
    alone = fit_alone(cache, tmp_path / "alone", *ADAM, taught=["test_60"])
    result = forked.call("train.py", "debug=default", f"hydra.run.dir={tmp_path}/run", f"scene.cache={cache}", "trainer=ddp",
                         "trainer.accelerator=cpu", "scene.also_train=[test_60]", *ADAM, f"ckpt_path={alone}/first.ckpt",
                         "evaluation.video=false", "evaluation.floor=false", "evaluation.samples=256",
                         "evaluation.assignment=64")  # fmt: skip
    assert result.returncode == 0, result.stdout[-3000:] + result.stderr[-3000:]
    found, expected = learned(tmp_path / "run/checkpoints/last.ckpt"), learned(alone / "last.ckpt")
    assert largest(found, expected) < 1e-6
    assert largest(learned(alone / "first.ckpt"), expected) > 1e-3  # what is resumed from
    single = learned(fit_alone(cache, tmp_path / "single", *ADAM) / "last.ckpt")  # what one rank would learn alone
    assert largest(single, expected) > 1e-3
    # the first process speaks for both
    assert result.stdout.count("run folder:") == result.stdout.count("fit: ") == 1 and result.stderr.count("fit joint:   0%") == 1
    # <host>.<process>.<number>: the first process alone writes, one file during the fit and one with the outcome
    assert len({f.name.rsplit(".", 2)[1] for f in (tmp_path / "run/tensorboard").rglob("events*")}) == 1
    assert "train/test_60/rms_m" in json.loads((tmp_path / "run/metrics.json").read_text())


def exchanging(rank: int, folder: str) -> None:
    """What a rank does in the test below."""
    torch.set_num_threads(1)
    store = torch.distributed.FileStore(f"{folder}/store", 2)
    torch.distributed.init_process_group("gloo", store=store, rank=rank, world_size=2)
    both, one, none = (torch.nn.Parameter(torch.zeros(2)) for _ in range(3))
    both.grad = torch.tensor([1.0, 10.0]) * (rank + 1)
    if rank == 1:
        one.grad = torch.tensor([5.0, 6.0])
    figures = parallel.exchange([both, one, none], {"b": torch.tensor(rank + 1.0), "a": torch.tensor(0.5)})
    said = []
    parallel.agree(None)
    try:
        parallel.agree(ConfigError("of rank 1") if rank == 1 else None)
    except ConfigError as error:
        said.append(str(error))
    torch.save([both.grad, one.grad, none.grad, figures, said, parallel.mean(float(rank))], f"{folder}/{rank}.pt")
    if rank == 1:
        os._exit(1)
    try:
        parallel.agree(None)
    except parallel.RankLost as error:
        Path(folder, "lost").write_text(str(error))
    parallel.disconnect()


def test_ranks_exchange_agree_and_notice_a_loss(tmp_path):
    context = torch.multiprocessing.get_context("spawn" if torch.cuda.is_initialized() else "fork")  # which imports nothing again
    processes = [context.Process(target=exchanging, args=(rank, str(tmp_path))) for rank in range(2)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(120)
    assert [process.exitcode for process in processes] == [0, 1]
    for rank in range(2):
        both, one, none, figures, said, mean = torch.load(tmp_path / f"{rank}.pt", weights_only=True)
        assert both.tolist() == [3.0, 30.0] and one.tolist() == [5.0, 6.0] and none is None
        assert {k: float(v) for k, v in figures.items()} == {"a": 1.0, "b": 3.0}
        assert said == ["of rank 1"] and mean == 0.5
    assert "resume with ckpt_path" in (tmp_path / "lost").read_text()


@pytest.mark.parametrize("accelerator, devices, message", [
    ("gpu", 1000, r"trainer.devices: expected at most \d+, .* found 1000"),
    ("gpu", [1000], r"trainer.devices: expected indices below \d+, .* found \[1000\]"),
    ("cpu", 0, "trainer.devices: expected a whole number of at least 1, found 0"),
    ("cpu", [0], r"trainer.devices: expected a whole number of at least 1, found \[0\]"),
    ("gpu", "two", "trainer.devices: .* found 'two'"),
    ("tpu", 1, "trainer.accelerator: expected cpu or gpu, found 'tpu'"),
])  # fmt: skip
def test_a_mistake_in_the_devices_names_its_key(accelerator, devices, message):
    with pytest.raises(ConfigError, match=message):
        parallel.devices(accelerator, devices)


def test_more_processes_than_shares_are_refused():
    parallel.check_share(4, 2, 2)
    with pytest.raises(ConfigError, match=r"trainer.devices: expected at most 4 .*, found 5"):
        parallel.check_share(5, 2, 2)
