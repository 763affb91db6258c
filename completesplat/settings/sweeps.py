"""Values of the settings that a sweep runs over."""

from collections.abc import Sequence

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, Override

from completesplat.errors import CompleteSplatError
from completesplat.settings.options import options

SEARCH = "hparams_search"
"""Config group of searches for good settings."""


def swept_overrides(arguments: Sequence[str]) -> list[Override]:
    """Return the settings to which a command line gives several values (`seed=0,1`, `ablation=glob(*)`), in order."""
    overrides = [argument for argument in arguments if "=" in argument and not argument.startswith("-")]
    parsed = OverridesParser.create().parse_overrides(overrides)
    return [override for override in parsed if override.is_sweep_override()]


def starts_search(arguments: Sequence[str]) -> bool:
    """Return whether a search for good settings is chosen, which is a sweep also without `-m`."""
    return any(argument.startswith(f"{SEARCH}=") for argument in arguments)


def swept_values(arguments: Sequence[str]) -> dict[str, list[str]] | None:
    """Return the values of each swept setting as texts, by its name, or None if a sweeper has to choose them."""
    values: dict[str, list[str]] = {}
    for override in swept_overrides(arguments):
        pattern = override.value()
        if isinstance(pattern, Glob):
            values[override.key_or_group] = pattern.filter(options(override.key_or_group))
        elif override.is_discrete_sweep():
            values[override.key_or_group] = list(map(str, override.sweep_string_iterator()))
        else:
            return None
    return values


def check_sweep(arguments: Sequence[str]) -> None:
    """Raise CompleteSplatError if a swept setting has no value at all, so that a sweep would have no job.

    Options in Hydra's own groups and in `--config-dir` are not known here.
    """
    further_options = any(argument.startswith("--config-dir") for argument in arguments)
    for override in swept_overrides(arguments):
        values = swept_values([str(override.input_line)])
        if values is None or values[override.key_or_group]:
            continue
        known = options(override.key_or_group)
        if isinstance(override.value(), Glob) and (further_options or not known):
            continue
        advice = f"; there are {', '.join(known)}" if known else ""
        raise CompleteSplatError(f"{override.input_line}: stands for no value, so there is no job{advice}")
