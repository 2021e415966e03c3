"""The experiment log: one record a line in the `*.jsonl` files beside this one; README.md explains the keys.

The site shows all of them in one table (`docs/site/hooks.py`).
"""

import datetime
import html
import json
import re
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
KEYS = ("id", "date", "commit", "title", "command", "hardware", "seeds", "metrics", "verdict", "tags", "notes")


def files() -> list[str]:
    """Names of the files, without suffix."""
    return sorted(path.stem for path in HERE.glob("*.jsonl"))


def load(name: str) -> list[dict[str, Any]]:
    """The records of one file.

    Raises:
      ValueError: a record breaks the schema; names the file and the line.
    """
    records = []
    for line, text in enumerate((HERE / f"{name}.jsonl").read_text(encoding="utf-8").splitlines(), 1):
        record = json.loads(text)
        if problem := check(record):
            raise ValueError(f"{name}.jsonl:{line}: {problem}")
        records.append(record)
    return records


def check(record: dict[str, Any]) -> str | None:
    """What breaks the schema in a record, or None."""
    if tuple(record) != KEYS:
        return f"expected the keys {list(KEYS)}, got {list(record)}"
    if not re.fullmatch(r"[a-z0-9][a-z0-9.-]*", record["id"]):
        return f"id {record['id']!r}: only a-z, 0-9, '.' and '-' are allowed"
    try:
        datetime.date.fromisoformat(record["date"])
    except ValueError:
        return f"date {record['date']!r} is not ISO 8601"
    for key in ("commit", "title", "command", "hardware", "verdict", "notes"):
        if not isinstance(record[key], str):
            return f"{key} is not text"
    if record["commit"] and not re.fullmatch(r"[0-9a-f]{7}( \(.+\))?", record["commit"]):
        return f"commit {record['commit']!r} is not seven digits, with a remark in brackets"
    if not (record["title"] and record["command"] and record["verdict"]):
        return "title, command or verdict is empty"
    if not all(isinstance(seed, int) for seed in record["seeds"]):
        return "seeds are not integers"
    for name, value in record["metrics"].items():
        if not all(isinstance(v, (int, float, str)) for v in (value if isinstance(value, list) else [value])):
            return f"metric {name} is neither a number, nor text, nor a list of them"
        if name.endswith("_ci95") and not isinstance(value, str) and len(value) != 2:
            return f"metric {name} is no interval"
    return None


def table() -> str:
    """All records as one HTML table with a filter; a record's id is its row's anchor."""
    rows = []
    for name in files():
        for record in load(name):
            metrics = ", ".join(f"{key} {_plain(value)}" for key, value in record["metrics"].items())
            how = "; ".join(filter(None, (record["command"], record["hardware"], record["notes"])))
            cells = (name, record["date"], record["commit"], record["title"], record["verdict"], metrics, how)
            texts = "".join(f"<td>{html.escape(cell)}</td>" for cell in cells)
            rows.append(f'<tr id="{record["id"]}"><td><code>{record["id"]}</code></td>{texts}</tr>')
    heads = ("record", "file", "date", "commit", "title", "verdict", "metrics", "command, hardware, notes")
    head = "".join(f"<th>{cell}</th>" for cell in heads)
    return (
        '<input id="filter" type="search" placeholder="Filter: all words must occur" style="width: 100%">\n'
        f'<table id="records" data-search-exclude><thead><tr>{head}</tr></thead>\n'
        f"<tbody>{''.join(rows)}</tbody></table>\n"
        f"<script>{_FILTER}</script>"
    )


_FILTER = (
    "document.getElementById('filter').addEventListener('input', event => {"
    "const words = event.target.value.toLowerCase().split(' ');"
    "for (const row of document.querySelectorAll('#records tbody tr')) {"
    "const text = row.textContent.toLowerCase();"
    "row.hidden = !words.every(word => text.includes(word)); } });"
)


def _plain(value: Any) -> str:
    return f"[{', '.join(map(str, value))}]" if isinstance(value, list) else str(value)
