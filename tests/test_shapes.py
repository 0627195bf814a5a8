"""Functions of kinematics take and give the shapes of their docstrings, for any leading dimensions and in both precisions."""

import types

import pytest
import torch
from torch import Tensor

from mosa.modules.fitting.losses import cofactors, polar_rotation, stretches
from mosa.physics.rotations import axial, skew
from mosa.rendering import covariance

jaxtyping = pytest.importorskip("jaxtyping")
beartype = pytest.importorskip("beartype").beartype
VECTOR, MATRIX, QUATERNION = (
    jaxtyping.Float[Tensor, shape] for shape in ("*n 3", "*n 3 3", "*n 4")
)
SHAPES = {
    skew: ((VECTOR,), MATRIX),
    axial: ((MATRIX,), VECTOR),
    cofactors: ((MATRIX,), MATRIX),
    polar_rotation: ((MATRIX,), MATRIX),
    stretches: ((MATRIX,), VECTOR),
    covariance.quaternion_to_matrix: ((QUATERNION,), MATRIX),
    covariance.quaternion_multiply: ((QUATERNION, QUATERNION), QUATERNION),
    covariance.covariance_from: ((VECTOR, QUATERNION), MATRIX),
    covariance.matrix_to_quaternion: ((MATRIX,), QUATERNION),
    covariance.scales_and_rotations: ((MATRIX,), tuple[VECTOR, QUATERNION]),
}


def checked(function, given, answer):
    """The function with these types of its arguments and its answer, compared with what it is called with and returns."""
    code = function.__code__
    copy = types.FunctionType(
        code, function.__globals__, function.__name__, function.__defaults__, function.__closure__
    )
    copy.__annotations__ = dict(zip(code.co_varnames, given), **{"return": answer})
    return jaxtyping.jaxtyped(copy, typechecker=beartype)


def drawn(kind, leading, dtype):
    """Tensors that every function takes: of positive determinant and symmetric, or vectors of positive numbers."""
    last = {VECTOR: (3,), MATRIX: (3, 3), QUATERNION: (4,)}[kind]
    values = (
        torch.rand(*leading, *last, dtype=dtype, generator=torch.Generator().manual_seed(0)) + 0.1
    )
    return values @ values.mT + torch.eye(3, dtype=dtype) if kind is MATRIX else values


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("leading", [(), (5,), (2, 5)], ids=str)
@pytest.mark.parametrize("function", SHAPES, ids=lambda function: function.__name__)
def test_shapes_are_those_of_the_docstring(function, leading, dtype):
    given, answer = SHAPES[function]
    found = checked(function, given, answer)(*(drawn(kind, leading, dtype) for kind in given))
    assert all(part.dtype == dtype for part in (found if isinstance(found, tuple) else (found,)))


def test_a_wrong_shape_is_found():
    with pytest.raises(jaxtyping.TypeCheckError, match="return value"):
        checked(skew, (VECTOR,), VECTOR)(torch.ones(5, 3))
    with pytest.raises(jaxtyping.TypeCheckError, match="parameters"):
        checked(skew, (VECTOR,), MATRIX)(torch.ones(5, 4))
    with pytest.raises(jaxtyping.TypeCheckError):  # leading dimensions that differ
        checked(covariance.covariance_from, (VECTOR, QUATERNION), MATRIX)(
            torch.ones(5, 3), torch.ones(1, 4)
        )
