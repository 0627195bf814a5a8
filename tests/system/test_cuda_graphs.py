"""Functions that a GPU replays: the same values and gradients as without."""

import pytest
import torch

from mosa.system.cuda_graphs import Graphed

SCALE = torch.tensor([2.0, 3.0, 5.0])


def parts(scale):
    def function(x, y):
        return (x * scale).sin() + y, (x * y).sum()

    return function


def test_on_a_cpu_it_is_the_function():
    graphed, x, y = Graphed(parts(SCALE)), torch.rand(3, requires_grad=True), torch.rand(3)
    for got, expected in zip(graphed(x, y), parts(SCALE)(x, y), strict=True):
        assert torch.equal(got, expected) and got.grad_fn is not None


@pytest.mark.gpu
def test_on_a_gpu_every_call_has_its_own_values_and_gradients():
    scale = SCALE.cuda()
    graphed = Graphed(parts(scale))
    for rows in (4, 4, 4, 7):
        x = torch.rand(rows, 3, device="cuda", requires_grad=True)
        y = torch.rand(3, device="cuda")
        found = []
        for function in (graphed, parts(scale)):
            values, number = function(x, y)
            (gradient,) = torch.autograd.grad(values.square().sum() + number, x)
            found.append((values.detach().clone(), number.detach().clone(), gradient.clone()))
        for got, expected in zip(*found, strict=True):
            assert torch.equal(got, expected)
    with torch.no_grad():
        assert torch.equal(graphed(x, y)[0], parts(scale)(x, y)[0])


@pytest.mark.gpu
def test_what_cannot_be_captured_runs_as_it_is():
    x = torch.rand(3, device="cuda", requires_grad=True)
    graphed = Graphed(lambda x: x * float(x.detach().sum()))  # waits for the GPU
    stream = torch.cuda.current_stream()
    with pytest.warns(UserWarning, match="no CUDA graph"):
        first = graphed(x)
    assert torch.cuda.current_stream() == stream
    assert torch.equal(first, graphed(x)) and torch.equal(first, x * float(x.detach().sum()))
