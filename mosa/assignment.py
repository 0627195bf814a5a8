"""The mean distance of exact assignments between clouds, `emd_m`, several of them in processes of their own: SciPy's solver holds
Python's lock, so that threads take their turns. `python -m mosa.assignment` is such a process: clouds on its standard input, the
distances on its output. It imports no more than NumPy and SciPy.
"""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from mosa.threads import cores, threaded

Clouds = tuple[np.ndarray, np.ndarray]
WORTH = 1000
"""Points of a cloud from which on its assignment (0.1 s, eight times that for twice as many) is worth a process (0.5 s)."""


def mean_distance(clouds: Clouds) -> float:
    """Of the best one-to-one assignment between two clouds (N, 3) of equally many points, in their unit."""
    cost = cdist(*clouds)
    rows, columns = linear_sum_assignment(cost)
    return float(cost[rows, columns].mean())


def mean_distances(pairs: Sequence[Clouds]) -> list[float]:
    """`mean_distance` of each; of large clouds on all cores of this process."""
    workers = min(cores(), len(pairs))
    if workers < 2 or len(pairs[0][0]) < WORTH:
        return [mean_distance(pair) for pair in pairs]
    result = [0.0] * len(pairs)
    for first, found in enumerate(threaded(_elsewhere, [pairs[k::workers] for k in range(workers)])):
        result[first::workers] = found
    return result


def _elsewhere(pairs: Sequence[Clouds]) -> list[float]:
    """In another process, or here where there is none to be had: a figure is no reason for a run to fail."""
    sent = io.BytesIO()
    np.savez(sent, *[cloud for pair in pairs for cloud in pair])
    known = os.pathsep.join([str(Path(__file__).parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])])
    try:
        done = subprocess.run([sys.executable, "-m", "mosa.assignment"], input=sent.getvalue(), capture_output=True, check=True,
                              env={**os.environ, "PYTHONPATH": known})  # fmt: skip
        return json.loads(done.stdout)
    except (OSError, ValueError, subprocess.SubprocessError):
        return [mean_distance(pair) for pair in pairs]


def main() -> None:
    with np.load(io.BytesIO(sys.stdin.buffer.read())) as clouds:
        each = [clouds[name] for name in clouds.files]
    print(json.dumps([mean_distance(pair) for pair in zip(each[::2], each[1::2])]))


if __name__ == "__main__":
    main()
