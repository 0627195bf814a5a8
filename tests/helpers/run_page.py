"""A page of docs/ in a folder, block by block: Python as it stands, each command by its own entry point and parser.

    python tests/helpers/run_page.py docs/tutorial.md <folder> <code before it> <code after it>

Left out is what takes long behind a parser: the job of a command that Hydra configures, a viewer's page, an export, jobs of
experiments. A block that cannot run says so above itself, in the page: <!-- not run: reason -->, or
<!-- not run without <module>: reason -->.

With TESTS_REALLY in the environment, a folder, the commands run, but for those of `CANNOT`. The code before the page may
set SAID, pieces of its commands by what stands in for them, and SMALLER, overrides by command, which are appended.
A line of train.py that another page has too runs once: its run folder lies in that folder.
"""

import hashlib
import json
import os
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
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
from mosa.training import preflight, workflow
from mosa.viewer import recorded

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
REALLY = os.environ.get("TESTS_REALLY")
RUN = "outputs/train/<date>/<time>"
"""A folder of this name, letter for letter, is what the pages' commands find."""
NO_CODE = ("bibtex", "csv", "math", "text")
CANNOT = {"trainer=gpu": "the tests have no GPU"}
"""Words of commands that cannot run here, and why: they are parsed and checked, as on the other pages."""
CHECKS = {"train": preflight.check_configuration, "eval": preflight.check_evaluation, "splats": preflight.check_splats,
          "capture": CaptureSettings.read, "environments": setting_of, "material": MaterialSettings.read}  # fmt: skip

attempt, opened = configured.attempt, recorded.opened


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


def command(words: list[str], smaller: Mapping[str, Sequence[str]]) -> None:
    """Fails where the command line would."""
    while re.match(r"[A-Z_]+=", words[0]):  # the environment
        words = words[1:]
    program, *words = [word for word in words if word != "..."]
    while program in ("python", "python3", "-m"):
        program, *words = words
    really = REALLY is not None and not set(words) & set(CANNOT)
    if really:
        program = {"mosa-train": "train.py"}.get(program, program)
        named = {program, *words}
        words += [more for word, further in smaller.items() if word in named for more in further]
    sys.argv = [program, *words]
    configured.attempt = attempt if really else checked
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
        if really and program == "train.py" and not new_run(words):
            return
        called(lambda: runpy.run_path(str(ROOT / program), run_name="__main__"))
    elif program.endswith(".py") and really:
        runpy.run_path(str(ROOT / program), run_name="__main__")
    else:
        assert program in ("venv", "source", "pytest") or (ROOT / program).is_file(), program


def new_run(words: list[str]) -> bool:
    """Whether a line of train.py did not run yet; its run folder, which is the same for all, takes its place here."""
    chosen = [word for word in words if not word.startswith("hydra.run.dir=")]
    (here,) = [word.partition("=")[2] for word in words if word not in chosen] or [RUN]
    kept = Path(REALLY, hashlib.sha256(repr(chosen).encode()).hexdigest()[:16])
    Path(here).parent.mkdir(parents=True, exist_ok=True)
    Path(here).unlink(missing_ok=True)
    Path(here).symlink_to(kept)
    sys.argv = ["train.py", *chosen, f"hydra.run.dir={kept}"]
    return not (kept / "metrics.json").is_file()


def called(main: Callable[[], None]) -> None:
    try:
        main()
        code = 0
    except SystemExit as ended:
        code = ended.code
    assert not code, sys.argv  # without the traceback of the exit


def launched(smaller: Mapping[str, Sequence[str]], words: list[str], **_) -> SimpleNamespace:
    """In place of a process that a page starts."""
    command([Path(words[0]).name, *words[1:]], smaller)
    return SimpleNamespace(stdout="", stderr="", returncode=0)


def looked_at(chosen: Mapping[str, str | None]):
    """A viewer's page that is served, and ends at once."""
    page = opened(chosen)
    page.ended.set()
    return page


def run(page: Path, before: str, after: str) -> None:
    names: dict = {"SAID": {}, "SMALLER": {}}
    subprocess.run = partial(launched, names["SMALLER"])
    exec(before, names)
    written(page, Path())
    for block in blocks(page):
        if block.named or block.left_out or block.language in NO_CODE:
            continue
        if block.language == "python":  # lines of its traceback are those of the page
            exec(compile("\n" * block.line + block.text, str(page), "exec"), names)
            continue
        assert block.language == "bash", f"{page}:{block.line}: a block of no language that runs"
        text = block.text.replace("\\\n", " ")
        for said, instead in names["SAID"].items():
            text = text.replace(said, instead)
        for line in text.splitlines():
            for each in line.split(" && "):
                command(shlex.split(each, comments=True), names["SMALLER"])
    if not any(block.left_out for block in blocks(page)):
        exec(after, names)


if __name__ == "__main__":
    name, folder, before, after = sys.argv[1:]
    os.chdir(folder)
    Hydra.get_mode = lambda *_, **__: None  # for which it would compose once more
    recorded.opened = looked_at if REALLY else lambda chosen: sys.exit()
    exported.export = lambda *words: {}
    # of all runs alike, and looked at in test_main_job.py
    workflow.write_first_picture = lambda *_: None
    run(ROOT / name, before, after)
