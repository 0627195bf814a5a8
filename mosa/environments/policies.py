"""Policies of few numbers, and how they are found: by gradients through the simulator, or by a model of what was tried in it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.optim.lr_scheduler import CosineAnnealingLR

from mosa.config.leaf_settings import SearchSection as Search
from mosa.environments.arena import Arena, play, play_all
from mosa.environments.task import Task, View
from mosa.errors import DataError


class LinearPolicy(nn.Module):
    """Actions tanh(W o + b) in [-1, 1] of observations scaled to their ranges: (O + 1) A numbers, 16 for a placement and 20 for a
    throw. It begins with weights 0, at the middle of what may be asked of a hand."""

    def __init__(self, task: Task) -> None:
        super().__init__()
        low, high = torch.tensor([(q.low, q.high) for q in task.observations]).T
        self.register_buffer("middle", 0.5 * (low + high))
        self.register_buffer("spread", 0.5 * (high - low))
        self.weight = nn.Parameter(torch.zeros(len(task.actions), len(task.observations)))
        self.bias = nn.Parameter(torch.zeros(len(task.actions)))

    def scaled(self, observation: Tensor) -> Tensor:
        """(B, O) in [-1, 1] where a trial is within its ranges."""
        return (observation.to(self.weight) - self.middle) / self.spread

    def forward(self, observation: Tensor) -> Tensor:
        """(B, A) of (B, O)."""
        return torch.tanh(self.scaled(observation) @ self.weight.T + self.bias)

    def written(self) -> dict[str, list]:
        """Plain numbers, fit for JSON; `read` gives the same policy."""
        return {name: value.tolist() for name, value in self.state_dict().items()}

    @classmethod
    def read(cls, task: Task, written: Mapping[str, Any]) -> LinearPolicy:
        """Errors: DataError where it is no policy of this task."""
        policy = cls(task)
        try:
            policy.load_state_dict({name: torch.tensor(value) for name, value in written.items()})
        except (RuntimeError, TypeError, ValueError) as error:
            reason = " ".join(str(error).split())[:200]
            raise DataError(
                f"policy: expected the numbers of a policy for {task.name}, found {reason}"
            ) from error
        return policy


@dataclass(frozen=True)
class Found:
    """policy: (B, O) to (B, A); history: one entry for each look at it; seconds: of the search; trials: played."""

    policy: Callable[[Tensor], Tensor]
    history: list[dict[str, float]]
    seconds: float
    trials: int


class PolicyChecks:
    """Periodic evaluation of the policy during a search, on trials of their own; keeps the best policy.

    check: the arena that the trials are played in; say: told a line of each look."""

    def __init__(
        self,
        policy: LinearPolicy,
        check: Arena,
        search: Search,
        seed: int,
        say: Callable[[str], None],
    ) -> None:
        self.policy, self.check, self.search, self.say = policy, check, search, say
        own = torch.Generator().manual_seed(10**6 + seed)
        self.trials = check.task.draw(search.validation, own)
        self.history: list[dict[str, float]] = []
        self.best = math.inf, self.numbers()
        self.began, self.played = time.perf_counter(), 0

    def last(self, iteration: int) -> bool:
        """Evaluate if due before an iteration. Returns whether the search is over."""
        over = iteration == self.search.iterations
        if over or iteration % self.search.every == 0:
            loss, success = play_all(self.check, self.trials, self.policy)
            self.played += len(self.trials)
            mean, share = float(loss.mean()), float(success.float().mean())
            self.history.append({"iteration": iteration, "loss": mean, "success": share})
            self.say(f"iteration {iteration}: loss {mean:.3f}, success {share:.2f}")
            if mean < self.best[0]:
                self.best = mean, self.numbers()
        return over

    def numbers(self) -> dict[str, Tensor]:
        """Of the policy as it is now."""
        return {name: value.clone() for name, value in self.policy.state_dict().items()}

    def found(self) -> Found:
        """The policy as it was at its best."""
        best = min(self.history, key=lambda look: look["loss"])
        if best["iteration"] == 0:
            self.say("no look was better than the policy that the search began from, which is kept: "
                     "try a smaller search.rate, or a larger search.batch")  # fmt: skip
        elif best is not self.history[-1]:
            self.say(
                f"the policy of iteration {best['iteration']} is kept, loss {best['loss']:.3f}"
            )
        self.policy.load_state_dict(self.best[1])
        seconds = time.perf_counter() - self.began
        return Found(self.policy.requires_grad_(False), self.history, seconds, self.played)


def by_gradient(
    train: Arena,
    check: Arena,
    search: Search,
    seed: int,
    say: Callable[[str], None] = lambda line: None,
) -> Found:
    """The mean loss descended through the simulator, contact and all. train, check: of the same simulator and task."""
    task, generator = train.task, torch.Generator().manual_seed(seed)
    policy = LinearPolicy(task)
    checks = PolicyChecks(policy, check, search, seed, say)
    optimiser = torch.optim.Adam(policy.parameters(), lr=search.rate)
    schedule = CosineAnnealingLR(optimiser, search.iterations, 0.1 * search.rate)

    def bounded(observation: Tensor) -> Tensor:
        action = policy(observation)
        action.register_hook(lambda g: _clipped(g, search.clip))
        return action

    for iteration in range(search.iterations + 1):
        if checks.last(iteration):
            break
        outcome = play(train, task.draw(train.count, generator), bounded, differentiable=True)
        checks.played += train.count
        optimiser.zero_grad()
        kept = (~outcome.diverged).to(outcome.loss)
        if bool(kept.any()):
            (outcome.loss * kept).sum().backward()
            for parameter in policy.parameters():  # the mean of clipped trials
                parameter.grad /= train.count
            optimiser.step()
        schedule.step()
    return checks.found()


class OutcomeModel(nn.Module):
    """What comes of an action in a situation: `MEMBERS` networks that begin differently and are fitted to trials that were
    played. Where they disagree nothing like it was tried. Inputs are observations, scaled to their ranges, and actions; outputs
    are `OUTCOME`."""

    def __init__(self, inputs: Tensor, outcomes: Tensor, generator: torch.Generator) -> None:
        super().__init__()
        self.register_buffer("middle", outcomes.median(0).values)
        self.register_buffer("spread", (outcomes - self.middle).abs().mean(0).clamp_min(1e-6))
        sizes = (inputs.shape[1], HIDDEN, HIDDEN, outcomes.shape[1])
        drawn = (torch.randn(MEMBERS, a, b, generator=generator) for a, b in pairwise(sizes))
        self.weights = nn.ParameterList([each / math.sqrt(each.shape[1]) for each in drawn])
        self.biases = nn.ParameterList([torch.zeros(MEMBERS, 1, b) for b in sizes[1:]])

    def scaled(self, inputs: Tensor) -> Tensor:
        x = inputs.expand(MEMBERS, *inputs.shape)
        for k, (weight, bias) in enumerate(zip(self.weights, self.biases)):
            x = torch.baddbmm(bias, x, weight)
            x = functional.silu(x) if k + 1 < len(self.weights) else x
        return x

    def forward(self, inputs: Tensor) -> Tensor:
        """(members, n, outputs) of (n, inputs)."""
        return self.middle + self.spread * self.scaled(inputs)


MEMBERS, HIDDEN = 5, 64
FITTED, DESCENDED, IMAGINED = 400, 300, 512  # steps on model, on policy; situations
OUTCOME = (("center", 3), ("velocity", 3), ("upright", 3), ("lowest", 1))  # of a `View`


def _outcome(view: View) -> Tensor:
    """(B, 10)."""
    parts = [getattr(view, name).reshape(-1, size) for name, size in OUTCOME]
    return torch.cat(parts, 1).detach().cpu().float()


def _seen_as(outcome: Tensor) -> View:
    """The view of numbers (B, 10)."""
    center, velocity, upright, lowest = outcome.split([size for _, size in OUTCOME], 1)
    return View(center, velocity, functional.normalize(upright, dim=1), lowest[:, 0])


@torch.enable_grad()
def _fitted_model(inputs: Tensor, outcomes: Tensor, generator: torch.Generator) -> OutcomeModel:
    model = OutcomeModel(inputs, outcomes, generator)
    wanted = (outcomes - model.middle) / model.spread
    optimiser = torch.optim.AdamW(model.parameters(), lr=3e-3, weight_decay=1e-2)
    schedule = CosineAnnealingLR(optimiser, FITTED)
    # every member leaves out other trials, so that they differ where few were played
    counted = (torch.rand(MEMBERS, len(inputs), 1, generator=generator) < 0.8).float()
    for _ in range(FITTED):
        optimiser.zero_grad()
        # a body that was missed is thrown about: it shall not outweigh those that were not
        both = model.scaled(inputs), wanted.expand(MEMBERS, -1, -1)
        away = functional.smooth_l1_loss(*both, beta=0.3, reduction="none")
        (away * counted).mean().backward()
        optimiser.step()
        schedule.step()
    return model.requires_grad_(False)


@torch.no_grad()
def by_model(
    train: Arena,
    check: Arena,
    search: Search,
    seed: int,
    say: Callable[[str], None] = lambda line: None,
) -> Found:
    """A model of how trials end is fitted to all that was tried in the simulator, and the policy is descended on the model; then
    more is tried about what that policy does. Bounces leave a rough slope for single trials, and the model a smooth one over many.
    train, check: of the same simulator and task, the former with `search.candidates` times `search.batch` worlds."""
    task = train.task
    generator, policy = torch.Generator().manual_seed(seed), LinearPolicy(task)
    checks = PolicyChecks(policy, check, search, seed, say)
    tried: list[tuple[Tensor, Tensor, Tensor]] = []
    for iteration in range(search.iterations + 1):
        if checks.last(iteration):
            break
        trials = task.draw(train.count, generator)
        seen, about = policy.scaled(trials.observed), policy(trials.observed)
        wide = search.spread / (1 + iteration)
        action = (about + wide * torch.randn(about.shape, generator=generator)).clamp(-1, 1)
        outcome = play(train, trials, lambda _, action=action: action)
        checks.played += train.count
        whole = ~outcome.diverged
        tried.append((seen[whole], action[whole], _outcome(train.view)[whole]))
        seen, action, ends = (torch.cat(part) for part in zip(*tried))
        model = _fitted_model(torch.cat([seen, action], 1), ends, generator)
        _descend(policy, model, task, generator)
    return checks.found()


@torch.enable_grad()
def _descend(
    policy: LinearPolicy, model: OutcomeModel, task: Task, generator: torch.Generator
) -> None:
    """The policy's numbers to the least cost that the model's members agree on: their mean and their standard deviation."""
    trials = task.draw(IMAGINED, generator)
    observed, many = trials.observed, trials.select(torch.arange(IMAGINED).repeat(MEMBERS))
    optimiser = torch.optim.Adam(policy.parameters(), lr=0.02)
    schedule = CosineAnnealingLR(optimiser, DESCENDED)
    for _ in range(DESCENDED):
        ends = model(torch.cat([policy.scaled(observed), policy(observed)], 1))
        found = task.loss(many, _seen_as(ends.flatten(0, 1))).view(MEMBERS, IMAGINED)
        optimiser.zero_grad()
        (found.mean(0) + found.std(0)).mean().backward()
        optimiser.step()
        schedule.step()


def _clipped(gradient: Tensor, most: float) -> Tensor:
    """Rows (B, A) of at most that norm; 0 where one is not finite."""
    finite = torch.isfinite(gradient).all(1, keepdim=True)
    gradient = torch.where(finite, gradient, torch.zeros_like(gradient))
    return gradient * (most / gradient.norm(dim=1, keepdim=True).clamp_min(1e-12)).clamp_max(1.0)


SEARCHES = {"gradient": by_gradient, "model": by_model}  # by the name in `policy`
