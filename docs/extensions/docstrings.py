"""Docstrings are written to be read in an editor; here their tables and indented formulas become reStructuredText."""

import re

SECTION = re.compile(r"^\s*(Args|Attributes|Returns|Raises|Yields|Source):")
FIELD = re.compile(r"^\w+(, \w+)*: \S")
RULE = re.compile(r"^\s*\|[\s:|-]+\|\s*$")


def as_rest(app, what, name, obj, options, lines):
    """A hook of autodoc; changes the lines in place."""
    lines[:] = literal(tables(fields(lines)))


def fields(lines: list[str]) -> list[str]:
    """Paragraphs of ``name: what it is`` before the first section as attributes; bars outside of code and tables as
    they stand."""
    found, listed, before = [], False, True
    for line in lines:
        before = before and not SECTION.match(line)
        starts = not found or not found[-1].strip()
        if before and starts and FIELD.match(line):
            found += ["Attributes:"]
            listed = True
        listed = listed and before and bool(line.strip())
        if not line.strip().startswith("|"):
            line = with_bars(line)
        found.append(f"    {line}" if listed else line)
    return found


def with_bars(line: str) -> str:
    """The line with ``|`` outside of code escaped: there it would be a substitution."""
    parts = re.split(r"(`+[^`]*`+)", line)
    return "".join(part if k % 2 else part.replace("|", r"\|") for k, part in enumerate(parts))


def tables(lines: list[str]) -> list[str]:
    """Tables with ``|`` as list tables."""
    found, rows = [], []
    for line in [*lines, ""]:
        if line.strip().startswith("|") and line.strip().endswith("|"):
            rows.append(line)
            continue
        found += _table(rows)
        rows = []
        found.append(line)
    return found[:-1]


def _table(rows: list[str]) -> list[str]:
    if len(rows) < 2 or not RULE.match(rows[1]):
        return rows
    indent = " " * (len(rows[0]) - len(rows[0].lstrip()))
    made = ["", f"{indent}.. list-table::", f"{indent}   :header-rows: 1", ""]
    for row in (rows[0], *rows[2:]):
        cells = [cell.strip().replace("\\|", "|") for cell in re.split(r"(?<!\\)\|", row.strip()[1:-1])]
        made += [f"{indent}   {'*' if k == 0 else ' '} - {cell}" for k, cell in enumerate(cells)]
    return [*made, ""]


def literal(lines: list[str]) -> list[str]:
    """Indented paragraphs before the first section, formulas and programs, as literal blocks."""
    found, inside = [], False
    for i, line in enumerate(lines):
        if SECTION.match(line):
            return [*found, *lines[i:]]
        indented = line.startswith("    ") and not line.lstrip().startswith((".. list-table", "* -", "- ", ":header"))
        if indented and not inside and (not found or not found[-1].strip()):
            found += ["::", ""]
            inside = True
        elif line.strip() and not line.startswith(" "):
            if inside and found[-1].strip():
                found.append("")
            inside = False
        found.append(line)
    return found
