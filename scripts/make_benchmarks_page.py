"""Makes docs/benchmarks.md from what `pgsd bench` and `pgsd verify` wrote, so that the page says only what a run printed.

pgsd bench --json docs/figures/bench.json
pgsd verify --json docs/figures/verify.json
python scripts/make_benchmarks_page.py
"""

from __future__ import annotations

from itertools import groupby
from pathlib import Path

from pgsd_nerfstudio.laboratory.records import Record, figure, read_records, split_source, verdict

DOCS = Path(__file__).resolve().parent.parent / "docs"
LONG = 60  # rows from which a table is folded away
HEAD = """# Figures

Made by `scripts/make_benchmarks_page.py` from the JSON files in `docs/figures/`; edit none of it by hand. Each heading is the
command that prints the rows below it again. An error stands beside every speed that was paid for with one. "-" in the last
column: nothing was promised, or it cannot be measured on the machine (the reason stands under "where from").
"""


def page(files: list[Path]) -> str:
    """The whole page from files of records, each with the remarks in the .md of its name, if there is one."""
    parts = [HEAD]
    for path in files:
        for run, group in groupby(read_records(path), key=lambda row: split_source(row.source)[1]):
            command, _, machine = run.partition(" on ")
            rows_here = list(group)
            body = table(rows_here)
            if len(rows_here) > LONG:
                body = f"<details><summary>{len(rows_here)} rows</summary>\n\n{body}\n</details>\n"
            parts.append(f"## `{command}`\n\n{machine}\n\n{body}")
        remarks = path.with_suffix(".md")
        if remarks.exists():
            parts.append(remarks.read_text())
    return "\n".join(parts)


def table(rows: list[Record]) -> str:
    """Rows as a Markdown table."""
    lines = ["| figure | value | error | target | holds | where from |", "|---|--:|--:|--:|---|---|"]
    for row in rows:
        error = figure(row.error, row.error_unit)
        target = f"{row.target} {row.unit}".strip() if row.target else "-"
        cells = (row.name, figure(row.value, row.unit), error, target, verdict(row), split_source(row.source)[0] or "-")
        lines.append("| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    out = DOCS / "benchmarks.md"
    out.write_text(page(sorted((DOCS / "figures").glob("*.json"))))
    print(out)
