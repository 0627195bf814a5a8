"""The page of all settings, from their models:  python -m mosa.config.reference > docs/reference/configuration.md

With the name of a command, and of a key, it says what that is:  python -m mosa.config.reference train fit.joint
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path

from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from mosa.config.composition import configuration
from mosa.config.leaf_settings import COMMANDS
from mosa.settings import (
    Settings,
    annotation_of,
    arguments_of,
    described,
    model_in,
    nearest,
    untold,
)

HEAD = """# Configuration

`conf/train.yaml` is the configuration of `train.py`. It takes one option of each group, and every key can be set on the
command line.

| group | options | sets |
|---|---|---|
| `scene` | `rabbit`, `transforms`, `pacnerf`, ... | data ([Read your data](../data.md)) |
| `prior` | `neo_hookean`, `auto`, `von_mises`, ... | the isotropic law ([Choose](../choosing.md)) |
| `adapter` | `operator`, `mosa`, `none`, ... | the learned correction |
| `criterion` | `corrected`, `free`, `both` | what a fit compares |
| `fit` | `fast`, `adam`, `paper`, `tiny` | optimisers, iterations, rates |
| `simulation` | `fast`, `paper` | particles, grid, time step |
| `reconstruction` | `fast`, `paper` | hull, Gaussians, motion |
| `trainer` | `cpu`, `gpu` | Lightning's Trainer |
| `callbacks`, `logger` | `default`, ...; `tensorboard`, `csv`, `wandb`, `none` | Lightning's callbacks and loggers |
| `ablation`, `debug`, `experiment` | `full`, ...; `default`; `bird`, ... | sets of keys that belong together |

The other commands have `conf/eval.yaml`, `conf/capture.yaml`, `conf/splats.yaml`, `conf/environments.yaml` and
`conf/material.yaml`.

## Defaults and descriptions

The tables below list every key of every command with its default, its range and its unit. A file in `conf/` holds only the
values that differ from these defaults. `key=value` on the command line or in `mosa.compose` changes one.
`python -m mosa.config.reference train fit.joint` prints a part.

Keys under `adapter` and `scene` depend on the option that you choose: [Adapters](#options-of-a-law-and-arguments-of-the-adapters),
[Scenes](#keys-of-a-scene).

The settings models generate this page (`python -m mosa.config.reference`), and a test compares both. The models are in
`mosa/config/command_settings.py`, `mosa/config/leaf_settings.py` and in the package of each section.
"""
SCENES = {"transforms": "films in files", "markers": "`scene=markers`", "rabbit": "built-in bodies"}
"""File in conf/scene -> the options whose keys it shows."""
IN_SCENES = """The column *Expected* names the options that take a key. Defaults are those of `conf/scene/transforms.yaml`,
`markers.yaml` and `rabbit.yaml`; the file of your option may have others."""


def default_of(f: FieldInfo) -> str:
    found = f.get_default(call_default_factory=True)
    if found is PydanticUndefined:
        return "needed"
    return (
        "null" if found is None else str(found).lower() if isinstance(found, bool) else str(found)
    )


def about(f: FieldInfo) -> str:
    """The docstring below a field, in one line."""
    return " ".join(str(f.description).split())


def rows(model: type[Settings], instance: Settings | None, where: str = "") -> Iterator[tuple[str, str, str, str]]:  # fmt: skip
    """(key, default, expected, meaning) of all keys, those of sections under them."""
    for name, f in model.model_fields.items():
        kind, key = annotation_of(f), f"{where}{name}"
        default = f.get_default(call_default_factory=True)
        if instance is not None:
            default = getattr(instance, name)
        inner = model_in(kind)
        if inner is not None and issubclass(inner, Settings):
            yield key, "", "", about(f)
            yield from rows(inner, default if isinstance(default, inner) else None, f"{key}.")
            continue
        shown = default_of(f) if instance is None else default_of(FieldInfo(default=default))
        yield key, shown, described(kind), about(f)


def in_file(group: str, option: str) -> dict[str, tuple[str, str]]:
    """key -> (value, comment) of the lines of conf/<group>/<option>.yaml."""
    text = (Path(configuration()) / group / f"{option}.yaml").read_text()
    lines = re.findall(r"^(?:  )?(\w+): +([^#\n]*?)(?: +# *(.*))?$", text, re.M)
    return {key: (value, comment) for key, value, comment in lines}


def arguments() -> Iterator[tuple[str, str, str, str]]:
    """Of `prior.options`, and of the adapters, whose files say what their keys mean."""
    from mosa.modules.adapters.registry import adapter_class
    from mosa.physics.engine.law_options import LawOptions

    yield from rows(LawOptions, LawOptions(), "prior.options.")
    for option in ("operator", "mosa", "direct", "nclaw", "neuma", "interaction"):
        written = in_file("adapter", option)
        build = adapter_class({"name": written["name"][0]})
        model = arguments_of(build, "adapter")  # type: ignore[arg-type]
        for key, default, kind, _ in rows(model, None, "adapter."):
            about = written[key.removeprefix("adapter.")][1]
            yield key, default, kind, f"`adapter={option}`: {about}"


def of_scenes() -> Iterator[tuple[str, str, str, str]]:
    """Keys of the formats' loaders, as their files say them; of a later format those that differ."""
    said: set[tuple[str, str]] = set()
    for option, where in SCENES.items():
        for key, (value, about) in in_file("scene", option).items():
            if key != "format" and (key, about) not in said:
                said.add((key, about))
                yield f"scene.{key}", value, where, about


def of_trainer() -> Iterator[tuple[str, str, str, str]]:
    """Keys of conf/trainer/cpu.yaml, and the other arguments of Lightning's Trainer that are numbers, texts or flags."""
    import lightning as L

    begin, written = L.Trainer.__init__, in_file("trainer", "cpu")
    kinds = arguments_of(begin, "trainer", *untold(begin))
    others = {key: row for key, *row in rows(kinds, None)}
    for key in written | others:
        default, kind, _ = others.get(key, ("", "", ""))
        value, about = written.get(key, (default, ""))
        yield f"trainer.{key}", value, kind, about or "an argument of Lightning's Trainer"


def table(found: Iterator[tuple[str, str, str, str]]) -> str:
    lines = ["| Key | Default | Expected | Meaning |", "|---|---|---|---|"]
    for key, default, kind, about in found:
        kind = kind.replace(" and at most 1000000000", "").replace(" and at most 1e+20", "")
        cells = (f"`{key}`", f"`{default}`" if default else "", kind, about)
        lines.append(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |")
    return "\n".join(lines)


def page() -> str:
    parts = [HEAD.strip()]
    for name, model in COMMANDS.items():
        parts += [f"## {model.__doc__}", f"`conf/{name}.yaml`", table(rows(model, None))]
    parts += ["## Options of a law and arguments of the adapters", table(arguments())]
    parts += ["## Keys of a scene", IN_SCENES, table(of_scenes())]
    return "\n\n".join(parts) + "\n"


def main(words: list[str]) -> None:
    if not words:
        print(page(), end="")
        return
    if words[0] not in COMMANDS:
        print(f"expected one of {', '.join(COMMANDS)}, found {words[0]}", file=sys.stderr)
        sys.exit(2)
    key = f"{words[1]}." if words[1:] else ""
    found = list(rows(COMMANDS[words[0]], None))
    if words[0] == "train":
        found += [*arguments(), *of_scenes(), *(of_trainer() if key.startswith("trainer.") else ())]
    asked = [row for row in found if f"{row[0]}.".startswith(key)]
    # an entry of a mapping has no row of its own
    asked = asked or [row for row in found if row[1] and key.startswith(f"{row[0]}.")]
    for key, default, kind, about in asked:
        print(
            f"{key}{f' = {default}' if default else ''}\n    {about}{f' ({kind})' if kind else ''}"
        )
    if not asked:
        known = [row[0] for row in found]
        print(
            f"{words[1]}: unknown key of {words[0]}{nearest(words[1], known, '')}; "
            f"python -m mosa.config.reference {words[0]} lists all",
            file=sys.stderr,
        )
        sys.exit(2)


if __name__ == "__main__":
    main(sys.argv[1:])
