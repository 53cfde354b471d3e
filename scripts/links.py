"""Checks the links of the documentation: every relative target and heading must exist.

Links to other sites are not fetched, so that the check needs no network; only their
form is looked at. Usage: ``links.py [ROOT]``, this repository by default.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote, urlparse

ROOT = Path(__file__).resolve().parent.parent
_FENCE = re.compile(r"^(```|~~~).*?^\1", re.MULTILINE | re.DOTALL)
_CODE = re.compile(r"`[^`\n]*`")
_LINK = re.compile(r"!?\[(?:[^\[\]]|\[[^\]]*\])*\]\(\s*<?([^)\s>]+)>?(?:\s+\"[^\"]*\")?\s*\)")
_HTML = re.compile(r"<(?:img|a|source)\b[^>]*?\b(?:src|href)=\"([^\"]+)\"")
_HEADING = re.compile(r"^#{1,6}\s+(.*?)\s*#*$", re.MULTILINE)


def documents(root: Path) -> list[Path]:
    """The Markdown files that git tracks or would track."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", "*.md"]
    listed = subprocess.run(command, cwd=root, check=True, capture_output=True, text=True)
    names = {name for name in listed.stdout.split("\0") if name}
    return sorted(root / name for name in names if (root / name).is_file())


def anchors(text: str) -> set[str]:
    """The fragments that headings of ``text`` answer to, as hosting sites make them."""
    found: dict[str, int] = {}
    result = set()
    for heading in _HEADING.findall(_FENCE.sub("", text)):
        slug = re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-")
        seen = found.get(slug, 0)
        found[slug] = seen + 1
        result.add(f"{slug}-{seen}" if seen else slug)
    return result


def links(text: str) -> Iterator[str]:
    """The targets of the links of ``text``, code left out."""
    prose = _CODE.sub("", _FENCE.sub("", text))
    yield from _LINK.findall(prose)
    yield from _HTML.findall(prose)


def fault(document: Path, target: str) -> str | None:
    """What is wrong with one link of ``document``; None when nothing is."""
    parts = urlparse(target)
    if parts.scheme in ("http", "https"):
        return None if parts.netloc else "has no host"
    if parts.scheme:
        return None if parts.scheme == "mailto" else f"has the unknown scheme {parts.scheme}"
    path = document.parent / unquote(parts.path) if parts.path else document
    if not path.exists():
        return "does not exist"
    if parts.fragment and path.suffix == ".md":
        known = anchors(path.read_text(encoding="utf-8"))
        return None if parts.fragment in known else "names no heading"
    return None


def main() -> int:
    """Prints each broken link as ``FILE: target reason``; returns the exit status."""
    root = Path(sys.argv[1]).resolve() if len(sys.argv) > 1 else ROOT
    faults = [
        f"{document.relative_to(root)}: {target} {reason}"
        for document in documents(root)
        for target in links(document.read_text(encoding="utf-8"))
        if (reason := fault(document, target))
    ]
    print("\n".join(faults) or "links: fine", file=sys.stderr if faults else sys.stdout)
    return 1 if faults else 0


if __name__ == "__main__":
    raise SystemExit(main())
