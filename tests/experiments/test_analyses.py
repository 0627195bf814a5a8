"""What experiments work out beside their tables."""

from types import SimpleNamespace

import pytest

from mosa.experiments import analyses


@pytest.mark.parametrize(
    ("learned", "true", "angle"), [(0.3, 0.5, "0"), (0.3, 0.0, ""), (0.0, 0.5, "")]
)
def test_what_is_isotropic_has_no_stiffest_direction(monkeypatch, tmp_path, learned, true, angle):
    """The table had 70 degrees of a law whose modulus varied by rounding alone, and angles from fibres that are not there."""
    moduli = lambda share: lambda *given: 2e5 * (1 + share * (given[-1] @ given[-1][0]).square())  # noqa: E731
    twin = SimpleNamespace(body=None, record=SimpleNamespace(settings={"scene": {}}))
    record = SimpleNamespace(place={"truth": SimpleNamespace(name="body")})
    monkeypatch.setattr(analyses, "loaded", lambda records: [(record, twin)])
    monkeypatch.setattr(analyses, "redistribution", lambda body, n: None)
    monkeypatch.setattr(analyses, "learned_modulus", moduli(learned))
    monkeypatch.setattr(analyses, "true_modulus", moduli(true))
    monkeypatch.setattr(analyses, "label", lambda *_: "ours")
    monkeypatch.setattr(analyses, "save", lambda canvas, path: path)
    experiment = SimpleNamespace(
        columns="truth", rows="method", axes={"method": [SimpleNamespace(name="ours")]}
    )
    text, _ = analyses.directions(experiment, [record], tmp_path / "figure")
    assert text.splitlines()[-1].split("|")[-2].strip() == angle
