"""A report as values, and its two written forms: one HTML file, and Markdown with figures.

The HTML page needs nothing but itself: no script, no font, no image lies outside, and its
content security policy says so to the browser. All text is escaped in both forms, since names
of entries and sets may come from uploaded files.
"""

from __future__ import annotations

import base64
import html
import re
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Literal
from urllib.parse import quote

from jinja2 import Environment, StrictUndefined

from trajectron_model.checkpoint import write_atomically

_TEMPLATE = "page.html.jinja"
_FIGURES = "figures"
_PLAIN = " /=:(),;.!-_*+?@$[]{}|^`~"  # needs no escape, neither in an address nor in HTML
# Characters that neither XML nor a terminal should ever see.
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff]")
_MARKDOWN = re.compile(r"([\\`*_\[\]|~#$])")


@dataclass(frozen=True)
class Figure:
    """One figure of a cell.

    Attributes:
        text: as shown.
        interval: its 95% interval, in small print; empty for none.
        best: whether it is the best of its column.
    """

    text: str
    interval: str = ""
    best: bool = False


Cell = tuple[Figure, ...]
"""The figures of one cell of a table, such as ADE and FDE; shown with a stroke between."""


def cell(text: str) -> Cell:
    """A cell of plain text."""
    return (Figure(text),)


@dataclass(frozen=True)
class Table:
    """A table; the first column holds names, the others figures.

    Attributes:
        caption: above it: what is measured, its unit, and which way is better.
        header: of each column.
        rows: as many cells each as the header has.
        note: below it, small.
        muted: rows that are shown and not ranked, by index: in sample, or published elsewhere.
    """

    caption: str
    header: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""
    muted: frozenset[int] = frozenset()

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.header):
                raise ValueError(
                    f"{self.caption}: {len(row)} cells in a row, {len(self.header)} in the header"
                )


@dataclass(frozen=True)
class Picture:
    """A figure.

    Attributes:
        name: of its file, without the suffix: lower-case letters, digits and dashes.
        caption: below it.
        content: the file.
        kind: its format.
    """

    name: str
    caption: str
    content: bytes
    kind: Literal["svg", "png"] = "svg"

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[a-z0-9-]+", self.name):
            raise ValueError(f"{self.name!r} is no name for a figure's file")

    @property
    def file(self) -> str:
        """The name of its file."""
        return f"{self.name}.{self.kind}"

    @property
    def data_uri(self) -> str:
        """The whole figure as an address; drawings stay nearly as short as they are."""
        if self.kind == "svg":
            return f"data:image/svg+xml,{quote(self.content, safe=_PLAIN)}"
        return f"data:image/png;base64,{base64.b64encode(self.content).decode('ascii')}"


@dataclass(frozen=True)
class Section:
    """A part of a report.

    Attributes:
        title: of the section.
        paragraphs: above its contents.
        contents: tables and figures in their order.
        warning: set apart, where a reader could be misled without it.
    """

    title: str
    paragraphs: tuple[str, ...] = ()
    contents: tuple[Table | Picture, ...] = ()
    warning: str = ""


@dataclass(frozen=True)
class Document:
    """A report.

    Attributes:
        title: of the page.
        lead: what it is about, in a paragraph or two.
        facts: short names and values, such as the protocol and its counts.
        sections: in their order.
    """

    title: str
    lead: tuple[str, ...]
    facts: Mapping[str, str]
    sections: tuple[Section, ...]

    def to_html(self) -> str:
        """One self-contained page."""
        environment = Environment(
            autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
        )
        environment.filters["clean"] = clean
        environment.tests["table"] = lambda content: isinstance(content, Table)
        source = resources.files(__package__).joinpath(_TEMPLATE).read_text(encoding="utf-8")
        return environment.from_string(source).render(document=self, anchor=_anchor)

    def to_markdown(self, figures: str = _FIGURES) -> str:
        """The same in Markdown.

        Args:
            figures: the folder of the figures, as seen from the text.
        """
        lines = [f"# {_markdown(self.title)}", "", *_paragraphs(self.lead)]
        lines += [f"- **{_markdown(name)}:** {_markdown(value)}"
                  for name, value in self.facts.items()]  # fmt: skip
        for section in self.sections:
            lines += ["", f"## {_markdown(section.title)}", ""]
            if section.warning:
                lines += [f"> **Warning.** {_markdown(section.warning)}", ""]
            lines += _paragraphs(section.paragraphs)
            for content in section.contents:
                lines += _content(content, figures)
        return "\n".join(lines).rstrip() + "\n"

    def write(self, folder: Path) -> None:
        """Writes ``report.html``, ``report.md`` and ``figures/``, each whole or not at all.

        Figures of an earlier report in the same folder go.
        """
        folder.mkdir(parents=True, exist_ok=True)
        pictures = [
            content
            for section in self.sections
            for content in section.contents
            if isinstance(content, Picture)
        ]
        files = [picture.file for picture in pictures]
        if len(set(files)) < len(files):
            raise ValueError("two figures have the same name")
        fresh = Path(tempfile.mkdtemp(prefix=f".{_FIGURES}-", dir=folder))
        try:
            fresh.chmod(0o755)
            for picture in pictures:
                (fresh / picture.file).write_bytes(picture.content)
            shutil.rmtree(folder / _FIGURES, ignore_errors=True)
            fresh.replace(folder / _FIGURES)
        finally:
            shutil.rmtree(fresh, ignore_errors=True)
        write_atomically(folder / "report.md", self.to_markdown().encode())
        write_atomically(folder / "report.html", self.to_html().encode())


def clean(text: str) -> str:
    """The text without control characters and lone surrogates, which no page may hold."""
    return _CONTROL.sub("\N{REPLACEMENT CHARACTER}", text)


def _anchor(title: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")


def _markdown(text: str) -> str:
    """Text that Markdown shows as it is."""
    plain = html.escape(re.sub(r"\s+", " ", clean(text)), quote=False)
    return _MARKDOWN.sub(r"\\\1", plain)


def _paragraphs(paragraphs: Sequence[str]) -> list[str]:
    return [line for paragraph in paragraphs for line in (_markdown(paragraph), "")]


def _content(content: Table | Picture, figures: str) -> list[str]:
    if isinstance(content, Picture):
        alternative = html.escape(clean(content.caption), quote=True)
        image = f'<img src="{figures}/{content.file}" alt="{alternative}">'
        return [image, "", f"*{_markdown(content.caption)}*", ""]
    lines = [f"**{_markdown(content.caption)}**", ""]
    lines.append("| " + " | ".join(_markdown(cell) for cell in content.header) + " |")
    lines.append("| --- |" + " ---: |" * (len(content.header) - 1))
    for index, row in enumerate(content.rows):
        lines.append("| " + " | ".join(_cell(c, index in content.muted) for c in row) + " |")
    lines.append("")
    return [*lines, _markdown(content.note), ""] if content.note else lines


def _cell(cell: Cell, muted: bool) -> str:
    texts = []
    for figure in cell:
        mark = "**" if figure.best else "*" if muted else ""
        texts.append(f"{mark}{_markdown(figure.text)}{mark}" if figure.text else "")
    intervals = " / ".join(_markdown(figure.interval) for figure in cell if figure.interval)
    small = f" <sub>{intervals}</sub>" if intervals else ""
    return " / ".join(texts) + small
