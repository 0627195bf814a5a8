"""Which law is simulated: a view of a body's parts."""

from dataclasses import FrozenInstanceError

import pytest
import torch
from small_bodies import WORLD, small_body, start

from mosa.errors import ConfigError


def test_a_model_is_a_view_of_what_is_learned():
    body = small_body(modes=True)
    model = body.model()
    assert (
        model == body.model("adapted")
        and model.material is body.material
        and model.adapter is body.adapter
    )
    assert (
        model.only(adapter=False).adapter is None
        and model.only(adapter=False).heterogeneity is body.heterogeneity
    )
    assert model.only(heterogeneity=False).heterogeneity is None and model.only() == model
    with pytest.raises(FrozenInstanceError):
        model.adapter = None


def test_backbones_have_no_adapter_and_the_calibrated_one_no_stiffness_field():
    body = small_body(modes=True)
    assert body.model("prior").adapter is body.model("prior_eta").adapter is None
    assert (
        body.model("prior").heterogeneity is None
        and body.model("prior_eta").heterogeneity is not None
    )
    assert body.model("prior").material is not body.material
    with pytest.raises(
        ConfigError, match="variant: expected one of prior, prior_eta, adapted, found 'posterior'"
    ):
        body.model("posterior")


def test_a_prior_with_eta_is_compared_only_where_there_is_an_eta():
    """It was a row of the table beside the prior, with the same figures."""
    assert small_body(modes=True).variants == ["prior", "prior_eta", "adapted"]
    assert small_body().variants == ["prior", "adapted"]


def test_an_adapter_before_its_stage_is_no_part_of_the_model():
    body = small_body(on=False)
    assert body.model().adapter is None
    body.adapter.switch_on(3e4, 0.35)
    assert body.model().adapter is body.adapter


@torch.no_grad()
def test_what_is_simulated_is_the_model_that_is_given():
    body = small_body(numbers=0.2 * torch.ones(19).double())
    learned, prior = (
        body.simulate(start(), WORLD, 6, 1 / 60, model=model).x
        for model in (None, body.model().only(adapter=False))
    )
    assert torch.equal(body.simulate(start(), WORLD, 6, 1 / 60, model=body.model("prior")).x, prior)
    assert float((learned - prior).abs().max()) > 1e-4
