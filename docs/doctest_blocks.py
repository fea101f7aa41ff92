"""An extension of griffe, which reads docstrings for the API reference: examples in them become blocks of code."""

from __future__ import annotations

import re

import griffe

EXAMPLE = re.compile(r"(?m)^>>> .*(?:\n.+)*")


class DoctestBlocks(griffe.Extension):
    """Fences each `>>>` example up to the next empty line, which Markdown would take for quotations."""

    def on_instance(self, *, obj: griffe.Object, **kwargs: object) -> None:
        if obj.docstring is not None:
            obj.docstring.value = EXAMPLE.sub(r"```pycon\n\g<0>\n```", obj.docstring.value)
