"""Every combination of the config groups composes, and a switch changes what it names and nothing else."""

import functools
import inspect
import re
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.errors import MissingConfigException
from omegaconf import DictConfig, OmegaConf

import mosa
from mosa.config import build
from mosa.config.build import build_adapter, build_stages, rehearse
from mosa.config.command_settings import TrainSettings
from mosa.errors import ConfigError, DataError
from mosa.modules.adapters.registry import ADAPTERS, adapter_class
from mosa.modules.body.simulation_settings import SimulationSettings
from mosa.settings import annotation_of, arguments_of, described, fits

ROOT = Path(__file__).parents[2]


def group(name: str) -> list[str]:
    return sorted(p.stem for p in (ROOT / "conf" / name).glob("*.yaml"))


@functools.cache
def once(*overrides: str) -> DictConfig:
    """Not to be changed: composing takes longer than most tests here."""
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        return compose("train", overrides=list(overrides))


def composed(*overrides: str) -> dict:
    return OmegaConf.to_container(once(*overrides), resolve=False)


@pytest.mark.parametrize("scene", group("scene"))
def test_every_scene_passes_the_checks_before_a_run_with_priors_and_adapters(scene):
    """With each scene two of them, so that every prior and every adapter meets several scenes."""
    adapters, priors, first = group("adapter"), group("prior"), group("scene").index(scene)
    for i in range(2 * first, 2 * first + 2):
        prior, adapter = priors[i % len(priors)], adapters[i % len(adapters)]
        config = composed(f"scene={scene}", f"prior={prior}", f"adapter={adapter}")
        assert config["prior"] and config["scene"]
        rehearse(config)


@pytest.mark.parametrize(
    "override", ["debug=defualt", "scene=rabit", "prior=jelly", "ablation=no_foo", "trainer=tpu"]
)
def test_a_mistyped_option_is_refused(override):
    with pytest.raises(MissingConfigException, match=override.split("=")[1]):
        composed(override)


@pytest.mark.parametrize("override, message", [
    ("prior=neo_hokean", r"prior: expected .*, found neo_hokean; .*neo_hookean; .* hydra\.searchpath"),
    ("ablation=no_rotation", "found no_rotation; the nearest is no_rot;"),
    ("callbacks=[default,early_stoping]", "callbacks: expected one of default, early_st.*nearest is early_stopping"),
    ("hydra/launcher=rai", "hydra/launcher: expected one of .*basic"),
    ("prior=null", r"prior: expected one of auto, .*, found null; without prior= "),
    ("logger=null", "logger: expected one of csv, none, .*, found null; logger=none"),
    ("hydra/sweeper=null", "a group, as scene, .*: expected the name of an option, found null"),
    ("trainer.max_time=60", r"'trainer\.max_time'; the nearest is \+trainer\.max_time=<value>"),
    ("trainer.max_epoch=1", r"'trainer\.max_epoch'; the nearest is trainer\.max_epochs"),
    ("callbacks.early_stopping.patience=3", "callbacks=early_stopping has it, the chosen callb"),
    ("scene.test=[]", "scene=markers, pacnerf, .* have it, .* brings its own held-out"),
    ("particles=200", r"'particles'; expected .*simulation\.particles"),
    ("fps=24", r"'fps'; expected .*film\.fps"),
    ("run_dir=a", r"'run_dir'; expected hydra\.run\.dir=<folder>"),
    ("simulation.particels=200", "'simulation.particels'; the nearest is simulation.particles"),
    (("scene=transforms", "scene.ground={hight: 0.1}"), r"'scene\.ground\.hight'; the nearest is scene\.ground\.height\."),
    (("scene=transforms", "scene.ground.hight=0.1"), r"'scene\.ground\.hight'; the nearest is scene\.ground\.height\."),
    (("scene=transforms", "scene.body={path: a.ply}"), r"override 'scene\.body\.path'\.$"),
])  # fmt: skip
def test_a_mistyped_override_in_python_names_what_there_is(override, message):
    with pytest.raises(ConfigError, match=message) as found:
        mosa.compose(*([override] if isinstance(override, str) else override))
    assert "use +" not in str(found.value)


@pytest.mark.parametrize("made", [mosa.compose, mosa.LitMosa, mosa.SceneDataModule])
def test_overrides_in_a_list_are_refused(made):
    with pytest.raises(
        ConfigError, match=r"overrides: expected texts.*of a list: compose\(\*list\)"
    ):
        made(["scene=tiny"])


@pytest.mark.parametrize("adapter, message", [
    ({"name": "stress", "alpha": 2}, "adapter.alpha"),
    ({"name": "direct", "no_C": True}, "no_C"),
    ({"name": "stress", "alfa": 0.1}, "adapter.alfa: unknown key; expected one of alpha"),
    ({"name": "stres"}, "adapter.name: expected hyperelastic, stress, direct, nclaw, neuma, interaction or null, found 'stres'"),
    ({"name": ["stress"]}, "adapter.name: expected hyperelastic, stress, direct, nclaw, neuma, interaction or null"),
    ({"name": "hyperelastic", "alpha": 0.2}, "adapter.alpha: unknown key; expected none"),
    ({"name": "direct", "_target_": "subprocess.Popen"}, "adapter._target_: unknown key"),
])  # fmt: skip
def test_a_mistake_in_the_adapter_names_its_key(adapter, message):
    with pytest.raises(ConfigError, match=message):
        build_adapter(adapter)


@pytest.mark.parametrize(
    "key, value",
    [("precision", 16), ("stride", 0), ("max_substeps", 2.5), ("courant", 0), ("dx", -1.0)],
)
def test_a_mistake_in_the_simulation_names_its_key(key, value):
    with pytest.raises(ConfigError, match=f"simulation.{key}"):
        SimulationSettings(**{"dx": 0.1, key: value})


def test_a_mistake_in_a_stage_names_its_key():
    fit = {name: {"iterations": 2, "lr": 0.1} for name in ("prior", "prior_eta", "joint")}
    with pytest.raises(
        ConfigError,
        match=r"fit\.joint\.lrr: unknown key; expected one of optimizer, newton_iterations, .*fit\.joint\.lr",
    ):
        build_stages(fit | {"joint": {"iterations": 2, "lrr": 1}}, heterogeneity=None, adapter=None)
    with pytest.raises(ConfigError, match=r"fit\.joint\.start"):
        build_stages(
            fit | {"joint": {"iterations": 2, "lr": 1, "start": "foo"}},
            heterogeneity=None,
            adapter=None,
        )


CONSTANT = {"name": "stress", "state_dependence": "constant"}


@pytest.mark.parametrize("adapter, expected", [
    ({"name": "hyperelastic"}, "gauss_newton"), ({"name": None}, None), ({"name": "stress"}, "adam"),
    (CONSTANT, "adam"), (CONSTANT | {"no_pre": True, "no_post": True}, "gauss_newton"),
    (CONSTANT | {"state_dependence": "later"}, "gauss_newton"),
])  # fmt: skip
def test_a_stage_takes_gauss_newton_where_all_it_learns_has_few_numbers(adapter, expected):
    fit, built = composed()["fit"], build_adapter(adapter)
    stages = build_stages(fit, heterogeneity=None, adapter=built)
    found = {stage.name: stage.optimizer for stage in stages}
    assert (
        found.get("joint") == expected and found["prior"] == "gauss_newton"
    )  # without an adapter there is nothing to join
    assert found.get("networks") == ("adam" if adapter.get("state_dependence") == "later" else None)
    asked = fit | {"joint": fit["joint"] | {"optimizer": "gauss_newton"}}
    if built is not None and built.later:  # as of a checkpoint of an ended fit
        built.vary()
        stages = [(s.name, s.optimizer) for s in build_stages(asked, None, built)]
        assert stages[-2:] == [("joint", "gauss_newton"), ("networks", "adam")]
    if expected == "adam":
        with pytest.raises(
            ConfigError, match=r"fit\.joint\.optimizer: gauss_newton learns few numbers"
        ):
            build_stages(asked, heterogeneity=None, adapter=built)
    adam = composed("fit=adam")["fit"]
    assert {s.optimizer for s in build_stages(adam, heterogeneity=None, adapter=built)} == {"adam"}


@pytest.mark.parametrize("overrides, law", [("", "auto"), ("fit=adam", "corotated"), ("fit=paper", "corotated"),
    ("debug=default", "corotated"), ("fit=adam prior=stvk", "stvk"), ("debug=default prior=auto", "auto")])  # fmt: skip
def test_laws_are_compared_where_none_is_named(overrides, law):
    # by Gauss-Newton: Adam, and a smoke run, take one
    assert composed(*overrides.split())["prior"]["law"] == law


@pytest.mark.parametrize("override, adapter, expected", [(None, None, 9), ("fit.prior.looks=0", None, 0), ("fit=adam", None, 0),
                                                         (None, "hyperelastic", 0)])  # fmt: skip
def test_a_calibration_looks_again_where_it_is_all_there_is(override, adapter, expected):
    fit = composed(*([override] if override else []))["fit"]
    stages = build_stages(fit, heterogeneity=None, adapter=build_adapter({"name": adapter}))
    assert [stage.name for stage in stages if stage.looks_again] == [
        "prior"
    ] * expected and not stages[0].looks_again


@pytest.mark.parametrize("group_name", ["adapter", "ablation", "criterion", "debug", "experiment", "fit", "logger", "prior",
                                        "reconstruction", "simulation", "trainer"])  # fmt: skip
def test_every_option_passes_the_checks_before_a_run(group_name):
    for option in group(group_name):
        config = composed(f"{group_name}={option}")
        rehearse(config)


@pytest.mark.parametrize("override", [
    "seed=abc", "seed=-1", "seed=1.5", "scene.also_train=test_60", "fit.views=1.5", "fit.views=true", "fit.clip=0",
    "fit.prior.lr=-1",
    "fit.joint.lr_adapter=abc", "fit.prior.iterations=1.5", "fit.joint.start=foo", "losses.image=null", "losses.flow=-1",
    "heterogeneity.enabled=maybe", "heterogeneity.amplitude=abc", "adapter.alpha=.nan", "adapter.plastic=1",
    "simulation.particles=1.5", "simulation.dx=abc", "simulation.courant=5", "simulation.contact_offset=abc", "prior.frozen=E",
    "rendering.margin=abc", "reconstruction.resolution=0", "reconstruction.points=2", "reconstruction.neighbours=1",
    "reconstruction.static.views=abc", "reconstruction.static.shape=1",
    "reconstruction.static.relocate_every=-1",
    "reconstruction.appearance.shape=round", "reconstruction.appearance.axis_ratio=0.5",
    "reconstruction.dynamic.modes=0", "world.walls=5", "world.colliders=[5]",
    "evaluation.samples=0",
])  # fmt: skip
def test_a_value_of_the_wrong_kind_is_named_before_anything_is_computed(override):
    base = (
        ["adapter=linear"] if override.startswith("adapter.") else []
    )  # it has the keys, and the default has not
    with pytest.raises(
        ConfigError, match=rf"^{override.lstrip('+').split('=')[0]}: expected .*, found "
    ):
        rehearse(composed(*base, override))


@pytest.mark.parametrize("overrides, message", [
    (["prior.parameters.nu=0.7"], r"prior\.parameters\.nu"),
    (["+prior.foo=1"], r"prior\.foo: unknown key; expected one of law, parameters, frozen, modulated"),
    (["+prior.options.foo=1"], r"prior\.options\.foo: unknown key; expected one of yield_convention"),
    (["adapter=linear", "adapter.alpha=2"], r"adapter\.alpha"),
    (["heterogeneity.wavelength=3"], r"heterogeneity\.wavelength"),
    (["criterion.name=open"], r"criterion\.name"),
    (["criterion.gain=2"], r"criterion\.gain"),
    (["identification.count=0"], r"identification\.count"),
    (["heterogeneity.amplitude=2"], r"heterogeneity\.amplitude"),
    (["simulation.precision=16"], r"simulation\.precision"),
    (["fit.prior.iterations=0"], r"fit\.prior\.iterations"),
    (["world.walls={foo:1}"], r"world\.walls\.foo: unknown key; expected one of mode, friction"),
    (["world.walls={friction:abc}"], r"world\.walls\.friction"),
    (["world.walls={mode:sticky,friction:0.1}"], r"world\.walls\.friction"),
    (["world.colliders=[{type:cone}]"], r"world\.colliders\[0\]\.type"),
    (["world.driven=[{type:sphere}]"], r"world\.driven\[0\]: a sphere needs radius"),
    (["world.driven=[{indices:[0],mass:-1}]"], r"world\.driven\[0\]\.mass"),
    (["world.forces=[{of:grip}]"], r"world\.forces\[0\]\.file: expected this key"),
    (["+prior.parameters.damping=-1"], r"prior\.parameters\.damping"),
])  # fmt: skip
def test_a_part_that_cannot_be_built_is_named_before_anything_is_computed(overrides, message):
    with pytest.raises(ConfigError, match=message):
        rehearse(composed(*overrides))


def test_forces_need_a_fit_that_compares_them(tmp_path):
    (tmp_path / "cell.csv").write_text("time,fy\n0,1\n1,2\n")
    world = [
        "world.driven=[{name:grip,type:sphere,radius:1}]",
        f"world.forces=[{{of:grip,file:{tmp_path}/cell.csv}}]",
    ]
    rehearse(composed(*world))
    of_another = [world[0], world[1].replace(".csv", ".csv,recording:test_60")]
    rehearse(composed(*of_another, "scene.also_train=[test_60]"))
    with pytest.raises(ConfigError, match=r"recording: .* \(there are none\).* found 'test_60'"):
        rehearse(composed(*of_another))
    with pytest.raises(ConfigError, match=r"one file for each solid .* found two of 'grip'"):
        rehearse(composed(world[0], world[1][:-1] + "," + world[1].partition("[")[2]))
    with pytest.raises(ConfigError, match=r"world\.forces: expected stages that run Gauss-Newton"):
        rehearse(composed(*world, "fit=adam"))
    with pytest.raises(
        ConfigError, match=r"name of one collider or driven set \(there are none\), found 'grip'"
    ):
        rehearse(composed(world[1]))


def test_adaptive_substeps_need_free_rollouts():
    """Refused where the first stage after calibration began, after the reconstruction, in words of criterion=corrected alone."""
    for criterion in ("corrected", "both"):
        with pytest.raises(
            ConfigError, match=f"criterion=free beside it, found criterion={criterion}"
        ):
            rehearse(composed("simulation.adaptive=true", f"criterion={criterion}"))
    for free in (["criterion=free"], ["adapter=none", "heterogeneity.enabled=false"], ["scene=markers"]):  # fmt: skip
        rehearse(composed("simulation.adaptive=true", *free))


def test_what_another_experiment_says_is_read_before_anything_is_computed(tmp_path):
    known = f"identification.known={tmp_path / 'none.json'}"
    for prior in ("auto", "neo_hookean"):
        with pytest.raises(DataError, match=r"^identification\.known: .*none\.json: no such file"):
            rehearse(composed(f"prior={prior}", known))


def test_a_rehearsal_draws_no_random_number():
    before = torch.get_rng_state()
    rehearse(composed("adapter=mosa"))
    assert torch.equal(torch.get_rng_state(), before)


def flat(config, prefix="") -> dict:
    result = {}
    for key, value in config.items():
        result |= (
            flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
        )
    return result


EXPECTED = {
    "full": set(),
    "no_C": {"adapter.no_C"},
    "no_het": {"heterogeneity.enabled"},
    "no_pre": {"adapter.no_pre"},
    "no_post": {"adapter.no_post"},
    "no_flow": {"losses.flow"},
    "no_scale": {"losses.stretch"},
    "no_rot": {"losses.rotation"},
    "no_prior_stress": {"adapter.no_prior_stress"},
}


@pytest.mark.parametrize("name", sorted(EXPECTED))
def test_an_ablation_changes_the_switch_it_names_and_nothing_else(name):
    # the parts of the networks exist in the paper's adapter only
    whole = "paper" if any(key.startswith("adapter.") for key in EXPECTED[name]) else "full"
    full, ablated = flat(composed(f"ablation={whole}")), flat(composed(f"ablation={name}"))
    assert {k for k in full.keys() | ablated.keys() if full.get(k) != ablated.get(k)} == EXPECTED[
        name
    ]


@pytest.mark.parametrize("name, overrides", [
    ("bird", ["scene=pacnerf_bird", "prior=neo_hookean", "scene.holdout_cameras=[5]"]),
    ("paper_size", ["simulation=paper", "trainer=gpu", "scene.scale=1"]),
])  # fmt: skip
def test_an_experiment_is_what_its_overrides_are(name, overrides):
    assert composed(f"experiment={name}") == composed(*overrides) != composed()
    assert (
        composed(f"experiment={name}", "seed=3", "prior=stvk")["prior"]["law"]
        == composed("prior=stvk")["prior"]["law"]
    )


PRINTED = {
    "adapter.name": "stress", "adapter.alpha": 0.1, "adapter.alpha_normal": None, "adapter.factors": "printed",
    "adapter.l_max": None, "adapter.rest_free": False, "adapter.plastic": True, "adapter.major_symmetry": False,
    "adapter.state_dependence": "full", "adapter.no_C": False, "adapter.no_pre": False, "adapter.no_post": False,
    "losses.image": 1.0, "losses.mask": 1.0, "losses.flow": 1.0, "losses.rotation": 0.1, "losses.stretch": 0.1,
    "losses.heterogeneity": 0.1, "losses.position": 0.0, "losses.operator": 0.0, "losses.operator_variance": 0.0,
    "heterogeneity.enabled": True, "heterogeneity.kind": "network", "heterogeneity.amplitude": 0.2,
    "criterion.name": "free", "simulation.contact_offset": False, "simulation.stride": 1,
    "prior.options.friction_cone": "printed", "reconstruction.geometry.source": "gaussians",
    "reconstruction.cue": "gaussian", "reconstruction.dynamic.model": "network",
    "reconstruction.dynamic.carriers": "particles", "reconstruction.dynamic.elastic": 0.0,
    "reconstruction.dynamic.bases": 10, "reconstruction.dynamic.hidden": 256,
    "reconstruction.dynamic.basis_layers": 8, "reconstruction.dynamic.coefficient_layers": 3,
    "reconstruction.dynamic.space_frequencies": 10, "reconstruction.dynamic.time_frequencies": 6,
    "reconstruction.static.shape": "isotropic", "reconstruction.appearance.shape": "isotropic",
    "reconstruction.informed.iterations": 0, "rendering.appearance": "particles",
}  # fmt: skip
"""What the paper and GIC print, by key (docs/paper.md)."""


@pytest.mark.parametrize("prior", ["neo_hookean", "von_mises", "drucker_prager"])
def test_the_papers_experiment_is_as_printed(prior):
    values = TrainSettings.read(composed("experiment=paper", f"prior={prior}"))
    found = flat(values.plain())
    assert {key: found[key] for key in PRINTED} == PRINTED
    stages = rehearse(values)
    assert [stage.name for stage in stages] == ["prior", "prior_eta", "joint"]
    assert not any(stage.newton for stage in stages)
    short = rehearse(composed("debug=default", "experiment=paper", f"prior={prior}"))
    assert len(short) == 3 and not any(stage.newton for stage in short)


@pytest.mark.parametrize("name", sorted(ADAPTERS))
def test_an_adapters_arguments_are_its_own(name):
    """Its constructor says what each may be, and refuses what is none, whoever calls it."""
    build = adapter_class({"name": name})
    known = arguments_of(build, "adapter").model_fields
    assert set(known) == set(inspect.signature(build).parameters)
    for argument, f in known.items():
        kind = annotation_of(f)
        assert fits(kind, f.default)
        message = rf"^adapter\.{argument}: expected {re.escape(described(kind))}, found <object"
        with pytest.raises(ConfigError, match=message):
            build(**{argument: object()})
        with pytest.raises(ConfigError, match=message):
            build_adapter({"name": name, argument: object()})


def test_arguments_are_read_without_their_source(monkeypatch):
    """The search for docstrings that they cannot have read it again for each function."""

    def asked(length: int = 3): ...

    with monkeypatch.context() as unread:
        unread.setattr("inspect.findsource", lambda _: pytest.fail("a source was read"))
        arguments = arguments_of(asked, "")
    assert arguments.read({"length": 4}).length == 4


def test_bodies_of_one_data_module_share_no_module(monkeypatch):
    """One Trainer's module, in evaluation mode or on its device, took the Gaussians of another's along."""
    shape = SimpleNamespace(tensors=lambda: {}, splats=torch.nn.Linear(1, 1), rest=torch.zeros(1))
    monkeypatch.setattr(build, "build_body", lambda *_: torch.nn.Module())
    one, other = (build.body_of(shape, None) for _ in range(2))
    one.eval()
    assert other.splats.training and other.splats.weight is not one.splats.weight


def test_one_solid_in_place_of_a_list_of_them_is_named():
    with pytest.raises(ConfigError, match=r"world\.colliders.*\n?.*expected a list, as \[\{"):
        mosa.compose("world.colliders={type: plane}")
