"""Small recordings in place of those that the commands of tutorials name: drops, a swinging beam, stress-strain tests."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from written_scenes import export_transforms

from mosa.data.scene import load_scene
from mosa.system.caches import default_cache


def drops(*folders: str) -> None:
    """The three drops of the scene tiny by half of its cameras at a quarter of its size, and a film of the first two
    after each other."""
    films, some = [], [0, 2, 4]
    for name in ("train", "test_60", "test_40"):
        film = load_scene(format="builtin", name="tiny", sequence=name, scale=0.25, cache=default_cache())  # fmt: skip
        seen = {"images": film.images[some], "mattes": film.mattes[some]}
        films.append(replace(film, cameras=film.cameras.select(some), **seen))
    first, second, _ = films
    both = replace(
        first,
        images=torch.cat([first.images, second.images], 1),
        mattes=torch.cat([first.mattes, second.mattes], 1),
        times=torch.cat([first.times, second.times + 2 * first.times[-1] - first.times[-2]]),
    )
    for folder, film in zip(folders, [*films, both]):
        export_transforms(film, folder)


def swings(*paths: str) -> None:
    """Tip and base of a beam of 10 cm that is let go at 0.3 s and swings about its sag of 7 mm at 7.8 Hz; time [s], places [m]."""
    places = {"Tip - 1": [0.1, 0.0208, 0], "Tip - 2": [0.1, 0.0094, 0.0208], "Tip - 3": [0.1, -0.0081, -0.0208],
              "Base - 1": [0.0058, -0.0045, 0.0287], "Base - 2": [0.0058, 0.0232, -0.0219],
              "Base - 3": [0.0058, -0.0038, -0.0213]}  # fmt: skip
    times = np.arange(0, 1.5, 0.01)
    phase = 2 * np.pi * 7.8 * np.clip(times - 0.3, 0, None)
    moved = 7e-3 * (np.exp(-0.05 * phase) * np.cos(phase) - 1)
    rows = [f"{time:.2f},{name},{x},{y + down * (x / 0.1) ** 2:.6f},{z}"
            for time, down in zip(times, moved) for name, (x, y, z) in places.items()]  # fmt: skip
    for path in map(Path, paths):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join(["time,name,x,y,z", *rows]) + "\n")


def foams(*paths: str) -> None:
    """Two tensions and a shear of a soft foam [kPa]."""
    rows = ["a,uniaxial x,1.05,1.6", "a,uniaxial x,1.1,3.1", "b,uniaxial y,1.1,3.2", "c,shear xy,0.1,1.1"]  # fmt: skip
    for path in map(Path, paths):
        path.write_text("\n".join(["test,mode,first,stress_1", *rows]) + "\n")
