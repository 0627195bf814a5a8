"""The code of docs/own_training_script.md runs as it stands, on the cached tiny scene."""

import re
from pathlib import Path

import forked
from assembled import ROUGHLY

from tests.integration.test_extending import recorded, written

ROOT = Path(__file__).parents[2]


def test_the_page_runs(cache, tmp_path):
    """Its films in a format of one's own are those of docs/extending.md."""
    page = (ROOT / "docs" / "own_training_script.md").read_text()
    blocks = re.findall(r"```python\n(?!# \w+\.py)(.*?)```", page, re.S)
    assert len(blocks) == 5
    written(tmp_path)
    recorded(tmp_path, cache)
    held = '"scene.holdout_frames=1"'
    assert blocks[0].count(held) == 1
    blocks[0] = blocks[0].replace(held, f"{held}, *{ROUGHLY}")
    code = "\n".join(blocks).replace('"debug=default"', f'"debug=default", "scene.cache={cache}"')
    script = tmp_path / "own.py"
    script.write_text(f"import os\n\nos.chdir({str(tmp_path)!r})\n{code}")
    result = forked.call(str(script))
    assert result.returncode == 0, result.stderr[-3000:]
    assert "overridden `transfer_batch" not in result.stderr
    assert "will override existing callbacks" not in result.stderr
    assert "loss_raw/height" in next(tmp_path.glob("heights/**/metrics.csv")).read_text()
    assert "Scene(name='fall'" in result.stdout
    assert "MotionBatch(" in result.stdout and re.search(
        r"torch.Size\(\[3, \d+, 3\]\)", result.stdout
    )
