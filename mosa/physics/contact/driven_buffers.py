"""Device buffers of driven particles: which they are, their points' paths by substep, and the
launches on them."""

import weakref

import torch
import warp as wp

from mosa.physics.contact.driven import Held
from mosa.physics.contact.driven_kernels import HEAVIER, driven_kernels


class DrivenBuffers:
    """Sets among the columns of `colliders`, the `ColliderBuffers` of the workspace `work`, whose
    poses and reactions are theirs.

    mass_wp: (N,) [kg] with which particles go to the grid; paths, adj_paths: (S, W P, 3) places [m]
    and rates [m/s] of the P points of W worlds.
    """

    def __init__(self, colliders, scalar, substeps: int, points: int, work) -> None:
        self.colliders, self.count = colliders, points
        self.kernels = driven_kernels(scalar, work.exact)
        self._work = weakref.proxy(work)
        n, vec3 = work.particles, colliders.kernels.vec3
        self._sets, self._sets_wp = work.array((n,), wp.int32, torch.int32)
        self._points, self._points_wp = work.array((n,), wp.int32, torch.int32)
        self._local, self._local_wp = work.array((n, 3), vec3)
        _, self._v_held = work.array((n, 3), vec3)
        self._mass, self.mass_wp = work.array((n,), colliders.scalar)
        self.paths, self._paths = colliders.vectors(substeps, work.worlds * points, 2)
        if colliders.with_adjoint:
            self.adj_paths, self._adj_paths = colliders.vectors(substeps, work.worlds * points, 2)
            self._adj_sums = colliders.sums(self.adj_paths)

    def load(self, held: Held, paths: tuple) -> None:
        """Copy in which particles are driven, and the paths of the points of a segment's substeps."""
        for target, source in zip(self.paths, paths):
            target.copy_(source)
        for target, source in zip((self._sets, self._local, self._points), held):
            target.copy_(source)
        more = (self._sets >= 0) * (HEAVIER - 1.0)
        self._mass.copy_(self._work.mass * (1.0 + more))

    def reset_adjoint(self) -> None:
        for array in self.colliders.added_to(self._adj_paths, self._adj_sums):
            array.zero_()

    def settle_adjoint(self) -> None:
        self.colliders.settle_sums(self.adj_paths, self._adj_sums)

    def _poses(self) -> list:
        return [*self.colliders.pose_arrays, *self._paths]

    def _columns(self) -> list:
        return [self._work.size, self.colliders.count]

    def hold(self, step: int, x, v, time: float) -> wp.array:
        """Velocities that go to the grid in substep `step`, of particles that have velocities v
        before. time [s]: as of `ColliderBuffers.strike`."""
        work = self._work
        work.run(self.kernels.hold, work.particles, [
            x, v, work.springs_wp, self._sets_wp, self._local_wp, self._points_wp, time, *self._columns(), self.count, step,
            *self._poses(), self._v_held,
        ])  # fmt: skip
        return self._v_held

    def feel(self, step: int, x, v, v_new, time: float, impulses) -> None:
        """After the grid of the substep whose `hold` was the last: adds up the reactions."""
        work = self._work
        work.run(self.kernels.feel, work.particles, [
            x, v, self._v_held, v_new, work.mass_wp, impulses, self._sets_wp, time, *self._columns(), step,
            self.colliders.pose_arrays[0], *self.colliders.reaction_arrays,
        ])  # fmt: skip

    def adj_feel(self, step: int, x, time: float, adj_v_new) -> None:
        """Adds the reactions' part to the adjoint of the velocities after the grid."""
        work = self._work
        work.run(self.kernels.adj_feel, work.particles, [
            x, work.mass_wp, self._sets_wp, time, *self._columns(), step, self.colliders.pose_arrays[0],
            *self.colliders.adj_reaction_arrays, adj_v_new,
        ])  # fmt: skip

    def adjoint(self, step: int, x, v, v_new, time: float, impulses, adj_x, adj_v, adj_springs) -> None:  # fmt: skip
        """Turns the adjoint of velocities after `hold` into that before it; adds to the others."""
        own, work = self.colliders.added_to(self._adj_paths, self._adj_sums), self._work
        work.run(self.kernels.adj_hold, work.particles, [
            x, v, v_new, work.springs_wp, work.mass_wp, impulses, self._sets_wp, self._local_wp, self._points_wp, time,
            *self._columns(), self.count, step, *self._poses(), *self.colliders.adj_reaction_arrays, adj_x, adj_v, adj_springs,
            *self.colliders.adj_pose_arrays, *own,
        ])  # fmt: skip
