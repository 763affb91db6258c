"""The figures that the paper publishes, and their check against the paper's LaTeX."""

from completesplat.reports.published.checking import check

__all__ = ["check"]
