"""Whole 4-vectors in memory: against plain indexing, on the CPU and on a GPU, and what the transfers compile to for one."""

import re

import pytest
import torch
import warp as wp

from mosa.physics.grid.node_access import node_access
from mosa.physics.grid.transfer_kernels import transfer_kernels
from mosa.physics.launching import warp_stream

GPU = pytest.param("cuda", marks=pytest.mark.gpu)
KINDS = {torch.float32: (wp.float32, wp.vec4f), torch.float64: (wp.float64, wp.vec4d)}


def kernel_of(dtype):
    scalar, vec4 = KINDS[dtype]
    memory = node_access(scalar)

    @wp.kernel(enable_backward=False, module="unique")
    def kernel(
        source: wp.array(dtype=vec4), index: wp.array(dtype=int), stored4: wp.array(dtype=vec4),
        stored3: wp.array(dtype=vec4), added4: wp.array(dtype=vec4), added3: wp.array(dtype=vec4),
    ):  # fmt: skip
        i = wp.tid()
        memory.store4(stored4, i, memory.load4(source, i))
        memory.store3(stored3, i, memory.load3(source, i))
        if index[i] < 0:
            return
        together = memory.run(index[i], True)
        a = memory.load4(source, i)
        b = memory.load3(source, i)
        memory.add4(added4, index[i], a, scalar(2.0) * a, scalar(3.0) * a, together)
        memory.add3(added3, index[i], b, scalar(2.0) * b, scalar(3.0) * b, together)

    return kernel


@pytest.mark.parametrize("device", ["cpu", GPU])
@pytest.mark.parametrize("dtype", KINDS)
@pytest.mark.parametrize("longest", [1, 2, 5, 100])
@pytest.mark.parametrize("rises", [0.0, 0.9])
def test_loads_stores_and_sums_are_those_of_plain_indexing(rises, longest, dtype, device):
    """Whole numbers, so that sums are exact in any order; some 16 threads meet at each target, in runs of up to `longest`, over the
    ends of warps and blocks too; the next run's target is one more with the chance `rises`. Some threads take no part."""
    n, g = 1000, torch.Generator().manual_seed(0)
    source = torch.randint(-99, 99, (n, 4), generator=g).to(device=device, dtype=dtype)
    lengths = torch.randint(1, longest + 1, (n,), generator=g)
    steps = torch.where(
        torch.rand(n, generator=g) < rises, 1, torch.randint(0, 60, (n,), generator=g)
    )
    index = (steps.cumsum(0) % 60).repeat_interleave(lengths)[:n].to(device=device)
    index[torch.randint(0, n, (50,), generator=g).to(device)] = -1
    results = [torch.full((count, 4), 7.0, device=device, dtype=dtype) for count in (n, n, 62, 62)]
    vec4 = KINDS[dtype][1]
    arrays = [
        wp.from_torch(source, dtype=vec4),
        wp.from_torch(index.int()),
        *(wp.from_torch(t, dtype=vec4) for t in results),
    ]
    with warp_stream(source.device):
        wp.launch(kernel_of(dtype), n, inputs=arrays, device=arrays[0].device)
    wp.synchronize_device(arrays[0].device)
    three = source.clone()
    three[:, 3] = 0
    part = index >= 0
    expected = [source, three]
    for values in (source, three):
        expected.append(torch.full_like(results[2], 7.0))
        for k in range(3):
            expected[-1].index_add_(0, index[part] + k, (k + 1) * values[part])
    for found, value in zip(results, expected):
        assert torch.equal(found, value)


@pytest.mark.skipif(not wp.get_cuda_supported_archs(), reason="this Warp has no compiler for GPUs")
@pytest.mark.parametrize(
    "dtype, add, load, per_node",
    [(torch.float32, "add.v4.f32", "v4.f32", 1), (torch.float64, "add.f64", "v2.f64", 4)],
)
def test_the_scatter_and_gather_of_a_node_are_vector_instructions(
    dtype, add, load, per_node, tmp_path
):
    """The transfers, compiled for compute capability 9.0 without a GPU: 27 nodes, no atomic that returns a value."""
    kernels = transfer_kernels(KINDS[dtype][0], each=2)
    for module in (kernels.p2g.module, kernels.adj_g2p.module):
        wp.compile_aot_module(module, arch=90, module_dir=tmp_path, use_ptx=True)
    found = "".join(file.read_text() for file in tmp_path.glob("*.ptx"))
    entries = {
        re.match(r"\w+__(\w+?)_[0-9a-f]+_", part)[1]: part
        for part in found.split(".visible .entry ")[1:]
    }
    adds = {name: text.count(f"red.relaxed.gpu.global.{add}") for name, text in entries.items()}
    loads = {
        name: len(re.findall(rf"ld\.global\.nc\.(?:L\w+::\w+\.)*{re.escape(load)}", text))
        for name, text in entries.items()
    }
    assert adds["p2g"] == 2 * 27 * per_node and adds["adj_g2p"] == 27 * min(per_node, 3)
    for name in ("g2p", "adj_g2p", "adj_p2g"):
        assert loads[name] >= 27, loads
    assert "atom.global.add.f" not in found and "atom.add.f" not in found
