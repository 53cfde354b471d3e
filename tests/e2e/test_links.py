"""The checker of the documentation's links finds what is broken, and only that."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "links.py"

OTHER = """# Two Words, really
## Code: `x.y` & more
```sh
# not a heading
```
"""


def check(folder: Path, text: str) -> subprocess.CompletedProcess[str]:
    subprocess.run(["git", "init", "--quiet", str(folder)], check=True)
    (folder / "other.md").write_text(OTHER, encoding="utf-8")
    (folder / "doc.md").write_text(text, encoding="utf-8")
    command = [sys.executable, str(SCRIPT), str(folder)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    "text",
    [
        "[a](other.md)",
        "[a](other.md#two-words-really) [b](other.md#code-xy--more)",
        "# Here\n[a](#here)",
        "![a picture](other.md)",
        '[a](other.md "title") and [b [c]](other.md)',
        "[a](https://example.org/x) <img src='x'>",
        "`[a](gone.md)` is code\n```\n[a](gone.md)\n```\n",
    ],
)
def test_sound_links_pass(tmp_path: Path, text: str) -> None:
    result = check(tmp_path, text)
    assert result.returncode == 0, result.stderr


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("[a](gone.md)", "doc.md: gone.md does not exist"),
        ("[a](other.md#three)", "doc.md: other.md#three names no heading"),
        ("[a](other.md#not-a-heading)", "names no heading"),
        ("[a](#nowhere)", "doc.md: #nowhere names no heading"),
        ('<img src="gone.png">', "doc.md: gone.png does not exist"),
        ("[a](https:///x)", "has no host"),
        ("[a](ftp://example.org)", "unknown scheme"),
    ],
)
def test_broken_links_are_named(tmp_path: Path, text: str, fault: str) -> None:
    result = check(tmp_path, text)
    assert result.returncode == 1
    assert fault in result.stderr
