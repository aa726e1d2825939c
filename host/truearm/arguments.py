"""Check arguments of the public interface against their annotations.

An annotation defines the type of an argument: a class, ``str``, ``int``, ``float``, ``bool``, a union, or a tuple,
sequence or mapping of these. With ``Annotated`` it also has a rule (``Within``, ``OneOf``), or as a text the function
that makes such an object. A list is accepted as a tuple, and a NumPy number as a number. ``floats`` checks what
annotations cannot express, the shape of an array.
"""

from __future__ import annotations

import functools
import inspect
import numbers
import os
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from enum import StrEnum
from typing import Annotated, Any, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import ArrayLike, NDArray

from truearm.bounds import SHOWN, OneOf, Within
from truearm.errors import Argument, InputError
from truearm.text import with_article

P = ParamSpec("P")
R = TypeVar("R")

WORDS: Mapping[Any, str] = {
    bool: "True or False",
    int: "a whole number",
    float: "a number",
    str: "a text",
    type(None): "None",
    os.PathLike: "a path",
    np.ndarray: "an array",
    Callable: "a function",
}
MANY: Mapping[Any, str] = {str: "texts", float: "numbers", int: "whole numbers"}


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """Make a function raise TypeError or InputError for an argument that does not match its annotation."""
    signature = inspect.signature(function)

    @functools.wraps(function)
    def called(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            given = signature.bind(*args, **kwargs).arguments
        except TypeError as exc:  # in Python's words, with the function's name
            raise TypeError(f"{function.__name__}() {exc}") from None
        for name, value in given.items():
            check(name, value, _hints(function)[name])
        return function(*args, **kwargs)

    return called


def check_fields(record: Any) -> None:
    """Check the fields of a dataclass. Raises TypeError, InputError."""
    kind: Callable[..., Any] = type(record)
    hints = _hints(kind)
    for field in fields(record):
        check(field.name, getattr(record, field.name), hints[field.name])


def check(name: str, value: Any, hint: Any) -> None:
    """Raise TypeError unless a value matches an annotation, and InputError if it breaks a rule of it."""
    fitting = [one for one in _alternatives(hint) if _is(value, one)]
    if not fitting:
        wanted = " or ".join(dict.fromkeys(_words(one) for one in _alternatives(hint)))
        raise TypeError(f"{name}: must be {wanted}, is {_shown(value)}")
    for rule in getattr(fitting[0], "__metadata__", ()):
        if isinstance(rule, Within | OneOf):
            rule.check(name, value)


def floats(name: str, value: Any, *shape: int | None, or_one: bool = False) -> NDArray[np.float64]:
    """Return an array of finite numbers of a shape, in which None means any number but 0.

    ``or_one``: a single item without the first axis is accepted, too. Raises TypeError, InputError.
    """
    sizes = ", ".join("n" if size is None else str(size) for size in shape) + "," * (len(shape) == 1)
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
    if not np.isfinite(array).all():
        raise InputError(Argument(name), ": must be finite numbers")
    return np.asarray(array, dtype=float)


@functools.cache
def _hints(of: Callable[..., Any]) -> dict[str, Any]:
    return get_type_hints(of, include_extras=True)


def _alternatives(hint: Any) -> tuple[Any, ...]:
    """Return the alternatives of a union."""
    if get_origin(hint) in (Union, types.UnionType) and hint != ArrayLike:
        return tuple(one for part in get_args(hint) for one in _alternatives(part))
    return (hint,)


def _is(value: Any, hint: Any) -> bool:
    """Return whether a value matches one alternative of an annotation."""
    origin, parts = get_origin(hint), get_args(hint)
    if hint is Any or hint == ArrayLike:
        return True
    if origin is Annotated:
        return _any(value, parts[0])
    if isinstance(hint, type) and issubclass(hint, StrEnum):
        return isinstance(value, str)  # its names are checked where they are used
    if hint in (int, float):
        kind = numbers.Integral if hint is int else numbers.Real
        return isinstance(value, kind) and not isinstance(value, bool)
    if hint is bool:
        return isinstance(value, bool | np.bool_)
    if origin is tuple and isinstance(value, tuple | list | np.ndarray):
        some = parts[-1] is Ellipsis
        return (some or len(value) == len(parts)) and all(
            _any(one, part) for one, part in zip(value, parts[:1] * len(value) if some else parts, strict=True)
        )
    if origin is Sequence:
        return isinstance(value, Sequence) and not isinstance(value, str) and all(_any(one, parts[0]) for one in value)
    if origin is Mapping:
        return isinstance(value, Mapping) and all(_any(k, parts[0]) and _any(v, parts[1]) for k, v in value.items())
    return callable(value) if origin is Callable else isinstance(value, origin or hint)


def _any(value: Any, hint: Any) -> bool:
    return any(_is(value, one) for one in _alternatives(hint))


def _words(hint: Any) -> str:
    """Return a readable description of the values that an annotation allows."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Annotated:
        made_by = [text for text in hint.__metadata__ if isinstance(text, str)]
        return " or ".join(map(_words, _alternatives(parts[0]))) + (f" (see {' or '.join(made_by)})" if made_by else "")
    if origin is tuple and parts[-1] is not Ellipsis:
        return f"a tuple of {len(parts)} {MANY.get(parts[0], 'items')}"
    if origin in (tuple, Sequence):
        return f"a {origin.__name__.lower()} of {MANY.get(parts[0], 'items')}"
    if origin is Mapping:
        return f"a mapping of names to {getattr(parts[1], '__name__', 'mappings')}s"
    kind = str if isinstance(hint, type) and issubclass(hint, StrEnum) else origin or hint
    return WORDS.get(kind) or with_article(kind.__name__)


def _shown(value: Any) -> str:
    if value is None or isinstance(value, str | bytes | bool | numbers.Number | tuple | list):
        text = " ".join(repr(value).split())
        return text if len(text) <= SHOWN else text[:SHOWN] + "…"
    return f"of type {type(value).__name__}"
