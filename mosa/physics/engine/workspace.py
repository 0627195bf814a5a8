"""Device buffers of a segment of substeps, and the launches that advance it and run its adjoint.

Everything is allocated once per (particles, slots); nothing allocates inside the substep loop. The launches of a segment are
captured as one graph the second time they are asked for with the same time step: on CUDA that saves the waits between them, on a
CPU the 10 us that Python takes for each. The grid's window is read from memory by the kernels, and the nodes' arrays are longer
than it: a body that moves or speeds up goes through the same graphs.
"""

from collections.abc import Sequence

import numpy as np
import torch
import warp as wp
from torch import Tensor

from mosa.errors import SimulationDiverged
from mosa.physics.constitutive.laws import SLOTS
from mosa.physics.constitutive.material_kernels import kernels_of
from mosa.physics.constitutive.particle_access import LANES
from mosa.physics.contact.collider_buffers import ColliderBuffers
from mosa.physics.contact.driven import Held
from mosa.physics.contact.driven_buffers import DrivenBuffers
from mosa.physics.contact.grid_update import update_kernels
from mosa.physics.contact.touch import planes_struct, springs, touch_kernels
from mosa.physics.engine.capture import Graphs, WarpCapture
from mosa.physics.engine.numerics import Numerics, State, Steps
from mosa.physics.exact_sums import COLUMNS, needed
from mosa.physics.grid.mean_volume import mean_volume_kernels
from mosa.physics.grid.transfer_kernels import NO_EVENT, transfer_kernels
from mosa.physics.grid.window import SMALL
from mosa.physics.launching import SCALARS, aligned, copies, filled, launch, zeros_in_one
from mosa.system.limits import counted

FEW = 2**15
"""Particles up to which each has a thread of P2G of its own on a GPU, which is not full then: of 10k, 100k and 1M, two a thread
are 6 % slower, 14 and 20 % faster (H100, forward)."""
SPARE = 8
"""Room for larger windows: half as many nodes again, at most `window.SMALL`, or one in so many where that is more. A window that
finds none costs new buffers and captures."""
IDLE = 8
"""Times the window's nodes that stay (`window.SMALL` in any case) for when it grows again: idle ones cost memory and, on CUDA,
threads that end at once."""
LARGE = 2**22
"""Bytes of one number of all particles at all kept substeps, from which copies of the states take longer than the launches that
they save: where they are kept, the workspace itself is, see `SegmentSolver.keep`; and each tensor of them is copied by itself, as
one launch for many has 320 blocks, which the 132 multiprocessors of an H200 share unevenly."""


class Workspace:
    """Buffers for N particles and `slots` stored substeps (2 states and 1 grid when nothing is stored).

    worlds: among which the particles are shared in equal parts, one world's after the other's; adapted, plastic_adapted: whether a
    stress operator and a plastic operator act; shared: the stress operator is the same for all particles, with gradients by
    particle; with_adjoint: also buffers for the adjoint; pointed: no buffers for the operators, which only `point` gives.

    key: under which it is in a pool."""

    key: tuple = ()

    @torch.inference_mode(False)
    def __init__(
        self, numerics: Numerics, particles: int, substeps: int, *, adapted: bool, plastic_adapted: bool, with_adjoint: bool,
        pointed: bool = False, worlds: int = 1, shared: bool = False,
    ) -> None:  # fmt: skip
        self.worlds, self.size = worlds, particles // worlds
        self.numerics, self.particles, self.substeps = numerics, particles, substeps
        self.with_adjoint, self._pointed = with_adjoint, pointed
        self.scalar, self.exact = SCALARS[numerics.dtype], needed(numerics.device)
        on_gpu = torch.device(numerics.device).type == "cuda"
        self.each = 2 if on_gpu and not self.exact and particles > FEW else 1
        self.kernels = transfer_kernels(self.scalar, self.exact, self.each)
        self.update = update_kernels(self.scalar)
        self.stress, self.mapping = kernels_of(
            numerics.law, self.scalar, adapted, plastic_adapted, numerics.energetic, self.exact
        )
        self.plastic = numerics.law.plastic
        _, self.block_wp = self.array((LANES, 3, 3), wp.mat33d, torch.float64)
        n = particles
        states = substeps + 1 if with_adjoint else 2
        self._large = states * n * torch.finfo(numerics.dtype).bits // 8 >= LARGE
        self.states, self.states_wp = self._slots(states)
        self.x, self.v, self.C_affine, self.F = self.states[:4]
        stresses = substeps if with_adjoint else 1
        self.tau, self.tau_wp = self._per_slot(stresses, (n, 3, 3), self.kernels.mat33)
        if numerics.moduli is not None:
            self.mean = mean_volume_kernels(self.scalar, SLOTS, self.exact)
            self.moduli = wp.vec3i(*numerics.moduli)
            _, self.F_bar_wp = self.array((n, 3, 3), self.kernels.mat33)
        self.mass, self.mass_wp = self.array((n,), self.scalar)
        self.volume, self.volume_wp = self.array((n,), self.scalar)
        vec6, mat66 = wp.types.vector(6, self.scalar), wp.types.matrix((6, 6), self.scalar)
        shapes = {
            "parameters": ((n, SLOTS), wp.types.vector(SLOTS, self.scalar)),
            "G": ((n if adapted else 1, 6, 6), mat66), "h": ((n if adapted else 1, 6), vec6),
            "plastic_G": ((n if plastic_adapted else 1, 6, 6), mat66), "plastic_h": ((n if plastic_adapted else 1, 6), vec6),
        }  # fmt: skip
        self.held, self.held_wp = {}, {}
        for name, (shape, kind) in shapes.items():
            one = name != "parameters" and (pointed or (shared and name in ("G", "h")))
            self.held[name], self.held_wp[name] = self.array(
                (1, *shape[1:]) if one else shape, kind
            )
        self._rows = {name: self.held[name][0] for name in ("G", "h")} if shared else {}
        if with_adjoint:
            self._allocate_adjoint(shapes)
        self.flags, self.flags_wp = self.array((4,), wp.int64, torch.int64)
        self.window, window = self.array((3 * worlds, 3), wp.vec3i, torch.int32)
        self.grids = filled(self.kernels.Grids, window, self.size, numerics.dx, 1.0 / numerics.dx)
        # what gravity adds to node velocities in the first substep of a segment and in the others
        self.impulses, self.impulses_wp = self._per_slot(2, (worlds, 3), self.kernels.vec3)
        values = wp.from_torch(numerics.planes, dtype=self.scalar)
        modes = wp.from_torch(numerics.modes, dtype=wp.int32)
        self.planes = filled(planes_struct(self.scalar), values, modes, numerics.plane_count)
        self._allocate_contact()
        self.cutoff = 0.0
        self.nodes = self.capacity = self.allocations = 0
        self._placed: np.ndarray | None = None
        # the windows that are placed; nobody changes them
        self._given: tuple[np.ndarray, np.ndarray] | None = None
        self._pulled: tuple | None = None
        self.steps = Steps(numerics.dt, numerics.dt)
        strategy = WarpCapture(numerics.device, self.flags_wp.device)
        self._graphs = Graphs(
            strategy, "substeps cannot be captured as a graph and are launched one by one"
        )

    def _allocate_adjoint(self, shapes: dict) -> None:
        """shapes: of what is held, with Warp's types, by name."""
        numerics, n = self.numerics, self.particles
        self.adj_states, self.adj_wp = self._slots(2)
        self.adj_C_affine, self.adj_F = self.adj_states[2:4]
        self.adj_tau, self.adj_tau_wp = self.array((n, 3, 3), self.kernels.mat33)
        if numerics.moduli is not None:
            _, self.adj_F_bar_wp = self.array((n, 3, 3), self.kernels.mat33)
        buffer, parts = zeros_in_one(
            [shape for shape, _ in shapes.values()], numerics.dtype, numerics.device
        )
        self.adj_held = dict(zip(shapes, parts))
        self.adj_held_wp = {
            name: wp.from_torch(part, dtype=shapes[name][1]) for name, part in self.adj_held.items()
        }
        # to clear in one launch: all of it, and all but the parameters' part, which comes first
        self.all_adj_wp = wp.from_torch(buffer, dtype=self.scalar)
        self.adj_operator_wp = wp.from_torch(buffer[parts[1].storage_offset() :], dtype=self.scalar)

    def _allocate_contact(self) -> None:
        """What particles meet: planes, solids, driven sets."""
        numerics, n = self.numerics, self.particles
        self.colliders, self.springs, self.driven = None, None, None
        if numerics.touching or numerics.colliders is not None:
            self.touch = touch_kernels(self.scalar)
            self.v_met, self.v_met_wp = self.array((n, 3), self.kernels.vec3)
            self.springs, self.springs_wp = self.array((n,), self.scalar)
            if self.with_adjoint:
                _, self.adj_springs_wp = self.array((n,), self.scalar)
                # of the springs in the packed parameters
                self.slopes, self.slopes_wp = self.array((n, SLOTS), self.scalar)
                self.adj_slots_wp = wp.from_torch(self.adj_held["parameters"], dtype=self.scalar)
        if numerics.colliders is not None:
            self.colliders = ColliderBuffers(
                numerics.colliders, self.scalar, self.substeps, self, self.with_adjoint
            )
        if numerics.driven:
            self.driven = DrivenBuffers(
                self.colliders, self.scalar, self.substeps, numerics.points, self
            )
        # solids are before the driven sets among the colliders
        self.struck = numerics.colliders is not None and len(numerics.colliders) > numerics.driven

    def array(
        self, shape: tuple[int, ...], kind, dtype: torch.dtype | None = None
    ) -> tuple[Tensor, wp.array]:
        """Zeros of `shape`, and the same memory as Warp's array of `kind`."""
        tensor = torch.zeros(shape, dtype=dtype or self.numerics.dtype, device=self.numerics.device)
        return tensor, wp.from_torch(tensor, dtype=kind)

    def _per_slot(self, slots: int, shape: tuple[int, ...], kind):
        """Parts of one buffer, each where the kernels can read it in pieces."""
        _, parts = zeros_in_one([shape] * slots, self.numerics.dtype, self.numerics.device)
        return parts, [wp.from_torch(t, dtype=kind) for t in parts]

    def _slots(self, count: int) -> tuple[list[list[Tensor]], list]:
        """(`count` slots of x, v, C_affine, F, and of F_tot where the law yields, the same as a kernel's `Particles` each)."""
        n, vector, matrix = self.particles, self.kernels.vec3, self.kernels.mat33
        kinds = [((n, 3), vector)] * 2 + [((n, 3, 3), matrix)] * (2 + self.plastic)
        tensors, arrays = zip(*(self._per_slot(count, *kind) for kind in kinds))
        # the deformation gradient that is never mapped is F itself where the law does not yield
        whole = arrays if self.plastic else (*arrays, arrays[-1])
        return list(tensors), [filled(self.kernels.Particles, *parts) for parts in zip(*whole)]

    @property
    def stays(self) -> bool:
        """Whether the states that its forward pass leaves wait for the backward pass here, and not in copies. A workspace that is
        pointed to operators has graphs that others hold; on a CPU, where copies cost little, each thread would gather its own."""
        return self._large and self.with_adjoint and not self._pointed and self.flags.is_cuda

    @property
    def kept_bytes(self) -> int:
        """Of what the adjoint reads of a forward pass, in the window that is set."""
        of_nodes = 2 * self.substeps * 4 * self.nodes * self.numerics.dtype.itemsize
        return of_nodes + sum(t.nbytes for t in self._particle_slots())

    def tape(self) -> list[Tensor]:
        """Copies of all that the adjoint reads of a forward pass, one tensor of slots each, the grid's last."""
        slots = self._particle_slots()
        kept = [slot.clone() for slot in slots] if self._large else copies(slots)
        return [*kept, self.grid_slots().clone(memory_format=torch.contiguous_format)]

    def rewind(self, tape: Sequence[Tensor]) -> None:
        """As if the forward pass that left `tape`, in the window that is set, had just run."""
        slots = self._particle_slots()
        if self._large:
            for slot, kept in zip(slots, tape):
                slot.copy_(kept)
        else:
            torch._foreach_copy_(slots, list(tape[:-1]))
        self.grid_slots().copy_(tape[-1])

    def _particle_slots(self) -> list[Tensor]:
        return [part[0]._base for part in (*self.states, self.tau)]

    def grid_slots(self) -> Tensor:
        """(2, slots, nodes of the windows, 4): momentum and mass, velocity."""
        return self.fields.narrow(2, 0, self.nodes)

    def set_window(self, origins: np.ndarray, dims: np.ndarray) -> None:
        """Place the grids: lowest node and number of nodes per axis, (W, 3), or (3,) for all worlds. Buffers and graphs are new
        where there is no room for them."""
        if self._given is not None and origins is self._given[0] and dims is self._given[1]:
            return
        rows = np.zeros((self.worlds, 3, 3), dtype=np.int32)
        rows[:, 0], rows[:, 1] = origins, dims
        ends = rows[:, 1].prod(-1, dtype=np.int64).cumsum()
        rows[1:, 2, 0], nodes = ends[:-1], int(ends[-1])
        if not nodes <= self.capacity <= max(IDLE * nodes, SMALL):
            self._allocate_nodes(nodes + max(nodes // SPARE, min(nodes // 2, SMALL)))
        if self._placed is None or not np.array_equal(rows, self._placed):
            # CUDA stages it before it returns
            self.window.copy_(torch.from_numpy(rows).flatten(0, 1), non_blocking=True)
            self._placed, self.nodes = rows, nodes
        self._given = origins, dims

    @torch.inference_mode(False)  # another rollout may want gradients
    def _allocate_nodes(self, count: int) -> None:
        self.allocations += 1
        self._graphs.forget()
        self.capacity, self._given = 0, None  # until all is there: memory may run out
        self.fields = self.grid_wp = self.velocity_wp = None  # freed before there are others
        self.adj_grid = self.adj_grid_wp = self.adj_velocity_wp = None
        # where only the last one is wanted a second one, which is cleared while the first is read
        grids, vec4 = self.substeps if self.with_adjoint else 2, self.kernels.vec4
        each = 8 * self.numerics.dtype.itemsize
        remedy = "use more substeps, or a box"
        counted("kept grid nodes", (grids, count), remedy, each=each, error=SimulationDiverged)
        numerics = self.numerics
        self.fields = torch.zeros(
            (2, grids, count, 4), dtype=numerics.dtype, device=numerics.device
        )
        self.grid_wp, self.velocity_wp = (
            [wp.from_torch(t, dtype=vec4) for t in slots] for slots in self.fields
        )
        if self.exact:
            self.sums, self.sums_wp = self.array((4 * count, COLUMNS), wp.int64, torch.int64)
        if self.numerics.moduli is not None:
            _, (self.volumes_wp, self.adj_volumes_wp) = self._per_slot(2, (count, 4), vec4)
        if self.with_adjoint:
            self.adj_grid, self.adj_grid_wp = self.array((count, 4), vec4)
            _, self.adj_velocity_wp = self._per_slot(2, (count, 4), vec4)
        self.capacity = count

    def load(
        self, state: State, held: dict[str, Tensor | None], volume: Tensor, mass: Tensor, cutoff: float,
        poses: tuple[Tensor, ...] | None = None, steps: Steps | None = None,
        gravities: tuple[tuple[float, float, float], ...] | None = None, driven: Held | None = None,
    ) -> None:  # fmt: skip
        """Copy the start of a segment in: the state, the parameters, the adapter's operator,
        colliders' poses, driven particles.

        steps: the numerics' dt by default; gravities: of every world [m/s^2], the numerics' by
        default."""
        self.steps = steps or Steps(self.numerics.dt, self.numerics.dt)
        pulled = (*self.steps, gravities or (self.numerics.gravity,) * self.worlds)
        if pulled != self._pulled:
            rows = [[[time * g for g in gravity] for gravity in pulled[2]] for time in self.steps]
            rows = torch.tensor(rows, dtype=torch.float64)
            for target, row in zip(self.impulses, rows.to(self.numerics.dtype)):
                target.copy_(row, non_blocking=True)
            self._pulled = pulled
        if self.colliders is not None:
            self.colliders.load(poses[: len(self.colliders.poses)])
        targets = [*(part[0] for part in self.states), self.volume, self.mass]
        torch._foreach_copy_(targets, [*state[: len(self.states)], volume, mass])
        if self.driven is not None:
            self.driven.load(driven, poses[len(self.colliders.poses) :])
        self.hold(held)
        if cutoff != self.cutoff:
            self.cutoff = cutoff
            self._graphs.forget()

    def hold(self, held: dict[str, Tensor | None]) -> None:
        """Copy parameters and the adapter's operator in, those that are given."""
        given = {name: value for name, value in held.items() if value is not None}
        targets = self.held
        if self._rows:  # a view of one row with a leading dimension has other strides than its target: each is then copied alone
            targets = self.held | self._rows
            given |= {name: given[name][0] for name in self._rows}
        torch._foreach_copy_([targets[name] for name in given], list(given.values()))
        self._tighten(given.get("parameters"))

    def point(self, held: dict[str, Tensor | None]) -> None:
        """As `hold`, without a copy or a graph: the next launches read these tensors. The caller keeps them."""
        for name, value in held.items():
            if value is not None:
                self.held_wp[name] = wp.from_torch(
                    aligned(value.detach()), dtype=self.held_wp[name].dtype
                )
        self._tighten(held.get("parameters"))

    def _tighten(self, parameters: Tensor | None) -> None:
        """Springs of what particles meet, of packed parameters (N, SLOTS); the mass has to be there."""
        if self.springs is None or parameters is None:
            return
        law, parameters = self.numerics.law, parameters.detach()
        with torch.set_grad_enabled(self.with_adjoint):
            parameters = parameters.requires_grad_(self.with_adjoint)
            values = {name: parameters[:, law.offsets[name] : law.offsets[name] + size].squeeze(-1)
                      for name, size in law.parameters.items()}  # fmt: skip
            found = springs(law.wave_modulus(values), self.mass, self.volume, self.numerics.dx)
            if found.requires_grad:
                self.slopes.copy_(torch.autograd.grad(found.sum(), parameters)[0])
        self.springs.copy_(found.detach())

    def final(self) -> State:
        """Copies of the state after the segment."""
        return State.whole(self.state(self.substeps))

    def state(self, step: int) -> list[Tensor]:
        """Copies of (x, v, C_affine, F), where the law yields of F_tot too, after `step` substeps: the last ones, or any of those
        whose states are kept."""
        slot = step % len(self.x)
        return copies([part[slot] for part in self.states])

    def advance(self) -> None:
        """All substeps of the segment; events are left in `flags` for the caller to read."""
        self.flags.fill_(NO_EVENT)
        self._launch("advance", lambda: self.advance_steps(0, self.substeps))

    def adjoint(self) -> None:
        """Adjoint of all substeps, last to first, after `advance`. Seeds: adj_* slot `substeps` % 2, results: slot 0."""
        self._launch("adjoint", lambda: self.adjoint_steps(0, self.substeps))

    def _launch(self, name: str, body) -> None:
        name = (name, *self.steps)
        if self._graphs.waits(name):
            self._graphs.capture(name, body)
        self._graphs.play(name, body)

    def run(self, kernel, dim: int, inputs: list, adj_inputs: list | None = None) -> None:
        launch(kernel, dim, inputs, self.flags_wp.device, adj_inputs)

    def over_nodes(self, kernel, inputs: list) -> None:
        """Launch for all nodes of the windows. Graphs hold the number of threads: one for all nodes of a world on a CPU, on a CUDA
        device one for each that there is room for, shared among the worlds in equal parts."""
        threads = -(-self.capacity // self.worlds) if self.flags_wp.device.is_cuda else 1
        self.run(kernel, threads * self.worlds, [self.grids, threads, *inputs])

    def _added_to(self, field) -> wp.array:
        """What particles add to, of which the nodes' numbers in `field` are made."""
        return self.sums_wp if self.exact else field

    def _settle(self, field) -> None:
        if self.exact:
            self.over_nodes(self.kernels.settle, [self.sums_wp, field])

    def _kick(self, step: int) -> float:
        """For how long [s] the forces of a substep act."""
        return self.steps.kick if step == 0 else self.steps.dt

    def _grid_arguments(self, slot: int, step: int) -> list:
        return [self.grid_wp[slot], self.impulses_wp[min(step, 1)], self.cutoff, self.planes]

    def _touch_arguments(self, state: int, step: int) -> list:
        now = self.states_wp[state]
        return [now.x, now.v, self.volume_wp, self.springs_wp, self.planes, self._kick(step)]

    def _met(self, state: int, step: int, again: bool = False) -> wp.array:
        """Velocities of a state that go to the grid: after the planes and solids that particles meet, where there are such.
        again: in the adjoint, where reactions are known."""
        now = self.states_wp[state]
        v = now.v
        if self.numerics.touching:
            met = [*self._touch_arguments(state, step), self.v_met_wp]
            self.run(self.touch.meet, self.particles, met)
            v = self.v_met_wp
        if self.struck:
            v = self.colliders.strike(step, self._struck(state), self._kick(step), again)
        if self.driven is not None:
            v = self.driven.hold(step, now.x, v, self._kick(step))
        return v

    def _struck(self, state: int) -> list:
        """What solids act on: particles after the planes that they meet."""
        now = self.states_wp[state]
        v = self.v_met_wp if self.numerics.touching else now.v
        return [now.x, v, self.volume_wp, self.springs_wp, self.mass_wp]

    def _found(self, state: int) -> wp.array:
        """Velocities of a state as driven sets find them, once `_met` has run: after planes and
        solids."""
        return self.colliders.struck if self.struck else self._struck(state)[1]

    def _averaged(self, state: int) -> wp.array:
        """F of which the stress is taken."""
        now = self.states_wp[state]
        if self.numerics.moduli is None:
            return now.F
        if not self.exact:
            self.over_nodes(self.kernels.clear, [self.volumes_wp])
        volumes = self._added_to(self.volumes_wp)
        self.run(
            self.mean.collect, self.particles, [now.x, now.F, self.volume_wp, self.grids, volumes]
        )
        self._settle(self.volumes_wp)
        self.run(self.mean.average, self.particles, [
            now.x, now.F, self.held_wp["parameters"], self.moduli, self.grids, self.volumes_wp, self.F_bar_wp,
        ])  # fmt: skip
        return self.F_bar_wp

    def _adj_averaged(self, step: int, adj) -> None:
        """Adds what `adj_F_bar` says to the gradients of x, F and parameters, after `_averaged` of
        the same step."""
        if not self.exact:
            self.over_nodes(self.kernels.clear, [self.adj_volumes_wp])
        now = self.states_wp[step]
        self.run(self.mean.adj_average, self.particles, [
            now.x, now.F, self.held_wp["parameters"], self.moduli, self.grids, self.volumes_wp, self.adj_F_bar_wp,
            adj.x, adj.F, self.adj_held_wp["parameters"], self._added_to(self.adj_volumes_wp),
        ])  # fmt: skip
        self._settle(self.adj_volumes_wp)
        self.run(self.mean.adj_collect, self.particles, [
            now.x, now.F, self.volume_wp, self.grids, self.volumes_wp, self.adj_volumes_wp, adj.x, adj.F,
        ])  # fmt: skip

    def _stress_arguments(self, state: int, slot: int) -> list:
        held = self.held_wp
        return [
            self._averaged(state), self.states_wp[state].C, held["parameters"], held["G"], held["h"], self.tau_wp[slot],
            self.block_wp,
        ]  # fmt: skip

    def _mapping_arguments(self, state: int, new: int) -> list:
        held, numerics = self.held_wp, self.numerics
        return [
            self.states_wp[state].F, self.states_wp[new].C, held["parameters"], held["plastic_G"], held["plastic_h"],
            self.steps.dt, numerics.norm_eps, int(numerics.rebuild), self.states_wp[new].F,
        ]  # fmt: skip

    def advance_steps(self, first: int, count: int) -> None:
        """Launch substeps `first` to `first + count` of the segment, from the states in slot `first`."""
        kernels, numerics, n = self.kernels, self.numerics, self.particles
        states, grids, dt = len(self.x), len(self.grid_wp), self.steps.dt
        low, high = kernels.vec3(*numerics.low), kernels.vec3(*numerics.high)
        mass = self.mass_wp if self.driven is None else self.driven.mass_wp
        if self.colliders is not None and first == 0:
            self.colliders.reset()
        for step in range(first, first + count):
            a, g, s, kick = step % states, step % grids, step % len(self.tau), self._kick(step)
            now, then = self.states_wp[a], self.states_wp[(step + 1) % states]
            if step == 0 and not self.exact:
                self.over_nodes(kernels.clear, [self.grid_wp[g]])
            clears = step + 1 < self.substeps and not self.exact
            cleared = self.grid_wp[(step + 1) % grids] if clears else None
            self.run(self.stress, n, self._stress_arguments(a, s))
            self.run(kernels.p2g, -(-n // self.each), [
                now, self._met(a, step), self.tau_wp[s], mass, self.volume_wp, self.grids, kick,
                int(numerics.check_J), step, self.flags_wp, self._added_to(self.grid_wp[g]),
            ])  # fmt: skip
            self._settle(self.grid_wp[g])
            given = [*self._grid_arguments(g, step), self.velocity_wp[g], cleared]
            self.over_nodes(self.update.grid_update, given)
            self.run(kernels.g2p, n, [
                now, self.velocity_wp[g], self.grids, dt, low, high, step, self.flags_wp, then,
            ])  # fmt: skip
            if self.plastic:
                self.run(self.mapping, n, self._mapping_arguments(a, (step + 1) % states))
            if self.driven is not None:
                impulses = self.impulses_wp[min(step, 1)]
                self.driven.feel(step, now.x, self._found(a), then.v, kick, impulses)
        if self.colliders is not None and first + count == self.substeps:
            self.colliders.settle()

    def adjoint_steps(self, first: int, count: int, more: bool = False) -> None:
        """Launch the adjoint of `advance_steps`: from the seeds in slot (first + count) % 2 to slot first % 2.

        adj_held is of these substeps alone; more: but the parameters' part is added to what is there."""
        kernels, numerics, n, held = self.kernels, self.numerics, self.particles, self.adj_held_wp
        dt, mass = self.steps.dt, self.mass_wp if self.driven is None else self.driven.mass_wp
        (self.adj_operator_wp if more else self.all_adj_wp).zero_()
        if self.springs is not None:
            self.adj_springs_wp.zero_()
        if self.colliders is not None and first + count == self.substeps:
            self.colliders.reset_adjoint()
            if self.driven is not None:
                self.driven.reset_adjoint()
        for step in reversed(range(first, first + count)):
            a, b = step % 2, (step + 1) % 2  # adjoint slots; the states of all substeps are stored
            now, then, kick = self.states_wp[step], self.states_wp[step + 1], self._kick(step)
            adj, adj_then = self.adj_wp[a], self.adj_wp[b]
            if self.plastic:
                adj.F.zero_()
                self.run(self.mapping, n, self._mapping_arguments(step, step + 1), [
                    adj.F, adj_then.C, held["parameters"], held["plastic_G"], held["plastic_h"], 0.0, 0.0, 0, adj_then.F,
                ])  # fmt: skip
            if self.driven is not None:
                self.driven.adj_feel(step, now.x, kick, adj_then.v)
            adj_velocity = self.adj_velocity_wp[a]
            if step == self.substeps - 1 and not self.exact:
                self.over_nodes(kernels.clear, [adj_velocity])
            cleared = self.adj_velocity_wp[b] if step > 0 and not self.exact else None
            self.run(kernels.adj_g2p, n, [
                now, self.velocity_wp[step], self.grids, dt, then, adj_then, adj, self._added_to(adj_velocity),
            ])  # fmt: skip
            self._settle(adj_velocity)
            given = [*self._grid_arguments(step, step), adj_velocity, self.adj_grid_wp, cleared]
            self.over_nodes(self.update.adj_grid, given)
            self.run(kernels.adj_p2g, n, [
                now, self._met(step, step, True), self.tau_wp[step], mass, self.volume_wp, self.grids, kick,
                self.adj_grid_wp, adj, self.adj_tau_wp,
            ])  # fmt: skip
            of_met = (adj.x, adj.v, self.adj_springs_wp) if self.springs is not None else ()
            if self.driven is not None:
                self.driven.adjoint(
                    step, now.x, self._found(step), then.v, kick, self.impulses_wp[min(step, 1)], *of_met
                )  # fmt: skip
            if self.struck:
                self.colliders.adjoint(step, self._struck(step), kick, *of_met)
            if numerics.touching:
                self.run(self.touch.adj_meet, n, [*self._touch_arguments(step, step), *of_met])
            adj_F = adj.F
            if numerics.moduli is not None:
                adj_F = self.adj_F_bar_wp
                adj_F.zero_()
            self.run(self.stress, n, self._stress_arguments(step, step), [
                adj_F, adj.C, held["parameters"], held["G"], held["h"], self.adj_tau_wp, None,
            ])  # fmt: skip
            if numerics.moduli is not None:
                self._adj_averaged(step, adj)
        if self.springs is not None:
            self.run(self.touch.loosen, n, [self.adj_springs_wp, self.slopes_wp, self.adj_slots_wp])
        if self.colliders is not None and first == 0:
            self.colliders.settle_adjoint()
            if self.driven is not None:
                self.driven.settle_adjoint()
