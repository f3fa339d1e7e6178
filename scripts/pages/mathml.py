"""A hook of mkdocs: equations become MathML, which browsers draw by themselves, without script and network."""

from __future__ import annotations

import html
import re
from typing import Any

from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError

_EQUATION = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)


def on_page_content(text: str, **_: Any) -> str:
    """The HTML of a page, its equations converted."""
    return _EQUATION.sub(_converted, text)


def _converted(found: re.Match[str]) -> str:
    tag, latex = found.groups()
    mathml = convert(html.unescape(latex), display="block" if tag == "div" else "inline")
    if "\\" in mathml:  # what the converter does not know it leaves as it is
        raise PluginError(f"not all of this equation can be drawn: {html.unescape(latex)}")
    return f'<div class="equation">{mathml}</div>' if tag == "div" else mathml
