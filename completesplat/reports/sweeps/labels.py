"""What a job is called: by that in which it differs from the others."""

from collections.abc import Callable, Sequence

from completesplat.reports.sweeps.jobs import Job

SEED = "seed"
PROPOSED = "full"
"""The unchanged method among the ablations: the last row, as in the paper."""


def labels(jobs: Sequence[Job]) -> Callable[[Job], str]:
    """Names jobs by the overrides that are not equal in all of them, the seed apart.

    The choice of a config group is named by its value alone (`no_skips`), any other setting as `key=value`. A job that
    differs in nothing bears the name of its experiment, or `all`.
    """
    described = [job.overrides for job in jobs if job.overrides]
    keys = dict.fromkeys(key for overrides in described for key in overrides)
    differing = [key for key in keys if len({overrides.get(key) for overrides in described}) > 1]
    # A group fills a mapping of the configuration, or acts on all of it and leaves nothing under its own name.
    settings = {key for job in jobs for key, value in job.config.items() if not isinstance(value, dict)}

    def label(job: Job) -> str:
        parts = []
        for key in differing:
            if key in job.overrides and key != SEED:
                bare = "." not in key and "@" not in key and key not in settings
                parts.append(job.overrides[key] if bare else f"{key}={job.overrides[key]}")
        return ", ".join(parts) or job.overrides.get("experiment", "all")

    return label


def setting(job: Job) -> frozenset[tuple[str, str]]:
    """What jobs share that differ in nothing but the seed."""
    return frozenset((key, value) for key, value in job.overrides.items() if key != SEED)


def order(label: str) -> list[tuple[bool, str]]:
    """A key that sorts labels alphabetically, part by part, the unchanged method last."""
    return [(part == PROPOSED, part) for part in label.split(", ")]
