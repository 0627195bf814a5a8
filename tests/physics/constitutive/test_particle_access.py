"""A particle's own numbers: values and gradients against plain indexing, and what their adjoints compile to for a GPU."""

import re

import pytest
import torch
import warp as wp

from mosa.physics.constitutive.laws import SLOTS, law_named
from mosa.physics.constitutive.material_kernels import (
    ROWS,
    field_types,
    state_kernel,
    stress_kernel,
)
from mosa.physics.constitutive.particle_access import LANES, particle_access
from mosa.physics.launching import aligned, warp_stream

GPU = pytest.param("cuda", marks=pytest.mark.gpu)
SCALARS = {torch.float32: wp.float32, torch.float64: wp.float64}
SHAPES = {"matrix33": (3, 3), "vector6": (6,), "parameters": (SLOTS,)}


def launched(kernel, arrays, adjoints) -> None:
    """Forward and adjoint on the stream on which torch fills what they read and write."""
    device = arrays[0].device
    with warp_stream(torch.device(wp.device_to_torch(device))):
        wp.launch(kernel, 77, inputs=arrays, device=device)
        wp.launch(kernel, 77, inputs=arrays, adj_inputs=adjoints, adjoint=True, device=device)
    wp.synchronize_device(device)


def kernel_of(name: str, scalar, own: bool):
    """out[i] = sum of the squares of the numbers that particle i has."""
    shape = SHAPES[name]
    make = wp.types.matrix if len(shape) == 2 else wp.types.vector
    size = {"shape": shape} if len(shape) == 2 else {"length": shape[0]}
    field, double = make(dtype=scalar, **size), make(dtype=wp.float64, **size)
    load = getattr(particle_access(scalar, SLOTS), name)

    @wp.kernel(module="unique")
    def kernel(numbers: wp.array(dtype=field), out: wp.array(dtype=wp.float64)):
        i = wp.tid()
        if wp.static(own):
            value = load(numbers, i, i) if wp.static(name == "vector6") else load(numbers, i)
        else:
            value = double(numbers[i])
        out[i] = wp.ddot(value, value) if wp.static(len(shape) == 2) else wp.dot(value, value)

    return kernel, field


@pytest.mark.parametrize("device", ["cpu", GPU])
@pytest.mark.parametrize("dtype", SCALARS)
@pytest.mark.parametrize("name", SHAPES)
def test_values_and_gradients_are_those_of_plain_indexing(name, dtype, device):
    """The gradient is added to what is there: an adjoint's target is rarely empty."""
    generator = torch.Generator().manual_seed(0)
    numbers, there = (
        torch.randn(77, *SHAPES[name], generator=generator, dtype=torch.float64).to(device, dtype)
        for _ in range(2)
    )
    seed = torch.randn(77, generator=generator, dtype=torch.float64).to(device)
    found = []
    for own in (False, True):
        kernel, field = kernel_of(name, SCALARS[dtype], own)
        out, gradient = torch.zeros(77, dtype=torch.float64, device=device), there.clone()
        arrays = [wp.from_torch(numbers, dtype=field), wp.from_torch(out)]
        adjoints = [wp.from_torch(gradient, dtype=field), wp.from_torch(seed.clone())]
        launched(kernel, arrays, adjoints)
        found.append((out, gradient))
    for a, b in zip(*found):
        assert torch.equal(a, b)
    assert not torch.equal(found[1][1], there)


def product_of(scalar, own: bool):
    """out[i] = |G[place] x[i]|^2, place: i, or 0 where there is one matrix."""
    field, wide = (
        wp.types.matrix(shape=(6, 6), dtype=scalar),
        wp.types.matrix(shape=(6, 6), dtype=wp.float64),
    )
    vector = wp.types.vector(length=6, dtype=wp.float64)
    times66 = particle_access(scalar, SLOTS).times66

    @wp.kernel(module="unique")
    def kernel(
        G: wp.array(dtype=field), x: wp.array(dtype=vector), out: wp.array(dtype=wp.float64)
    ):
        i = wp.tid()
        if wp.static(own):
            value = times66(G, i, wp.min(i, G.shape[0] - 1), x[i])
        else:
            value = wide(G[i]) * x[i]
        out[i] = wp.dot(value, value)

    return kernel, field, vector


@pytest.mark.parametrize("device", ["cpu", GPU])
@pytest.mark.parametrize("dtype", SCALARS)
@pytest.mark.parametrize("shared", [False, True])
def test_a_product_with_an_operator_is_that_of_matrices(shared, dtype, device):
    """A matrix that all share is read at one place, and each particle adds to the gradient of its own. To the last bit on a CPU; a
    GPU's compiler may fuse a product with a sum in one and not in the other."""
    generator = torch.Generator().manual_seed(0)

    def drawn(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64).to(device)

    G, x, there, there_x, seed = (
        drawn(1 if shared else 77, 6, 6),
        drawn(77, 6),
        drawn(77, 6, 6),
        drawn(77, 6),
        drawn(77),
    )
    G, there = G.to(dtype), there.to(dtype)
    found = []
    for own in (False, True):
        kernel, field, vector = product_of(SCALARS[dtype], own)
        matrices = G if own else G.expand(77, 6, 6).contiguous()
        out, gradients = (
            torch.zeros(77, dtype=torch.float64, device=device),
            [there.clone(), there_x.clone()],
        )
        arrays = [
            wp.from_torch(matrices, dtype=field),
            wp.from_torch(x, dtype=vector),
            wp.from_torch(out),
        ]
        adjoints = [wp.from_torch(t, dtype=kind) for t, kind in zip(gradients, (field, vector))]
        launched(kernel, arrays, [*adjoints, wp.from_torch(seed.clone())])
        found.append((out, *gradients))
    for plain, own in zip(*found):
        if device == "cpu":
            assert torch.equal(plain, own)
        else:
            # sums of six products, the largest of which rounds as the largest result does
            assert (own - plain).abs().max() <= 8 * torch.finfo(plain.dtype).eps * plain.abs().max()
    assert not torch.equal(found[1][1], there)


def test_what_the_kernels_read_is_aligned():
    flat = torch.arange(101.0)
    view = flat[1:97].view(8, 12)
    assert view.data_ptr() % 16 and aligned(view).data_ptr() % 16 == 0
    assert torch.equal(aligned(view), view)
    assert aligned(flat) is flat


@pytest.mark.parametrize("dtype", SCALARS)
def test_rotations_of_several_particles_at_once_are_those_of_each(dtype):
    """Bit for bit, also where the iteration goes another way, and of a last block that is not full."""
    generator = torch.Generator().manual_seed(0)
    size = 10 ** torch.linspace(1, -6, 77, dtype=torch.float64)[:, None, None]
    F = torch.randn(77, 3, 3, generator=generator, dtype=torch.float64)
    F = (torch.eye(3) + size * F).to(dtype)
    law, (mat33, vec6, mat66, vecp) = law_named("corotated"), field_types(SCALARS[dtype])
    kernel = stress_kernel(law.stress, law.uses_rotation, SCALARS[dtype], False)
    fields = [
        F,
        torch.zeros_like(F),
        F.new_ones(77, SLOTS),
        F.new_zeros(1, 6, 6),
        F.new_zeros(1, 6),
    ]
    kinds, block = (mat33, mat33, vecp, mat66, vec6, mat33), torch.zeros(LANES, 3, 3).double()
    found = []
    for room in (None, wp.from_torch(block, dtype=wp.mat33d)):
        tau = torch.empty_like(F)
        arrays = [wp.from_torch(t, dtype=kind) for t, kind in zip([*fields, tau], kinds)]
        wp.launch(kernel, 77, inputs=[*arrays, room], device="cpu")
        found.append(tau)
    assert torch.equal(*found) and (torch.linalg.det(F) < 0).any() and block.any()


@pytest.mark.skipif(not wp.get_cuda_supported_archs(), reason="this Warp has no compiler for GPUs")
@pytest.mark.parametrize("make", [stress_kernel, state_kernel])
def test_the_adjoints_wait_for_no_sum(make, tmp_path, monkeypatch):
    """Of the stress with an operator and of the adapter's input, compiled for compute capability 9.0 without a GPU: sums leave no
    result, and the operator's 36 numbers are added four at a time."""
    law = law_named("corotated")
    kernel = make(law.stress, law.uses_rotation, wp.float32, make is stress_kernel)
    monkeypatch.setattr(wp.config, "optimization_level", None)
    kernel.module.mark_modified()  # it may have been hashed with the options of the other tests
    wp.compile_aot_module(kernel.module, arch=90, module_dir=tmp_path, use_ptx=True)
    ptx = "\n".join(path.read_text() for path in tmp_path.glob("*.ptx"))
    bodies = re.split(r"\.entry ", ptx)[1:]
    backward = [body for body in bodies if "backward" in body.split("(")[0]]
    assert len(backward) == 1
    assert not re.search(r"\batom\.", backward[0])
    if make is stress_kernel:
        assert len(re.findall(r"red\.relaxed\.gpu\.global\.add\.v4\.f32", backward[0])) >= 9


@pytest.mark.parametrize("device", ["cpu", GPU])
@pytest.mark.parametrize("apart", [False, True])
def test_rows_of_a_shared_operators_gradient_hold_all_of_it(apart, device):
    """Of more particles than there are rows: those of one row add up, and with `apart` each has its own."""
    n, law, (mat33, vec6, mat66, vecp) = ROWS + 3, law_named("corotated"), field_types(wp.float64)
    kernel = stress_kernel(law.stress, law.uses_rotation, wp.float64, True, apart=apart)
    g = torch.Generator().manual_seed(0)

    def drawn(*shape):
        return torch.randn(*shape, generator=g, dtype=torch.float64).to(device)

    F, seed = (
        torch.eye(3, dtype=torch.float64, device=device) + 0.05 * drawn(n, 3, 3),
        drawn(n, 3, 3),
    )
    zeros = torch.zeros_like
    inputs = [F, zeros(F), torch.ones(n, SLOTS).to(F), drawn(1, 6, 6), drawn(1, 6), zeros(F)]
    kinds, found = (mat33, mat33, vecp, mat66, vec6, mat33), []
    for shared in (True, False):
        own = [
            t if shared or len(t) > 1 else t.expand(n, *t.shape[1:]).contiguous() for t in inputs
        ]
        adjoints = [
            zeros(F),
            zeros(F),
            zeros(inputs[2]),
            F.new_zeros(n, 6, 6),
            F.new_zeros(n, 6),
            seed.clone(),
        ]
        arrays = [
            [wp.from_torch(t, dtype=kind) for t, kind in zip(each, kinds)]
            for each in (own, adjoints)
        ]
        with warp_stream(F.device):
            wp.launch(
                kernel, n, inputs=[*arrays[0], None], adj_inputs=[*arrays[1], None], adjoint=True, device=device
            )  # fmt: skip
        wp.synchronize_device(device)
        found.append(adjoints[3:5])
    for rows, each in zip(*found):
        if not apart:
            each = torch.cat([each[:3] + each[ROWS:], each[3:ROWS], zeros(each[:3])])
        assert (rows - each).abs().max() <= 1e-12 * each.abs().max() and each[-4].abs().max() > 0
