"""The examples in the docstrings of `geometry` give the values that they show."""

from __future__ import annotations

import doctest
import inspect
from importlib import import_module

import pytest

MODULES = ["interpolation", "lenses", "quaternions", "relative", "similarity", "two_view"]


def find_examples(module: str) -> list[doctest.DocTest]:
    """The docstring examples of every public function and class of a module of `geometry`."""
    found = import_module(f"lightning_pose.geometry.{module}")
    finder = doctest.DocTestFinder(recurse=False)
    public = {name: inspect.unwrap(getattr(found, name)) for name in found.__all__}
    called = {name: item for name, item in public.items() if inspect.isroutine(item) or inspect.isclass(item)}
    tests = [finder.find(item, name, found, globs=vars(found).copy()) for name, item in called.items()]
    assert all(test and test[0].examples for test in tests), f"a public name of {module} has no example"
    return [test[0] for test in tests]


@pytest.mark.parametrize(
    "example", [test for module in MODULES for test in find_examples(module)], ids=lambda t: t.name
)
def test_example(example: doctest.DocTest) -> None:
    printed: list[str] = []
    doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(example, out=printed.append)
    assert not printed, "".join(printed)
