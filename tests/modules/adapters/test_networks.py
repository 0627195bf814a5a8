"""The memory-saving MLP is an ordinary one."""

import torch
from torch.autograd import gradcheck

from mosa.modules.adapters.networks import TwoHiddenLayers, zero_outputs


def test_value_and_gradients_are_those_of_the_layers_in_a_row():
    torch.manual_seed(0)
    network = TwoHiddenLayers(5, 3, 16).double()
    x = torch.randn(9, 5, dtype=torch.float64, requires_grad=True)
    seed = torch.randn(9, 3, dtype=torch.float64)
    inputs = (x, *network.parameters())
    plain = x
    for layer in network:
        plain = layer(plain)
    expected = torch.autograd.grad((plain * seed).sum(), inputs)
    value = network(x)
    torch.testing.assert_close(value, plain, rtol=0, atol=1e-14)
    for a, b in zip(torch.autograd.grad((value * seed).sum(), inputs), expected):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(network[-1](network.features(x)), plain, rtol=0, atol=1e-14)


def test_gradient_against_differences():
    torch.manual_seed(1)
    network = TwoHiddenLayers(4, 2, 6).double()
    parameters = tuple(p.detach().requires_grad_() for p in network.parameters())
    x = torch.randn(3, 4, dtype=torch.float64, requires_grad=True)

    def value(x, *weights):
        return torch.func.functional_call(
            network, dict(zip(dict(network.named_parameters()), weights)), (x,)
        )

    assert gradcheck(value, (x, *parameters), rtol=1e-6, atol=1e-9)


def test_frozen_weights_get_no_gradient_and_inputs_still_do():
    network = TwoHiddenLayers(4, 2, 6).requires_grad_(False)
    x = torch.randn(3, 4, requires_grad=True)
    network(x).sum().backward()
    assert x.grad is not None and x.grad.abs().sum() > 0
    assert all(p.grad is None for p in network.parameters())


def test_zeroed_outputs_are_zero_and_the_others_are_not():
    network = TwoHiddenLayers(4, 5, 6)
    zero_outputs(network[-1], 2)
    y = network(torch.randn(7, 4))
    assert torch.equal(y[:, :2], torch.zeros(7, 2)) and (y[:, 2:] != 0).all()
