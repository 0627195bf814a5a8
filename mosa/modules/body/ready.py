"""A body at its start, ready to be simulated: by itself, or stacked with others as so many worlds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from mosa.errors import ConfigError
from mosa.physics.adapters.interface import Held, steady_answer
from mosa.physics.contact.colliders import Collider
from mosa.physics.contact.driven import stack_held
from mosa.physics.engine.simulator import Simulator
from mosa.physics.time.clock import Adaptive
from mosa.types import ParticleState, Rollout


@dataclass(frozen=True)
class Ready:
    """A body at its start, and what a simulation of it takes; or, by `stack`, the same in B worlds.

    state: in the simulator's type, higher by `lift` (3,) [m], the contact's offset, than where the body is seen; arguments: of
    `Simulator.rollout`; timing: of substeps that vary, None where they are fixed."""

    simulator: Simulator
    state: ParticleState
    lift: Tensor
    arguments: dict
    timing: Adaptive | None

    def simulate(
        self, frames: int, colliders: Sequence[Collider] = (), *, collect: Callable | None = None,
        progress: Callable[[int], None] | None = None, observed: Tensor | None = None, gain: float = 0.0,
        unseen: Callable[[Tensor, int], Tensor] | None = None, begun: Rollout | None = None,
    ) -> Rollout:  # fmt: skip
        """As `Body.simulate`, from here on; of a stack, the worlds at once.

        begun: the first frames, simulated before from here with the same arguments (substeps that
        do not vary, no colliders), which the rest then follow."""
        simulator, stacked = self.simulator, self.state.x.ndim == 3
        arguments, alone = self.arguments, not stacked and collect is None
        if observed is not None and alone and arguments["stride"] is None:
            arguments = self.answered().arguments  # once, not in every frame
        roll = partial(
            simulator.rollout, **arguments, collect=collect, motions=self.motions(colliders)
        )
        lift = self.lift[:, None] if stacked else self.lift
        first, state = (0, self.state) if begun is None else (len(begun.x) - 1, begun.final)
        if observed is None:
            timing = {} if self.timing is None else {"timing": self.timing}
            rollout = roll(
                state, frames=frames - first, started=first > 0,
                start_time=first * simulator.frame_dt, progress=progress, **timing,
            )  # fmt: skip
        else:
            if self.timing:
                raise ConfigError("simulation.adaptive: expected criterion=free beside it")
            seen = (observed[:frames, None] if stacked else observed[:frames]) + lift.detach()
            hidden = (
                None if unseen is None else lambda x, frame: unseen(x - lift.detach().to(x), frame)
            )
            seen = seen.to(state.x.dtype)
            rollout = corrected_rollout(roll, state, seen, gain, simulator.frame_dt, hidden, first)
        fields = {
            name: getattr(rollout, name).to(self.lift.dtype) for name in ("x", "v", "F", "F_tot")
        }
        fields["x"] = fields["x"] - lift
        if begun is not None:
            fields["times"] = rollout.times + first * simulator.frame_dt
            parts = {name: (getattr(begun, name), field[1:]) for name, field in fields.items()}
            fields = {name: torch.cat(both) for name, both in parts.items()}
        return replace(rollout, **fields)

    def motions(self, colliders: Sequence[Collider]) -> list:
        """Of the colliders, where the simulator sees them: the offset is the ground's, they keep their place. Of a stack, a list
        for each world."""
        if self.lift.ndim > 1:
            return [[collider.motion.shifted(lift) for collider in colliders] for lift in self.lift]
        return [collider.motion.shifted(self.lift) for collider in colliders]

    def answered(self) -> Ready:
        """With the adapter's answer now in place of the adapter, which may become another one. Errors: ConfigError where the
        operator depends on the state."""
        adapter = self.arguments["adapter"]
        if adapter is None:
            return self
        if self.arguments["stride"] is not None:
            raise ConfigError(
                f"adapter: expected one whose operator is the same in every state, found {type(adapter).__name__}"
            )
        held = Held(steady_answer(adapter, self.simulator.law, self.state.F))
        return replace(self, arguments={**self.arguments, "adapter": held})

    @classmethod
    def stack(cls, parts: Sequence[Ready]) -> Ready:
        """B bodies of the same particles and law, each with its own numbers, `answered`, and start, as so many worlds: state
        (B, N, ...), lift (B, 3), and arguments of `Simulator.rollout`. Errors: ConfigError where the time steps differ."""
        first, n = parts[0], len(parts[0].arguments["volume"])
        counts = sorted({part.simulator.substeps for part in parts})
        if len(counts) > 1 or any(part.timing for part in parts):
            raise ConfigError(
                f"worlds: expected equal fixed substeps, found {counts}; give substeps"
            )
        each = [part.arguments for part in parts]
        sizes = first.simulator.law.parameters
        parameters = {
            name: torch.stack([value.expand(n) if sizes[name] == 1 else value.reshape(-1, sizes[name]).expand(n, -1)
                               for value in (own["parameters"][name] for own in each)])
            for name in each[0]["parameters"]
        }  # fmt: skip
        adapters = None if each[0]["adapter"] is None else [own["adapter"] for own in each]
        arguments = {**each[0], "parameters": parameters, "adapter": adapters}
        if "held" in arguments:
            arguments["held"] = stack_held([own["held"] for own in each])
        return replace(
            first, state=ParticleState.stack([part.state for part in parts]), lift=torch.stack([part.lift for part in parts]),
            arguments=arguments,
        )  # fmt: skip


def corrected_rollout(
    roll: Callable[..., Rollout], state, observed: Tensor, gain: float, frame_dt: float,
    unseen: Callable[[Tensor, int], Tensor] | None = None, first: int = 0,
) -> Rollout:  # fmt: skip
    """Frames predicted one by one: after each, v += gain (x_seen - x)/frame_dt. Its positions are those before the correction.
    first: the frame that `state` is of; the result begins with it.

    roll: a simulator's rollout with everything but state, frames and times given; observed: (T, N, 3) [m] with its frame 0;
    frame_dt [s]; unseen: of positions [m] in a frame, what would not have been observed of them, and is no distance then.
    Differentiable.

    In a free rollout the errors of grid and contact accumulate through the bounce, and a law is bent to undo them. A prediction
    error method (Ljung, System Identification, chapter 3) asks less: from what was seen up to a frame, predict the next. Here the
    observer is Luenberger's with a fixed gain on the velocities; positions and deformation gradients stay the simulation's."""

    def corrected(there, number: int):
        away = observed[first + number] - there.x
        if unseen is not None:
            away = away + unseen(there.x, first + number)
        return replace(there, v=there.v + ((gain / frame_dt) * away).to(there.v))

    begun = state if first == 0 else corrected(state, 0)
    frames = len(observed) - first
    start_time = first * frame_dt
    return roll(begun, frames=frames, started=first > 0, start_time=start_time, after=corrected)
