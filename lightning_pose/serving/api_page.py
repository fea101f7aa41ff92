"""The OpenAPI description as a page without scripts, which needs no other server."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import Any

__all__ = ["render_api_page"]

PAGE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>{title}: addresses</title>
<link rel="stylesheet" href="page.css">
<link rel="icon" href="icon.svg">
<main>
<h1>{title} {version}</h1>
<p>{summary} The same as <a href="openapi.json">openapi.json</a>; <a href="./">try it</a>.</p>
{operations}
</main>
</html>
"""

Spec = Mapping[str, Any]


def render_api_page(spec: Spec) -> str:
    """HTML that lists each address of an OpenAPI description with its request and its answers."""
    info = spec["info"]
    operations = [
        _render_operation(method, path, operation)
        for path, methods in spec["paths"].items()
        for method, operation in methods.items()
    ]
    return PAGE.format(
        title=escape(info["title"]),
        version=escape(info["version"]),
        summary=escape(info.get("summary", "")),
        operations="\n".join(operations),
    )


def _render_operation(method: str, path: str, operation: Spec) -> str:
    parts = [
        f"<h2><code>{escape(method.upper())} {escape(path)}</code></h2>",
        f"<p>{escape(operation['summary'])}.</p>",
    ]
    if operation.get("parameters"):
        rows = [(f"?{entry['name']}=", entry["description"]) for entry in operation["parameters"]]
        parts.append(_render_table("Query", rows))
    for kind, content in operation.get("requestBody", {}).get("content", {}).items():
        parts.append(_render_table(f"Body: {kind}", _list_fields(content["schema"])))
    for status, answer in operation["responses"].items():
        if status == "200":
            (content,) = answer["content"].values()
            parts.append(_render_table(f"200: {answer['description']}", _list_fields(content["schema"])))
    errors = [(status, answer["description"]) for status, answer in operation["responses"].items() if status != "200"]
    parts.append(_render_table("Errors", errors))
    return "\n".join(parts)


def _list_fields(schema: Spec) -> list[tuple[str, str]]:
    """Names and descriptions of a schema's properties, or of the schema itself."""
    fields = schema.get("properties", {} if schema["type"] == "object" else {"the whole body": schema})
    return [(name, field.get("description") or str(field.get("type", ""))) for name, field in fields.items()]


def _render_table(title: str, rows: list[tuple[str, str]]) -> str:
    cells = "".join(f"<tr><th><code>{escape(name)}</code><td>{escape(text)}" for name, text in rows)
    return f"<h3>{escape(title)}</h3>\n<table>{cells}</table>" if rows else f"<h3>{escape(title)}</h3>"
