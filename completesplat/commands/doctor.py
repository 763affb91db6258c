"""`completesplat doctor`: what this machine has, what it lacks, and whether completing a photograph can work."""

import json
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any


def run(config: Any, out: Path) -> None:
    """Print the table and write `doctor.json`; exit status 1 if something is broken that a prediction needs."""
    from rich.console import Console

    findings = []
    with Console(stderr=True).status("looking") as status:
        for part, function, arguments in checks(Path.cwd()):
            status.update(f"looking at: {part}")
            findings += findings_of(part, function, arguments)
    broken = [finding for finding in findings if finding.state == "broken"]
    content = {"works": not broken, "findings": [vars(finding) for finding in findings]}
    (out / "doctor.json").write_text(json.dumps(content, indent=2) + "\n")
    show(findings)
    if broken:
        print("broken: " + "; ".join(f"{one.part}, {one.name}: {one.said}" for one in broken))
        print(out)
        sys.exit(1)
    print("Nothing that completing a photograph needs is broken.")


def checks(place: Path) -> list[tuple[str, str, tuple[Path, ...]]]:
    """Modules of `completesplat.reports.doctor`, the function of each, and its arguments."""
    from completesplat.commands import conf_folder

    return [
        ("packages", "check", ()),
        ("packages", "imports", ()),
        ("device", "check", ()),
        ("rendering", "check", ()),
        ("weights", "check", ()),
        ("data", "check", (conf_folder() / "data", place)),
        ("tools", "check", (place,)),
    ]


def findings_of(part: str, function: str, arguments: Sequence[Path]) -> list[Any]:
    """What one check finds. Its module is imported only now, and what it cannot import is a finding too."""
    from completesplat.reports.doctor.finding import Finding, one_line

    try:
        return getattr(import_module(f"completesplat.reports.doctor.{part}"), function)(*arguments)
    except Exception as error:  # of any library: the other parts are looked at all the same
        return [Finding(part, function, "broken", one_line(error))]


def show(findings: Sequence[Any]) -> None:
    """The table, with a rule between the parts."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    styles = {"yes": "green", "no": "yellow", "broken": "bold red"}
    table = Table(title="completesplat doctor", title_justify="left")
    for heading in ("part", "what", "here", "which, or why not"):
        table.add_column(heading, overflow="fold")
    last = None
    for finding in findings:
        if last not in (None, finding.part):
            table.add_section()
        state = Text(finding.state, style=styles[finding.state])
        table.add_row("" if finding.part == last else finding.part, Text(finding.name), state, Text(finding.said))
        last = finding.part
    Console(width=None if Console().is_terminal else 160).print(table)
