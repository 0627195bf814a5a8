"""How nodes move under learned pair forces (`interaction.py`): symplectic Euler over frames, with an adjoint of each frame.

Only the nodes at the frames are kept: the adjoint runs the frame again. A substep is some forty operations on a few thousand
bonds, so that a GPU would wait for their launches; both passes of a frame are CUDA graphs there.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.func import functional_call

from mosa.errors import ConfigError, SimulationDiverged
from mosa.physics.launching import same_memory
from mosa.types import ParticleState, Rollout


class Interactions:
    """Nodes under their pair forces, gravity and a ground; symplectic Euler. `substeps` of each frame of frame_dt [s]."""

    def __init__(self, network, density: float, world, frame_dt: float) -> None:
        if world.planes or world.colliders or world.driven:
            raise ConfigError(
                "adapter=interaction: expected a world with a ground alone, found world.walls, world.colliders or world.driven"
            )
        fastest = network.fastest * math.sqrt(float(network.E_ref) / density)
        fastest *= math.exp(0.5 * network.stiffer)
        # half of the limit of stability, 2/fastest, for bonds at their stiffest
        self.substeps = math.ceil(frame_dt * fastest)
        self.network, self.density, self.world, self.frame_dt = network, density, world, frame_dt
        self.gravity, self.up = (t.detach().to(network.rest) for t in (world.gravity, world.up))
        self.E_ref, self.read = float(network.E_ref), [t.detach() for t in network.buffers()]
        self.passes: Callable[..., tuple[Tensor, Tensor]] | None = None

    def serves(self, density: float, world, frame_dt: float) -> bool:
        """Whether these are the dynamics of the network as it is now, for such a body."""
        asked = (density, frame_dt, float(self.network.E_ref))
        alike = asked == (self.density, self.frame_dt, self.E_ref) and world is self.world
        return alike and same_memory(self.read, list(self.network.buffers()))

    def rollout(
        self, state: ParticleState, *, frames: int, parameters=None, volume=None, density=None, adapter=None, stride=None,
        collect: Callable | None = None, motions=(), progress: Callable[[int], None] | None = None, started: bool = False,
        start_time: float = 0.0, after: Callable[[ParticleState, int], ParticleState] | None = None,
    ) -> Rollout:  # fmt: skip
        """As `Simulator.rollout`; what concerns a law or a grid is not read. Errors: SimulationDiverged naming the frame."""
        if state.x.ndim == 3:
            raise ConfigError("adapter=interaction: expected one body at a time, found many worlds")
        network = self.network
        x, v = state.x[network.nodes], state.v[network.nodes]
        C = state.C_affine
        recorded = [(state.x, state.v, state.F)]
        weights = tuple(network.net.parameters())
        if self.passes is None:
            self.passes = self.frame
            if x.is_cuda:
                samples = tuple(t.detach().clone().requires_grad_() for t in (x, v, *weights))
                self.passes = torch.cuda.make_graphed_callables(self.frame, samples)
        for frame in range(1, frames):
            x, v = Frame.apply(self.passes, x, v, *weights)
            if not bool(torch.isfinite(x).all()):
                raise SimulationDiverged(
                    f"adapter=interaction: a position is not finite in frame {frame}; lower "
                    "fit.joint.lr_adapter"
                )
            recorded.append(network.follow_nodes(x, v))
            if after is not None and frame < frames - 1:
                there, moving, F = recorded[-1]
                begun = after(ParticleState(there, moving, C, F, F), frame)
                x, v = begun.x[network.nodes], begun.v[network.nodes]
            if progress is not None:
                progress(frame)
        if collect is not None:
            network.note_stress(x.new_zeros(1, 6))
            collect(network.statistics())
        xs, vs, Fs = (torch.stack(values) for values in zip(*recorded))
        times = self.frame_dt * torch.arange(frames, dtype=xs.dtype, device=xs.device)
        a, b, c = Fs.detach().unbind(-2)
        inverted = int(((a * torch.linalg.cross(b, c)).sum(-1) <= 0).sum())
        final = ParticleState(xs[-1], vs[-1], C, Fs[-1], Fs[-1])
        counts = (self.substeps,) * (frames - 1)
        return Rollout(xs, vs, Fs, Fs, times, final, inverted=inverted, counts=counts)

    def stepper(self, *_, **__) -> None:
        raise ConfigError("adapter=interaction: expected a whole rollout (Twin.simulate)")

    def frame(self, x: Tensor, v: Tensor, *weights: Tensor) -> tuple[Tensor, Tensor]:
        """(x, v) (M, 3) of the nodes one frame later; weights: the network's, in its order."""
        network, dt = self.network, self.frame_dt / self.substeps
        named = dict(
            zip((name for name, _ in network.net.named_parameters()), weights, strict=True)
        )

        def net(read: Tensor) -> Tensor:
            return functional_call(network.net, named, (read,))

        mass = self.density * network.node_volume[:, None]
        for _ in range(self.substeps):
            v = v + dt * (network.forces(x, v, self.density, net) / mass + self.gravity)
            if self.world.ground is not None:
                v = self.contact(x, v)
            x = x + dt * v
        return x, v

    def contact(self, x: Tensor, v: Tensor) -> Tensor:
        """Velocities after the ground, as a grid node's (`contact/planes.py`), but that a node may leave it in every mode: on a
        grid the particles leave sticky nodes, which are no part of the body."""
        ground, up = self.world.ground, self.up
        normal = (v @ up)[:, None]
        touching = ((x @ up) - ground.height <= self.network.radius)[:, None] & (normal < 0)
        tangent = v - normal * up
        if ground.mode == "sticky":
            return torch.where(touching, torch.zeros_like(v), v)
        if ground.mode == "slip":
            return torch.where(touching, tangent, v)
        size = (tangent.square().sum(-1, keepdim=True) + 1e-12).sqrt()
        kept = (1 + ground.friction * normal / size).clamp(min=0)
        return torch.where(touching, kept * tangent, v)


class Frame(torch.autograd.Function):
    """`Interactions.frame` of nodes x, v (M, 3) and the network's weights, by `passes`: the function or its graphs, which answer in
    the same memory every time."""

    @staticmethod
    def forward(ctx, passes: Callable[..., tuple[Tensor, Tensor]], *values: Tensor):
        ctx.passes = passes
        # the weights too: a change of them before the adjoint is then an error
        ctx.save_for_backward(*values)
        return tuple(t.clone() for t in passes(*values))

    @staticmethod
    @once_differentiable
    def backward(ctx, *seeds: Tensor):
        with torch.enable_grad():
            leaves = [t.detach().requires_grad_() for t in ctx.saved_tensors]
            gradients = torch.autograd.grad(ctx.passes(*leaves), leaves, seeds)
        needed = ctx.needs_input_grad[1:]
        return None, *(g.clone() if own else None for g, own in zip(gradients, needed, strict=True))
