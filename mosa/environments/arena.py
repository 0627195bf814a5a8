"""Trials of a task, played in many worlds of a simulator at once: what Gymnasium's classes, the policies and the table stand on."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from mosa.config.checkpoints import given_as
from mosa.environments.task import LAST, Task, Trials, View
from mosa.environments.truth import true_twin
from mosa.errors import ConfigError, DataError, SimulationDiverged
from mosa.physics.engine.inputs import numbers
from mosa.settings import check
from mosa.twin.episode import TwinState
from mosa.twin.twin import Twin

SIMULATORS = ("learned", "isotropic", "truth")
"""The law that a run learned; the calibrated isotropic prior of the same run; the hidden truth of its built-in scene."""


@dataclass(frozen=True)
class Simulator:
    """A twin and which of its laws is simulated. name: one of `SIMULATORS`."""

    name: str
    twin: Twin
    variant: str = "adapted"


def simulator_named(
    name: str,
    checkpoint: str | Path | None = None,
    *,
    scene: str | None = None,
    device: str = "cpu",
    spacing: float | None = None,
) -> Simulator:
    """learned | isotropic: of a run's checkpoint; truth: of the built-in scene that the run learned from, or of `scene`.

    spacing [m]: of the truth's particles, None for the films' own. Errors: ConfigError, DataError naming what is missing.
    """
    check("simulator", name, Literal[SIMULATORS])
    if checkpoint is None and (name != "truth" or scene is None):
        more = ", or truth.scene=<a built-in scene>" * (name == "truth")
        wanted = f"a run's checkpoint{more} for simulator={name}"
        raise ConfigError(f"checkpoint: expected {wanted}, found none")
    with given_as("checkpoint"):
        learned = None if checkpoint is None else Twin.load(checkpoint, device)
    if name != "truth":
        return Simulator(name, learned, "adapted" if name == "learned" else "prior")
    known = {"name": scene} if scene is not None else scene_of(learned, checkpoint)
    return Simulator(name, true_twin(**truth_of(known), device=device, spacing=spacing))


def truth_of(known: Mapping[str, Any]) -> dict[str, Any]:
    """What tells the hidden truths of built-in scenes apart, of a scene's configuration: arguments of `true_twin`."""
    own = {key: known[key] for key in ("name", "material", "seed") if key in known}
    return {"material": "anisotropic", "seed": 0} | own


def scene_of(learned: Twin, checkpoint: str | Path) -> Mapping[str, Any]:
    """The configuration of the built-in scene that a twin was learned from. Errors: ConfigError where it was another one, DataError
    where the checkpoint does not say."""
    known = learned.record.settings.get("scene")
    where, way = f"checkpoint: {checkpoint}: settings.scene", "name one with truth.scene="
    if not isinstance(known, Mapping) or not isinstance(known.get("format"), str):
        raise DataError(
            f"{where}: expected the scene that the twin was learned from, found none; {way}"
        )
    if (kind := known["format"]) != "builtin":
        said = f"a run on a scene of format {kind}: the truth is known for built-in scenes only"
        raise ConfigError(f"simulator: expected learned or isotropic for {said}")
    if not isinstance(name := known.get("name"), str):
        wanted = "the name of a built-in scene"
        raise DataError(f"{where}.name: expected {wanted}, found {name!r}; {way}")
    return known


def look(state: TwinState, weights: Tensor) -> View:
    """weights: (N,) shares of the body's mass."""
    x, v = state.positions, state.v.to(weights)
    share = weights.to(x)[:, None]
    turned = (share[..., None] * state.F_tot.to(x)).sum(1)[:, :, 1]
    upright = torch.nn.functional.normalize(turned, dim=1)
    return View((share * x).sum(1), (share * v).sum(1), upright, x[..., 1].amin(1))


@dataclass(frozen=True)
class Played:
    """loss: (B,) of the last moments, with its graph where the play was differentiable; success, diverged: (B,) bool; states: of
    worlds that were recorded, (x (T, B, N, 3), F_tot (T, B, N, 3, 3), the solids' rotations and positions (T, B, K, 3, 4))."""

    loss: Tensor
    success: Tensor
    diverged: Tensor
    states: tuple[Tensor, Tensor, Tensor] | None = None


class Arena:
    """`worlds` copies of a simulator's body at a task, of the law's values `laws` as `Twin.worlds` takes
    them. One after the other: `reset` with trials, then `act`."""

    def __init__(self, simulator: Simulator, task: Task, worlds: int, laws: Any = None) -> None:
        self.simulator, self.task, self.count = simulator, task, worlds
        twin = copy.copy(simulator.twin)
        twin.world = task.world(twin.world)
        self.body, self.worlds = twin.body, twin.worlds(worlds, laws)
        self.gravity = float(twin.world.gravity.norm())
        self.weights = (self.body.volume / self.body.volume.sum()).detach()
        self.rest = (self.body.rest - self.body.center).detach()
        self.trials: Trials | None = None
        self.states: list[tuple[Tensor, Tensor, Tensor]] | None = None

    def reset(
        self, trials: Trials, *, differentiable: bool = False, record: bool = False
    ) -> Tensor:
        """Begin these trials, one a world; what is observed of them (B, O). Errors: ConfigError."""
        if len(trials) != self.count:
            found = f"{self.count} worlds, found {len(trials)}"
            raise ConfigError(f"trials: expected one for each of {found}")
        self.trials, self.differentiable = trials, differentiable
        self.diverged = torch.zeros(self.count, dtype=torch.bool)
        self.last: list[Tensor] = []
        self.states = [] if record else None
        return trials.observed.cpu()

    def act(self, action: Tensor) -> None:
        """Let go as actions (B, A) say, of which all beyond [-1, 1] counts as its end, and play to the end of the episode. Errors:
        ConfigError before a reset, and for another shape."""
        shape = len(self.begun), len(self.task.actions)
        action = numbers("action", action, f"{shape} finite numbers", shape).clamp(-1, 1)
        starts = self.task.starts(self.trials, action, self.rest, self.gravity)
        state = self.worlds.reset(
            starts, colliders=self.task.solids(), variant=self.simulator.variant, control_dt=self.task.control_dt,
            frames=self.task.steps, differentiable=self.differentiable, substeps=self.task.substeps,
        )  # fmt: skip
        self._see(state)
        for step in range(self.task.steps):
            self._advance(self.task.command(step))

    def loss(self) -> Tensor:
        """(B,) of the moments seen last; of a world that diverged the loss of a body far away."""
        found = torch.stack(self.last[-LAST:]).mean(0)
        return torch.where(self.diverged.to(found.device), found.new_tensor(LOST), found)

    @property
    def begun(self) -> Trials:
        """The trials that go on. Errors: ConfigError before a reset."""
        if self.trials is None:
            raise ConfigError(
                "environment: expected reset() before step and render, found no trial"
            )
        return self.trials

    def success(self) -> Tensor:
        """(B,) bool, at the end."""
        found = torch.as_tensor(self.task.succeeded(self.trials, self.view)).cpu()
        if found.dtype != torch.bool or found.shape != self.diverged.shape:
            said = f"expected ({self.count},) flags, found {found.dtype} {tuple(found.shape)}"
            raise ConfigError(f"task {self.task.name}: succeeded: {said}")
        return found & ~self.diverged

    def _advance(self, command) -> None:
        for _ in range(self.count + 1):
            try:
                state = self.worlds.step(command).state
                break
            except SimulationDiverged as error:
                world = world_of(error)
                if world is None or bool(self.diverged[world]):
                    raise
                # the trial is lost; its world goes on from its start, so that the others can
                self.diverged[world] = True
                self.worlds.restart([world])
        self._see(state)
        self.last.append(self.task.loss(self.trials, self.view))

    def _see(self, state: TwinState) -> None:
        self.view = look(state, self.weights)
        if self.states is not None:
            places = torch.cat([state.collider_rotation, state.collider_position[..., None]], 3)
            parts = (state.positions, state.F_tot, places)
            self.states.append(tuple(value.detach().cpu() for value in parts))


LOST = 5.0  # loss of a trial whose simulation diverged: log(1 + 12^2)


def world_of(error: SimulationDiverged) -> int | None:
    """Number of the world that the message names."""
    found = re.search(r"world (\d+)", str(error))
    return int(found.group(1)) if found else None


Acting = Callable[[Tensor], Tensor]  # a policy: observations (B, O) to actions (B, A) in [-1, 1]


def play(arena: Arena, trials: Trials, policy: Acting, **how: bool) -> Played:
    """One episode in each world. how: differentiable, record, as `Arena.reset` takes them."""
    with torch.set_grad_enabled(how.get("differentiable", False)):
        arena.act(policy(arena.reset(trials, **how)))
        states = None
        if arena.states is not None:
            states = tuple(torch.stack(parts) for parts in zip(*arena.states))
        return Played(arena.loss(), arena.success(), arena.diverged, states)


def play_all(arena: Arena, trials: Trials, policy: Acting) -> tuple[Tensor, Tensor]:
    """(loss (n,), success (n,)) of any number of trials, as many at a time as the arena has worlds."""
    losses, successes = [], []
    for first in range(0, len(trials), arena.count):
        which = torch.arange(first, first + arena.count) % len(trials)
        kept = min(arena.count, len(trials) - first)
        played = play(arena, trials.select(which), policy)
        losses.append(played.loss.cpu()[:kept])
        successes.append(played.success[:kept])
    return torch.cat(losses), torch.cat(successes)
