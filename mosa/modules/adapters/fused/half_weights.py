"""The weights of the four networks as `operator_half` reads them: in float16, padded, one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

BIAS = 12
"""Column of the networks' inputs, after (w, s), that is 1: its weights are biases."""
HIDDEN_BIASES = (3, 9, 11, 17, 19, 23)
"""Of the layers with `hidden` outputs whose input has no column to spare, by their place among the 26 weights; row k of a tile."""


class _Block(NamedTuple):
    """Entries of a weight (outputs x inputs, a bias one input) and where they go in a tile (inputs x outputs)."""

    weight: int
    outputs: slice
    inputs: slice
    row: int = 0
    column: int = 0
    halved: bool = False


class _Tile(NamedTuple):
    rows: int
    columns: int
    blocks: tuple[_Block, ...]


def _tiles(hidden: int) -> list[_Tile]:
    """In the order in which the kernel finds them; its names beside them. What goes into a silu is halved: silu(z) = u + u tanh(u)
    with u = z/2."""
    every, h = slice(None), hidden

    def first(weight: int, inputs: slice = every) -> tuple[_Block, _Block]:
        """A first layer's weights for inputs of at most 12 columns, and its bias."""
        return _Block(weight, every, inputs, halved=True), _Block(
            weight + 1, every, every, BIAS, halved=True
        )

    def whole(
        weight: int,
        outputs: slice = every,
        inputs: slice = every,
        columns: int = h,
        column: int = 0,
    ) -> _Tile:
        return _Tile(
            h,
            columns,
            (
                _Block(
                    weight, outputs, inputs, column=column, halved=weight in (2, 8, 14, 16, 20, 22)
                ),
            ),
        )

    after = slice(h, None)  # the inputs of Psi2 and Theta after l1 and l2
    numbers, l2 = slice(0, 12), slice(12, None)  # the outputs of Psi2
    biases = tuple(
        _Block(bias, l2 if bias == 19 else every, every, k, halved=bias in (3, 9, 17, 23))
        for k, bias in enumerate(HIDDEN_BIASES)
    )
    first_layers = [
        _Tile(16, h, part) for part in (first(0), first(6), first(14, after), first(20, after))
    ]  # F1, A1, Bn, Tx
    squares = [
        whole(2), whole(8), whole(10),  # F2, A2, A3
        whole(14, inputs=slice(0, h)), whole(16), whole(18, l2),  # B1, B2, B4
        whole(20, inputs=slice(0, h)), whole(22),  # T1, T2
    ]  # fmt: skip
    outputs = [
        whole(4, columns=16, column=6), whole(18, numbers, columns=16), whole(24, columns=16),  # F3, B3, T3
        whole(12, columns=64),  # Ap
    ]  # fmt: skip
    narrow = _Tile(
        16,
        16,
        (_Block(5, every, every, 0, 6), _Block(19, numbers, every, 1), _Block(25, every, every, 2)),
    )
    return [
        *first_layers,
        _Tile(16, h, biases),
        *squares,
        *outputs,
        narrow,
        _Tile(16, 64, (_Block(13, every, every),)),
    ]


@lru_cache
@torch.inference_mode(False)  # who asks first may not want gradients, and others do
def _order(shapes: tuple[torch.Size, ...], device: torch.device) -> tuple[Tensor, Tensor]:
    """(index, factor) of each packed number among all weights and a final zero."""
    numbers, start = [], 0
    for shape in shapes:
        count = shape.numel()
        numbers.append(torch.arange(start, start + count).view(shape[0], -1))
        start += count
    indices, factors = [], []
    for tile in _tiles(shapes[0][0]):
        index = torch.full((tile.rows, tile.columns), start)
        factor = torch.ones(tile.rows, tile.columns)
        for block in tile.blocks:
            part = numbers[block.weight][block.outputs, block.inputs].T
            place = (
                slice(block.row, block.row + part.shape[0]),
                slice(block.column, block.column + part.shape[1]),
            )
            index[place] = part
            factor[place] = 0.5 if block.halved else 1.0
        indices.append(index.flatten())
        factors.append(factor.flatten())
    return torch.cat(indices).to(device), torch.cat(factors).to(device)


def packed(weights: Sequence[Tensor]) -> Tensor:
    """(K,) float16 of the 26 weights in the kernels' order."""
    index, factor = _order(tuple(p.shape for p in weights), weights[0].device)
    flat = torch.cat([*(p.flatten() for p in weights), weights[0].new_zeros(1)])
    return (flat[index] * factor).half()
