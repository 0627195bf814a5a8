"""The tasks by the conventions of Gymnasium, and its vector environments over worlds. Needs the extra `environments`.

    from mosa.environments.gymnasium_api import TwinEnv, TwinVectorEnv
    env = TwinVectorEnv("hanging", worlds=32, simulator="learned", checkpoint="outputs/train/.../checkpoints/last.ckpt")
    observations, _ = env.reset(seed=0)

or, after importing this module, gymnasium.make("mosa/Hanging-v0", checkpoint=...)."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor

from mosa.environments.arena import Arena, simulator_named
from mosa.environments.pictures import picture
from mosa.environments.task import TASKS, Task
from mosa.environments.tasks import task_named
from mosa.errors import ConfigError
from mosa.physics.engine.inputs import numbers
from mosa.settings import Count, Section, Seed, typed
from mosa.twin.twin import Pixels

try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise ConfigError(
        "mosa.environments.gymnasium_api: expected Gymnasium, found none; pip install 'mosa[environments]' "
        "(mosa.environments.arena and the gradient policy work without it)"
    ) from error


class _Worlds:
    """What the environments share: an arena whose trials are drawn from a seed."""

    arena: Arena

    def _spaces(
        self,
        worlds: int,
        task: str | Task,
        simulator: str,
        options: dict | None,
        laws: Any = None,
        **of: Any,
    ) -> tuple[spaces.Box, spaces.Box]:
        """(observations: ranges of a start, wider by rounding; actions). Errors: ConfigError, DataError."""
        made = simulator_named(simulator, **of)
        task = task_named(task, made.twin.body.rest, **(options or {}))
        self.arena, self.task = Arena(made, task, worlds, laws), task
        low, high = np.array([(q.low, q.high) for q in task.observations], np.float32).T
        seen = spaces.Box(low - 1e-6, high + 1e-6, dtype=np.float32)
        return seen, spaces.Box(-1.0, 1.0, (len(task.actions),), np.float32)

    def _draw(self, random: np.random.Generator, record: bool, options: Any = None) -> np.ndarray:
        """Errors: ConfigError for options of a reset, which would change nothing."""
        if options:
            said = "expected none, as trials are drawn from the seed (a task's are given to the environment)"
            raise ConfigError(f"options: {said}, found {', '.join(options)}")
        generator = torch.Generator().manual_seed(int(random.integers(2**62)))
        task = self.arena.task
        return _array(self.arena.reset(task.draw(self.arena.count, generator), record=record))

    @torch.no_grad()
    def _step(self, actions: np.ndarray) -> np.ndarray:
        """Rewards (B,) of actions; the episodes are over then."""
        self.arena.act(actions)
        return -_array(self.arena.loss()).astype(np.float64)


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy().astype(np.float32)


class TwinEnv(gymnasium.Env, _Worlds):
    """One body at a task.

    task: placement | hanging, or a `Task`; simulator: learned | isotropic (of `checkpoint`) | truth (of the built-in scene that it
    learned from, or of `scene`); spacing [m]: of the truth's particles; options: of the task.
    Actions: numbers in [-1, 1] that stand for `self.task.actions` (tilts [rad], aims [m], speed [m/s]); observations:
    `self.task.observations`, in their units. A hand decides once: an episode has one step, which plays the motion to its end and
    terminates. Reward: minus log(1 + squared misses in tolerances), 0 is the most. `info["success"]`: what the table counts.
    Rendering: `rgb_array`, what it looks like now; `rgb_array_list`, the last episode."""

    metadata: ClassVar[dict] = {"render_modes": ["rgb_array", "rgb_array_list"], "render_fps": 25}

    @typed
    def __init__(
        self, task: str | Task = "placement", *, simulator: str = "learned", checkpoint: str | Path | None = None,
        scene: str | None = None, device: str = "cpu", spacing: float | None = None, options: Section | None = None,
        render_mode: Literal["rgb_array", "rgb_array_list"] | None = None, size: Pixels = 240,
    ) -> None:  # fmt: skip
        of = {"checkpoint": checkpoint, "scene": scene, "device": device, "spacing": spacing}
        found = self._spaces(1, task, simulator, options, **of)
        self.observation_space, self.action_space = found
        self.render_mode, self.size = render_mode, size

    @typed
    def reset(
        self, *, seed: Seed | None = None, options: dict | None = None
    ) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        return self._draw(self.np_random, self.render_mode is not None, options)[0], {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        if self.arena.trials is not None and self.arena.last:
            raise ConfigError("environment: expected reset() after an episode's end, found none")
        expected = f"{(shape := self.action_space.shape)} finite numbers"
        reward = self._step(numbers("action", action, expected, shape)[None])
        info = {"success": bool(self.arena.success()[0]), "diverged": bool(self.arena.diverged[0])}
        return _array(self.arena.begun.observed)[0], float(reward[0]), True, False, info

    def render(self) -> np.ndarray | list[np.ndarray] | None:
        if self.render_mode is None:
            return None
        shots = (self.arena.begun and self.arena.states) or [held(self.arena)]
        pictures = [picture(self.arena, x[0], F[0], None if tool is None else tool[0], self.size)
                    for x, F, tool in (shots if self.render_mode == "rgb_array_list" else shots[-1:])]  # fmt: skip
        return pictures if self.render_mode == "rgb_array_list" else pictures[-1]


def held(arena: Arena) -> tuple[Tensor, Tensor, None]:
    """(x (B, N, 3), F_tot (B, N, 3, 3), None) of bodies in the hand, before it has decided: as if it aimed at the middle."""
    nothing = torch.zeros(arena.count, len(arena.task.actions))
    starts = arena.task.starts(arena.trials, nothing, arena.rest, arena.gravity)
    parts = (
        [torch.as_tensor(start[key]) for start in starts]
        for key in ("rotation", "position", "height")
    )
    turns, place, height = (torch.stack(part).to(arena.rest) for part in parts)
    x = arena.rest @ turns.mT
    place[:, 1] = height - x[..., 1].amin(1)
    return x + place[:, None], turns[:, None].expand(*x.shape, 3), None


class TwinVectorEnv(VectorEnv, _Worlds):
    """`worlds` bodies at a task, stepped together: on a GPU in the same launches; laws: of each, as
    `Twin.worlds` takes them. Further arguments, actions, observations and rewards as
    `TwinEnv`. All episodes end at once and begin anew in the same step (`AutoresetMode.SAME_STEP`): its observations are those of
    the new trials, `info["final_obs"]` and `info["final_info"]["success"]` those of the ended ones."""

    metadata: ClassVar[dict] = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}

    @typed
    def __init__(
        self, task: str | Task = "placement", worlds: Count = 8, *, simulator: str = "learned",
        checkpoint: str | Path | None = None, scene: str | None = None, device: str = "cpu", spacing: float | None = None,
        options: Section | None = None, laws: Any = None,
    ) -> None:  # fmt: skip
        of = {"checkpoint": checkpoint, "scene": scene, "device": device, "spacing": spacing}
        found = self._spaces(worlds, task, simulator, options, laws, **of)
        self.single_observation_space, self.single_action_space = found
        self.num_envs, self.render_mode = worlds, None
        self.action_space = batch_space(self.single_action_space, worlds)
        self.observation_space = batch_space(self.single_observation_space, worlds)

    @typed
    def reset(
        self, *, seed: Seed | None = None, options: dict | None = None
    ) -> tuple[np.ndarray, dict]:
        if seed is not None:
            self._np_random, self._np_random_seed = gymnasium.utils.seeding.np_random(seed)
        return self._draw(self.np_random, False, options), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict]:
        rewards = self._step(actions)
        ended, never = np.ones(self.num_envs, bool), np.zeros(self.num_envs, bool)
        last = np.empty(self.num_envs, dtype=object)
        last[:] = list(_array(self.arena.begun.observed))
        found = {"success": self.arena.success(), "diverged": self.arena.diverged.clone()}
        own = {key: value.numpy() for key, value in found.items()}
        info: dict[str, Any] = {"final_obs": last, "_final_obs": ended.copy(), "final_info": own}
        info["_final_info"] = ended.copy()
        return self._draw(self.np_random, False), rewards, ended, never, info


for _name in TASKS:
    gymnasium.register(id=f"mosa/{_name.capitalize()}-v0", entry_point=f"{__name__}:TwinEnv",
                       vector_entry_point=f"{__name__}:_vector", kwargs={"task": _name})  # fmt: skip


def _vector(num_envs: int = 8, **arguments) -> TwinVectorEnv:
    """What gymnasium.make_vec calls."""
    return TwinVectorEnv(worlds=num_envs, **arguments)
