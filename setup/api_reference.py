# SPDX-License-Identifier: GPL-3.0-or-later
"""API reference of ``import physgen`` as Markdown, from signatures and docstrings.

MkDocs calls ``on_page_markdown`` as a hook (mkdocs.yml) and puts the reference in the place of the marker in
docs/api.md. ``python setup/api_reference.py`` prints it.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
import sys
import textwrap
from typing import Any

MARKER = "<!-- reference -->"


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """``markdown`` of one page with the reference in the place of the marker."""
    return markdown.replace(MARKER, reference()) if page.file.src_uri == "api.md" else markdown


def reference() -> str:
    """Markdown of all public names of the package, functions first."""
    import physgen

    names = getattr(physgen, "__all__", ())
    functions, classes, constants = [], [], []
    for name in names:
        value = getattr(physgen, name)
        if inspect.isclass(value):
            classes.append(_class(name, value))
        elif callable(value):
            functions.append(_function(f"physgen.{name}", value))
        else:
            constants.append(f"### `physgen.{name}`\n\n`{value!r}`\n")
    parts = []
    for title, found in (("Functions", functions), ("Classes", classes), ("Constants", constants)):
        if found:
            parts.append(f"## {title}\n\n" + "\n".join(found))
    return "\n".join(parts)


def _class(name: str, kind: type) -> str:
    lines = [f"### `class physgen.{name}`\n"]
    bases = [base.__name__ for base in kind.__bases__ if base is not object]
    if bases:
        lines.append(f"Base: {', '.join(f'`{base}`' for base in bases)}\n")
    lines.append(markdown_of(inspect.getdoc(kind) if kind.__doc__ else ""))
    if dataclasses.is_dataclass(kind):
        shown = [f for f in dataclasses.fields(kind) if not f.name.startswith("_")]
        if shown:
            lines.append("| field | type | default |\n| --- | --- | --- |")
            lines += [f"| `{f.name}` | `{_plain(f.type)}` | {_field_default(f)} |" for f in shown]
            lines.append("")
    for member, value in vars(kind).items():
        if member.startswith("_"):
            continue
        if isinstance(value, property):
            doc = inspect.getdoc(value) or ""
            returns = _plain(inspect.signature(value.fget).return_annotation) if value.fget else ""
            lines.append(f"#### `{name}.{member}`{f' → `{returns}`' if returns else ''}\n\n{markdown_of(doc)}")
        elif isinstance(value, classmethod | staticmethod) or inspect.isfunction(value):
            lines.append(_function(f"{name}.{member}", getattr(kind, member), level=4))
    return "\n".join(lines)


def _function(name: str, function: Any, level: int = 3) -> str:
    signature = inspect.signature(function)
    shown = [p for p in signature.parameters.values() if p.name not in ("self", "cls")]
    lines, star = [], False
    for parameter in shown:
        if parameter.kind is parameter.KEYWORD_ONLY and not star:
            lines.append("*")
            star = True
        prefix = {parameter.VAR_POSITIONAL: "*", parameter.VAR_KEYWORD: "**"}.get(parameter.kind, "")
        star = star or parameter.kind is parameter.VAR_POSITIONAL
        text = prefix + parameter.name
        if parameter.annotation is not parameter.empty:
            text += f": {_plain(parameter.annotation)}"
        if parameter.default is not parameter.empty:
            text += f" = {_default(parameter.default)}"
        lines.append(text)
    returns = "" if signature.return_annotation is signature.empty else f" -> {_plain(signature.return_annotation)}"
    short = f"{name}({', '.join(lines)}){returns}"
    if len(short) > 88:
        short = f"{name}(\n    " + ",\n    ".join(lines) + f",\n){returns}"
    doc = markdown_of(inspect.getdoc(function) or "")
    return f"{'#' * level} `{name}`\n\n```python\n{short}\n```\n\n{doc}"


def _plain(annotation: Any) -> str:
    text = annotation if isinstance(annotation, str) else getattr(annotation, "__name__", str(annotation))
    return re.sub(r"\b(?:[a-z_]+\.)+(?=[A-Z])", "", text)


def _field_default(field: dataclasses.Field[Any]) -> str:
    value = field.default
    if field.default_factory is not dataclasses.MISSING:
        value = field.default_factory()
    text = "" if value is dataclasses.MISSING else repr(value)
    return f"`{text}`" if text and len(text) < 40 else "…" if text else ""


def _default(value: Any) -> str:
    text = repr(value)
    return text if not text.startswith("<") else "…"


def markdown_of(doc: str) -> str:
    """Markdown of a docstring: ``x`` as code, indented or ``>>>`` blocks as code, "name: text" lines as lists."""
    blocks: list[str] = []
    for block in re.split(r"\n\s*\n", doc.strip("\n")):
        lines = block.split("\n")
        code = all(line.startswith("    ") for line in lines) or lines[0].lstrip().startswith(">>>")
        if code:
            text = _without_prompts(textwrap.dedent(block))
            if blocks and blocks[-1].startswith("```"):
                blocks[-1] = blocks[-1].removesuffix("\n```") + f"\n\n{text}\n```"
            else:
                blocks.append(f"```python\n{text}\n```")
            continue
        heading, rest = lines[0], lines[1:]
        if rest and all(line.startswith("    ") for line in rest) and heading.rstrip().endswith(":"):
            blocks.append(_inline(heading))
            blocks.append(_items(textwrap.dedent("\n".join(rest)).split("\n")))
        else:
            blocks.append(_items(lines))
    return "\n\n".join(blocks) + "\n"


def _items(lines: list[str]) -> str:
    """A list of the lines "name: text" (continued by indented ones); other lines as they are."""
    if not any(re.match(r"[\w, *]{1,40}: \S", line) for line in lines):
        return _inline("\n".join(lines))
    found = []
    for line in lines:
        match = re.match(r"([a-z_][\w, *]{0,40}): (\S.*)", line)
        if match:
            names = ", ".join(f"`{name.strip()}`" for name in match[1].split(","))
            found.append(f"- {names}: {match[2]}")
        elif found and found[-1].startswith("- "):
            found[-1] += " " + line.strip()
        else:
            found.append(line)
    text, before = "", ""
    for line in found:
        text += ("\n" if line.startswith("- ") and not before.startswith("- ") and before else "") + line + "\n"
        before = line
    return _inline(text.rstrip("\n"))


def _without_prompts(text: str) -> str:
    """Return a doctest as plain code, its outputs as comments."""
    if ">>>" not in text:
        return text
    lines = []
    for line in text.splitlines():
        code = re.match(r"(?:>>>|\.\.\.)(?: (.*))?$", line)
        lines.append(re.sub(r"\s*# doctest:.*", "", code[1] or "") if code else f"# {line}")
    return "\n".join(lines)


def _inline(text: str) -> str:
    return re.sub(r"``(.+?)``", r"`\1`", text)


if __name__ == "__main__":
    sys.stdout.write(reference())
