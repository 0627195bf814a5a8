"""docs/notebook.ipynb from top to bottom, without a kernel: its code cells are plain Python."""

import json
import os
import re
from pathlib import Path

import forked

ROOT = Path(__file__).parents[2]
NOTEBOOK = ROOT / "docs" / "notebook.ipynb"


STANDS_IN = """
import os, pathlib, types
os.chdir(pathlib.Path(__file__).parent)
launched = lambda *_, **__: types.SimpleNamespace(stdout="", stderr="", returncode=0)
"""


def test_the_notebook_runs_from_top_to_bottom(cache, tmp_path):
    """The first cell's command is run from here, by the program that has imported the libraries already."""
    cells = json.loads(NOTEBOOK.read_text())["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    assert all(
        cell["outputs"] == [] and cell["execution_count"] is None
        for cell in cells
        if cell["cell_type"] == "code"
    )
    assert code[0].count('"debug=default"') == code[0].count("subprocess.run(") == 1
    code[0] = code[0].replace(
        '"debug=default"', f'"debug=default", "scene.cache={cache}"'
    )  # the tests' own place for films
    code[0] = code[0].replace("subprocess.run(", "launched(")

    def launched(words, **_):
        assert Path(words[0]).name == "mosa-train" and words[-1].startswith("hydra.run.dir=")
        given = [word.replace("hydra.run.dir=", f"hydra.run.dir={tmp_path}/") for word in words[1:]]
        return forked.call("train.py", *given)

    first = {"launched": launched}
    exec(code[0], first)
    assert first["learned"].returncode == 0, first["learned"].stderr[-2000:]
    script = tmp_path / "cells.py"
    cells = "\n\n".join(f"{text}\nprint('cell {k} done')" for k, text in enumerate(code))
    script.write_text(f"{STANDS_IN}\n{cells}")
    # Jupyter's kernel would find the package where it is installed, the tests their own tree
    environment = os.environ | {"MPLBACKEND": "Agg", "OMP_NUM_THREADS": "1",
                                "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}  # fmt: skip
    found = forked.call(str(script), environment=environment, timeout=600)
    assert found.returncode == 0, f"{found.stdout[-2000:]}\n{found.stderr[-2000:]}"
    for line in (*(f"cell {k} done" for k in range(len(code))), "Held-out positions", "20 files;"):
        assert line in found.stdout, line
    losses = [float(loss) for loss in re.findall(r"iteration \d+: loss ([\d.]+)", found.stdout)]
    assert len(losses) == 3 and losses[-1] < 0.5 * losses[0]  # the policy learns
    assert "UserWarning" not in found.stderr  # nothing in it is what the program warns of
    assert (tmp_path / "notebook_run" / "checkpoints" / "last.ckpt").is_file()
    assert "nan" not in found.stdout.lower().split("cell 2 done")[1]
