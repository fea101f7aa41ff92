"""Whether settings in a checkpoint have the types that a class declares, before they fail somewhere in the middle."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

__all__ = ["find_mistyped"]

PLAIN: dict[object, tuple[type, ...]] = {
    NoneType: (NoneType,),
    bool: (bool,),
    int: (int,),
    float: (int, float),
    str: (str,),
}
"""Declared types, and the types of values that fit."""


def find_mistyped(cls: type, arguments: Mapping[str, Any]) -> str | None:
    """The first of some constructor arguments whose value does not have its declared type; None if all have.

    Types that are not plain, and arguments that no constructor of the class or its bases names, are not looked at.
    """
    for base in cls.__mro__:
        if "__init__" not in vars(base):
            continue
        try:
            hints = get_type_hints(base.__init__)
        except (NameError, TypeError, AttributeError):  # of modules that only type checkers import
            continue
        for name, hint in hints.items():
            if name in arguments and not _fits(arguments[name], hint):
                return name
    return None


def _fits(value: object, hint: Any) -> bool:
    """Whether a plain value has a type."""
    origin = get_origin(hint)
    if origin in (Union, UnionType):
        return any(_fits(value, each) for each in get_args(hint))
    if origin is Literal:
        return value in get_args(hint)
    if origin in (list, tuple, Sequence, Iterable):
        return isinstance(value, list | tuple)
    if origin in (dict, Mapping):
        return isinstance(value, Mapping)
    if hint not in PLAIN:
        return True
    return isinstance(value, PLAIN[hint]) and (hint is bool or not isinstance(value, bool))
