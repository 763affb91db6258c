"""Options and settings in `conf/` with their comments, for help texts and refusals.

A comment above a key or behind its value explains the key; the first comment of a file explains the file.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from difflib import get_close_matches
from functools import cache
from itertools import takewhile
from pathlib import Path
from typing import NamedTuple

import yaml

LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
NAMED = re.compile(r"^\| (`[^|]*`) \| ([^|]*) \|$", re.MULTILINE)
PACKAGE = "# @package "
TASKS = ("data", "bench", "report")  # verbs with several tasks: `data toy` is short for `data data_task=toy`
LEAST_LIKE = 0.7
REFERRING = re.compile(r"\._\w+_=|=\$\{\w+\}$")  # `_target_` and the like, or a reference to a part


class Setting(NamedTuple):
    """A key in a file of `conf/`, with its value as written there and its comment."""

    key: str
    value: str
    comment: str


class GroupDefault(NamedTuple):
    """An entry of a file's defaults list: a config group, the place of its settings, and the default option."""

    group: str
    place: str
    option: str
    comment: str


class ConfFile(NamedTuple):
    """Contents of a file of `conf/`; `package` is the place of its settings, if the file names one."""

    about: str
    package: str | None
    settings: list[Setting]
    choices: list[GroupDefault]
    bases: list[str]
    """Files from which it inherits settings."""


def conf_folder() -> Path:
    """Return the folder of configs, inside an installed package or beside the package in the repository."""
    package = Path(__file__).parents[1]
    return package / "conf" if (package / "conf").is_dir() else package.parent / "conf"


def folders() -> list[Path]:
    """Return the folders of configs: the package's, and `conf` in the working folder if it exists."""
    return [conf_folder(), *(folder for folder in [Path.cwd() / "conf"] if folder.is_dir())]


def groups() -> list[str]:
    return sorted({path.name for folder in folders() for path in folder.iterdir() if path.is_dir()})


def options(group: str) -> list[str]:
    return sorted({file.stem for folder in folders() for file in (folder / group).glob("[!_]*.yaml")})


def about_groups() -> dict[str, str]:
    """Return a description of each group, from the table in `conf/README.md`."""
    text = (conf_folder() / "README.md").read_text(encoding="utf-8")
    return {name: about for names, about in NAMED.findall(text) for name in re.findall(r"`(\w+)`", names)}


def read_conf_file(name: str) -> ConfFile:
    """Read a file of `conf/` by its name without suffix (`data/toy_objects`); raise FileNotFoundError if missing."""
    for folder in folders():
        if (folder / f"{name}.yaml").is_file():
            return parse((folder / f"{name}.yaml").read_text(encoding="utf-8"))
    raise FileNotFoundError(name)


@cache
def parse(text: str) -> ConfFile:
    """Parse the text of a file."""
    lines = text.splitlines()
    head = list(takewhile(lambda line: line.startswith("#"), lines))
    packages = [line.removeprefix(PACKAGE).strip() for line in head if line.startswith(PACKAGE)]
    about = "\n".join(line[1:].removeprefix(" ") for line in head if not line.startswith(PACKAGE))

    def comment(node: yaml.Node) -> str:
        number = node.start_mark.line
        above = takewhile(lambda line: line.lstrip().startswith("#"), lines[len(head) : number][::-1])
        behind = lines[number][node.start_mark.column :].partition(" #")[2]
        return " ".join(filter(None, [*(line.strip()[1:].strip() for line in [*above][::-1]), behind.strip()]))

    root = yaml.compose(text, Loader=LOADER) or yaml.compose("{}", Loader=LOADER)  # an empty file has no root
    entries = {key.value: value for key, value in root.value}
    choices = []
    bases = []
    for entry in entries["defaults"].value if "defaults" in entries else []:
        if isinstance(entry, yaml.MappingNode):
            ((name, option),) = entry.value
            group, _, place = name.value.removeprefix("override ").removeprefix("/").partition("@")
            choices.append(GroupDefault(group, place or group, option.value, comment(entry)))
        elif entry.value != "_self_":
            bases.append(entry.value)
    settings = [setting for setting in _settings(root, text, comment) if not setting.key.startswith("defaults")]
    return ConfFile(about, packages[0] if packages else None, settings, choices, bases)


def _settings(parent: yaml.MappingNode, text: str, comment: Callable[[yaml.Node], str]) -> Iterator[Setting]:
    for key, node in parent.value:
        if isinstance(node, yaml.MappingNode) and not node.flow_style:
            yield from (inner._replace(key=f"{key.value}.{inner.key}") for inner in _settings(node, text, comment))
            continue
        block = isinstance(node, yaml.SequenceNode) and not node.flow_style
        value = "" if block else text[node.start_mark.index : node.end_mark.index]
        yield Setting(key.value, " ".join(value.split()), comment(key))


def own_settings(written: ConfFile, without: tuple[str, ...] = ()) -> Iterator[Setting]:
    """Yield a file's settings that have values, in its order, except those below the keys in `without`."""
    keys = {setting.key for setting in written.settings}
    for setting in written.settings:
        inner = any(key.startswith(f"{setting.key}.") for key in keys)
        hydras = setting.key.rpartition(".")[2].startswith("_") and without
        if not inner and not hydras and setting.key.partition(".")[0] not in without:
            yield setting


def settings_of_option(group: str, option: str, place: str | None = None) -> list[Setting]:
    """Return all settings of an option, also inherited ones, with keys below `place` (by default, its package)."""
    written = with_bases(group, option)
    where = place if place is not None else written.package or group.replace("/", ".")
    prefix = "" if where in ("", "_global_") else f"{where}."
    return [setting._replace(key=prefix + setting.key) for setting in own_settings(written)]


def settings_of_verb(verb: str, task: str | None = None) -> list[Setting]:
    """Return a verb's own settings: its output folder, those in its file, and those of its task."""
    without = ("hydra", "verb", "description", "task")
    settings = [*own_settings(with_bases("", verb), without)]
    settings += [] if task is None else own_settings(with_bases(f"{verb}_task", task), without)
    return list({setting.key: setting for setting in settings}.values())


def search_settings(verb: str, task: str | None, words: Sequence[str]) -> list[tuple[Setting, list[Setting], str]]:
    """Return settings with all the words, those with the words in their names first.

    Each entry has the settings of its part, and ends with its option, unless that is the default.
    """
    entries = [(setting, list[Setting](), "") for setting in settings_of_verb(verb, task)]
    for group, place, default, _ in choices_of_verb(verb, task):
        for option in sorted(options(group), key=lambda name: name != default):
            if with_bases(group, option).package != "_global_":  # else it sets what others define
                part = settings_of_option(group, option, None if place == group else place)
                entries += [(setting, part, "" if option == default else f" ({place}={option})") for setting in part]
    once = {entry[0].key: entry for entry in entries[::-1] if not REFERRING.search(f"{entry[0].key}={entry[0].value}")}
    patterns = [re.compile(rf"(?<![^\W_]){re.escape(word).replace('_', '[_ ]')}", re.IGNORECASE) for word in words]
    results = [e for e in reversed(once.values()) if all(x.search(f"{e[0].key}: {e[0].comment}") for x in patterns)]
    return sorted(results, key=lambda entry: not all(x.search(entry[0].key) for x in patterns))


def with_bases(group: str, option: str) -> ConfFile:
    """Return an option's file, or a verb's in the group "", with the settings and choices that it inherits."""
    written = read_conf_file(f"{group}/{option}".lstrip("/"))
    inherited = [with_bases(group, base) for base in written.bases]
    choices = [choice for entry in inherited for choice in entry.choices] + written.choices
    settings: dict[str, Setting] = {}
    for entry in (entry for base in [*inherited, written] for entry in base.settings):
        settings[entry.key] = entry._replace(comment=entry.comment or settings.get(entry.key, entry).comment)
    return written._replace(settings=list(settings.values()), choices=choices)


def choices_of_verb(verb: str, task: str | None = None) -> list[GroupDefault]:
    """Return the config groups of a verb and its task with their default options, without the group of tasks."""
    choices = [choice for choice in with_bases("", verb).choices if choice.group != f"{verb}_task"]
    return choices + ([] if task is None else with_bases(f"{verb}_task", task).choices)


def did_you_mean(name: str, names: Iterable[str]) -> str:
    """Return an ending for a message about an unknown name: the nearest of `names`, or nothing if none is near."""
    nearest = get_close_matches(name, list(names), cutoff=LEAST_LIKE)
    return f"; did you mean {' or '.join(nearest)}?" if nearest else ""
