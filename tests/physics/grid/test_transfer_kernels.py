"""The transfers of a GPU, whose threads share sums and stores, against those of a CPU, of counts that fill no block."""

import pytest
import torch
import warp as wp

from mosa.physics.grid.transfer_kernels import NO_EVENT, transfer_kernels
from mosa.physics.launching import filled, launch, warp_stream

WORLDS, DIMS = 3, [(9, 8, 7), (7, 10, 8), (12, 7, 9)]


def inputs(size: int, order: str) -> dict[str, torch.Tensor]:
    """Particles of three worlds with nodes of their own, one in ten of them outside; dx is 1."""
    g = torch.Generator().manual_seed(size)
    n, nodes = WORLDS * size, sum(a * b * c for a, b, c in DIMS)
    x = (1 + torch.rand(WORLDS, size, 3, generator=g) * (torch.tensor(DIMS) - 3)[:, None]).float()
    cell = ((x - 0.5).floor() * torch.tensor([400, 20, 1])).sum(-1)
    places = (
        cell.argsort(-1)
        if order == "by cell"
        else torch.rand(WORLDS, size, generator=g).argsort(-1)
    )
    x = x.gather(1, places[..., None].expand_as(x)).view(n, 3)
    x[torch.rand(n, generator=g) < 0.1] += 50.0
    shapes = dict(v=(3,), C=(3, 3), F=(3, 3), tau=(3, 3), ax=(3,), av=(3,), aC=(3, 3), aA=(3, 3))
    made = {name: torch.randn(n, *shape, generator=g) for name, shape in shapes.items()}
    made |= {name: torch.rand(n, generator=g) + 0.5 for name in ("mass", "volume")}
    return {"x": x} | made | {k: torch.randn(nodes, 4, generator=g) for k in ("velocity", "a_grid")}


def transferred(given: dict[str, torch.Tensor], size: int, device: str) -> dict[str, torch.Tensor]:
    """What all four kernels write."""
    each = 2 if device == "cuda" else 1
    kernels, n = transfer_kernels(wp.float32, each=each), WORLDS * size
    kinds = {1: wp.float32, 3: kernels.vec3, 4: kernels.vec4, 9: kernels.mat33}

    def array(t: torch.Tensor) -> wp.array:
        return wp.from_torch(t, dtype=kinds[t[0].numel()])

    def particles(**fields: torch.Tensor):
        return filled(kernels.Particles, *(array(fields[name]) for name in "x v C F A".split()))

    t = {name: value.to(device) for name, value in given.items()}
    now = particles(A=t["F"], **{name: t[name] for name in "xvCF"})
    then, adj = ({k: torch.full_like(t[k.replace("A", "F")], 1.0) for k in "xvCFA"} for _ in "ab")
    adj_then = particles(x=t["ax"], v=t["av"], C=t["aC"], F=t["F"], A=t["aA"])
    grid, adj_velocity = torch.zeros_like(t["velocity"]), torch.zeros_like(t["velocity"])
    adj_tau, flags = torch.full_like(t["tau"], 1.0), torch.full((4,), NO_EVENT, device=device)
    rows, first = torch.zeros(WORLDS, 3, 3, dtype=torch.int32), 0
    for row, dims in zip(rows, DIMS):
        row[1], row[2, 0] = torch.tensor(dims), first
        first += dims[0] * dims[1] * dims[2]
    windows = wp.from_torch(rows.view(-1, 3).to(device), dtype=wp.vec3i)
    grids, events = filled(kernels.Grids, windows, size, 1.0, 1.0), wp.from_torch(flags)
    low, high = kernels.vec3(2.0, 2.0, 2.0), kernels.vec3(5.0, 5.0, 5.0)
    sent = [now, array(t["v"]), array(t["tau"]), array(t["mass"]), array(t["volume"]), grids, 0.5]
    with warp_stream(t["x"].device):
        for kernel, threads, arguments in (
            (kernels.p2g, -(-n // each), [*sent, 1, 3, events, array(grid)]),
            (kernels.g2p, n, [now, array(t["velocity"]), grids, 0.5, low, high, 3, events, particles(**then)]),
            (kernels.adj_g2p, n, [now, array(t["velocity"]), grids, 0.5, particles(**then), adj_then,
                                  particles(**adj), array(adj_velocity)]),
            (kernels.adj_p2g, n, [*sent, array(t["a_grid"]), particles(**adj), array(adj_tau)]),
        ):  # fmt: skip
            launch(kernel, threads, arguments, windows.device)
    wp.synchronize_device(windows.device)
    found = {"grid": grid, "adj velocity": adj_velocity, "adj tau": adj_tau, "flags": flags, **then}
    return {k: v.cpu() for k, v in (found | {f"adj {k}": v for k, v in adj.items()}).items()}


@pytest.mark.gpu
@pytest.mark.parametrize("order", ["by cell", "shuffled"])
@pytest.mark.parametrize("size", [1, 21, 333, 5003])
def test_ragged_counts_of_several_worlds_on_a_gpu(size, order):
    given = inputs(size, order)
    expected = transferred(given, size, "cpu")
    for name, found in transferred(given, size, "cuda").items():
        if name == "flags":
            assert torch.equal(found, expected[name])
            continue
        scale = expected[name].abs().max().clamp_min(1e-30)
        assert (found - expected[name]).abs().max() <= 2e-6 * scale, name
