"""The card beside a checkpoint: what was filmed, what was learned and how surely, where it holds."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from collections.abc import Sequence as Ordered

import torch
from torch import Tensor

from mosa.evaluation.analysis import statements, tables
from mosa.evaluation.evaluate import SAME, Sequence
from mosa.modules.body.body import Body
from mosa.physics.world import World
from mosa.types import RUBBING, Rollout

FILE = "model_card.md"
SHARE = 0.001  # of particles and frames at each end that the range of stretches leaves out


def filmed(sequences: Ordered[Sequence]) -> list[str]:
    """A line for each sequence."""
    lines = []
    for s in sequences:
        scene, dt = s.scene, s.scene.frame_dt
        learned = s.learned
        cameras = scene.training_cameras if learned else scene.cameras
        made = "simulated by this program, no capture" if scene.synthetic else "footage"
        by = f"{len(cameras)} cameras"
        if scene.markers is not None:
            made, by = "measured", f"{len(scene.markers.names)} tracked points"
        lines.append(
            f"- `{s.prefix}`, {'learned from' if learned else 'held out'}: scene {scene.name}, "
            f"sequence {scene.sequence}; {made}; {by}, {len(s.frames)} frames at "
            f"{1 / dt:.4g} a second; speed at the start {float(s.start.velocity.norm()):.3g} m/s."
        )
    return lines


def stretches(motions: Ordered[Tensor]) -> tuple[float, float]:
    """Smallest and largest principal stretch of F_tot (T, N, 3, 3) of the motions, but for `SHARE` at each end."""
    found = torch.cat([torch.linalg.svdvals(F.detach().double()).flatten() for F in motions])
    ordered = found[found.isfinite()].sort().values
    skipped = int(SHARE * len(ordered))
    return float(ordered[skipped]), float(ordered[len(ordered) - 1 - skipped])


Kept = Mapping[str, Mapping[str, Rollout]]  # by prefix and variant


def valid(sequences: Ordered[Sequence], kept: Kept, body: Body, world: World) -> list[str]:
    """What the motions covered that the law was learned from."""
    trained = [s for s in sequences if s.learned]
    # without the frames that are held out
    seen = [(kept[s.prefix]["adapted"], s.frames) for s in trained if "adapted" in kept.get(s.prefix, {})]  # fmt: skip
    lines = []
    if seen:
        low, high = stretches([r.F_tot[frames] for r, frames in seen])
        lines += [
            f"- Principal stretches from {low:.3g} to {high:.3g} occurred in the motions that were "
            "learned from. Beyond them the law is extrapolated.",
            f"- The motions last {max(float(r.times[frames[-1]]) for r, frames in seen):.3g} s. Creep, relaxation "
            "and wear over longer times were not seen.",
        ]
    if (ground := world.ground) is not None:
        lines.append(
            f"- The ground at {ground.height:.4g} m was met as `{ground.mode}`"
            f"{f', with friction {ground.friction:.3g}' * (ground.mode in RUBBING)}. Other surfaces may slide differently."
        )
    lines += [
        f"- The density {body.density:.5g} kg/m^3 was given, not measured. Without measured forces, "
        "films determine moduli divided by density: moduli, masses and forces scale with it.",
        f"- Grid spacing {1e3 * body.settings.dx:.4g} mm with {len(body.rest)} particles. On another "
        "grid the same numbers are a slightly different law.",
    ]
    return lines


LICENCE = (
    "The program that made this file has the MIT licence. It knows no licence of the films. Shape, "
    "colours and law come from them: ask whoever made the films before you pass this file on."
)
LOADING = """```python
from mosa import Twin

twin = Twin.load("last.ckpt")
print(twin.summary())
rollout = twin.simulate(height=0.2, velocity=(0, 0, 0), angular_velocity=(0, 0, 0), frames=30)
```"""


def model_card(
    figures: Mapping[str, float],
    body: Body,
    sequences: Ordered[Sequence],
    kept: Kept,
    world: World,
    version: str,
    note: str = "",
    fixed: Collection[str] = (),
) -> str:
    """Markdown. figures: of the run, some may be missing; kept: rollouts by prefix and variant; version: of mosa; note: on all;
    fixed: parameters that were not learned."""
    law, name = body.material.law, sequences[0].scene.name
    # a fit may leave out parts that the body has: their numbers are then 0
    learns = body.adapter is not None and body.adapter.corrects
    correction = type(body.adapter).__name__ if learns else "none"
    with torch.no_grad():
        spread = float(torch.std(body.factor(body.heterogeneity), correction=0))
    field = "is the same everywhere" if spread < SAME else "varies over the body"
    learned = (
        f"Law `{law}`, correction {correction}; the stiffness {field}. The body is "
        f"{1e3 * body.size:.4g} mm long and has {1e6 * float(body.volume.sum()):.4g} cm^3."
    )
    known = [n for n in fixed if n != "contact_offset_m" and f"id/{n}" in figures]
    given = ", ".join(f"{tables.with_unit(law, n)} = {figures[f'id/{n}']:.5g}" for n in known)
    learned += f" Given, not learned: {given}." * bool(given)
    unsure = "This fit keeps no posterior: how sure the law is, is not known."
    tracked = sequences[0].scene.markers is not None
    doubt = statements.unexplained_text(figures, world) or statements.worse_text(figures)
    about = tables.columns_text(figures, name, tracked)
    errors = (note, doubt, tables.results_table(figures), about)
    parts = {
        "What was filmed": "\n".join(filmed(sequences)),
        "What was learned": f"{learned}\n\n{tables.parameter_table(figures, law, fixed)}",
        "What is determined, and what is not": statements.determined_text(figures, law, tracked)
        or unsure,
        "Errors": "\n\n".join(filter(None, errors)),
        "Where it is valid": "\n".join(valid(sequences, kept, body, world)),
        "Licence": LICENCE,
        "How to load": LOADING,
    }
    text = "\n\n".join(f"## {title}\n{part}" for title, part in parts.items())
    return f"# Model card: {name}\n\nA learned body, by mosa {version}.\n\n{text}\n"
