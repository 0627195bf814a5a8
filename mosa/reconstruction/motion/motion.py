"""Two parametrisations of a motion over time: free amplitudes of smooth modes, and the motion-basis network of GIC."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from mosa.reconstruction.motion.cues import Neighbourhood
from mosa.reconstruction.motion.modes import Modes
from mosa.rendering.covariance import carried_covariance, covariance_from, quaternion_multiply
from mosa.types import Splats


@dataclass(frozen=True)
class MotionSample:
    """S frames of a moving Gaussian set. positions: (S, N, 3) [m]; covariances: (S, N, 3, 3) [m^2]; deformation: (S, N, 3, 3);
    scales: (S, N, 3) [m]; rotations: (S, N, 4) quaternions wxyz of the Gaussians, None where their shape follows the
    deformation. deformation is None where the network is evaluated without neighbourhoods."""

    positions: Tensor
    covariances: Tensor
    deformation: Tensor | None
    scales: Tensor | None = None
    rotations: Tensor | None = None


SOFTNESS = 10.0
"""Modes after the affine ones in which the unit of amplitudes halves."""


class ModalMotion(nn.Module):
    """Displacement of frame t = offset_t + sum_k modes_k amplitude_tk (in units `reach` [m] times a factor that falls with k).

    Frame 0 is the rest frame. With `free_shape` the Gaussians' scale and rotation have amplitudes of their own (the
    paper's free scale and rotation); otherwise A_t = F_t A_0 F_t^T with F_t the deformation gradient, as in the
    simulation.
    offsets: (T, 3) [m] first guess of the translation of each frame."""

    def __init__(
        self, offsets: Tensor, energies: Tensor, *, reach: float, free_shape: bool = False,
    ) -> None:  # fmt: skip
        super().__init__()
        frames, count = len(offsets), len(energies)
        self.reach = reach
        order = (torch.arange(count, device=offsets.device) - 3).clamp(min=0)
        self.register_buffer("offsets", offsets - offsets[0])
        self.register_buffer("unit", reach / (1 + order / SOFTNESS))
        self.register_buffer("turn", 1 / (1 + order / SOFTNESS))
        self.amplitude = nn.Parameter(torch.zeros(frames, count, 3, device=offsets.device))
        shapes = torch.zeros(frames, count, 6, device=offsets.device)
        self.shape_amplitude = nn.Parameter(shapes) if free_shape else None

    def coefficients(self, frames: Tensor) -> Tensor:
        """Mode coefficients (S, K, 3) [m] of the given frames; zero at frame 0."""
        moving = (frames > 0).to(self.unit)[:, None, None]
        return moving * self.amplitude[frames] * self.unit[:, None]

    def displacement(self, frames: Tensor, modes: Modes) -> tuple[Tensor, Tensor]:
        """Displacement (S, N, 3) [m] and deformation gradient (S, N, 3, 3)."""
        return self.displaced(self.coefficients(frames), frames, modes)

    def displaced(
        self, coefficients: Tensor, frames: Tensor, modes: Modes
    ) -> tuple[Tensor, Tensor]:
        """The same under other coefficients (S, K, 3) [m], of frames (S,), or (1,) for all of them."""
        shift, gradient = modes.displacement(coefficients)
        identity = torch.eye(3, dtype=gradient.dtype, device=gradient.device)
        return shift + self.offsets[frames][:, None], gradient + identity

    def forward(
        self, frames: Tensor, splats: Splats, modes: Modes, around: Neighbourhood | None = None
    ) -> MotionSample:
        shift, deformation = self.displacement(frames, modes)
        positions = splats.means + shift
        if self.shape_amplitude is None:
            shapes = carried_covariance(deformation, splats.scales, splats.rotations)
            return MotionSample(positions, shapes, deformation)
        moving = (frames > 0).to(self.turn)[:, None, None]
        shape = modes.values @ (moving * self.shape_amplitude[frames] * self.turn[:, None])
        scales = splats.scales * shape[..., :3].exp()
        half = 0.5 * shape[..., 3:]
        turn = torch.cat([torch.ones_like(half[..., :1]), half], -1)
        rest = splats.rotations.expand(len(frames), -1, -1)
        rotations = nn.functional.normalize(quaternion_multiply(turn, rest), dim=-1)
        return MotionSample(
            positions, covariance_from(scales, rotations), deformation, scales, rotations
        )


def _encoded(x: Tensor, frequencies: int) -> Tensor:
    """x, sin(2^l pi x), cos(2^l pi x), l < frequencies."""
    octaves = 2.0 ** torch.arange(frequencies, dtype=x.dtype, device=x.device)
    angles = torch.pi * x[..., None] * octaves
    return torch.cat([x, angles.sin().flatten(-2), angles.cos().flatten(-2)], -1)


class _Layers(nn.Module):
    """`layers` hidden layers of ReLU and a linear one; skip: the input is read once more after that
    many of them, 0: never."""

    def __init__(self, inputs: int, hidden: int, layers: int, outputs: int, skip: int = 0) -> None:
        super().__init__()
        self.skip = skip if skip < layers else 0
        read = [inputs if i == 0 else hidden + inputs * (i == self.skip) for i in range(layers)]
        self.hidden = nn.ModuleList(nn.Linear(width, hidden) for width in read)
        self.last = nn.Linear(hidden, outputs)
        nn.init.normal_(self.last.weight, std=0.02)
        nn.init.zeros_(self.last.bias)

    def forward(self, x: Tensor) -> Tensor:
        h = x
        for i, layer in enumerate(self.hidden):
            h = torch.cat([x, h], -1) if i and i == self.skip else h
            h = layer(h).relu()
        return self.last(h)


class MotionBasisNetwork(nn.Module):
    """Deformation = mean over `bases` of coefficient_b(x, t) basis_b(t), number by number (GIC; eq. 2).

    basis_b: time to 10 numbers (translation 3 in units of `reach` [m], quaternion 4, log scale 3), by
    layers that read the time again after the fourth; coefficient_b: position and time to the factors
    of these numbers. Both read the time through a small network, from `time_frequencies` sines and
    cosines, and positions as `space_frequencies` of them. The value at t = 0 is subtracted, so that
    frame 0 is the rest frame. Scale and rotation are free. Skip and widths are those of GIC (Cai et al.
    2024), which has 10 and 6 frequencies, one scale and no rotation; the paper frees both."""

    SKIP, CLOCK = 4, (256, 30)

    def __init__(
        self, offsets: Tensor, *, centre: Tensor, reach: float, bases: int = 10, hidden: int = 256,
        basis_layers: int = 8, coefficient_layers: int = 3, space_frequencies: int = 4,
        time_frequencies: int = 5,
    ) -> None:  # fmt: skip
        super().__init__()
        self.register_buffer("offsets", offsets - offsets[0])
        self.register_buffer("centre", centre)
        self.reach, self.bases = reach, bases
        self.space_frequencies, self.time_frequencies = space_frequencies, time_frequencies
        width, clock = self.CLOCK
        self.clock = nn.Sequential(
            nn.Linear(1 + 2 * time_frequencies, width), nn.ReLU(), nn.Linear(width, clock)
        )
        self.basis = _Layers(clock, hidden, basis_layers, bases * 10, self.SKIP)
        space = 3 * (1 + 2 * space_frequencies)
        self.coefficient = _Layers(clock + space, hidden, coefficient_layers, bases * 10)
        nn.init.normal_(self.coefficient.last.bias)

    def _raw(self, time: Tensor, points: Tensor) -> Tensor:
        """(S, N, 10) before subtraction; time: (S, 1) in [0, 1]; points: (N, 3) normalised."""
        clock = self.clock(_encoded(time, self.time_frequencies))
        basis = self.basis(clock).unflatten(-1, (self.bases, 10))
        encoded = _encoded(points, self.space_frequencies).expand(len(time), -1, -1)
        read = torch.cat([encoded, clock[:, None].expand(-1, len(points), -1)], -1)
        factors = self.coefficient(read).unflatten(-1, (self.bases, 10))
        return (factors * basis[:, None]).mean(-2)

    def forward(
        self,
        frames: Tensor,
        splats: Splats,
        modes: Modes | None,
        around: Neighbourhood | None = None,
    ) -> MotionSample:
        time = frames[:, None].to(self.centre) / max(1, len(self.offsets) - 1)
        points = (splats.means - self.centre) / self.reach
        raw = self._raw(torch.cat([torch.zeros_like(time[:1]), time]), points)
        raw = raw[1:] - raw[:1]
        positions = splats.means + self.reach * raw[..., :3] + self.offsets[frames][:, None]
        change = raw[..., 3:7] + torch.eye(1, 4, dtype=raw.dtype, device=raw.device)
        rotations = quaternion_multiply(
            nn.functional.normalize(change, dim=-1), splats.rotations.expand(len(frames), -1, -1)
        )
        scales = splats.scales * raw[..., 7:].exp()
        deformation = around.deformation(positions) if around is not None else None
        return MotionSample(
            positions, covariance_from(scales, rotations), deformation, scales, rotations
        )
