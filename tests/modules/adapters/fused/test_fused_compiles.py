"""The fused kernels compile for Hopper, within its shared memory: as much of a GPU as a machine without one can test."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("triton")

SHARED = 227 * 1024
"""Bytes of a multiprocessor's shared memory that one program may have (compute capability 9.0)."""


@pytest.mark.slow
def test_they_compile_for_hopper():
    script = Path(__file__).with_name("compile_fused.py")
    environment = {k: v for k, v in os.environ.items() if k != "TRITON_INTERPRET"}
    environment["TRITON_DISABLE_LINE_INFO"] = "1"  # the same code, without a table for debuggers
    environment["PYTHONPATH"] = os.pathsep.join(
        [str(Path(__file__).parents[4]), os.environ.get("PYTHONPATH", "")]
    )
    result = subprocess.run(
        [sys.executable, str(script), "64"], capture_output=True, text=True, env=environment
    )
    assert result.returncode == 0, result.stderr[-3000:]
    found = json.loads(result.stdout.splitlines()[-1])
    assert len(found) == 13
    for name, kernel in found.items():
        assert kernel["shared"] <= SHARED, name
        assert kernel["tensor_cores"] == name.endswith(("forward", "backward")), name
