"""The list of metrics in ``docs/metrics.md``, written from the registry itself.

python scripts/metrics_page.py            # writes the list anew
python scripts/metrics_page.py --check    # says whether it is current
"""

from __future__ import annotations

import sys
from pathlib import Path

from prometheus_client import Metric
from prometheus_client.metrics import MetricWrapperBase

from trajectron_service.metrics import Metrics

PAGE = Path(__file__).parents[1] / "docs" / "metrics.md"
BEGIN, END = "<!-- metrics: begin -->\n", "<!-- metrics: end -->\n"


def main() -> None:
    """See the module."""
    page = PAGE.read_text(encoding="utf-8")
    current = with_table(page)
    if "--check" in sys.argv[1:]:
        if page != current:
            sys.exit("docs/metrics.md: the list of metrics is not current; run this script")
        return
    PAGE.write_text(current, encoding="utf-8")


def with_table(page: str) -> str:
    """The page with its list as the registry has it."""
    before, rest = page.split(BEGIN)
    _, after = rest.split(END)
    return f"{before}{BEGIN}{table()}{END}{after}"


def table() -> str:
    """Every metric of ours by name: type, labels, meaning."""
    rows = ["| metric | type | labels | what |", "| --- | --- | --- | --- |"]
    for name, kind, labels, meaning in sorted(map(_row, instruments())):
        shown = ", ".join(f"`{label}`" for label in labels)
        rows.append(f"| `{name}` | {kind} | {shown} | {meaning} |")
    return "\n".join(rows) + "\n"


def instruments() -> list[MetricWrapperBase]:
    """Those of ours on a new registry; what the client library brings is left out."""
    found = Metrics().registry._collector_to_names  # noqa: SLF001  there is no other way to ask
    return [one for one in found if isinstance(one, MetricWrapperBase)]


def _row(instrument: MetricWrapperBase) -> tuple[str, str, tuple[str, ...], str]:
    family: Metric = next(iter(instrument.describe()))
    total = "_total" if family.type == "counter" else ""
    labels = tuple(instrument._labelnames)  # noqa: SLF001  as above
    return family.name + total, family.type, labels, family.documentation


if __name__ == "__main__":
    main()
