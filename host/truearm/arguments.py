"""Check arguments of the public interface against their annotations, and convert them.

An annotation defines the type of an argument: a class, ``str``, ``int``, ``float``, ``bool``, an enumeration, a union,
or a tuple, sequence or mapping of these. With ``Annotated`` it also has a rule (``Within``, ``OneOf``, or a value type
of a file, ``schema.Value``), or as a text the function that makes such an object. A list or an array becomes a tuple, a
NumPy number a number, and a text a member of the enumeration. ``floats`` checks what annotations cannot express, the
shape of an array.
"""

from __future__ import annotations

import functools
import inspect
import numbers
import re
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from enum import StrEnum
from typing import Annotated, Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import ArrayLike, NDArray

from truearm.bounds import SHOWN, FileName, OneOf, Within
from truearm.errors import Argument, InputError
from truearm.schema import SchemaError, Value

P = ParamSpec("P")
R = TypeVar("R")


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """Make a function raise TypeError or InputError for an argument that does not match its annotation."""
    signature = inspect.signature(function)

    @functools.wraps(function)
    def called(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            bound = signature.bind(*args, **kwargs)
        except TypeError as exc:  # in Python's words, with the function's name
            raise TypeError(f"{function.__name__}() {exc}") from None
        for name, value in bound.arguments.items():
            bound.arguments[name] = converted(name, value, _hints(function)[name])
        return function(*bound.args, **bound.kwargs)

    return called


@dataclass(frozen=True)
class Checked:
    """A record whose fields are checked and converted as it is made. Raises TypeError, InputError."""

    def __post_init__(self) -> None:
        kind: Callable[..., Any] = type(self)
        hints = _hints(kind)
        for field in fields(self):
            object.__setattr__(self, field.name, converted(field.name, getattr(self, field.name), hints[field.name]))


def converted(name: str, value: Any, hint: Any) -> Any:
    """Return a value in the form that its annotation defines: a list as a tuple, a text as a member of an enumeration.

    Raises TypeError unless the value matches the annotation, and InputError if it breaks a rule of it.
    """
    alternatives = _alternatives(hint)
    fitting = [alternative for alternative in alternatives if _is(value, alternative)]
    if not fitting:
        allowed = " or ".join(dict.fromkeys(_words(alternative) for alternative in alternatives))
        raise TypeError(f"{name}: must be {allowed}, is {_shown(value)}")
    frozen = _frozen(name, value, fitting[0])
    for rule in () if frozen is None else getattr(fitting[0], "__metadata__", ()):
        if isinstance(rule, Within | OneOf | FileName):
            rule.check(name, frozen)
        elif not isinstance(rule, str):
            frozen = _parsed(name, frozen, rule)
    return frozen


def floats(name: str, value: Any, *shape: int | None, or_one: bool = False, finite: bool = True) -> NDArray[np.float64]:
    """Return an array of finite numbers of a shape, in which None means any number but 0.

    ``or_one``: a single item without the first axis is accepted, too; ``finite`` False: so is NaN. Raises TypeError,
    InputError.
    """
    sizes = ", ".join("n" if size is None else str(size) for size in shape) + "," * (len(shape) == 1)
    if np.ma.is_masked(value):
        raise TypeError(f"{name}: has masked values; leave them out")
    try:
        array = np.asarray(value)
    except ValueError:  # rows of different lengths
        array = np.empty(0, dtype=object)
    if array.dtype.kind not in "fiu":
        raise TypeError(f"{name}: must be an array ({sizes}) of real numbers, is {_shown(value)}")
    if or_one and array.ndim == len(shape) - 1:
        array = array[None]
    if array.ndim != len(shape) or any(
        has == 0 if size is None else has != size for has, size in zip(array.shape, shape)
    ):
        raise InputError(Argument(name), f": must be an array ({sizes}), its shape is {array.shape}")
    if finite and not np.isfinite(array).all():
        raise InputError(Argument(name), ": must be finite numbers")
    return np.asarray(array, dtype=float)


@functools.cache
def _hints(annotated: Callable[..., Any]) -> dict[str, Any]:
    return get_type_hints(annotated, include_extras=True)


def _alternatives(hint: Any) -> tuple[Any, ...]:
    """Return the alternatives of a union."""
    if get_origin(hint) in (Union, types.UnionType) and hint != ArrayLike:
        return tuple(alternative for member in get_args(hint) for alternative in _alternatives(member))
    return (hint,)


def _is(value: Any, hint: Any) -> bool:
    """Return whether a value matches one alternative of an annotation."""
    origin, arguments = get_origin(hint), get_args(hint)
    if hint is Any or hint == ArrayLike:
        return True
    if origin is Annotated:
        return _any(value, arguments[0])
    if origin is Literal or (isinstance(hint, type) and issubclass(hint, StrEnum)):
        return isinstance(value, str)  # ``_frozen`` refuses other texts
    if hint in (int, float):
        kind = numbers.Integral if hint is int else numbers.Real
        return isinstance(value, kind) and not isinstance(value, bool)
    if hint is bool:
        return isinstance(value, bool | np.bool_)
    if origin is tuple and isinstance(value, tuple | list | np.ndarray):
        is_any_length = arguments[-1:] == (Ellipsis,)
        return (is_any_length or len(value) == len(arguments)) and all(
            _any(item, kind_of_item)
            for item, kind_of_item in zip(
                value, arguments[:1] * len(value) if is_any_length else arguments, strict=True
            )
        )
    if origin is Sequence:
        return (
            isinstance(value, Sequence)
            and not isinstance(value, str)
            and all(_any(item, arguments[0]) for item in value)
        )
    if origin is Mapping:
        return isinstance(value, Mapping) and all(
            _any(k, arguments[0]) and _any(v, arguments[1]) for k, v in value.items()
        )
    return callable(value) if origin is Callable else isinstance(value, origin or hint)


def _frozen(name: str, value: Any, hint: Any) -> Any:
    """Return a value that matches one alternative of an annotation in its final form, without the annotation's rules."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _frozen(name, value, next(item for item in _alternatives(arguments[0]) if _is(value, item)))
    if origin is Literal:
        OneOf(arguments).check(name, value)
    elif isinstance(hint, type) and issubclass(hint, StrEnum):
        OneOf(tuple(hint)).check(name, value)
        return hint(value)
    elif origin is tuple:
        kinds = arguments[:1] * len(value) if arguments[-1:] == (Ellipsis,) else arguments
        return tuple(converted(name, item, kind) for item, kind in zip(value, kinds, strict=True))
    return value.item() if isinstance(value, np.generic) else value


def _parsed(name: str, value: Any, rule: Value) -> Any:
    """Return a value in SI as a file's value type accepts it. Raises InputError."""
    try:
        return rule.parse(value, rule.suffixes[0])
    except SchemaError as exc:
        raise InputError(Argument(name), f": {exc}") from None


def _any(value: Any, hint: Any) -> bool:
    return any(_is(value, alternative) for alternative in _alternatives(hint))


def _words(hint: Any) -> str:
    """Return the values that an annotation allows, as Python writes types, and which functions make them."""
    if get_origin(hint) is Annotated:
        made_by = [text for text in hint.__metadata__ if isinstance(text, str)]
        return " or ".join(map(_words, _alternatives(hint.__origin__))) + f" (see {' or '.join(made_by)})" * bool(
            made_by
        )
    kind = np.ndarray if get_origin(hint) is np.ndarray else hint
    return re.sub(r"\w+\.(?=\w)", "", inspect.formatannotation(kind)).replace("NoneType", "None")


def _shown(value: Any) -> str:
    if value is None or isinstance(value, str | bytes | bool | numbers.Number | tuple | list):
        text = " ".join(repr(value).split())
        return text if len(text) <= SHOWN else text[:SHOWN] + "…"
    return f"of type {type(value).__name__}"
