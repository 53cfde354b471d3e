"""Asks OSV whether an exact version that `make` installs has a known weakness.

    python scripts/audit.py

Exits 1 when one has. Where the database cannot be reached it says so and exits 0: nobody should
be unable to work on a train; CI runs with a network.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import httpx

CONSTRAINTS = Path(__file__).parents[1] / "constraints.txt"
DATABASE = "https://api.osv.dev/v1/querybatch"
_TIMEOUT_S = 10.0


def main() -> int:
    """Prints what was found."""
    pinned = pins(CONSTRAINTS.read_text(encoding="utf-8"))
    queries = [
        {"package": {"ecosystem": "PyPI", "name": name}, "version": version}
        for name, version in pinned
    ]
    try:
        answer = httpx.post(DATABASE, json={"queries": queries}, timeout=_TIMEOUT_S)
        answer.raise_for_status()
        results = answer.json()["results"]
    except (httpx.HTTPError, ValueError, KeyError) as error:
        sys.stdout.write(f"audit: could not ask the database, nothing is known: {error}\n")
        return 0
    found = weaknesses(pinned, results)
    for line in found:
        sys.stdout.write(f"{line}\n")
    sys.stdout.write(f"audit: {len(pinned)} packages, {len(found)} with known weaknesses\n")
    return 1 if found else 0


def pins(text: str) -> list[tuple[str, str]]:
    """Names and versions of lines ``name==version``."""
    lines = (line.split("#")[0].strip() for line in text.splitlines())
    pairs = (line.partition("==") for line in lines if "==" in line)
    return [(name.strip(), version.strip()) for name, _, version in pairs]


def weaknesses(pinned: list[tuple[str, str]], results: list[dict[str, Any]]) -> list[str]:
    """A line for each package that has any, with their identifiers."""
    return [
        f"{name} {version}: {', '.join(one['id'] for one in result['vulns'])}"
        for (name, version), result in zip(pinned, results, strict=True)
        if result.get("vulns")
    ]


if __name__ == "__main__":
    sys.exit(main())
