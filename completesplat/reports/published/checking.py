"""Whether the published figures were typed as the paper prints them."""

from completesplat.reports.published.figures import Figure, PublishedTable, published
from completesplat.reports.published.grid import environment, grid


def check(paper_text: str) -> list[str]:
    """All differences between the data file and the LaTeX of the paper; empty where there are none."""
    return [difference for table in published() for difference in differences(table, paper_text)]


def differences(table: PublishedTable, paper_text: str) -> list[str]:
    """Those of one table: headings, cells with their marks, and the phrases that it says."""
    found = environment(paper_text, table.label)
    if found is None:
        return [f"{table.name}: the paper has no table labelled {table.label}"]
    said = " ".join(found.split())
    wrong = [f"{table.name}: the paper does not say {phrase!r}" for phrase in table.says if phrase not in said]
    try:
        printed = grid(found, "PSNR")
    except ValueError as error:
        return [*wrong, f"{table.name}: {error}"]
    headings = [column.heading for column in table.columns]
    if headings != printed.headings:
        wrong.append(f"{table.name}: the headings are {headings}, the paper's {printed.headings}")
    if len(table.rows) != len(printed.rows):
        wrong.append(f"{table.name}: {len(table.rows)} rows, the paper has {len(printed.rows)}")
    for typed, row in zip(table.rows, printed.rows, strict=False):
        wrong += [f"{table.name}: {difference}" for difference in _row(typed, row, headings)]
    return wrong


def _row(typed: list[Figure], printed: list[Figure], headings: list[str]) -> list[str]:
    name = " / ".join(cell.text for cell in typed[:2])
    if len(typed) != len(printed):
        return [f"{name}: {len(typed)} cells, the paper has {len(printed)}"]
    return [
        f"{name}, {heading}: {_said(one)}, the paper prints {_said(other)}"
        for one, other, heading in zip(typed, printed, headings, strict=False)
        if one != other
    ]


def _said(cell: Figure) -> str:
    return " ".join([repr(cell.text), *sorted(cell.marks)])
