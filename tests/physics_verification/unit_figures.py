"""Figures of the checks that are tested beside their units (8 to 11, 20, 21, oracle), measured again for docs/verification.md."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import substep_reference as reference
import torch
from bodies import (
    DENSITY,
    LAM,
    MU,
    agitated,
    eyes,
    parameters_of,
    random_adapter,
    rotations,
    uniform_volume,
)
from stepwise import increment
from stresses import deformations, stress

from mosa.errors import ConfigError
from mosa.modules.adapters.stress import StressAdapter
from mosa.physics.constitutive.laws import law_named
from mosa.physics.engine.law_options import LawOptions
from mosa.physics.engine.material_operations import first_advance
from mosa.physics.engine.simulator import Simulator
from mosa.types import Ground, ParticleState


def initial_adapter(dtype: torch.dtype) -> float:
    """Check 8: largest difference of a motion with a new adapter to the prior's, over 100 substeps."""
    state = agitated(dtype=dtype)
    adapter = StressAdapter()
    adapter.switch_on(8e4, 0.3)
    sim = Simulator(
        "corotated", dx=0.04, substeps=100, frame_dt=0.02, dtype=dtype, ground=Ground(0.0)
    )
    with torch.no_grad():
        runs = [sim.rollout(state, {"mu": MU, "lam": LAM}, uniform_volume(state, 0.02), DENSITY, 2, adapter=a, stride=5).x
                for a in (None, adapter)]  # fmt: skip
    return float((runs[0] - runs[1]).abs().max())


def bounds(draws: int = 40, alpha: float = 0.1, l_max: float = 0.1) -> dict[str, float]:
    """Check 9: smallest det(I + C), largest |L|/l_max, over random weights of size 1e-3 to 1e3 and inputs to 1e6."""
    det, largest = np.inf, 0.0
    g = torch.Generator().manual_seed(0)
    for seed in range(draws):
        adapter = random_adapter(
            seed, 10.0 ** (6 * seed / (draws - 1) - 3), alpha=alpha, l_max=l_max
        )
        w, s = (
            10.0 ** (12 * seed / (draws - 1) - 6)
            * (2 * torch.rand(20, 6, generator=g, dtype=torch.float64) - 1)
            for _ in "ws"
        )
        with torch.no_grad():
            _, pre, post, C = adapter.operator(w, s)
        det = min(det, float(torch.linalg.det(torch.eye(3).double() + C).min()))
        largest = max(largest, float(pre.abs().max()) / l_max, float(post.abs().max()) / l_max)
    return {"det": det, "L": largest}


def assembled() -> float:
    """Check 10: steps of the paper against the assembled 6x6 operator."""
    adapter = random_adapter()
    g = torch.Generator().manual_seed(1)
    w, s = (0.1 * torch.randn(100, 6, generator=g, dtype=torch.float64) for _ in "ws")
    with torch.no_grad():
        return float((adapter.increment(w, s) - increment(adapter, w, s)).abs().max())


def plastic_return(law: str) -> dict[str, float]:
    """Check 11: excess of the yield function, change by a second return (off the tip), change of det F."""
    F = deformations(300, 20)
    sim = Simulator(law, dx=0.1, substeps=1, frame_dt=1e-3, dtype=torch.float64)
    p = parameters_of(law)
    packed = sim.pack(p, len(F))

    def returned(F):
        return first_advance(sim.numerics, F, torch.zeros_like(F), packed)

    A = returned(F)
    eps = torch.log(torch.linalg.svdvals(A))
    norm = (eps - eps.mean(1, keepdim=True)).norm(dim=1)
    if law == "von_mises":
        excess, tip = (
            norm - p["yield_stress"] / (2 * p["mu"]),
            torch.zeros(len(F), dtype=torch.bool),
        )
    else:
        t = eps.sum(1) - 3 * p["cohesion"]
        tip = torch.log(torch.linalg.det(F)) >= 3 * p["cohesion"]
        excess = norm + p["friction_alpha"] * (3 * p["lam"] + 2 * p["mu"]) / (2 * p["mu"]) * t
    found = {"yield": float(excess.max()), "again": float((returned(A) - A)[~tip].abs().max())}
    if law == "von_mises":
        found["det"] = float((torch.linalg.det(A) - torch.linalg.det(F)).abs().max())
    return found


def polar_gradient() -> float:
    """Check 20: adjoint of rotation and stretch against differences, at rest, equal, nearly singular and inverted values."""
    from test_kinematics import directional, run, run_adjoint

    values = [[1, 1, 1], [1.3, 1.3, 1.3], [1.2, 0.8, 0.8], [1.1, 1.1 + 1e-9, 0.9], [1.2, 0.7, 0.004], [1.4, 0.9, -0.5],
              [1.1, 0.502, -0.5]]  # fmt: skip
    S = torch.tensor(values, dtype=torch.float64).repeat(10, 1)
    F = torch.cat([rotations(len(S), 1) @ torch.diag_embed(S) @ rotations(len(S), 2), eyes(1)])
    S = torch.cat([S, torch.ones(1, 3).double()])
    h = (3e-3 * torch.minimum(S[:, 1] + S[:, 2], (S - 0.05).abs().amin(1)).clamp(max=1.0))[
        :, None, None
    ]
    g, one, worst = torch.Generator().manual_seed(3), torch.ones(len(F)).double(), 0.0
    for name in ("rotation", "stretch"):
        seed, dF = (torch.randn(F.shape, generator=g, dtype=torch.float64) for _ in "sd")
        dF = dF / torch.linalg.matrix_norm(dF)[:, None, None]
        adjoint, _ = run_adjoint(name, F, one, seed)
        expected = (
            seed * directional(lambda s, name=name, dF=dF: run(name, F + s * dF, one), h)
        ).sum((1, 2))
        scale = torch.linalg.matrix_norm(adjoint).clamp_min(1.0)
        worst = max(worst, float((((adjoint * dF).sum((1, 2)) - expected).abs() / scale).max()))
    return worst


def twin(law: str) -> float | None:
    """Check 21: one substep against the torch twin, largest relative difference of x, v, C_affine, F; None if it has no twin."""
    state = agitated()
    volume, p = uniform_volume(state, 0.02), parameters_of(law)
    tensors = {k: torch.tensor(v, dtype=torch.float64) for k, v in p.items()}
    if law_named(law).reference is not None:
        tensors["reference"] = reference.polar(state.F)
    try:
        other = reference.substep(
            law, state, tensors, volume, DENSITY, dx=0.04, dt=2e-4, gravity=(0.0, -9.8, 0.0)
        )
    except ConfigError:
        return None
    sim = Simulator(law, dx=0.04, substeps=1, frame_dt=2e-4, dtype=torch.float64)
    mine = sim.rollout(state, p, volume, DENSITY, 2, started=True).final
    pairs = [(getattr(mine, k), getattr(other, k)) for k in ("x", "v", "C_affine", "F")]
    return max(float((a - b).abs().max() / b.abs().max()) for a, b in pairs)


PROBES = {
    "neo_hookean": "probe_neo_hookean",
    "von_mises": "probe_von_mises_gic",
    "drucker_prager": "probe_drucker_prager",
}
TRAJECTORIES = {
    "elastic_torus_sticky": ("neo_hookean", Ground(0.0), 1e-12),
    "elastic_cube_slip": ("neo_hookean", Ground(0.0, "slip"), 1e-12),
    "elastic_cube_spin_freefall": ("neo_hookean", None, 1e-12),
    "plasticine_cube_sticky_gic": ("von_mises", Ground(0.0), 1e-7),
    "sand_cube_sticky": ("drucker_prager", Ground(0.0), 1e-7),
}


def oracle(folder: Path, name: str) -> dict:
    with np.load(folder / "oracle" / f"{name}.npz", allow_pickle=False) as file:
        arrays = {
            k: torch.from_numpy(np.asarray(file[k])).double()
            for k in file.files
            if file[k].dtype.kind in "fi"
        }
        meta = json.loads(str(file["meta"])) if "meta" in file.files else {}
    return {
        **{k: torch.tensor(v).double() for k, v in meta.items() if isinstance(v, int | float)},
        **arrays,
    }


def probe(folder: Path, law: str) -> torch.Tensor:
    """Relative errors (216,) of one advance and one stress of the probe's isolated particles."""
    data = oracle(folder, PROBES[law])
    p = {k: data[k] for k in law_named(law).parameters}
    sim = Simulator(law, dx=0.04, substeps=1, frame_dt=float(data["dt"]), gravity=(0, 0, 0), dtype=torch.float64,
                    options=LawOptions(norm_eps=1e-8, rebuild=law == "drucker_prager", on_inversion="ignore"))  # fmt: skip
    C = data["C_in"].contiguous()
    F = first_advance(sim.numerics, data["F_in"].contiguous(), C, sim.pack(p, len(C)))
    tau = stress(law, F, C, parameters=p)
    return (tau - data["tau"]).abs().amax((1, 2)) / data["tau"].abs().max()


def trajectory(folder: Path, name: str) -> float:
    """Largest distance [m] to a trajectory of the oracle over 8 frames (800 substeps), float64."""
    law, ground, _ = TRAJECTORIES[name]
    data = oracle(folder, name)
    p, n, dx = (
        {k: data[k] for k in law_named(law).parameters},
        data["x"].shape[1],
        float(data["dx"]),
    )
    sim = Simulator(law, dx=dx, frame_dt=1 / 24, substeps=100, gravity=data.get("gravity", torch.tensor([0.0, -9.8, 0.0])),
                    up=(0.0, 1.0, 0.0), dtype=torch.float64, ground=ground, options=LawOptions(
                        mass_cutoff=1e-8 * dx**3, init_affine="zero", norm_eps=0.0 if law == "neo_hookean" else 1e-8,
                        on_inversion="ignore", rebuild=law == "drucker_prager"))  # fmt: skip
    F = eyes(n)
    start = ParticleState(
        data["x0"].contiguous(), data["v0"].contiguous(), torch.zeros(n, 3, 3).double(), F, F
    )
    with torch.no_grad():
        out = sim.rollout(start, p, torch.full((n,), float(data["p_vol"])).double(), 1000.0, 9)
    return float((out.x - data["x"][:9]).abs().max())
