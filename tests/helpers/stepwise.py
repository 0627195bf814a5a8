"""The progressive stress adaptation in the paper's order, nothing assembled: a twin of `ProgressiveOperator.forward`."""

import torch
from torch import Tensor

from mosa.modules.adapters.progressive import ProgressiveOperator
from mosa.modules.adapters.stress import StressAdapter


def stepwise_planes(stress: Tensor, planes: Tensor) -> tuple[Tensor, Tensor]:
    """(n (N, 3), shears (N, 3) yz, zx, xy) of stress (N, 6) on the three planes (step 3). planes: corrections C (N, 3, 3, 3)."""
    xx, yy, zz, yz, zx, xy = stress.unbind(-1)

    def on_plane(C: Tensor, *components: Tensor) -> Tensor:
        traction = torch.stack(components, -1)
        return traction + (C @ traction[..., None])[..., 0]

    C_x, C_y, C_z = planes.unbind(1)
    t_x, t_y, t_z = on_plane(C_x, xx, xy, zx), on_plane(C_y, yy, yz, xy), on_plane(C_z, zz, zx, yz)
    normals = torch.stack([t_x[:, 0], t_y[:, 0], t_z[:, 0]], -1)
    shears = [t_y[:, 1] + t_z[:, 2], t_x[:, 2] + t_z[:, 1], t_x[:, 1] + t_y[:, 2]]
    return normals, torch.stack(shears, -1) / 2


def stepwise(operator: ProgressiveOperator, w: Tensor, s: Tensor) -> Tensor:
    """s3 (N, 6); without major_symmetry, which is one of the 6x6 operator."""
    _, s1, kw = operator.first(w, s)
    planes, l1 = operator.plane_corrections(kw, s1)
    n, shears = stepwise_planes(s1, planes)
    normal, l2 = operator.normal_correction(l1, n)
    s2 = torch.cat([n + (normal @ n[..., None])[..., 0], shears], -1)
    return s2 + operator.last(l2, kw, s2)


def increment(adapter: StressAdapter, w: Tensor, s: Tensor) -> Tensor:
    """d(w, s) - [rest_free] d(0, 0), (N, 6), as `StressAdapter.increment`, to which major symmetry leaves it."""
    if adapter.operator.major_symmetry:
        return adapter.increment(w, s)
    zero = torch.zeros_like(w[:1])
    s = torch.cat([s, zero])
    d = stepwise(adapter.operator, torch.cat([w, zero]), s) - s
    return d[:-1] - d[-1:] if adapter.rest_free else d[:-1]
