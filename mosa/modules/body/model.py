"""Which law is simulated, as one object."""

from __future__ import annotations

from dataclasses import dataclass, replace

from mosa.modules.adapters.base import Adapter
from mosa.modules.body.contact import ContactOffset
from mosa.modules.body.heterogeneity import StiffnessField
from mosa.modules.body.material import Material


@dataclass(frozen=True)
class Model:
    """A view of the parts of a body that a rollout uses: a law with its parameters, the height of the contact, a stiffness field
    and an adapter, each None where the model has none. It holds the modules, not copies: what is learned later is simulated."""

    material: Material
    contact: ContactOffset
    heterogeneity: StiffnessField | None = None
    adapter: Adapter | None = None

    def only(self, *, heterogeneity: bool = True, adapter: bool = True) -> Model:
        """Without the parts that are False."""
        field, own = (
            self.heterogeneity if heterogeneity else None,
            self.adapter if adapter else None,
        )
        return replace(self, heterogeneity=field, adapter=own)
