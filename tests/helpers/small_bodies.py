"""A body of 120 particles that falls on the ground, and its own rollouts as motion cues: what the fit's parts are tried on."""

from types import SimpleNamespace

import torch

from mosa.modules.adapters.hyperelastic import HyperelasticAdapter
from mosa.modules.body.body import Body, SimulationSettings, Start, World
from mosa.modules.body.heterogeneity import HeterogeneitySettings
from mosa.modules.body.material import Material
from mosa.modules.body.stiffness_modes import StiffnessModes
from mosa.physics.constitutive.singular_values import singular_value_decomposition
from mosa.types import Ground, MotionCues

E, NU, DX, FRAME_DT = 3e4, 0.35, 0.04, 1 / 60
WORLD = World(Ground(0.0, "separate", 0.3), torch.tensor([0.0, -9.8, 0.0]).double(), torch.tensor([0.0, 1.0, 0.0]).double(),
              torch.tensor([[-5.0, -5.0, -5.0], [5.0, 5.0, 5.0]]).double())  # fmt: skip
STICKY = World(Ground(0.0, "sticky"), WORLD.gravity, WORLD.up, WORLD.box)
FREE = World(None, torch.zeros(3).double(), torch.tensor([0.0, 1.0, 0.0]).double(), WORLD.box)


def lattice(counts=(6, 5, 4), spacing=DX / 2) -> torch.Tensor:
    """(N, 3) centres of a block's cells about 0."""
    axes = [(torch.arange(n).double() - (n - 1) / 2) * spacing for n in counts]
    return torch.cartesian_prod(*axes)


def small_body(*, numbers=None, adapter=True, modes=False, law="corotated", E=E, nu=NU, contact=False,
               counts=(6, 5, 4), precision=64, on=True) -> Body:  # fmt: skip
    """numbers: (19,) of the hyperelastic adapter, 0 where None; on: whether it is switched on, at E and nu."""
    rest = lattice(counts)
    n = len(rest)
    module = HyperelasticAdapter() if adapter else None
    field = (
        StiffnessModes(
            rest.amin(0) - DX / 4, rest.amax(0) + DX / 4, HeterogeneitySettings(wavelength=1.0)
        )
        if modes
        else None
    )
    body = Body(
        rest=rest, volume=torch.full((n,), (DX / 2) ** 3).double(), colors=torch.ones(n, 3), opacities=torch.ones(n),
        covariances=1e-4 * torch.eye(3).expand(n, 3, 3), density=1000.0, material=Material(law, {"E": E, "nu": nu}),
        heterogeneity=field, adapter=module, settings=SimulationSettings(dx=DX, precision=precision, contact_offset=contact),
    )  # fmt: skip
    if precision == 64:
        body = body.double()
    else:
        body = body.float()
    if module is not None and on:
        module.switch_on(E, nu)
        if numbers is not None:
            with torch.no_grad():
                module.numbers.copy_(numbers)
    return body


def start(
    height=0.09,
    speed=-1.5,
    turn=0.0,
    axis=(0.3, 0.5, 0.8),
    spin=(0.0, 0.0, 0.0),
    dtype=torch.float64,
) -> Start:
    """A body turned by `turn` [rad] about `axis` whose centre is at `height` [m]."""
    k = torch.tensor(axis).double()
    k = turn * k / k.norm()
    K = torch.tensor([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]]).double()
    vectors = (
        torch.linalg.matrix_exp(K),
        torch.tensor([0.0, height, 0.0]),
        torch.tensor([0.1, speed, 0.0]),
        torch.tensor(spin),
    )
    return Start(*(v.to(dtype) for v in vectors))


@torch.no_grad()
def cues_of(rollout, rotation) -> MotionCues:
    """What a perfect reconstruction would have seen of a rollout that began at `rotation` (3, 3)."""
    U, S, V = singular_value_decomposition(rollout.F_tot)
    T, n = rollout.x.shape[:2]
    return MotionCues(
        rollout.x.detach(),
        U @ V.mT @ rotation.T.to(U),
        S,
        torch.ones(T, n).to(S),
        torch.zeros(T, n, 3, 3).to(S),
    )


@torch.no_grad()
def take_of(body: Body, begins: Start, frames: int, world: World = WORLD):
    """A sequence of the body as it is, with all that it has."""
    rollout = body.simulate(begins, world, frames, FRAME_DT)
    touched = (
        rollout.x[:, :, 1].amin(1) < 0.7 * DX
    ).nonzero()  # a grid stops a body a fraction of a cell before it touches
    first = int(touched[0]) if len(touched) else frames - 1
    return SimpleNamespace(
        start=begins,
        cues=cues_of(rollout, begins.rotation),
        frame_dt=FRAME_DT,
        first_contact=first,
        response=None,
        name="train",
    )
