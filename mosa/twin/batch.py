"""A twin's body in many worlds at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

from torch import Tensor

from mosa.errors import ConfigError
from mosa.modules.body.body import Start, World
from mosa.modules.fitting.parameters import read_numbers
from mosa.physics.contact.colliders import Collider
from mosa.physics.contact.driven import Driven
from mosa.physics.engine.inputs import numbers, without_gradients
from mosa.physics.engine.simulator import Substeps
from mosa.settings import Count, Expected, typed
from mosa.system.limits import counted
from mosa.twin.episode import Episode, InMotion, TwinState
from mosa.twin.start import (
    Seconds,
    StartArguments,
    Variant,
    check_frames,
    check_wants_no_gradients,
    start_in,
    warn_of_creep,
)

FARTHEST = 100.0
"""Of a law's numbers, which are logarithms or shares: the largest single precision is e^89."""


class TwinWorlds(InMotion):
    """A twin's body in `count` worlds that never meet, stepped together: on CUDA in the same launches, on a CPU in threads. Of
    `step` every command is the same in all worlds, or (count, 3), rotations (count, 3, 3), for each."""

    def __init__(self, twin: Any, count: int, laws: Any = None) -> None:
        body = twin.body
        counted("worlds", (count, len(body.rest)), "take fewer", each=500)  # bytes of a particle
        if laws is not None:
            laws, shape = twin.material.laws(laws), (count, len(read_numbers(body)))
            said = f"one for each of {count} worlds, a tensor {shape} of finite numbers within {FARTHEST:g}, or [{{'E': 1e4}}, ...]"
            laws = without_gradients("laws", numbers("laws", laws, said, shape, most=FARTHEST))
        self.body, self.world, self.frame_dt = body, twin.world, twin.frame_dt
        self.training_start, self.count, self.laws = twin.training_start, count, laws
        self._box: Sequence[Sequence[float]] | Tensor | None = None

    def __repr__(self) -> str:
        return f"TwinWorlds({self.count} worlds of {len(self.body.rest)} particles)"

    @typed
    def reset(
        self, starts: Mapping[str, Any] | Sequence[Mapping[str, Any]] | None = None, *,
        colliders: Sequence[Collider | Mapping[str, Any]] | None = None, gravity: Tensor | Sequence[Any] | None = None,
        variant: Variant = "adapted", control_dt: Seconds | None = None,
        substeps: Substeps | None = None, frames: Count = 30, differentiable: bool = False,
        box: Sequence[Sequence[float]] | Tensor | None = None, driven: Sequence[Driven | Mapping[str, Any]] | None = None,
    ) -> TwinState:  # fmt: skip
        """Begin a motion in every world; returns the state (count, ...).

        starts: rotation, height, position, velocity, angular_velocity as `Twin.simulate` takes them, for all worlds or one mapping
        for each; gravity: (count, 3) [m/s^2], None for the world's; others as `Twin.reset`. Errors: ConfigError naming the world.
        """
        check_frames(frames, self.count * len(self.body.rest))
        more = {"colliders": colliders, "box": box, "driven": driven}
        if not differentiable:
            check_wants_no_gradients(starts=starts, gravity=gravity, **more)
        found = self._found(starts, range(self.count), more)
        if gravity is not None:
            shape = (self.count, 3)
            gravity = numbers("gravity", gravity, f"finite numbers {shape}", shape)
        self._box = box
        self._episode = Episode(
            self.body, found[0][1], control_dt or self.frame_dt, [start for start, _ in found],
            variant=variant, frames=frames, substeps=substeps, laws=self.laws, gravity=gravity,
            differentiable=differentiable,
        )  # fmt: skip
        warn_of_creep(self.body, found[0][1], self._episode.frame_dt, self._episode.substeps)
        return self._episode.state

    @typed
    def restart(
        self,
        which: Annotated[Sequence[int], Expected("a list of numbers of worlds")],
        starts: Mapping[str, Any] | Sequence[Mapping[str, Any]] | None = None,
    ) -> TwinState:
        """Put the worlds with these numbers back to new starts, as `reset` takes them, None for those they had; the others stay as
        they are. Time is one for all and goes on: colliders that were driven are back where they began, others follow their
        motion. Errors: ConfigError naming the world."""
        which, episode = list(which), self.episode
        more = {"colliders": (), "box": self._box, "driven": ()}
        found = [] if starts is None else self._found(starts, which, more)
        return episode.restart(which, None if starts is None else [start for start, _ in found])

    def _found(self, starts: Any, which: Sequence[int], more: Any) -> list[tuple[Start, World]]:
        """The starts of these worlds, and the world. Errors: ConfigError."""
        each = [starts or {}] * len(which) if isinstance(starts, Mapping | None) else starts
        if not isinstance(each, (list, tuple)) or not all(isinstance(s, Mapping) for s in each):
            raise ConfigError(
                f"starts: expected what Twin.simulate takes, by name, or a list of that, found {str(starts)[:80]}"
            )
        if len(each) != len(which):
            raise ConfigError(
                f"starts: expected one mapping for all worlds, or a list of {len(which)}, one a world, found a list of {len(each)}"
            )
        found: list[tuple[Start, World]] = []
        for i, (b, given) in enumerate(zip(which, each)):
            StartArguments.read(given, f"starts[{b}]")
            if i and given is each[0]:
                found.append(found[0])
                continue
            try:
                found.append(start_in(self.body, self.world, self.training_start, **given, **more))
            except ConfigError as error:
                raise ConfigError(f"starts[{b}]: {error}") from error
        return found
