"""What a user may set: pydantic models, whose mistakes are messages of this program.

A field is written once, with its default, its range and a line of description:

    class Search(Settings):
        where = "search"
        rate: Positive = 0.02
        "learning rate of Adam"

The checks of a configuration, Hydra's keys (`mosa.config.composition`), the reference (docs/reference/configuration.md) and the
record of a run follow from the models. Nothing is converted: a flag is no number, a text is no number, a number is finite.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import sys
import types
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import is_dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    ClassVar,
    Literal,
    NamedTuple,
    Self,
    TypeVar,
    Union,
    get_args,
    get_origin,
)

from annotated_types import Ge, Gt, Interval, Le, Len, Lt
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    TypeAdapter,
    ValidationError,
    create_model,
    model_validator,
)
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from mosa.errors import ConfigError

if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass
else:
    ModelMetaclass = type(BaseModel)

LARGEST, MOST = 1e20, 10**9  # of numbers and whole numbers without limits of their own
WIDEST = 4096  # of a network's layer: many times what any run has used

Public = TypeVar("Public", bound=Callable[..., Any])


class Expected(NamedTuple):
    """In the metadata of a type: what a message says after 'expected'."""

    text: str


Positive = Annotated[float, Gt(0), Le(LARGEST)]
Weight = Annotated[float, Ge(0), Le(LARGEST)]
Share = Annotated[float, Ge(0), Le(1)]
Number = Annotated[float, Expected("a number")]
Count = Annotated[int, Ge(1), Le(MOST)]
Whole = Annotated[int, Ge(0), Le(MOST)]
Width = Annotated[int, Ge(1), Le(WIDEST)]
Seed = Annotated[int, Ge(0), Le(2**32 - 1)]
Text = Annotated[str, Expected("a text")]
Section = Annotated[dict[str, Any], Expected("a section of keys")]
Entries = Annotated[list[dict[str, Any]], Expected("a list of sections")]
Three = Annotated[list[float], Expected("three numbers"), Len(3, 3)]
Four = Annotated[list[float], Expected("four numbers, an axis and degrees"), Len(4, 4)]


def such(valid: Callable[[Any], bool]) -> AfterValidator:
    """In the metadata of a type: what else holds for its values."""

    def checked(value: Any) -> Any:
        if not valid(value):
            raise ValueError("another")
        return value

    return AfterValidator(checked)


def folder(value: str) -> str:
    """Errors: ValueError for an empty one, which would be the folder that the program was started in."""
    if not value.strip() or "\0" in value:
        raise ValueError("no folder")
    return value


Side = Annotated[int, Ge(8), Le(8192)]
Pixels = Annotated[
    Side | Sequence[Side],
    Expected("a whole number of at least 8 and at most 8192, or two such, [width, height]"),
    such(lambda v: isinstance(v, int) or len(v) == 2),
]
Nearer = Annotated[float, Gt(0), Le(20)]
Zoom = Nearer | Annotated[Sequence[Nearer], Expected("a list of such"), Len(1)]
Names = Annotated[
    list[str], Expected("a list of names like [a, b], each once"),
    such(lambda v: len(set(v)) == len(v)),
]  # fmt: skip
Folder = Annotated[str, Expected("the path of a folder"), AfterValidator(folder)]


class _Checked(ModelMetaclass):
    """Makes a settings object of keyword arguments with the messages of this program."""

    def __call__(cls, **values: Any) -> Any:
        return cls.read(values)  # type: ignore[attr-defined]


class Settings(BaseModel, metaclass=_Checked):
    """Settings of one part, checked when they are made, constant afterwards. `where`: its key in a configuration.

    A section that is given in part keeps the defaults of the field that it is for. Errors: ConfigError naming the key, what was
    expected and what was found."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, arbitrary_types_allowed=True, protected_namespaces=(),
        use_attribute_docstrings=True,
    )  # fmt: skip
    where: ClassVar[str] = ""
    needs: ClassVar[dict[str, str]] = {}
    """What fields need to have an effect, by their names: `kind=modes`, the value of a field beside them, with `!=` another one;
    `newton` or `adam`, what a stage has to run (`mosa.config.effects`)."""

    @model_validator(mode="before")
    @classmethod
    def _completed(cls, values: Any) -> Any:
        if not isinstance(values, Mapping):
            return values
        found = dict(values)
        for key in (
            k for k, v in values.items() if isinstance(v, Mapping) and k in cls.model_fields
        ):
            default = cls.model_fields[key].get_default(call_default_factory=True)
            if isinstance(default, Settings):
                found[key] = {**dict(default), **found[key]}
        return found

    @classmethod
    def read(cls, values: Any, where: str | None = None) -> Self:
        """Of plain values by key, or of what was checked before. where: the section's key, for messages. Errors: ConfigError."""
        where = cls.where if where is None else where
        if isinstance(values, cls):
            return values
        if not isinstance(values, Mapping):
            raise ConfigError(f"{where}: expected a section of keys, found {values!r}")
        try:
            return cls.model_validate(dict(values))
        except ValidationError as error:
            raise mistake(error, cls, values, where) from None

    @classmethod
    def part(cls, values: Mapping[str, Any]) -> Self:
        """Of a configuration that may have further keys. Errors: ConfigError."""
        fields = cls.model_fields
        return cls.read({key: value for key, value in values.items() if key in fields})

    def but(self, **changes: Any) -> Self:
        """A copy with other values of these fields. Errors: ConfigError."""
        return type(self).read(dict(self) | changes)

    def plain(self) -> dict[str, Any]:
        """Nested plain containers, for a YAML file, a checkpoint or the key of a cache."""
        return self.model_dump()


def mistake(
    error: ValidationError, model: type[BaseModel], values: Any, where: str = ""
) -> ConfigError:
    """The first mistake that pydantic found, as a message with the key, what was expected, what was found and the way out."""
    found = error.errors(include_url=False, include_context=False)
    first = next((each for each in found if each["type"] == "extra_forbidden"), found[0])
    path, wanted, owner = ([where] if where else []), None, model
    for key in first["loc"]:
        step = next_in(owner if wanted is None else wanted, key)
        if step is None:
            break
        path, wanted = [*path, str(key)], step
        values = values[key] if isinstance(values, Mapping) and key in values else None
        inside = model_in(wanted)
        owner = inside or owner
    name = ".".join(path)
    if first["type"] in ("extra_forbidden", "invalid_key"):
        section, key = model_in(wanted) if wanted is not None else owner, str(first["loc"][-1])
        known = list((section or owner).model_fields)
        expected = f"one of {', '.join(known)}" if known else "none"
        expected += nearest(key, known, name)
        return ConfigError(f"{'.'.join([*path, key])}: unknown key; expected {expected}")
    if first["type"] == "missing":
        return ConfigError(f"{name}: expected this key, found none")
    return ConfigError(f"{name}: expected {described(wanted)}, found {shown(values)}")


def nearest(key: str, known: list[str], where: str) -> str:
    """The end of a message on an unknown key: which known one is like it, first one that
    begins it (no_rot of no_rotation), nothing where none is."""
    near = get_close_matches(key, known, 3)
    near.sort(key=lambda name: not key.startswith(name) or key[len(name) :][:1] == ".")
    return f"; the nearest is {f'{where}.{near[0]}'.strip('.')}" if near else ""


def shown(value: Any) -> str:
    text = repr(value)
    if shape := getattr(value, "shape", ()):  # of an array the kind is what matters
        kind = (str(getattr(value, part, "")) for part in ("dtype", "layout", "device"))
        text = f"{type(value).__name__} ({' '.join(kind)}) of shape {tuple(shape)}"
    return text if len(text) <= 200 else f"{text[:200]}..."


def next_in(kind: Any, key: Any) -> Any:
    """The type of what lies at `key` of a model or of a mapping of models; None where that is no key of a user's."""
    if (inside := model_in(kind)) is not None:
        f = inside.model_fields.get(key)
        return None if f is None else annotation_of(f)
    of = get_args(bare(kind))[1] if get_origin(bare(kind)) is dict else None
    return of if of is not None and model_in(of) is not None else None


def annotation_of(f: FieldInfo) -> Any:
    """A field's type with all that it says about it."""
    return Annotated[(f.annotation, *f.metadata)] if f.metadata else f.annotation


def bare(kind: Any) -> Any:
    """A type without metadata and without null."""
    if get_origin(kind) is Annotated:
        return bare(get_args(kind)[0])
    if get_origin(kind) in (Union, types.UnionType):
        some = [each for each in get_args(kind) if each is not type(None)]
        return bare(some[0]) if len(some) == 1 else kind
    return kind


def model_in(kind: Any) -> type[BaseModel] | None:
    """The model that a type is; None for another type."""
    found = bare(kind)
    if get_origin(found) is dict:
        return None
    return found if inspect.isclass(found) and issubclass(found, BaseModel) else None


def described(kind: Any) -> str:
    """What a type expects, in words."""
    if kind is Any or kind is None:
        return "a value" if kind is Any else "null"
    origin, inside = get_origin(kind), get_args(kind)
    if origin is Annotated:
        inner, told = inside[0], inside[1:]
        for each in told:
            if isinstance(each, Expected):
                return each.text
        return numbers_described(inner, list(flattened(told))) or described(inner)
    if Callable in (origin, kind):
        return "a function"
    if origin is Literal:
        return " or ".join(word(each) for each in inside)
    if origin in (Union, types.UnionType):
        some = [described(each) for each in inside if each is not type(None)]
        return ", or ".join(some + ["null"] * (type(None) in inside))
    if kind in (int, float):
        return numbers_described(kind, []) or ""
    other = "a list" if list in (origin, kind) or origin is Sequence else "a section of keys"
    words = {bool: "true or false", str: "a text", Path: "a path", type(None): "null"}
    return words.get(kind, other)


def word(value: Any) -> str:
    plain = str(value).lower() if isinstance(value, bool) else str(value)
    return "null" if value is None else plain


def flattened(told: Iterable[Any]) -> Iterable[Any]:
    """Metadata, of groups and of fields their parts."""
    for each in told:
        if isinstance(each, FieldInfo):
            yield from flattened(each.metadata)
        elif isinstance(each, Interval):
            yield from each
        else:
            yield each


def numbers_described(kind: Any, told: list[Any]) -> str | None:
    """Of a whole number or a number with bounds; None for another type."""
    if kind not in (int, float):
        return None
    lows = [(b.ge if isinstance(b, Ge) else b.gt, isinstance(b, Gt)) for b in told if isinstance(b, (Ge, Gt))]  # fmt: skip
    highs = [(b.le if isinstance(b, Le) else b.lt, isinstance(b, Le)) for b in told if isinstance(b, (Le, Lt))]  # fmt: skip
    low, high = max(lows, default=None), min(highs, default=None)
    number = (lambda v: f"{v:g}") if kind is float else str
    parts = ["a number" if kind is float else "a whole number"]
    if low is not None:
        parts.append(f"{'above' if low[1] else 'of at least'} {number(low[0])}")
    if high is not None:
        more = "and " if low is not None else ""
        parts.append(f"{more}{'at most' if high[1] else 'below'} {number(high[0])}")
    return " ".join(parts)


# -------------------------------------------------------------------------------- single values
def is_number(value: Any) -> bool:
    """A finite number that is no flag."""
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return number and abs(value) <= sys.float_info.max  # a whole number may be beyond


@functools.cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    own = model_in(kind) is not None  # a model has its own
    return TypeAdapter(kind, config=None if own else ConfigDict(strict=True, allow_inf_nan=False))


def fits(kind: Any, value: Any) -> bool:
    """Whether a value is of a type, with nothing converted."""
    try:
        _adapter(kind).validate_python(value)
    except ValidationError:
        return False
    return True


def check(where: str, value: Any, kind: Any) -> None:
    """Errors: ConfigError where a value is not of a type."""
    if not fits(kind, value):
        raise ConfigError(f"{where}: expected {described(kind)}, found {shown(value)}")


def check_values(values: Mapping[str, Any], kinds: Mapping[str, Any], where: str) -> None:
    """Every value that has a type is of it. Errors: ConfigError naming the first that is not, as a key below `where`."""
    for name, kind in kinds.items():
        if name in values:
            check(f"{where}.{name}", values[name], kind)


def imported(where: str, place: str) -> Any:
    """What another package registered as module:name. Errors: ConfigError beginning with `where`."""
    module, _, name = place.partition(":")
    try:
        return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        found = f"registered as {place}, which cannot be imported ({error})"
        raise ConfigError(f"{where} is {found}") from error


# -------------------------------------------------------------------------------- arguments
@functools.cache
def arguments_of(build: Callable[..., Any], where: str, *given: str) -> type[Settings]:
    """The keyword arguments of a class or function as settings, from their annotations. given: those that no key says.

    An argument without an annotation may be anything."""
    call = build.__init__ if inspect.isclass(build) and not is_dataclass(build) else build
    hints = typing.get_type_hints(call, include_extras=True)
    wanted = {}
    for name, p in inspect.signature(build).parameters.items():
        if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD) and name not in given:
            wanted[name] = hints.get(name, Any), ... if p.default is p.empty else p.default
    # docstrings of fields, of which there are none, would be sought in this file: half a second of a run
    silent = {"use_attribute_docstrings": False}
    made: type[Settings] = create_model(  # type: ignore[call-overload]
        build.__name__, __base__=Settings, __cls_kwargs__=silent, **wanted
    )
    made.where = where
    return made


def call(where: str, build: Callable[..., Any], keys: Mapping[str, Any], **given: Any) -> Any:
    """build(**given, **keys), the keys checked by its annotations. Errors: ConfigError for a key that it does not take, that is
    missing, or whose value is of another type."""
    checked = arguments_of(build, "", *given).read(keys, where)  # once for all places
    return build(**given, **{key: getattr(checked, key) for key in keys})


def typed(function: Public) -> Public:
    """A public function whose arguments are of the types that it says, as keys of a configuration are: numbers, texts, flags, and
    functions, types with metadata. Tensors and solids it reads by itself. Errors: ConfigError naming the argument."""
    names = tuple(inspect.signature(function).parameters)

    @functools.wraps(function)
    def called(*args: Any, **keys: Any) -> Any:
        # not by Signature.bind, which takes longer than the checks; the call itself refuses names that it has not
        arguments_of(function, "", *untold(function)).part(dict(zip(names, args)) | keys)
        return function(*args, **keys)

    return called  # type: ignore[return-value]


@functools.cache
def untold(function: Callable[..., Any]) -> tuple[str, ...]:
    """Names of the arguments whose types are none of settings."""

    def told(kind: Any) -> bool:
        if get_origin(kind) in (Union, types.UnionType):
            return all(map(told, get_args(kind)))
        plain = (int, float, str, bool, Path, type(None))
        return get_origin(kind) in (Annotated, Literal, Callable) or kind in (*plain, Callable)

    hints = typing.get_type_hints(function, include_extras=True)
    return tuple(n for n in inspect.signature(function).parameters if not told(hints.get(n, Any)))


def node_of(model: type[Settings], without: Iterable[str] = ()) -> dict[str, Any]:
    """The defaults of a model as plain data, for Hydra, with '???' for a text or a choice that has none. without: keys that groups
    choose whole."""
    found: dict[str, Any] = {}
    for name, f in model.model_fields.items():
        default = f.get_default(call_default_factory=True)
        if default is not PydanticUndefined and name not in without:
            found[name] = default.plain() if isinstance(default, Settings) else default
        elif bare(annotation_of(f)) is str or get_origin(bare(annotation_of(f))) is Literal:
            found[name] = "???"
    return found
