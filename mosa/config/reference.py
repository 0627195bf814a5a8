"""The page of all settings, from their models:  python -m mosa.config.reference > docs/reference/configuration.md

With the name of a command, and of a key, it says what that is:  python -m mosa.config.reference train fit.joint
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from mosa.config.leaf_settings import COMMANDS
from mosa.settings import Settings, annotation_of, described, model_in

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

The other commands have `conf/eval.yaml`, `conf/capture.yaml`, `conf/splats.yaml` and `conf/environments.yaml`.

## Defaults and descriptions

The tables below list every key of every command with its default, its range and its unit. A file in `conf/` holds only the
values that differ from these defaults. `key=value` on the command line or in `mosa.compose` changes one.
`python -m mosa.config.reference train fit.joint` prints a part.

Keys under `adapter` are arguments of the named adapter. Keys under `scene` are arguments of the format's loader
([data](../data.md)).

The settings models generate this page (`python -m mosa.config.reference`), and a test compares both. The models are in
`mosa/config/command_settings.py`, `mosa/config/leaf_settings.py` and in the package of each section.
"""


def default_of(f: FieldInfo) -> str:
    found = f.get_default(call_default_factory=True)
    if found is PydanticUndefined:
        return "needed"
    return (
        "null" if found is None else str(found).lower() if isinstance(found, bool) else str(found)
    )


def rows(model: type[Settings], instance: Settings | None, where: str = "") -> Iterator[tuple[str, str, str, str]]:  # fmt: skip
    """(key, default, expected, meaning) of all keys, those of sections under them."""
    for name, f in model.model_fields.items():
        kind, key = annotation_of(f), f"{where}{name}"
        default = f.get_default(call_default_factory=True)
        if instance is not None:
            default = getattr(instance, name)
        inner = model_in(kind)
        if inner is not None and issubclass(inner, Settings):
            yield key, "", "", str(f.description)
            yield from rows(inner, default if isinstance(default, inner) else None, f"{key}.")
            continue
        shown = default_of(f) if instance is None else default_of(FieldInfo(default=default))
        yield key, shown, described(kind), str(f.description)


def arguments() -> Iterator[tuple[str, str, str, str]]:
    """Of the adapters, and of `prior.options`."""
    from mosa.modules.adapters.registry import ADAPTERS, adapter_class
    from mosa.physics.engine.law_options import LawOptions
    from mosa.settings import arguments_of

    yield from rows(LawOptions, LawOptions(), "prior.options.")
    for name in ADAPTERS:
        if (build := adapter_class({"name": name})) is not None:
            model = arguments_of(build, "adapter")  # type: ignore[arg-type]
            for key, default, kind, about in rows(model, None, "adapter."):
                note = "" if about == "None" else f": {about}"
                yield key, default, kind, f"name={name}{note}"


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
    return "\n\n".join(parts) + "\n"


def main(words: list[str]) -> None:
    if not words:
        print(page(), end="")
        return
    if words[0] not in COMMANDS:
        print(f"expected one of {', '.join(COMMANDS)}, found {words[0]}", file=sys.stderr)
        sys.exit(2)
    found = [*rows(COMMANDS[words[0]], None), *(arguments() if words[0] == "train" else ())]
    for key, default, kind, about in found:
        if len(words) == 1 or f"{key}.".startswith(f"{words[1]}."):
            print(
                f"{key}{f' = {default}' if default else ''}\n    {about}{f' ({kind})' if kind else ''}"
            )


if __name__ == "__main__":
    main(sys.argv[1:])
