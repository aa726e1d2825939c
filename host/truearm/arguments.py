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
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
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
    try:
        return _fit(name, value, hint)
    except _Misfit:
        allowed = " or ".join(dict.fromkeys(_words(alternative) for alternative in _alternatives(hint)))
        raise TypeError(f"{name}: must be {allowed}, is {_shown(value)}") from None


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


class _Misfit(Exception):
    """A value has another type than its annotation."""


def _fit(name: str, value: Any, hint: Any) -> Any:
    """Return a value in the form that an annotation defines. Raises _Misfit, and InputError for a broken rule."""
    origin, kinds = get_origin(hint), get_args(hint)
    if hint is Any or hint == ArrayLike:
        return value
    if origin in (Union, types.UnionType):
        for alternative in kinds:
            with suppress(_Misfit):
                return _fit(name, value, alternative)
        raise _Misfit
    if origin is Annotated:
        return _ruled(name, _fit(name, value, hint.__origin__), hint.__metadata__)
    is_names = isinstance(hint, type) and issubclass(hint, StrEnum)
    if origin is Literal or is_names:
        if not isinstance(value, str):
            raise _Misfit
        OneOf(tuple(hint) if is_names else kinds).check(name, value)
        return hint(value) if is_names else value
    if origin is tuple and isinstance(value, tuple | list | np.ndarray):
        kinds = kinds[:1] * len(value) if kinds[-1:] == (Ellipsis,) else kinds
        if len(kinds) != len(value):
            raise _Misfit
        return tuple(_fit(name, item, kind) for item, kind in zip(value, kinds, strict=True))
    kind: Any = {int: numbers.Integral, float: numbers.Real, bool: bool | np.bool_}.get(hint, origin or hint)
    # which Python counts among them
    excluded = bool if hint in (int, float) else str if origin in (Sequence, Iterable) else ()
    if not isinstance(value, kind) or isinstance(value, excluded):
        raise _Misfit
    value = tuple(value) if origin is Iterable else value
    for items in (
        ([item] for item in value) if origin in (Sequence, Iterable) else value.items() if origin is Mapping else ()
    ):
        for item, kind_of_item in zip(items, kinds, strict=True):
            _fit(name, item, kind_of_item)
    return value.item() if isinstance(value, np.generic) else value


def _ruled(name: str, value: Any, rules: Sequence[Any]) -> Any:
    """Return a value as the rules of its annotation accept it. Raises InputError."""
    for rule in () if value is None else rules:
        if isinstance(rule, Within | OneOf | FileName):
            rule.check(name, value)
        elif isinstance(rule, Value):
            try:
                value = rule.parse(value, rule.suffixes[0])
            except SchemaError as exc:
                raise InputError(Argument(name), f": {exc}") from None
    return value


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
