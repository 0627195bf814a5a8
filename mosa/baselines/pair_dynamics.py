"""How nodes move under learned pair forces (`interaction.py`): symplectic Euler over frames, with an adjoint of each frame.

A substep is some forty small operations on a few thousand bonds, so that on a GPU what takes the time is launching them. Both
passes of a frame therefore read and write buffers that stay, and become CUDA graphs once they have run; on a CPU they run as they
are. Only the nodes at the frames are kept: the adjoint runs the frame again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.func import functional_call

from mosa.errors import ConfigError, SimulationDiverged
from mosa.physics.engine.capture import ATTEMPTS, Graphs, TorchCapture
from mosa.physics.launching import same_memory
from mosa.types import ParticleState, Rollout


class Interactions:
    """Nodes under their pair forces, gravity and a ground; symplectic Euler. `substeps` of each frame of frame_dt [s]."""

    def __init__(self, network, density: float, world, frame_dt: float) -> None:
        if world.planes or world.colliders or world.driven:
            raise ConfigError(
                "adapter=interaction: expected a world with a ground alone, found world.walls, world.colliders or world.driven"
            )
        fastest = (
            network.fastest
            * math.sqrt(float(network.E_ref) / density)
            * math.exp(0.5 * network.stiffer)
        )
        # half of the limit of stability, 2/fastest, for bonds at their stiffest
        self.substeps = math.ceil(frame_dt * fastest)
        self.network, self.density, self.world, self.frame_dt = network, density, world, frame_dt
        self._passes: FramePasses | None = None

    def rollout(
        self, state: ParticleState, *, frames: int, parameters=None, volume=None, density=None, adapter=None, stride=None,
        collect: Callable | None = None, motions=(), progress: Callable[[int], None] | None = None, started: bool = False,
        start_time: float = 0.0,
    ) -> Rollout:  # fmt: skip
        """As `Simulator.rollout`; what concerns a law or a grid is not read. Errors: SimulationDiverged naming the frame."""
        if state.x.ndim == 3:
            raise ConfigError("adapter=interaction: expected one body at a time, found many worlds")
        network = self.network
        x, v = state.x[network.nodes], state.v[network.nodes]
        C = state.C_affine
        recorded = [(state.x, state.v, state.F)]
        passes, weights = self.passes(x), tuple(network.net.parameters())
        for frame in range(1, frames):
            x, v = Frame.apply(passes, x, v, *weights)
            if not bool(torch.isfinite(x).all()):
                raise SimulationDiverged(
                    f"adapter=interaction: a position is not finite in frame {frame}; lower "
                    "fit.joint.lr_adapter"
                )
            recorded.append(network.follow_nodes(x, v))
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
        raise ConfigError(
            "adapter=interaction: expected a whole rollout (Twin.simulate); its nodes are not advanced step by step"
        )

    def passes(self, x: Tensor) -> FramePasses:
        """Those of nodes like x, with the network's weights as they are now."""
        if (
            self._passes is None
            or self._passes.x.device != x.device
            or self._passes.x.dtype != x.dtype
        ):
            self._passes = FramePasses(self, x)
        self._passes.follow()
        return self._passes

    def frame(
        self, x: Tensor, v: Tensor, gravity: Tensor, up: Tensor, net: Callable[[Tensor], Tensor]
    ) -> tuple[Tensor, Tensor]:
        """(x, v) (M, 3) of the nodes one frame later; net: the network."""
        network, dt = self.network, self.frame_dt / self.substeps
        mass = self.density * network.node_volume[:, None]
        for _ in range(self.substeps):
            v = v + dt * (network.forces(x, v, self.density, net) / mass + gravity)
            if self.world.ground is not None:
                v = self.contact(x, v, up)
            x = x + dt * v
        return x, v

    def contact(self, x: Tensor, v: Tensor, up: Tensor) -> Tensor:
        """Velocities after the ground, as a grid node's (`contact/planes.py`), but that a node may leave it in every mode: on a
        grid the particles leave sticky nodes, which are no part of the body."""
        ground = self.world.ground
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


class FramePasses:
    """A frame of the nodes and its adjoint. They read x, v (M, 3) and their adjoints, and leave what follows in `after` and
    `gradients` (of x, v and the weights)."""

    def __init__(self, dynamics: Interactions, like: Tensor) -> None:
        self.dynamics = dynamics
        self.x, self.v, *self.seeds = (torch.zeros_like(like) for _ in range(4))
        self.after = (torch.zeros_like(like), torch.zeros_like(like))
        self.gravity, self.up = (
            t.detach().to(like) for t in (dynamics.world.gravity, dynamics.world.up)
        )
        self.names, self.weights, self.gradients = [], [], []
        failing = "adapter=interaction cannot be captured as a CUDA graph and runs uncaptured"
        self._graphs = Graphs(TorchCapture(), failing, ATTEMPTS if like.is_cuda else 0)
        self._read: Sequence[Tensor] = ()

    def follow(self) -> None:
        """The network's weights as they are now. Graphs that read others, by their address, are dropped."""
        network = self.dynamics.network
        self.names, self.weights = (list(each) for each in zip(*network.net.named_parameters()))
        read = [*self.weights, *network.buffers()]
        if not same_memory(self._read, read):
            self._read = [t.detach() for t in read]
            self.gradients = [torch.zeros_like(t) for t in (self.x, self.v, *self.weights)]
            self._graphs.drop()

    def advance(self, x: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """(x, v) (M, 3) one frame later. Also captures what has run once: the adjoint itself runs in a thread of autograd's own."""
        bodies = {"forward": self._forward, "adjoint": self._adjoint}
        for name in self._graphs.waiting():
            if not self._graphs.capture(name, bodies[name]):
                torch.cuda.synchronize()
                break
        self.x.copy_(x)
        self.v.copy_(v)
        self._graphs.play("forward", self._forward)
        return self.after[0].clone(), self.after[1].clone()

    def adjoint(self, x: Tensor, v: Tensor, seeds: Sequence[Tensor]) -> list[Tensor]:
        """Gradients of x, v (M, 3) at the frame's start and of the weights; seeds: of x and v at its end."""
        for into, value in zip((self.x, self.v, *self.seeds), (x, v, *seeds), strict=True):
            into.copy_(value)
        self._graphs.play("adjoint", self._adjoint)
        return [t.clone() for t in self.gradients]

    @torch.no_grad()
    def _forward(self) -> None:
        found = self.dynamics.frame(
            self.x, self.v, self.gravity, self.up, self.dynamics.network.net
        )
        for into, value in zip(self.after, found, strict=True):
            into.copy_(value)

    def _adjoint(self) -> None:
        with torch.enable_grad():
            # aliases: autograd ties a leaf to the stream it was first used on, which a capture on another one may not touch
            leaves = [t.detach().requires_grad_() for t in (self.x, self.v, *self.weights)]
            named = dict(zip(self.names, leaves[2:], strict=True))
            found = self.dynamics.frame(
                *leaves[:2],
                self.gravity,
                self.up,
                lambda read: functional_call(self.dynamics.network.net, named, (read,)),
            )
            gradients = torch.autograd.grad(found, leaves, self.seeds)
        for into, value in zip(self.gradients, gradients, strict=True):
            into.copy_(value)


class Frame(torch.autograd.Function):
    """`FramePasses.advance`, with its adjoint."""

    @staticmethod
    def forward(ctx, passes: FramePasses, x: Tensor, v: Tensor, *weights: Tensor):
        ctx.passes = passes
        # the weights too: a change of them before the adjoint is then an error
        ctx.save_for_backward(x, v, *weights)
        return passes.advance(x, v)

    @staticmethod
    @once_differentiable
    def backward(ctx, *seeds: Tensor):
        x, v, *_ = ctx.saved_tensors
        found = ctx.passes.adjoint(x, v, seeds)
        return None, *(
            g if needed else None for g, needed in zip(found, ctx.needs_input_grad[1:], strict=True)
        )
