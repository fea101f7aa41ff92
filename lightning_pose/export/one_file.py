"""Joins the definitions that some names need, from all over the package, into one file that runs without the package.

An exported folder asks its map with the code of `mapping/` and `localization/`, word for word, so that there is one
implementation. A definition is taken along with whatever it uses; what only annotations name is left out if it is of a
package that the file may not import. A module of the package may be replaced by another with the same names.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

__all__ = ["join_modules"]

PACKAGE = "lightning_pose"
WIDTH = 120

ALLOWED = {"numpy", "cv2", "onnxruntime"}
"""Packages that the file may import, beside Python's own."""

CONTENTS = "CONTENTS"
"""In the head, this is replaced by a list of the file's parts."""

SHAPED = re.compile(r'Float\[np\.ndarray, "[^"]*"\]')


@dataclass
class Statement:
    """One statement at the top of a module, with the comments above it and the text below that documents it.

    `used` are names that it uses when it runs, and `at_once` those of them that must be defined above it.
    """

    text: str
    defined: list[str]
    used: set[str]
    annotated: set[str]
    at_once: set[str]


@dataclass
class Module:
    """A module's statements, and where the names come from that it imports: module and name, or the module alone."""

    name: str
    headline: str
    statements: list[Statement]
    imported: dict[str, tuple[str, str | None]]
    needed: set[int] = field(default_factory=set)

    def find(self, name: str) -> int | None:
        """Number of the statement that defines a name."""
        return next((i for i, statement in enumerate(self.statements) if name in statement.defined), None)


def join_modules(roots: Iterable[str], replaced: Mapping[str, str], head: str, tail: str) -> str:
    """The text of one file.

    Args:
        roots: dotted names of what the file must define.
        replaced: dotted names of the package, or of scipy, to those that stand in for them, of the same last name.
        head: the file's docstring.
        tail: its last lines.

    Raises:
        ValueError: a definition needs a package that is not allowed, or two modules define one name.
    """
    collected = _Collector(replaced)
    for root in roots:
        collected.need(*root.rsplit(".", 1))
    return collected.write(head, tail)


class _Collector:
    """The modules that are needed, and what is needed of them."""

    def __init__(self, replaced: Mapping[str, str]) -> None:
        self.replaced = replaced
        self.modules: dict[str, Module] = {}
        self.imports: dict[str, tuple[str, str | None]] = {}

    def need(self, module: str, name: str) -> None:
        """Take a definition, and whatever it uses, unless it is taken already."""
        found = self.modules.get(module) or self.modules.setdefault(module, _read_module(module))
        number = found.find(name)
        if number is None:
            if name not in found.imported:
                raise ValueError(f"{module} does not define {name}")
            self._need_imported(found, name)
            return
        if number in found.needed:
            return
        found.needed.add(number)
        statement = found.statements[number]
        for used in sorted(statement.used):
            self._need_used(found, used)
        for used in sorted(statement.annotated - statement.used):
            self._take_if_possible(found, used)

    def _need_used(self, module: Module, name: str) -> None:
        """Take what a name means in a module; names of Python itself and of arguments mean nothing there."""
        if module.find(name) is not None:
            self.need(module.name, name)
        elif name in module.imported:
            self._need_imported(module, name)

    def _take_if_possible(self, module: Module, name: str) -> None:
        """Take a name of an annotation with what it uses, or nothing of it."""
        before = {each: set(self.modules[each].needed) for each in self.modules}, dict(self.imports)
        try:
            self._need_used(module, name)
        except ValueError:
            needed, self.imports = before
            for each, found in self.modules.items():
                found.needed = needed.get(each, set())

    def _need_imported(self, module: Module, name: str) -> None:
        """Take what a module imports under a name."""
        source, original = self._resolve(module, name)
        dotted = source if original is None else f"{source}.{original}"
        if source.partition(".")[0] == PACKAGE and original is not None:
            self.need(source, original)
        elif source.partition(".")[0] in {*sys.stdlib_module_names, *ALLOWED}:
            if self.imports.setdefault(name, (source, original)) != (source, original):
                raise ValueError(f"{name} is imported from {source} and from {self.imports[name][0]}")
        else:
            raise ValueError(f"{module.name} needs {dotted}, which an exported folder does not have")

    def _resolve(self, module: Module, name: str) -> tuple[str, str | None]:
        """Where a name that a module imports comes from: what stands in for it, if something does."""
        source, original = module.imported[name]
        dotted = source if original is None else f"{source}.{original}"
        if dotted not in self.replaced:
            return source, original
        source, _, original = self.replaced[dotted].rpartition(".")
        return source, original

    def _order_modules(self) -> list[str]:
        """The modules, each after those whose names it uses while it is read."""
        order: list[str] = []

        def place(name: str) -> None:
            if name in order or name not in self.modules:
                return
            module = self.modules[name]
            at_once = {used for number in module.needed for used in module.statements[number].at_once}
            for used in sorted(at_once & module.imported.keys()):
                place(self._resolve(module, used)[0])
            order.append(name)

        for name in self.modules:
            place(name)
        return order

    def write(self, head: str, tail: str) -> str:
        """The file."""
        parts = [f'"""{head}"""', "from __future__ import annotations", self._write_imports()]
        owner: dict[str, str] = {}
        for name in self._order_modules():
            module = self.modules[name]
            parts.append(_write_headline(module))
            for number in sorted(module.needed):
                for defined in module.statements[number].defined:
                    if owner.setdefault(defined, name) != name:
                        raise ValueError(f"{name} and {owner[defined]} both define {defined}; rename one")
                parts.append(module.statements[number].text)
        text = "\n\n".join([*parts, tail])
        text = re.sub(r"\n\n(?=(?:@|class |def |# -----))", "\n\n\n", SHAPED.sub("np.ndarray", text)) + "\n"
        return text.replace(CONTENTS, _list_contents(text))

    def _write_imports(self) -> str:
        lines, joined = [], {}
        for name, (source, original) in self.imports.items():
            if original is None:
                lines.append(f"import {source}" + (f" as {name}" if name != source else ""))
            else:
                joined.setdefault(source, []).append(original if original == name else f"{original} as {name}")
        lines += [f"from {source} import {', '.join(sorted(names))}" for source, names in joined.items()]
        by_package = {external: [] for external in (False, True)}
        for line in sorted(lines):
            by_package[line.split()[1].partition(".")[0] in ALLOWED].append(line)
        return "\n\n".join("\n".join(group) for group in by_package.values() if group)


def _list_contents(text: str) -> str:
    """A line for each headline: where it is, once this list is in the file."""
    lines = text.splitlines()
    rule = f"# {'-' * (WIDTH - 2)}"
    found = [i for i in range(1, len(lines) - 1) if lines[i - 1] == lines[i + 1] == rule]
    return "\n".join(f"{i + len(found):6}  {lines[i][2:].partition(':')[0][: WIDTH - 8]}" for i in found)


def _write_headline(module: Module) -> str:
    """The comment above a module's definitions."""
    return f"# {'-' * (WIDTH - 2)}\n# {module.headline}\n# {'-' * (WIDTH - 2)}"


def _read_module(name: str) -> Module:
    """Part a module of the package into its statements."""
    spec = find_spec(name)
    assert spec is not None, name
    assert spec.origin is not None, name
    source = Path(spec.origin).read_text(encoding="utf-8")
    lines, tree = source.splitlines(), ast.parse(source)
    module = Module(name, (ast.get_docstring(tree) or name).splitlines()[0], [], {})
    end = 0
    for node in tree.body:
        first, last = _find_start(node, lines, end), node.end_lineno or node.lineno
        text, end = "\n".join(lines[first:last]).strip("\n"), last
        if isinstance(node, ast.Import | ast.ImportFrom):
            module.imported |= _list_imports(node)
        elif isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            for inner in node.body:
                if isinstance(inner, ast.Import | ast.ImportFrom):
                    module.imported |= _list_imports(inner)
        elif isinstance(node, ast.Expr):
            if isinstance(node.value, ast.Constant) and module.statements and node is not tree.body[0]:
                module.statements[-1].text += f"\n{text}"  # it documents the constant above
        else:
            defined = _list_defined(node)
            if "__all__" not in defined:
                used, annotated = _list_used(node)
                module.statements.append(Statement(text, defined, used, annotated, _list_at_once(node)))
    return module


def _find_start(node: ast.stmt, lines: list[str], end: int) -> int:
    """The first line of a statement, with its decorators and the comments right above it."""
    first = min([node.lineno, *(each.lineno for each in getattr(node, "decorator_list", []))]) - 1
    while first > end and lines[first - 1].startswith("#"):
        first -= 1
    return first


def _list_imports(node: ast.Import | ast.ImportFrom) -> dict[str, tuple[str, str | None]]:
    if isinstance(node, ast.Import):
        return {alias.asname or alias.name: (alias.name, None) for alias in node.names}
    assert node.module is not None, "imports are absolute"
    return {alias.asname or alias.name: (node.module, alias.name) for alias in node.names}


def _list_defined(node: ast.stmt) -> list[str]:
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return [node.name]
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    return [name.id for target in targets for name in ast.walk(target) if isinstance(name, ast.Name)]


def _list_at_once(node: ast.stmt) -> set[str]:
    """Names that are looked up while a statement is read: all but those in bodies of functions and in annotations."""
    if isinstance(node, ast.FunctionDef):
        parts = [*node.decorator_list, *node.args.defaults, *filter(None, node.args.kw_defaults)]
    elif isinstance(node, ast.ClassDef):
        parts = [*node.bases, *(keyword.value for keyword in node.keywords), *node.decorator_list]
        return {each.id for part in parts for each in ast.walk(part) if isinstance(each, ast.Name)}.union(
            *(_list_at_once(inner) for inner in node.body)
        )
    else:
        value = getattr(node, "value", None)
        parts = [] if value is None else [value]
    return {each.id for part in parts for each in ast.walk(part) if isinstance(each, ast.Name)}


def _list_used(node: ast.stmt) -> tuple[set[str], set[str]]:
    """Names that a statement uses when it runs, and names in its annotations."""
    annotations = [
        part
        for each in ast.walk(node)
        for part in (getattr(each, "annotation", None), getattr(each, "returns", None))
        if isinstance(part, ast.AST)
    ]
    annotated = [each for part in annotations for each in ast.walk(part)]
    within = {id(each) for each in annotated}
    names = [each for each in ast.walk(node) if isinstance(each, ast.Name)]
    used = {each.id for each in names if id(each) not in within}
    return used, {each.id for each in names if id(each) in within}
