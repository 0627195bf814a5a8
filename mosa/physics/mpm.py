"""The differentiable segment: some substeps of MLS-MPM as one torch operation, recomputed in the backward pass.

Only a segment's inputs are kept between the passes. Also the two per-particle operations around it: the state that an adapter
reads, and the first advance of F under a return mapping.
"""

import math

import torch
import warp as wp
from torch import Tensor

from mosa.errors import SimulationDiverged
from mosa.physics.laws import Law
from mosa.physics.material_kernels import field_types, return_kernel, state_kernel, stress_kernel
from mosa.physics.mpm_kernels import INVERTED, NO_EVENT, NONFINITE, OUTSIDE, WINDOW
from mosa.physics.workspace import SCALARS, Numerics, Steps, Workspace

HELD = ("parameters", "G", "h", "plastic_G", "plastic_h")
MAX_NODES = 2**23
"""Nodes of the largest window: 200 cells across."""


def grid_window(x: Tensor, v: Tensor, dx: float, travel_time: float, margin: int) -> tuple[tuple, tuple]:
    """(lowest node, nodes per axis) that hold the stencils of all particles for `travel_time` seconds.

    x, v: (N, 3). Node counts are multiples of 4, so that a moving body seldom changes them.
    Errors: SimulationDiverged for non-finite input or particles spread over more than 2^23 nodes.
    """
    bounds = torch.cat([x.amin(0), x.amax(0), v.abs().amax().reshape(1)]).tolist()  # the only transfer to the host
    if not all(math.isfinite(b) for b in bounds):
        bad = int((~(torch.isfinite(x).all(1) & torch.isfinite(v).all(1))).nonzero()[0])
        raise SimulationDiverged(f"particle {bad} has a non-finite position or velocity before the substep")
    reach = math.ceil(bounds[6] * travel_time / dx) + margin
    low = [math.floor(b / dx - 0.5) - reach for b in bounds[:3]]
    high = [math.floor(b / dx - 0.5) + 2 + reach for b in bounds[3:6]]
    dims = [-(-(h - l + 1) // 4) * 4 for l, h in zip(low, high)]
    if math.prod(dims) > MAX_NODES:
        raise SimulationDiverged(
            f"particles spread over {dims} grid nodes of {dx} m (speeds to {bounds[6]:.3g} m/s): use more substeps, or a box"
        )
    return tuple(low), tuple(dims)


class SegmentSolver:
    """Runs the segments of one rollout. volume: (N,) [m^3]; density: number or (N,) [kg/m^3]; cutoff: node
    mass [kg].

    workspaces: buffers by shape, shared by the rollouts of one simulator (scratch only, nothing in them outlives a segment).
    """

    def __init__(self, numerics: Numerics, volume: Tensor, density: float | Tensor, cutoff: float, workspaces: dict) -> None:
        self.numerics, self.volume, self.cutoff = numerics, volume, cutoff
        self.mass = density * volume
        self._workspaces = workspaces
        self._dims = (0, 0, 0)

    def workspace(self, substeps: int, adapted: bool, plastic_adapted: bool, with_adjoint: bool) -> Workspace:
        key = (len(self.volume), substeps, adapted, plastic_adapted, with_adjoint)
        if key not in self._workspaces:
            self._workspaces[key] = Workspace(
                self.numerics, len(self.volume), substeps, adapted=adapted, plastic_adapted=plastic_adapted,
                with_adjoint=with_adjoint,
            )  # fmt: skip
        return self._workspaces[key]

    def prepare(
        self, state: tuple[Tensor, ...], held: dict, poses, substeps: int, window, with_adjoint: bool,
        steps: Steps | None = None,
    ) -> Workspace:  # fmt: skip
        """A workspace loaded with the start of a segment. poses: of the colliders at its substeps, None where there are none."""
        work = self.workspace(substeps, held["G"] is not None, held["plastic_G"] is not None, with_adjoint)
        work.set_window(*window)
        work.load(state, held, self.volume, self.mass, self.cutoff, poses, steps)
        return work

    def advance(
        self, state: tuple[Tensor, ...], held: dict, poses, substeps: int, first: int, steps: Steps | None = None
    ) -> tuple[tuple, tuple, tuple]:
        """(state after `substeps`, reactions (force, torque) of the colliders or (), grid window used).

        first: number of the first substep, for messages; steps: their times, the numerics' dt by default.

        Errors: SimulationDiverged naming substep and particle.
        """
        # the speed at the start tells the window; a body that is being accelerated may need the most that the time step bound
        # allows, half a cell per substep
        steps = steps or Steps(self.numerics.dt, self.numerics.dt)
        for margin in (2, 3 + substeps // 2):
            origin, dims = grid_window(state[0], state[1], self.numerics.dx, 2 * substeps * steps.dt, margin)
            self._dims = dims = tuple(max(a, b) for a, b in zip(dims, self._dims))
            work = self.prepare(state, held, poses, substeps, (origin, dims), with_adjoint=False, steps=steps)
            work.advance()
            flags = work.flags.tolist()
            if not self.left_window(flags, first, steps.dt):
                reaction = () if work.colliders is None else tuple(t.clone() for t in work.colliders.reaction)
                return work.final(), reaction, (origin, dims)
        raise self.left_behind(flags, first, steps.dt)

    def left_behind(self, flags: list[int], first: int, dt: float) -> SimulationDiverged:
        """The error to raise for a particle that leaves even the widest window."""
        return self._error(WINDOW, flags[WINDOW], first, dt)

    def left_window(self, flags: list[int], first: int, dt: float) -> bool:
        """Whether a particle left the grid's window; any other event raises."""
        if min(flags) == NO_EVENT:
            return False
        n = len(self.volume)
        event = min(range(4), key=lambda i: (flags[i] // n, i != INVERTED, i == WINDOW, flags[i]))
        if event == WINDOW:
            return True
        raise self._error(event, flags[event], first, dt)

    def _error(self, event: int, flag: int, first: int, dt: float) -> SimulationDiverged:
        substep, particle = first + flag // len(self.volume), flag % len(self.volume)
        law, numerics = self.numerics.law, self.numerics
        what = {
            WINDOW: "moved by more than half a cell per substep",
            NONFINITE: "position, velocity or deformation is no longer finite",
            OUTSIDE: f"position is outside the box {list(numerics.low)} to {list(numerics.high)} m",
            INVERTED: "det F <= 0, which "
            + (f"law {law.name} has no value for" if law.needs_positive_J else "on_inversion=error forbids"),
        }[event]
        return SimulationDiverged(
            f"substep {substep}, particle {particle}: {what} (dt {dt:.3g} s, dx {numerics.dx:.3g} m); "
            "use more substeps, a larger box, or parameters nearer to the calibrated ones"
        )


class _Segment(torch.autograd.Function):
    @staticmethod
    def forward(ctx, solver: SegmentSolver, substeps: int, first: int, steps: Steps | None, *inputs):
        """inputs: state (5), held (5), and, where there are colliders, their poses at the segment's substeps (4)."""
        state = tuple(t.detach().contiguous() for t in inputs[:5])
        held, poses = dict(zip(HELD, inputs[5:10], strict=True)), inputs[10:] or None
        result, reaction, window = solver.advance(state, held, poses, substeps, first, steps)
        ctx.solver, ctx.substeps, ctx.window, ctx.steps = solver, substeps, window, steps
        ctx.states = 5 if solver.numerics.law.plastic else 4
        ctx.save_for_backward(*state, *inputs[5:])
        return *result[: ctx.states], *reaction

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *seeds):
        saved = ctx.saved_tensors
        state, held, poses = saved[:5], dict(zip(HELD, saved[5:10], strict=True)), saved[10:] or None
        work = ctx.solver.prepare(state, held, poses, ctx.substeps, ctx.window, with_adjoint=True, steps=ctx.steps)
        work.advance()
        slot = ctx.substeps % 2
        targets = [work.adj_x, work.adj_v, work.adj_C, work.adj_F, work.adj_A][: ctx.states]
        filled = [target[slot] for target in targets] + ([] if poses is None else work.colliders.adj_reaction)
        for target, seed in zip(filled, seeds, strict=True):
            target.zero_() if seed is None else target.copy_(seed)
        work.adjoint()
        gradients = [target[0].clone() for target in targets] + [None] * (5 - ctx.states)
        gradients += [None if held[name] is None else work.adj_held[name].clone() for name in HELD]
        gradients += [] if poses is None else [t.clone() for t in work.colliders.adj_poses]
        return None, None, None, None, *gradients


def advance_segment(
    solver: SegmentSolver, state: tuple[Tensor, ...], held: dict, substeps: int, first: int, poses: tuple[Tensor, ...] = (),
    steps: Steps | None = None,
) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """((x, v, C_affine, F, F_tot) after `substeps`, reactions), differentiable in state, everything in `held`, and poses.

    poses: of K colliders at the segment's S substeps, as `collider_motion.Poses`, () where there are none; reactions: force [N]
    and torque about each collider's origin [N m], (S, K, 3), or (). steps: times of the substeps, the numerics' dt by default.
    """
    result = _Segment.apply(solver, substeps, first, steps, *state, *(held[name] for name in HELD), *poses)
    count = 5 if solver.numerics.law.plastic else 4
    final, reaction = result[:count], result[count:]
    return (final if count == 5 else (*final, final[3])), reaction


def warp_stream(device: torch.device):
    """Context in which Warp launches on torch's current stream."""
    if device.type != "cuda":
        return wp.ScopedDevice("cpu")
    # without waiting for Warp's own stream: nothing is left on it, and a stream that is being captured could not
    return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(device)), sync_enter=False)


def _arrays(tensors: list[Tensor], kinds: list) -> list:
    return [wp.from_torch(t.detach().contiguous(), dtype=kind) for t, kind in zip(tensors, kinds, strict=True)]


@torch.no_grad()
def kirchhoff_stress(law: Law, F: Tensor, C_affine: Tensor, parameters: Tensor) -> Tensor:
    """tau (N, 3, 3) [Pa] of the law alone, without an adapter. No gradient."""
    scalar = SCALARS[F.dtype]
    mat33, vec6, mat66, vecp = field_types(scalar)
    kernel = stress_kernel(law.stress, law.uses_rotation, scalar, False)
    blank, tau = F.new_zeros(1, 6, 6), torch.zeros_like(F, memory_format=torch.contiguous_format)
    with warp_stream(F.device):
        arrays = _arrays([F, C_affine, parameters, blank, blank[0, :1], tau], [mat33, mat33, vecp, mat66, vec6, mat33])
        wp.launch(kernel, len(F), inputs=arrays, device=arrays[0].device)
    return tau


class _MaterialState(torch.autograd.Function):
    @staticmethod
    def forward(ctx, law: Law, F, C, parameters):
        scalar = SCALARS[F.dtype]
        mat33, vec6, _, vecp = field_types(scalar)
        ctx.kernel = state_kernel(law.stress, law.uses_rotation, scalar, law.plastic)
        ctx.kinds = [mat33, mat33, vecp, vec6, vec6, vec6]
        ctx.plastic = law.plastic
        w, s, e = (F.new_zeros(len(F), 6) for _ in range(3))
        ctx.save_for_backward(F, C, parameters)
        with warp_stream(F.device):
            arrays = _arrays([F, C, parameters, w, s, e], ctx.kinds)
            wp.launch(ctx.kernel, len(F), inputs=arrays, device=arrays[0].device)
        return (w, s, e) if law.plastic else (w, s)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *seeds):
        inputs = list(ctx.saved_tensors)
        blank = inputs[0].new_zeros(len(inputs[0]), 6)
        # the kernel may consume the seeds: never hand it torch's own
        seeds = [blank.clone() if s is None else s.clone().contiguous() for s in seeds] + [blank.clone()] * (not ctx.plastic)
        gradients = [torch.zeros_like(t, memory_format=torch.contiguous_format) for t in inputs]
        with warp_stream(blank.device):
            arrays = _arrays([*inputs, blank, blank, blank], ctx.kinds)
            wp.launch(
                ctx.kernel, len(blank), inputs=arrays, adj_inputs=_arrays([*gradients, *seeds], ctx.kinds), adjoint=True,
                device=arrays[0].device,
            )  # fmt: skip
        return None, *gradients


def material_state(law: Law, F: Tensor, C_affine: Tensor, parameters: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
    """(w, s, e) that an adapter reads, differentiable.

    w: (N, 6) vech(W - I); s: (N, 6) vech(R^T tau R) [Pa] of the prior; e: (N, 6) vech(dev log W), None for elastic laws.
    """
    result = _MaterialState.apply(law, F, C_affine, parameters)
    return result if law.plastic else (*result, None)


class _Return(torch.autograd.Function):
    @staticmethod
    def forward(ctx, numerics: Numerics, F, C, parameters, G, h):
        scalar = SCALARS[F.dtype]
        mat33, vec6, mat66, vecp = field_types(scalar)
        adapted = G is not None
        ctx.kernel = return_kernel(numerics.law.return_map, scalar, adapted)
        ctx.kinds, ctx.adapted = [mat33, mat33, vecp, mat66, vec6], adapted
        ctx.constants = [numerics.dt, numerics.norm_eps, int(numerics.rebuild)]
        if not adapted:
            G, h = F.new_zeros(1, 6, 6), F.new_zeros(1, 6)
        ctx.save_for_backward(F, C, parameters, G, h)
        mapped = torch.zeros_like(F, memory_format=torch.contiguous_format)
        with warp_stream(F.device):
            arrays = _arrays([F, C, parameters, G, h], ctx.kinds)
            inputs = [*arrays, *ctx.constants, *_arrays([mapped], [mat33])]
            wp.launch(ctx.kernel, len(F), inputs=inputs, device=arrays[0].device)
        return mapped

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, seed):
        inputs = list(ctx.saved_tensors)
        gradients = [torch.zeros_like(t, memory_format=torch.contiguous_format) for t in inputs]
        with warp_stream(seed.device):
            arrays = _arrays(inputs, ctx.kinds)
            blank, seeds = _arrays([torch.zeros_like(seed), seed.clone()], ctx.kinds[:1] * 2)
            wp.launch(
                ctx.kernel, len(seed), inputs=[*arrays, *ctx.constants, blank],
                adj_inputs=[*_arrays(gradients, ctx.kinds), 0.0, 0.0, 0, seeds], adjoint=True, device=arrays[0].device,
            )  # fmt: skip
        return None, *gradients[:3], *(gradients[3:] if ctx.adapted else (None, None))


def first_advance(numerics: Numerics, F: Tensor, C_affine: Tensor, parameters: Tensor, G: Tensor | None = None,
                  h: Tensor | None = None) -> Tensor:  # fmt: skip
    """map((I + dt C_affine) F), (N, 3, 3): the advance of F with which a rollout starts. Differentiable."""
    if not numerics.law.plastic:
        return F + numerics.dt * (C_affine @ F)
    return _Return.apply(numerics, F, C_affine, parameters, G, h)
