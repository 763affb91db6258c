"""How large a model is."""

from typing import Any

from rich.table import Table
from torch import nn

from completesplat.reports.tables import table

COLUMNS = [("part", "part", ""), ("parameters, millions", "millions", ".2f"), ("of these trained", "trained", ".2f")]


def parameter_table(module: nn.Module) -> Table:
    """One line for each network of a module, and one for each part of a network that has several."""
    return table("Model", COLUMNS, parameter_rows(module))


def parameter_rows(module: nn.Module) -> list[dict[str, Any]]:
    """Names, and numbers of parameters in millions, of parts down to two levels; parts without any are left out."""
    rows = []
    for name, child in module.named_children():
        parts = [(f"  {part}", grandchild) for part, grandchild in child.named_children()]
        for label, network in [(name, child), *(parts if len(parts) > 1 else [])]:
            sizes = [(parameter.numel(), parameter.requires_grad) for parameter in network.parameters()]
            if sizes:
                millions, trained = sum(n for n, _ in sizes) / 1e6, sum(n for n, learns in sizes if learns) / 1e6
                rows.append({"part": label, "millions": millions, "trained": trained})
    return rows
