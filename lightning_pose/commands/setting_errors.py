"""Rewrites jsonargparse's message about a wrong setting as one line: the setting, what it takes, what was given."""

from __future__ import annotations

import re

__all__ = ["REMEDY", "explain_setting_error"]

REMEDY = "`python -m lightning_pose fit --help` explains every setting"
NOISE = re.compile(
    r"Does not validate against any of the Union subtypes|Subtypes: .*|Errors:|Given value type: .*"
    r"|Given value: (NestedArg|Namespace|\{).*|Expected a path but .* either not accessible or invalid"
)
EXPECTED = re.compile(
    r"Expected an? (<class '[^']+'>|typing\.Literal\[[^]]*\]|dot import path string(?=:)|[A-Za-z_][\w.]*)(: \S+)?\.?"
)
GIVEN = re.compile(r"\b(?:Given|Got) value: (.*)")
REQUIRED = re.compile(r"the following arguments are required: (.*)")
MOVED = {"model: Option 'camera' is not accepted": "model.camera is data.camera now; give it there"}
"""What to say of settings that have another place now."""

KINDS = {
    "bool": "true or false",
    "int": "a whole number (int)",
    "float": "a number (float)",
    "str": "a text",
    "list": "a list",
    "tuple": "a list",
    "set": "a list",
    "collections.abc.Iterable": "a list",
    "collections.abc.Sequence": "a list",
    "dict": "settings by name",
    "collections.abc.Mapping": "settings by name",
    "NoneType": "",
    "dot import path string": "the class path of a class",
}
"""What users write for the types of Python; nothing for a setting that may be left out."""


def explain_setting_error(message: str) -> str:
    """Put a message of jsonargparse, with a line for each type that a setting may have, into one line.

    A nested setting's message comes through here once for each of its parsers, and stays as it is then.
    """
    found = list(dict.fromkeys(_clean_line(line) for line in message.replace(f"; {REMEDY}", "").splitlines()))
    text = re.sub(r'Parser key "([^"]+)":', r"\1:", " ".join(line for line in found if line))
    kinds = [kind for kind in dict.fromkeys(_name_kind(match[1]) for match in EXPECTED.finditer(text)) if kind]
    given = GIVEN.search(text)
    text = " ".join(GIVEN.sub("", EXPECTED.sub("", text)).split()).rstrip(" .;")
    if kinds and re.fullmatch(r"([\w.]+: ?)*", text):  # else a constructor says what is wrong
        text = f"{text} give {' or '.join(kinds)}{f', not {given[1].strip()}' if given else ''}"
    elif given and given[1].strip() not in text:
        text = re.sub(r"^((?:[\w.]+: )*)", lambda keys: f"{keys[1]}{given[1].strip()}: ", text)
    required = REQUIRED.fullmatch(text)
    if required:
        names = " and no ".join(name.rpartition(".")[2] for name in required[1].split(", "))
        text = f"there is no {names}; give a complete config, such as --config configs/surf_lstm.yaml"
    return f"{MOVED.get(text, text)}; {REMEDY}"


def _clean_line(line: str) -> str:
    """A line without what only a programmer understands."""
    return NOISE.sub("", line).strip(" -")


def _name_kind(kind: str) -> str:
    """What users write for a type that jsonargparse names."""
    name = re.sub(r"<class '([^']+)'>", r"\1", kind)
    if name.startswith("typing.Literal["):
        return "one of " + name.removeprefix("typing.Literal[").removesuffix("]")
    return KINDS.get(name, f"a {name.rpartition('.')[2]}")
