"""Device buffers of driven particles: which they are, their points' paths by substep, and the
launches on them."""

import weakref

import torch
import warp as wp

from mosa.physics.contact.driven import Held
from mosa.physics.contact.driven_kernels import HEAVIER, driven_kernels
from mosa.physics.launching import filled


class DrivenBuffers:
    """Sets among the columns of `colliders`, the `ColliderBuffers` of the workspace `work`, whose
    poses and reactions are theirs.

    mass_wp: (N,) [kg] with which particles go to the grid; paths, adj_paths: (S, W P, 3) places [m]
    and rates [m/s] of the P points of W worlds."""

    def __init__(self, colliders, scalar, substeps: int, points: int, work) -> None:
        self.colliders, self.count = colliders, points
        self.kernels = driven_kernels(scalar, work.exact)
        self._work = weakref.proxy(work)
        n, vec3 = work.particles, colliders.kernels.vec3
        self._sets, sets = work.array((n,), wp.int32, torch.int32)
        self._points, points_of = work.array((n,), wp.int32, torch.int32)
        self._local, local = work.array((n, 3), vec3)
        self._driven = filled(self.kernels.Sets, sets, local, points_of, colliders.count, points)
        _, self._v_held = work.array((n, 3), vec3)
        self._mass, self.mass_wp = work.array((n,), colliders.scalar)
        self.paths, paths = colliders.vectors(substeps, work.worlds * points, 2)
        self._paths = filled(self.kernels.Paths, *paths)
        if colliders.with_adjoint:
            self.adj_paths, adj_paths = colliders.vectors(substeps, work.worlds * points, 2)
            self._adj_sums = colliders.sums(self.adj_paths)
            self._adj_added = colliders.added_to(adj_paths, self._adj_sums)
            self._adj_path_sums = filled(self.kernels.PathSums, *self._adj_added)

    def load(self, held: Held, paths: tuple) -> None:
        """Copy in which particles are driven, and the paths of the points of a segment's substeps."""
        for target, source in zip(self.paths, paths):
            target.copy_(source)
        for target, source in zip((self._sets, self._local, self._points), held):
            target.copy_(source)
        more = (self._sets >= 0) * (HEAVIER - 1.0)
        self._mass.copy_(self._work.mass * (1.0 + more))

    def reset_adjoint(self) -> None:
        for array in self._adj_added:
            array.zero_()

    def settle_adjoint(self) -> None:
        self.colliders.settle_sums(self.adj_paths, self._adj_sums)

    def hold(self, step: int, x, v, time: float) -> wp.array:
        """Velocities that go to the grid in substep `step`, of particles that have velocities v
        before. time [s]: as of `ColliderBuffers.strike`."""
        work = self._work
        work.run(self.kernels.hold, work.particles, [
            x, v, work.springs_wp, time, work.size, step, self._driven, self.colliders.pose_arrays, self._paths,
            self._v_held,
        ])  # fmt: skip
        return self._v_held

    def feel(self, step: int, x, v, v_new, time: float, impulses) -> None:
        """After the grid of the substep whose `hold` was the last: adds up the reactions."""
        work = self._work
        work.run(self.kernels.feel, work.particles, [
            x, v, self._v_held, v_new, work.mass_wp, impulses, time, work.size, step, self._driven,
            self.colliders.pose_arrays, *self.colliders.reaction_arrays,
        ])  # fmt: skip

    def adj_feel(self, step: int, x, time: float, adj_v_new) -> None:
        """Adds the reactions' part to the adjoint of the velocities after the grid."""
        work = self._work
        work.run(self.kernels.adj_feel, work.particles, [
            x, work.mass_wp, time, work.size, step, self._driven, self.colliders.pose_arrays,
            *self.colliders.adj_reaction_arrays, adj_v_new,
        ])  # fmt: skip

    def adjoint(self, step: int, x, v, v_new, time: float, impulses, adj_x, adj_v, adj_springs) -> None:  # fmt: skip
        """Turns the adjoint of velocities after `hold` into that before it; adds to the others."""
        work, colliders = self._work, self.colliders
        work.run(self.kernels.adj_hold, work.particles, [
            x, v, v_new, work.springs_wp, work.mass_wp, impulses, time, work.size, step, self._driven,
            colliders.pose_arrays, self._paths, *colliders.adj_reaction_arrays, adj_x, adj_v, adj_springs,
            colliders.adj_pose_sums, self._adj_path_sums,
        ])  # fmt: skip
