"""The hidden truth of a built-in scene as a twin: it is reset, stepped and put into many worlds as a learned one is."""

from __future__ import annotations

from typing import Annotated

import numpy as np
import torch
from annotated_types import Interval
from torch import Tensor, nn

from mosa.data.synthetic import BOX
from mosa.data.synthetic.bodies.objects import drop_named, object_named
from mosa.data.synthetic.bodies.shapes import SHAPES
from mosa.data.synthetic.drop import COURANT, GRAVITY, place
from mosa.data.synthetic.films import built
from mosa.data.synthetic.materials.hidden import Hidden
from mosa.data.synthetic.materials.published import PublishedMaterial
from mosa.errors import ConfigError
from mosa.modules.body.body import Body
from mosa.modules.body.model import Model
from mosa.modules.body.simulation_settings import SimulationSettings
from mosa.physics.world import Start, World
from mosa.settings import Expected, Seed, check
from mosa.system.limits import named_device
from mosa.twin.material import TwinMaterial
from mosa.twin.twin import Twin
from mosa.types import Ground

MAX_SUBSTEPS = 5000
FINEST, COARSEST = 5e-4, 4.0  # particle spacing: [m], share of the longest side
APPEARANCE = (0.8, 0.35)  # of a particle: opacity, standard deviation in spacings


class TrueMaterial(nn.Module):
    """A hidden material where a `Body` asks for its law: nothing of it is learned."""

    def __init__(self, hidden: Hidden | PublishedMaterial, rest: Tensor) -> None:
        super().__init__()
        self.law, self.hidden = hidden.law, hidden
        self.names = tuple(hidden.parameters(rest))
        for name, value in hidden.parameters(rest).items():
            self.register_buffer(f"true_{name}", value)

    def per_particle(self, factor: Tensor | float = 1.0) -> dict[str, Tensor]:
        """Values the simulator takes, (N,) or (N, k); the stiffness's own variation is among them, `factor` is the learner's."""
        return {name: getattr(self, f"true_{name}") for name in self.names}

    def max_modulus(self, factor: Tensor | float = 1.0) -> float:
        """P wave modulus [Pa]."""
        return self.hidden.wave_modulus()

    def max_viscosity(self, factor: Tensor | float = 1.0) -> float:
        """[Pa s]."""
        return self.hidden.viscosity()


class TrueTwin(Twin):
    """A twin of the truth, whose law nobody may read: nothing is known of it but its motion."""

    @property
    def material(self) -> TwinMaterial:
        """Errors: ConfigError."""
        raise ConfigError("material: expected a learned twin, found the truth, whose law is hidden")

    def __repr__(self) -> str:
        return f"TrueTwin({self.body!r})"


class TrueBody(Body):
    """The truth's particles with the hidden material: the same in every `variant`."""

    def model(self, variant: str = "adapted") -> Model:
        return Model(self.material, self.contact)


def true_twin(
    name: str, sequence: str = "train", *, material: str = "anisotropic", seed: int = 0, device: str = "cpu",
    spacing: float | None = None,
) -> Twin:  # fmt: skip
    """A twin of what a built-in scene's films show: particles, grid, hidden law and contact are those of `data.builtin.drop`.

    name: of the scene; sequence: whose start is the training start; material: anisotropic | isotropic; seed: of the scene's
    particles; spacing [m]: of the particles, None for the films' own (a coarser one is a quicker, poorer truth).
    Rest positions are those of the training sequence's frame 0, as a learned twin's are. Errors: ConfigError naming the key.
    """
    device, body, drop = named_device(device), object_named(name), drop_named(name, sequence)
    check("scene.seed", seed, Seed)
    widest = float(np.ptp(np.asarray(SHAPES[body.shape].bounds), axis=0).max()) / COARSEST
    said = f"a distance of {FINEST:g} to {widest:.3g} m between particles, a quarter of the body's longest side, or null"
    within = Annotated[float, Interval(ge=FINEST, le=widest)] | None
    check("truth.spacing", spacing, Annotated[within, Expected(said)])
    spacing = body.spacing if spacing is None else float(spacing)
    surface, particles, _ = built(body.shape, body.pitch, spacing, seed)
    hidden = body.material.variant(material)
    center = particles.mean(0)
    center[[0, 2]] = 0.0
    rest, _ = place(particles, center, drop_named(name, "train"), surface.vertices)
    begun, _ = place(particles, center, drop, surface.vertices)
    colors = SHAPES[body.shape].color(particles, np.random.default_rng([seed, 1]))
    opacity, width = APPEARANCE
    n, dx, meeting = len(rest), body.meeting.cell * spacing, body.meeting
    points = torch.tensor(rest, dtype=torch.float32)
    made = TrueBody(
        rest=points, volume=torch.full((n,), spacing**3), colors=torch.tensor(colors, dtype=torch.float32),
        opacities=torch.full((n,), opacity), covariances=((width * spacing) ** 2 * torch.eye(3)).repeat(n, 1, 1),
        density=hidden.density, material=TrueMaterial(hidden, points), heterogeneity=None, adapter=None,
        settings=SimulationSettings(dx=dx, stride=1, max_substeps=MAX_SUBSTEPS, courant=COURANT), law_options=hidden.options,
    )  # fmt: skip
    with torch.no_grad():
        made.contact.cells.fill_(meeting.lift)
    made.requires_grad_(False)
    tensor = lambda a: torch.tensor(a, dtype=torch.float32)  # noqa: E731
    reach = BOX[1][0] if body.reach is None else body.reach
    box = torch.tensor([[-reach, BOX[0][1], -reach], [reach, BOX[1][1], reach]])
    ground = Ground(0.0, meeting.mode, meeting.friction)
    world = World(ground, tensor(GRAVITY), torch.tensor([0.0, 1.0, 0.0]), box)
    falling = tensor([0.0, -drop.speed, 0.0])
    start = Start(tensor(drop.rotation), tensor(begun.mean(0)), falling, torch.zeros(3))
    return TrueTwin(made.to(device).eval(), world, 1 / body.footage.fps, None, start)
