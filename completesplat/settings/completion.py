"""Completion of command lines in shells, which call `completesplat --complete WORDS` at each press of the tab key."""

from collections.abc import Collection, Sequence

from completesplat.settings.options import (
    TASKS,
    choices_of_verb,
    options,
    read,
    settings_of_option,
    settings_of_verb,
)

BASH = r"""# eval "$(completesplat completion bash)"   in ~/.bashrc
_completesplat() {
    local line=${COMP_LINE:0:COMP_POINT} current
    local -a words
    read -ra words <<< "$line"
    [[ $line == *[[:space:]] ]] && words+=("")
    current=${words[${#words[@]}-1]}
    local IFS=$'\n'
    COMPREPLY=($("${words[0]}" --complete "${words[@]:1}" 2>/dev/null))
    # bash completes what follows the last =.
    if [[ $current == *=* && $COMP_WORDBREAKS == *=* ]]; then
        COMPREPLY=("${COMPREPLY[@]#"${current%%=*}="}")
    elif [[ ${#COMPREPLY[@]} -eq 1 && ${COMPREPLY[0]} == *= ]]; then
        compopt -o nospace 2>/dev/null
    fi
}
complete -o default -F _completesplat completesplat
"""
ZSH = r"""#compdef completesplat
# eval "$(completesplat completion zsh)"   in ~/.zshrc, below compinit
_completesplat() {
    local -a matches
    matches=("${(@f)$("${words[1]}" --complete "${(@)words[2,CURRENT]}" 2>/dev/null)}")
    matches=(${matches:#})
    if (( ${#matches} )); then
        compadd -S '' -- "${matches[@]}"
    else
        compset -P '*='
        _files
    fi
}
compdef _completesplat completesplat
"""
FISH = r"""# completesplat completion fish | source   in ~/.config/fish/config.fish
function __completesplat
    set -l words (commandline -opc) (commandline -ct)
    $words[1] --complete $words[2..-1] 2>/dev/null
end
complete -c completesplat -a '(__completesplat)'
"""
SCRIPTS = {"bash": BASH, "zsh": ZSH, "fish": FISH}
SWITCHES = ("true", "false")


def candidates(words: Sequence[str], verbs: Collection[str]) -> list[str]:
    """Return completions of the last word behind `completesplat`; an empty list if it may be anything."""
    if len(words) < 2:
        completions = [*verbs, "completion"]
    elif words[0] == "completion":
        completions = list(SCRIPTS)
    elif words[0] in verbs:
        completions = _behind_verb(words[0], words[1:])
    else:
        completions = []
    return [completion for completion in completions if completion.startswith(words[-1] if words else "")]


def _behind_verb(verb: str, words: Sequence[str]) -> list[str]:
    tasks = options(f"{verb}_task") if verb in TASKS else []
    task = None
    if tasks:
        task = next(choice.option for choice in read(verb).choices if choice.group == f"{verb}_task")
        task = words[0] if words[0] in tasks and len(words) > 1 else task
    chosen = {choice.place: (choice.group, choice.option) for choice in choices_of_verb(verb, task)}
    for word in words[:-1]:
        place, _, option = word.partition("=")
        if place in chosen and option in options(chosen[place][0]):
            chosen[place] = (chosen[place][0], option)
    settings = {setting.key: setting.value for setting in settings_of_verb(verb, task)}
    for place, (group, option) in chosen.items():
        if option in options(group) and group not in ("experiment", "ablation"):
            inner = settings_of_option(group, option, None if place == group else place)
            settings |= {entry.key: entry.value for entry in inner if not entry.key.rpartition(".")[2].startswith("_")}
    key, equals, _ = words[-1].partition("=")
    if equals:
        values = options(chosen[key][0]) if key in chosen else SWITCHES if settings.get(key) in SWITCHES else ()
        return [f"{key}={value}" for value in values]
    keys = [f"{name}=" for name in [*settings, *chosen]]
    # Nested keys are offered once their dots, or three characters, are typed.
    near = [name for name in keys if name.count(".") <= max(key.count("."), 0) or len(key) > 2]
    return [*(tasks if len(words) == 1 else []), *near, "--help"]
