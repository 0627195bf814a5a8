"""A page of docs/ in a folder, block by block: Python as it stands, each command by its own entry point and parser.

    python tests/helpers/run_page.py docs/tutorial.md <folder> <code before it> <code after it>

Left out is what takes long behind a parser: the job of a command that Hydra configures, a viewer's page, an export, jobs of
experiments. With TESTS_REALLY in the environment the commands run. A block that cannot run says so above itself, in the page:
<!-- not run: reason -->, or <!-- not run without <module>: reason -->.
"""

import json
import os
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
import warnings
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

from hydra._internal.hydra import Hydra
from hydra.core.hydra_config import HydraConfig
from markdown_it import MarkdownIt

from mosa.cli import configured
from mosa.config.build import plain
from mosa.config.extensions import load_extensions
from mosa.config.leaf_settings import CaptureSettings, MaterialSettings
from mosa.environments.command import setting_of
from mosa.export import run as exported
from mosa.training import preflight
from mosa.viewer import recorded

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
RUN = "outputs/train/<date>/<time>"
"""A folder of this name, letter for letter, is what the pages' commands find."""
NO_CODE = ("bibtex", "csv", "math", "text")
CHECKS = {"train": preflight.check_configuration, "eval": preflight.check_evaluation, "splats": preflight.check_splats,
          "capture": CaptureSettings.read, "environments": setting_of, "material": MaterialSettings.read}  # fmt: skip


class Block(NamedTuple):
    language: str
    text: str
    line: int
    """Lines above it."""
    named: str | None = None
    """Path of the file that it is."""
    left_out: bool = False


def blocks(page: Path) -> list[Block]:
    if page.suffix == ".ipynb":
        cells = json.loads(page.read_text())["cells"]
        return [Block("python", "".join(cell["source"]), 0) for cell in cells if cell["cell_type"] == "code"]  # fmt: skip
    found, above = [], ""
    for token in MarkdownIt("commonmark").parse(page.read_text()):
        if token.type in ("fence", "code_block"):
            named = re.match(r"# ([\w/]+\.(?:py|yaml))\n", token.content)
            reason = re.match(r"<!-- not run(?: without (\w+))?: .+ -->", above)
            left_out = reason is not None and not (reason[1] and find_spec(reason[1]))
            text = token.content[named.end() if named else 0 :]
            found.append(Block(token.info, text, token.map[0] + 1, named and named[1], left_out))
        above = token.content if token.type == "html_block" else ""
    return found


def written(page: Path, folder: Path) -> list[str]:
    """The page's files, below the folder; their paths."""
    files = [block for block in blocks(page) if block.named]
    for block in files:
        (folder / block.named).parent.mkdir(parents=True, exist_ok=True)
        (folder / block.named).write_text(block.text)
    return [block.named for block in files]


def checked(job: Callable, cfg) -> float:
    """In place of a command's job: what it refuses, or warns of, before anything takes long."""
    values = plain(cfg)
    load_extensions(values.get("extensions"))
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)  # a key that has no effect
        CHECKS[HydraConfig.get().job.name](values)
    return 0.0


def command(words: list[str]) -> None:
    """Fails where the command line would."""
    while re.match(r"[A-Z_]+=", words[0]):  # the environment
        words = words[1:]
    program, *words = [word for word in words if word != "..."]
    while program in ("python", "python3", "-m"):
        program, *words = words
    sys.argv = [program, *words]
    if program == "pip":
        extras = {name for each in re.findall(r"\[([\w,]+)\]", " ".join(words)) for name in each.split(",")}  # fmt: skip
        assert extras <= set(PROJECT["optional-dependencies"]), extras
    elif program == "-c":
        exec(words[0], {})
    elif program in PROJECT["scripts"] or re.fullmatch(r"mosa\.\w+", program):
        sys.argv += ["--dry-run"] if "experiment" in program else []
        where, _, name = PROJECT["scripts"].get(program, f"{program}.__main__:main").partition(":")
        called(getattr(import_module(where), name))
    elif program in ("train.py", "eval.py"):
        really = configured.attempt is not checked and program == "train.py"
        sys.argv += [f"hydra.run.dir={RUN}"] if really else []
        called(lambda: runpy.run_path(str(ROOT / program), run_name="__main__"))
    else:
        assert program in ("venv", "source", "pytest") or (ROOT / program).is_file(), program


def called(main: Callable[[], None]) -> None:
    try:
        main()
    except SystemExit as ended:
        assert not ended.code, sys.argv


def launched(words: list[str], **_) -> SimpleNamespace:
    """In place of a process that a page starts."""
    command([Path(words[0]).name, *words[1:]])
    return SimpleNamespace(stdout="", stderr="", returncode=0)


def run(page: Path, before: str, after: str) -> None:
    names: dict = {}
    exec(before, names)
    written(page, Path())
    for block in blocks(page):
        if block.named or block.left_out or block.language in NO_CODE:
            continue
        if block.language == "python":  # lines of its traceback are those of the page
            exec(compile("\n" * block.line + block.text, str(page), "exec"), names)
            continue
        assert block.language == "bash", f"{page}:{block.line}: a block of no language that runs"
        for line in block.text.replace("\\\n", " ").splitlines():
            for each in line.split(" && "):
                command(shlex.split(each, comments=True))
    if not any(block.left_out for block in blocks(page)):
        exec(after, names)


if __name__ == "__main__":
    name, folder, before, after = sys.argv[1:]
    os.chdir(folder)
    if "TESTS_REALLY" not in os.environ:
        configured.attempt, subprocess.run = checked, launched
        Hydra.get_mode = lambda *_, **__: None  # for which it would compose once more
    recorded.opened = lambda chosen: sys.exit()
    exported.export = lambda *words: {}
    run(ROOT / name, before, after)
