"""One's own splats as the object: a 3DGS PLY in place of the static stage."""

from dataclasses import replace

import pytest
import torch

from mosa.data.io.gaussian_ply import save_ply
from mosa.errors import DataError
from mosa.reconstruction import pipeline
from mosa.reconstruction.gaussians.initial import initial_splats
from mosa.reconstruction.motion.observed import object_windows
from mosa.reconstruction.pipeline import object_hull, reconstruct
from mosa.reconstruction.settings import build_settings

QUICK = {
    "resolution": 32, "ridge_passes": 4, "static": {"iterations": 3}, "appearance": {"iterations": 3},
    "dynamic": {"modes": 8, "track_iterations": 2, "iterations": 2},
}  # fmt: skip


def test_a_ply_replaces_the_static_stage(squashed, tmp_path, monkeypatch):
    """The particles get the file's colours, no static fit is run, and another file is another cache entry."""
    settings = build_settings(splats=str(tmp_path / "own.ply"), **QUICK)
    still = object_windows(squashed, squashed.training_cameras, [0], margin=6)
    splats = initial_splats(object_hull(squashed, settings), still, count=150, seed=0)
    green = replace(splats, colors=torch.tensor([0.1, 0.9, 0.2]).expand(150, 3))
    far = replace(
        green, means=green.means + 100
    )  # the room around the object, outside of the scene's box
    save_ply(
        tmp_path / "own.ply",
        type(green)(*(torch.cat([getattr(s, n) for s in (green, far)]) for n in vars(green))),
    )
    fitted, fit = [], pipeline.fit_splats

    def noted(start, *arguments, **options):
        fitted.append((options["move"], start.colors))
        return fit(start, *arguments, **options)

    monkeypatch.setattr(pipeline, "fit_splats", noted)

    def run():
        return reconstruct(
            squashed, settings=settings, spacing=0.03, cache_dir=tmp_path, progress=False
        )

    result = run()
    assert [move for move, _ in fitted] == [False]
    torch.testing.assert_close(
        fitted[0][1], torch.tensor([0.1, 0.9, 0.2]).expand_as(fitted[0][1]), atol=1e-5, rtol=0
    )
    assert torch.isfinite(result.cues.positions).all()
    save_ply(tmp_path / "own.ply", replace(splats, colors=0.5 * splats.colors))
    run()
    assert len(fitted) == 2 and len(list((tmp_path / "reconstruction").glob("*/static.pt"))) == 2


def test_splats_of_another_world_are_refused(squashed, tmp_path):
    means = 100 + torch.rand(20, 3)
    rotations = torch.tensor([1.0, 0, 0, 0]).expand(20, 4)
    splats = pipeline.Splats(
        means, torch.full((20, 3), 0.1), rotations, torch.full((20,), 0.5), torch.rand(20, 3)
    )
    settings = build_settings(splats=str(save_ply(tmp_path / "far.ply", splats)), **QUICK)
    with pytest.raises(
        DataError, match=r"far.ply: expected Gaussians in the scene's box .*found 0 of 20"
    ):
        reconstruct(squashed, settings=settings, spacing=0.03, cache_dir=None, progress=False)


@pytest.mark.parametrize("change, unit", [
    (lambda x, middle: x + torch.tensor([0.12, 0, 0]), 1), (lambda x, middle: middle + 0.3 * (x - middle), 0.3),
    (lambda x, middle: middle + 2.5 * (x - middle), 2.5), (lambda x, middle: x[:, [1, 0, 2]], 1),
])  # fmt: skip
def test_splats_beside_the_object_are_refused(squashed, tmp_path, change, unit):
    """Inside of the scene's box, in another unit, with other axes, or elsewhere."""
    settings = build_settings(splats=str(tmp_path / "own.ply"), **QUICK)
    still = object_windows(squashed, squashed.training_cameras, [0], margin=6)
    splats = initial_splats(object_hull(squashed, settings), still, count=150, seed=0)
    save_ply(tmp_path / "own.ply", splats)
    assert len(pipeline.imported_splats(str(tmp_path / "own.ply"), squashed).splats.means) == 150
    moved = replace(
        splats, means=change(splats.means, splats.means.mean(0)), scales=unit * splats.scales
    )
    save_ply(tmp_path / "own.ply", moved)
    with pytest.raises(
        DataError, match="expected Gaussians where the mattes of frame 0 show the object"
    ):
        pipeline.imported_splats(str(tmp_path / "own.ply"), squashed)
