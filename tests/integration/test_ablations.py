"""Each ablation changes the term or the parameters it names and leaves the others as they are at the first joint step."""

import pytest
import torch
from assembled import assembled, whole

AT_ONCE = "reconstruction.informed.iterations=0"
"""The joint stage begins without fitting the motion to the images again, which takes three quarters of the time."""


@pytest.fixture(scope="module")
def first_step(cache):
    """Function (ablation, overrides) -> (loss terms of the first joint step, names of the trainable parameters)."""
    known = {}

    def compute(ablation: str, *overrides: str):
        name = (ablation, *overrides)
        if name not in known:
            _, scene, module = assembled(cache, f"ablation={ablation}", AT_ONCE, *overrides)
            body = module.body
            joint = module.stages[-1]
            module.begin(joint)
            with torch.no_grad():
                terms, _ = module.terms(
                    joint, whole(module.takes[0]), scene.frames, module.takes[0]
                )
            compute.modules[name] = module
            known[name] = (
                {k: float(v) for k, v in terms.items()},
                {n for n, p in body.named_parameters() if p.requires_grad},
            )
        return known[name]

    compute.modules = {}
    return compute


DROPPED_TERMS = {
    "no_flow": {"flow"},
    "no_scale": {"stretch"},
    "no_rot": {"rotation"},
    "no_motion": {"flow", "stretch", "rotation"},
    "no_het": {"heterogeneity"},
    "no_stress": set(),
}


OF_THE_NETWORKS = ("no_C", "no_pre", "no_post", "no_prior_stress")


def baseline(name: str) -> str:
    """What an ablation is compared with: parts of the networks with the paper's adapter."""
    return "paper" if name in OF_THE_NETWORKS else "full"


@pytest.mark.parametrize("name", ["no_C", "no_pre", "no_post", *DROPPED_TERMS])
def test_other_terms_are_equal_at_the_first_step(first_step, name):
    full, _ = first_step(baseline(name))
    terms, _ = first_step(name)
    assert full.keys() - terms.keys() == DROPPED_TERMS.get(name, set())
    assert terms == {k: v for k, v in full.items() if k in terms}


@pytest.mark.parametrize(
    ("name", "marks"),
    [
        ("no_C", ("operator.planes",)),
        ("no_pre", ("operator.phi",)),
        ("no_post", ("operator.theta",)),
        ("no_stress", ("adapter.",)),
        ("no_het", ("heterogeneity.",)),
        ("no_flow", ()),
        ("no_rot", ()),
    ],
)
def test_the_parameters_it_names_stop_learning_and_no_others(first_step, name, marks):
    _, full = first_step(baseline(name))
    _, left = first_step(name)
    assert left <= full
    gone = full - left
    assert all(any(m in n for m in marks) for n in gone), gone
    assert bool(gone) == bool(marks)


def test_no_prior_stress_starts_near_the_prior(first_step):
    full, _ = first_step("paper")
    terms, _ = first_step("no_prior_stress")
    assert terms.keys() == full.keys()
    assert terms != full  # the stress now comes from a network
    assert terms["position"] == pytest.approx(
        full["position"], rel=0.05
    )  # which was fitted to the prior's


@pytest.mark.parametrize("name", ["nclaw", "neuma"])
def test_networks_in_place_of_the_law_start_near_the_prior_and_hold_its_parameters(
    first_step, name
):
    untouched, _ = first_step("paper")  # with the same time step, and networks that have not moved
    terms, _ = first_step("full", f"adapter={name}")
    assert terms["position"] == pytest.approx(
        untouched["position"], abs=0.005
    )  # of the body's size
    module = first_step.modules["full", f"adapter={name}"]
    assert [g["name"] for g in module.groups(module.stages[0])] == ["material", "contact"]
    assert [g["name"] for g in module.groups(module.stages[-1])] == ["contact", "adapter"]


LINEAR = "adapter=linear", "losses.operator=0.2"
"""It has a penalty of its size; that of the default adapter is the prior of its numbers."""


def test_without_the_adapter_there_is_no_penalty_of_it(first_step):
    full, _ = first_step("full", *LINEAR)
    terms, _ = first_step("no_stress", *LINEAR)
    assert full.keys() - terms.keys() == {"operator"}
    assert terms == {k: v for k, v in full.items() if k != "operator"}


def test_the_penalty_of_the_operator_weighs_less_the_more_the_prior_leaves_unexplained(first_step):
    terms, _ = first_step("full", *LINEAR)
    module = first_step.modules["full", *LINEAR]
    assert module.misfit == pytest.approx(
        terms["position"], rel=1e-6
    )  # the adapter has not moved: the prior's own
    with torch.no_grad():
        take = module.takes[0]
        penalty = [
            module.terms(module.stages[-1], whole(take), 3, take)[0]["operator"]
            for module.misfit in (0.01, 0.04)
        ]
    assert float(penalty[0] / penalty[1]) == pytest.approx(16.0, rel=1e-6)
    assert float(penalty[0]) == pytest.approx(1e-4, rel=1e-3)  # of an operator that is nothing yet


@pytest.mark.parametrize("kind", ["modes", "network"])
def test_a_stage_that_starts_from_the_prior_forgets_eta(first_step, kind):
    overrides = () if kind == "modes" else ("heterogeneity.kind=network", *LINEAR)
    first_step("full", *overrides)
    body = first_step.modules["full", *overrides].body
    body.freeze("prior")
    with torch.no_grad():
        last = (
            body.heterogeneity.coefficients if kind == "modes" else body.heterogeneity.net[-1].bias
        )
        last.fill_(0.3)
        learned = body.heterogeneity(body.rest)
    assert learned.abs().max() > 0.2
    body.freeze("prior_eta")
    body.thaw("prior")
    assert (body.heterogeneity(body.rest) == 0).all() and body.model("prior").heterogeneity is None
    body.thaw("prior_eta")
    assert torch.equal(body.heterogeneity(body.rest), learned)
    assert kind == "modes" or (learned == 0.3).all()
