"""A twin's material in hand: read and set in physical units, and what it says of itself."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Mapping
from typing import Annotated, Any

import torch
from annotated_types import Interval
from torch import Tensor, nn

from mosa.data.formats.scene_from_footage import check_density
from mosa.errors import ConfigError
from mosa.evaluation.analysis.anisotropy import mandel_matrix, mandel_scale
from mosa.evaluation.analysis.law_stress import in_double, tangent, values_of
from mosa.evaluation.analysis.statements import NOTICEABLE
from mosa.evaluation.analysis.stiffness import stiffest
from mosa.evaluation.uncertainty import determined
from mosa.modules.adapters.microplane import PAIRS
from mosa.modules.body.body import Body
from mosa.modules.body.material import FORMS, RELATIVE, Material, taken, unit_of
from mosa.modules.fitting.parameters import read_numbers
from mosa.physics.constitutive.damping import DAMPED, DAMPING
from mosa.physics.constitutive.laws import law_named
from mosa.physics.engine.law_options import AS_USUAL
from mosa.settings import Positive, check, nearest, typed
from mosa.twin.presets import preset

SAGS = 0.3  # E over the weight of a column as high as the body, below which its unit is doubted


class TwinMaterial:
    """The material of a twin. What is set counts from the next `simulate` or `reset` on.

    Reading: `parameters`, `E`, `nu`, `density`, `damping`, `stiffness`, `field`. Setting: `set(E=2e4, damping=5)`, or an
    attribute, `twin.material.E = 2e4`; `preset("jelly")` takes a known material."""

    __slots__ = ("_twin",)
    _twin: Any

    def __init__(self, twin: Any) -> None:
        object.__setattr__(self, "_twin", twin)

    def __setattr__(self, name: str, value: Any) -> None:
        self.set(**{name: value})

    @property
    def _body(self) -> Body:
        return self._twin.body

    # ---------------------------------------------------------------- reading
    @property
    def law(self) -> str:
        """Name of the law (docs/theory_to_code.md), without its damping."""
        return self._body.material.law.removesuffix(DAMPED)

    @property
    @torch.no_grad()
    def parameters(self) -> dict[str, float]:
        """Values of the law's parameters, SI units, friction_angle in degrees; of a direction its three components."""
        return {name: float(value) for name, value in self._body.material.physical().items()}

    @property
    def E(self) -> float:
        """Young's modulus [Pa] at small strain, of the law without its correction; 0 of a fluid.
        Multiplied by `field` over the body."""
        found = self.parameters
        if "E" in found:
            return found["E"]
        mu, kappa = found.get("mu", 0.0), found["kappa"]
        return 9 * kappa * mu / (3 * kappa + mu) if law_named(self.law).sheared else 0.0

    @property
    def nu(self) -> float:
        """Poisson's ratio at small strain."""
        return float(self._body.material.poisson())

    @property
    def density(self) -> float:
        """[kg/m^3] at rest. A film alone does not tell it: trained twins have the scene's."""
        return self._body.density

    @property
    def damping(self) -> float:
        """Shear viscosity [Pa s] beside the law; 0 without."""
        return self.parameters.get("damping", 0.0)

    @property
    def field(self) -> Tensor:
        """(N,) factor of the stiffness at every particle: E(X) = E * field. Ones where it does not vary."""
        with torch.no_grad():
            return self._body.factor(self._body.heterogeneity).detach().clone()

    @property
    def stiffness(self) -> Tensor:
        """(6, 6) float64 [Pa] at rest, prior and correction, where `field` is 1: stress over strain in Mandel scaling,
        components xx, yy, zz, yz, zx, xy in the axes of the rest shape. Errors: ConfigError for an adapter without a law."""
        body = self._body
        with torch.no_grad():
            alone = in_double(copy.deepcopy(body.material).cpu(), configured=False)
            C = tangent(alone, None, torch.eye(3).double()[None])[0]
            i, j = (torch.tensor(each) for each in zip(*PAIRS))
            scale = mandel_scale(C)
            C = C[i[:, None], j[:, None], i[None], j[None]] * scale[:, None] * scale
            C = 0.5 * (C + C.mT)
            adapter = body.adapter
            if adapter is None or not adapter.is_on:
                return C
            if adapter.own_dynamics:
                raise ConfigError(
                    "stiffness: this adapter moves the particles itself, without a law"
                )
            adapter.follow(body.material.poisson())
            known, E_ref = adapter.in_double(), float(adapter.E_ref)
            vech = C / scale[:, None] / scale * torch.tensor([1.0, 1, 1, 2, 2, 2]).double()

        def stress(strain: Tensor) -> Tensor:
            prior = vech @ strain / E_ref
            return E_ref * (prior + known.increment(strain[None], prior[None])[0])

        J = torch.autograd.functional.jacobian(stress, torch.zeros(6, dtype=torch.float64))
        return mandel_matrix(J).detach()

    # ---------------------------------------------------------------- setting
    @typed
    def set(self, law: str | None = None, **values: float) -> None:
        """Change the law or its values: E [Pa], nu, density [kg/m^3], damping and bulk_damping [Pa s], and all of `parameters`.

        law: of another one all parameters are needed. The learned correction stays, in proportion to E, and so does `field`.
        What the run knew about the uncertainty of the law is dropped, and the variants `prior` and `prior_eta` become the
        material that was set. Errors: ConfigError naming the value."""
        density, law = values.get("density"), None if law == self.law else law
        if density is not None:
            check_density("density", density)
        adapter = self._body.adapter
        if adapter is not None and adapter.own_dynamics:
            idle = [*([] if law is None else ["law"]), *(values.keys() - {"E", "density"})]
            if idle:
                raise ConfigError(
                    f"{idle[0]}: expected E and density alone, found an adapter that moves the particles itself, without a law"
                )
        self._take(self._with(values, law), density, new=law is not None)

    def _with(self, values: Mapping[str, float], law: str | None = None) -> Material:
        """The material with other values, law: or of another one. Errors: ConfigError naming the value."""
        known = values_of(self._body.material) if law is None else {}
        names = [*dict.fromkeys([*taken(law or self.law, FORMS), "E", "nu", *DAMPING, "density"])]
        if strange := [name for name in values if name not in names]:
            expected = f"expected one of {', '.join(names)}{nearest(strange[0], names, '')}"
            raise ConfigError(f"{strange[0]}: unknown value; {expected}")
        given = {**known, **{name: v for name, v in values.items() if name != "density"}}
        if "E" not in known and {"mu", "kappa"} <= set(known) and {"E", "nu"} & set(values):
            E, nu = given.pop("E", self.E), given.pop("nu", self.nu)
            check("E", E, Positive)
            check("nu", nu, Annotated[float, Interval(gt=-1, lt=0.5)])
            given |= {"mu": E / (2 * (1 + nu)), "kappa": E / (3 * (1 - 2 * nu))}
        if not any(given.get(name) for name in DAMPING):
            given = {name: value for name, value in given.items() if name not in DAMPING}
        modulated = self._body.material.modulated if law is None else None
        try:
            return Material(law or self.law, given, modulated=modulated)
        except ConfigError as error:  # which names them as a configuration does
            said = str(error).removeprefix("prior.parameters").lstrip(".: ")
            raise ConfigError(said) from error

    def laws(self, each: Any) -> Any:
        """(len(each), numbers) float64 of the twin's law, each time with other values, a list of mappings; anything else as it
        is. Errors: ConfigError naming the value."""
        if not isinstance(each, (list, tuple)) or not all(isinstance(v, Mapping) for v in each):
            return each
        names, found = self._body.material.learned, read_numbers(self._body).repeat(len(each), 1)
        for b, values in enumerate(each):
            self._doubt(other := self._with(values), self.density)
            raw = other.raw
            if fixed := [name for name in values if name not in names or name not in raw]:
                own = f"in {', '.join(names)}, inside their ranges, found {', '.join(fixed)}"
                raise ConfigError(f"laws[{b}]: worlds differ {own}; twin.material.set is for all")
            for name in values:
                found[b, names.index(name)] = raw[name].detach()
        return found

    def _doubt(self, material: Material, density: float) -> None:
        """Warn of an E that was not meant in Pa."""
        weight = density * float(self._twin.world.gravity.norm()) * self._body.size
        E = float(material.physical().get("E", torch.tensor(torch.inf)).detach().max())
        if E < SAGS * weight:
            said = f"E: {E:.3g} Pa does not carry the body's weight ({weight:.3g} Pa at its foot)"
            warnings.warn(f"{said}: in Pa?", stacklevel=5)

    def preset(self, name: str) -> None:
        """Take a known material of `mosa.twin.presets.PRESETS`: the same everywhere, without the learned correction.

        Errors: ConfigError naming the known ones."""
        found = preset(name)
        self._body.adapter = self._body.heterogeneity = None
        for variant in self._body.frozen.values():
            assert isinstance(variant, nn.ModuleDict)
            if "heterogeneity" in variant:
                del variant["heterogeneity"]
        self._take(Material(found.law, dict(found.parameters)), found.density, new=True)

    def _take(self, material: Material, density: float | None, new: bool) -> None:
        """Put a material into the body, and into the record that a checkpoint keeps of it."""
        twin, body = self._twin, self._body
        density = body.density if density is None else float(density)
        settings = copy.deepcopy(dict(twin.record.settings))
        if settings:
            prior = {} if new else settings.get("prior", {})
            values, law = values_of(material), material.law.removesuffix(DAMPED)
            chosen = {"law": law, "parameters": values, "candidates": None, "frozen": None}
            settings["prior"] = {**prior, **chosen}
            if body.adapter is None:
                settings["adapter"] = {"name": None}
            if body.heterogeneity is None:
                settings["heterogeneity"] = {"enabled": False}
        self._doubt(material, density)
        before = self.E
        changed = twin.record.but(settings=settings, law=None, density=density)
        twin._record, twin.posterior, body.density = changed, None, density
        body.material = material.to(body.rest)
        # networks give stresses in a unit of their own
        if body.adapter is not None and body.adapter.is_on and before > 0 and self.E > 0:
            body.adapter.E_ref.mul_(self.E / before)
        for variant in body.frozen.values():
            assert isinstance(variant, nn.ModuleDict)
            variant["material"] = copy.deepcopy(body.material).requires_grad_(False)
        if new:
            body.law_options = AS_USUAL

    def __repr__(self) -> str:
        values = ", ".join(said(self._body.material.law, k, v) for k, v in self.parameters.items())
        return f"TwinMaterial({self.law}: {values}; {self.density:.4g} kg/m^3)"


def said(law: str, name: str, value: float) -> str:
    """`E = 3e+04 Pa`."""
    unit = unit_of(law, name)
    return f"{name} = {value:.4g}{' ' + unit if unit else ''}"


@torch.no_grad()
def summary(twin: Any) -> str:
    """What a twin is, in lines of text with units, and how sure its law is where the run kept that."""
    body, world, material = twin.body, twin.world, twin.material
    volume = float(body.volume.sum())
    sure: Mapping[str, float] = {} if twin.posterior is None else determined(body, twin.posterior)
    lines = [
        f"body      {len(body.rest)} particles {1e3 * body.spacing:.3g} mm apart, "
        f"{1e3 * body.size:.4g} mm long, "
        f"{1e6 * volume:.4g} cm^3, {1e3 * volume * body.density:.4g} g at {body.density:.4g} kg/m^3",
        f"law       {body.material.law}",
    ]
    for name, value in material.parameters.items():
        relative, own = sure.get(f"posterior/{name}_relative_sd"), sure.get(f"posterior/{name}_sd")
        spread = f" +- {relative:.1%}" if name in RELATIVE and relative is not None else ""
        spread = spread if own is None else f" +- {own:.2g}"
        lines.append(f"          {said(body.material.law, name, value)}{spread}")
    adapter = body.adapter
    if adapter is None or not adapter.corrects:
        lines.append("learned   no correction of the law")
    else:
        lines.append(f"learned   {type(adapter).__name__}, a correction of the law")
        if (stiffness := adapter.stiffness()) is not None:
            axis, ratio = stiffest(stiffness.cpu())
            where = ", ".join(f"{v:.2f}" for v in axis.tolist())
            along = f", stiffest along ({where})" if ratio >= NOTICEABLE else ""
            lines.append(
                f"          largest over smallest Young's modulus {float(ratio):.3g}{along}"
            )
    low, high = float(material.field.min()), float(material.field.max())
    if high - low > 1e-6:
        lines.append(f"field     {low:.3g} to {high:.3g} times this stiffness over the body")
    if twin.posterior is None:
        lines.append("sure      not known: no posterior was kept, or the material was set by hand")
    ground = "none"
    if (met := world.ground) is not None:
        ground = f"at {met.height:.4g} m, {met.mode}, friction {met.friction:.3g}"
    up = ", ".join(f"{v:.3g}" for v in world.up.tolist())
    lines += [
        f"ground    {ground}",
        f"world     up ({up}), gravity {float(world.gravity.norm()):.4g} m/s^2, "
        f"{len(world.colliders)} colliders, {len(world.driven)} driven sets",
        f"grid      spacing {1e3 * body.settings.dx:.4g} mm, frames of "
        f"{1e3 * twin.frame_dt:.4g} ms",
    ]
    return "\n".join(lines)
