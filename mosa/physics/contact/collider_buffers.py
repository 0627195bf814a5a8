"""Device buffers of the colliders of a segment: poses, reactions and their adjoints by substep, and the launches on them."""

import weakref
from math import prod

import torch
import warp as wp
from torch import Tensor

from mosa.physics.contact.collider_kernels import collider_kernels
from mosa.physics.contact.colliders import PackedColliders
from mosa.physics.exact_sums import COLUMNS, sum_functions
from mosa.physics.launching import filled


class ColliderBuffers:
    """K colliders over `substeps` substeps of the workspace `work`, which holds them and is not held by them.

    poses, adj_poses: position (S, W K, 3), rotation (S, W K, 3, 3), linear, angular (S, W K, 3) of W worlds, one after another;
    struck: velocities after `strike`; reaction_arrays: what particles add their forces and torques
    to; reaction: force [N] and torque [N m] about the collider's origin (S, W K, 3), as the body exerts them on the collider in
    world axes."""

    def __init__(
        self, packed: PackedColliders, scalar, substeps: int, work, with_adjoint: bool
    ) -> None:
        self.count = len(packed)
        self.kernels = collider_kernels(scalar, work.exact)
        self.scalar, self._work, self.with_adjoint = scalar, weakref.proxy(work), with_adjoint
        self._solids = filled(
            self.kernels.Solids, self.count, wp.from_torch(packed.shapes, dtype=scalar),
            wp.from_torch(packed.codes, dtype=wp.int32), wp.from_torch(packed.fields, dtype=scalar),
        )  # fmt: skip
        columns = work.worlds * self.count
        vectors, matrices = (substeps, columns, 3), (substeps, columns, 3, 3)
        vec3, mat33 = self.kernels.vec3, self.kernels.mat33
        pose = ((vectors, vec3), (matrices, mat33), (vectors, vec3), (vectors, vec3))

        def buffers(kinds):
            made = [work.array(shape, kind) for shape, kind in kinds]
            return [tensor for tensor, _ in made], [array for _, array in made]

        self.poses, poses = buffers(pose)
        self.pose_arrays = filled(self.kernels.Poses, *poses)
        _, self.struck = work.array((work.particles, 3), vec3)
        self.reaction, reaction = buffers(pose[2:])
        self._reaction_sums = self.sums(self.reaction)
        self.reaction_arrays = self.added_to(reaction, self._reaction_sums)
        if with_adjoint:
            self.adj_poses, adj_poses = buffers(pose)
            self._adj_sums = self.sums(self.adj_poses)
            self._adj_added = self.added_to(adj_poses, self._adj_sums)
            self.adj_pose_sums = filled(self.kernels.PoseSums, *self._adj_added)
            self.adj_reaction, self.adj_reaction_arrays = buffers(pose[2:])

    def vectors(self, substeps: int, columns: int, count: int) -> tuple[list[Tensor], list]:
        """`count` times (substeps, columns, 3) zeros, and the same memory as Warp's arrays."""
        made = [self._work.array((substeps, columns, 3), self.kernels.vec3) for _ in range(count)]
        return [tensor for tensor, _ in made], [array for _, array in made]

    def sums(self, tensors: list[Tensor]) -> list | None:
        """What particles add to, of which `tensors` are made: exact sums, or the tensors themselves
        (None)."""
        if not self._work.exact:
            return None
        shapes = [(*t.shape[:2], prod(t.shape[2:]), COLUMNS) for t in tensors]
        return [self._work.array(shape, wp.int64, torch.int64) for shape in shapes]

    def load(self, poses: tuple[Tensor, ...]) -> None:
        """Copy the poses of a segment's substeps in."""
        torch._foreach_copy_(list(self.poses), list(poses))

    def reset(self) -> None:
        """Before a segment: no reaction yet."""
        for array in self.reaction_arrays:
            array.zero_()

    def reset_adjoint(self) -> None:
        for array in self._adj_added:
            array.zero_()

    def settle(self) -> None:
        """After a segment: the reactions are what was added up."""
        self.settle_sums(self.reaction, self._reaction_sums)

    def settle_adjoint(self) -> None:
        self.settle_sums(self.adj_poses, self._adj_sums)

    @staticmethod
    def added_to(arrays: list, sums: list | None) -> list:
        return arrays if sums is None else [array for _, array in sums]

    def settle_sums(self, tensors: list[Tensor], sums: list | None) -> None:
        if sums is None:
            return
        settle = sum_functions(self.scalar).settle
        for target, (added, _) in zip(tensors, sums, strict=True):
            rows = wp.from_torch(added.view(-1, COLUMNS))
            flat = [rows, wp.from_torch(target.view(-1), dtype=self.scalar)]
            self._work.run(settle, target.numel(), flat)

    def _arguments(self, met: list, step: int, time: float) -> list:
        return [*met, time, self._work.size, step, self._solids, self.pose_arrays]

    def strike(self, step: int, met: list, time: float, again: bool) -> wp.array:
        """Velocities of particles after contact in substep `step`. met: x, v, volume, springs, mass; time [s]: for which the
        substep's forces act; again: the reaction is known already."""
        reaction = [None, None] if again else self.reaction_arrays
        self._work.run(self.kernels.strike, self._work.particles, [
            *self._arguments(met, step, time), self.struck, *reaction,
        ])  # fmt: skip
        return self.struck

    def adjoint(self, step: int, met: list, time: float, adj_x, adj_v, adj_springs) -> None:
        """Turns the adjoint of velocities after contact into that before it; adds to the others."""
        self._work.run(self.kernels.adj_strike, self._work.particles, [
            *self._arguments(met, step, time), *self.adj_reaction_arrays, adj_x, adj_v, adj_springs,
            self.adj_pose_sums,
        ])  # fmt: skip
