"""The code of docs/own_training_script.md runs as it stands, on the cached tiny scene."""

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_page_runs(cache, tmp_path):
    page = (ROOT / "docs" / "own_training_script.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", page, re.S)
    assert len(blocks) == 4
    code = "\n".join(blocks).replace('"debug=default"', f'"debug=default", "scene.cache={cache}"')
    result = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=400)
    assert result.returncode == 0, result.stderr[-3000:]
    assert "MotionBatch(" in result.stdout and re.search(r"torch.Size\(\[3, \d+, 3\]\)", result.stdout)
