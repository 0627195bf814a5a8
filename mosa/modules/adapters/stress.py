"""Progressive stress adaptation, the paper's central module: bounded networks correct a prior stress in the material frame."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal

import torch
from pydantic import Field
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from mosa.errors import ConfigError
from mosa.modules.adapters.base import Adapter
from mosa.modules.adapters.fused.selection import chosen, weights_of
from mosa.modules.adapters.microplane import OFFSET
from mosa.modules.adapters.penalties import OperatorStatistics, statistics
from mosa.modules.adapters.progressive import Correction, ProgressiveOperator, apply
from mosa.modules.adapters.stiffening import ADAPTER_MARGIN, acoustic_stiffening, worst_stiffening
from mosa.modules.adapters.warm_start import warm_start
from mosa.physics.adapters.interface import AdapterOperator, MaterialState
from mosa.physics.adapters.network_evaluation import backward_at_hand
from mosa.settings import Expected, Positive, Width

Bound = Annotated[float, Field(gt=0, lt=1)]
NormalBound = Annotated[float | None, Field(gt=0, lt=1)]
Fused = Annotated[bool | Literal["auto"], Expected("auto, true or false")]


class StressAdapter(Adapter):
    """The paper's adapter. `forward` answers the simulator with an operator that is exact at the state it was asked at.

    alpha, alpha_normal, l_max (dimensionless): bounds, see `ProgressiveOperator`; input_scale: factor of what the networks read;
    rest_free: an undeformed body stays stress-free, exactly (the paper's literal form: false);
    plastic: a second set of networks corrects the strain in the yield function;
    major_symmetry: a projection after which a constant operator has an energy; state_dependence: full | constant | later (constant
    until the last stage);
    recompute: evaluate the networks again in the backward pass instead of storing 4 kB per particle and evaluation;
    fused: auto | true | false: Triton kernels on CUDA, which always recompute; auto: where they can take these options;
    factors: residual | printed, how the 12 numbers make a matrix (`microplane.CORRECTIONS`);
    no_C, no_pre, no_post, no_prior_stress: ablations. Errors: ConfigError naming the key for values out of range."""

    def __init__(
        self, *, alpha: Bound = 0.1, alpha_normal: NormalBound = None, l_max: Positive | None = 0.1, input_scale: Positive = 10.0,
        hidden: Width = 64, rest_free: bool = True, plastic: bool = False, major_symmetry: bool = False,
        state_dependence: Literal["full", "constant", "later"] = "full", recompute: bool = False, fused: Fused = "auto",
        factors: Literal["residual", "printed"] = "residual",
        no_C: bool = False, no_pre: bool = False, no_post: bool = False, no_prior_stress: bool = False,
    ) -> None:  # fmt: skip
        super().__init__()
        if no_prior_stress and no_pre:
            raise ConfigError("adapter: no_prior_stress needs L_pre (no_pre=false)")
        if state_dependence == "later" and (no_C or no_prior_stress or plastic):
            raise ConfigError(
                "adapter.state_dependence: later begins with the matrices C alone: expected no_C=false, "
                "no_prior_stress=false and plastic=false, or full"
            )
        self.rest_free, self.recompute, self.fused = rest_free, recompute, fused
        self.later = state_dependence == "later"
        shape: dict[str, Any] = {
            "alpha": alpha, "alpha_normal": alpha_normal, "input_scale": input_scale, "hidden": hidden,
            "factors": factors, "state_dependence": state_dependence, "no_C": no_C, "no_pre": no_pre, "no_post": no_post,
        }  # fmt: skip
        # without the prior the residuals have to carry the whole stress
        bound = None if no_prior_stress else l_max
        self.operator = ProgressiveOperator(
            l_max=bound, major_symmetry=major_symmetry, no_prior_stress=no_prior_stress, **shape
        )
        # C0 is a stiffness: it has no meaning for the strain in the yield function
        self.plastic_operator = ProgressiveOperator(l_max=l_max, **shape) if plastic else None
        # (4, 12), what a constant operator is made of
        self.numbers = self.operator.free

    @property
    def few_numbers(self) -> bool:
        part = self.operator
        return self.steady and not part.no_C and self.plastic_operator is None

    def vary(self) -> None:
        self.operator.vary()

    @property
    def steady(self) -> bool:
        part = self.operator  # the plastic one has the same switches
        networks = not (part.no_pre and part.no_post) or part.no_prior_stress
        return (part.constant or part.no_C) and not networks

    def stiffening(self, poisson: Tensor | float) -> float:
        """That of the operator itself where there is only one, else the bound of all that alpha allows; `ADAPTER_MARGIN` at least.

        What networks add (L_pre, L_post) is held between evaluations, as the operator is, and stiffens nothing meanwhile."""
        if self.operator.no_C or self.operator.no_prior_stress:
            return ADAPTER_MARGIN
        if not self.operator.constant:
            return worst_stiffening(max(self.operator.alpha, self.operator.alpha_normal))
        return max(ADAPTER_MARGIN, acoustic_stiffening(self.operator.constant_operator(), poisson))

    def prepare(self, law: str, states: Callable[[Tensor], MaterialState]) -> None:
        """Without the prior stress, L_pre starts as the prior (`warm_start`)."""
        if self.operator.no_prior_stress:
            warm_start(self, states)

    def in_double(self) -> StressAdapter:
        held = super().in_double()
        held.fused = "auto" if held.fused is True else held.fused  # the kernels run on CUDA only
        return held

    def affine(
        self, operator: ProgressiveOperator, w: Tensor, s: Tensor
    ) -> tuple[Tensor, Tensor, Correction]:
        """(A - I (N, 6, 6), b (N, 6), parts) of d(w, s) = (A - I) s + b, the rest term included."""
        zero = torch.zeros_like(w[:1])
        part = operator(torch.cat([w, zero]), torch.cat([s, zero]), self.poisson)
        b = part.pre + apply(part.G, part.pre) + part.post
        G, parts = part.G[:-1], Correction(*(p[:-1] for p in part))
        b = rested(b[:-1], b[-1:], w, s) if self.rest_free else b[:-1]
        if operator.no_prior_stress:
            # tau_hat = s3 at the state asked at. Held as an offset to the prior's stress, not as the stress itself: a stress
            # frozen for a few substeps pumps energy (a dropped block was off by 21 mm at stride 8, 0.6 mm in this form)
            G, b = torch.zeros_like(G), b - s
        return G, b, parts

    def increment(self, w: Tensor, s: Tensor) -> Tensor:
        """d(w, s) - [rest_free] d(0, 0), (N, 6) (steps 1 to 6); w, s: (N, 6) dimensionless."""
        G, b, _ = self.affine(self.operator, w, s)
        return apply(G, s) + b

    def forward(self, state: MaterialState) -> AdapterOperator:
        """Operator held by the simulator until it asks again; inputs of any float type, networks in their own.

        Errors: ConfigError before `switch_on`."""
        self.check_on()
        outer, inner = state.w.dtype, self.E_ref.dtype
        w = state.w.to(inner)
        G, h, parts = self._evaluate(self.operator, w, state.stress.to(inner), self.E_ref)
        self._last = (parts.C, parts.pre, parts.post)
        plastic_G = plastic_h = None
        if self.plastic_operator is not None and state.plastic_strain is not None:
            strain, one = state.plastic_strain.to(inner), torch.ones_like(self.E_ref)
            plastic_G, plastic_h, _ = self._evaluate(self.plastic_operator, w, strain, one)
            plastic_G, plastic_h = plastic_G.to(outer), plastic_h.to(outer)
        return AdapterOperator(G.to(outer), h.to(outer), plastic_G, plastic_h)

    def statistics(self) -> OperatorStatistics:
        """As `Adapter.statistics`; the fused kernels leave the numbers that the matrices are made of."""
        if self._last is None or self._last[0].shape[-1] != 12:
            return super().statistics()
        numbers, pre, post = self._last
        return statistics(self.operator.correction(numbers), pre, post)

    def _evaluate(
        self, operator: ProgressiveOperator, w: Tensor, s: Tensor, unit: Tensor
    ) -> tuple[Tensor, Tensor, Correction]:
        """`affine` with s and b in multiples of unit (); the fused kernels give C as (N, 4, 12), the numbers of the matrices."""
        if chosen(self.fused, operator, w):
            from mosa.modules.adapters.fused.operation import Settings, fused_operator

            scale = float(operator.scale)
            diagonal = 1.0 if operator.factors == "residual" else OFFSET
            settings = Settings(
                operator.alpha,
                operator.alpha_normal,
                diagonal,
                operator.l_max,
                scale,
                self.rest_free,
            )
            found = fused_operator(w, s, unit.reshape(1), settings, weights_of(operator))
            G, h, numbers, pre, post = found
            return G, h, Correction(G, pre, post, numbers.unflatten(-1, (4, 12)))
        if self.recompute and torch.is_grad_enabled() and not backward_at_hand():
            G, b, parts = checkpoint(
                self.affine, operator, w, s / unit, use_reentrant=False, preserve_rng_state=False
            )
        else:
            G, b, parts = self.affine(operator, w, s / unit)
        return G, unit * b, parts


def rested(b: Tensor, rest: Tensor, w: Tensor, s: Tensor) -> Tensor:
    """b - rest (N, 6), exactly 0 at w = s = 0: a batched product may round one row differently from another. Gradients stay."""
    difference = b - rest
    at_rest = ((w == 0) & (s == 0)).all(-1, keepdim=True)
    return difference - torch.where(at_rest, difference.detach(), torch.zeros_like(difference))
