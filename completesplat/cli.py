"""The `completesplat` command, which starts a verb and reports refusals in one line."""

import io
import os
import sys

VERBS = {
    "data": "make, check, look at, import and prepare data sets",
    "fit": "train a model, one stage at a time",
    "test": "score a trained model on held-out scenes",
    "predict": "draw complete scenes from photographs (predict photo.jpg [more.jpg ...])",
    "view": "a page in the browser: look at scenes, draw new ones from a photograph (view PATH)",
    "report": "tables beside the paper's (report runs=DIR), a page with all (report html), samplers, ... (report NAME)",
    "new": "start a part of your own in this folder: loss, rasterizer, dataset, ablation or experiment (new loss NAME)",
    "bench": "time what takes time (bench rasterizers, bench data, bench startup, ...)",
    "doctor": "what this machine has and lacks, and whether completing a photograph can work",
}
USAGE = "usage: completesplat VERB [key=value ...]      completesplat VERB --help\n\n" + "\n".join(
    f"  {verb:9} {description}" for verb, description in VERBS.items()
)
USAGE += "\n\ncompletesplat completion bash|zsh|fish prints what makes that shell complete verbs, groups and settings"


def main() -> None:
    """Run the command; exit with status 0 only if everything worked, 2 for a refused input, 1 for other failures."""
    # Paths may hold bytes that are not UTF-8. Standard error escapes them by default.
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    arguments = sys.argv[1:]
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(USAGE)
        return
    if arguments[0] == "--version":
        from completesplat import __version__

        print(f"completesplat {__version__}")
        return
    try:
        os.getcwd()
    except FileNotFoundError:
        sys.exit(_refuse("the working folder was removed: go to another folder"))
    if arguments[0] in ("--complete", "completion"):
        return _complete(arguments[1:], script=arguments[0] == "completion")
    if arguments[0] not in VERBS:
        from completesplat.settings.options import did_you_mean

        sys.exit(_refuse(f"no verb {arguments[0]!r}: there are {', '.join(VERBS)}{did_you_mean(arguments[0], VERBS)}"))

    # This must be set before torch is loaded. By default its idle threads (GNU OpenMP's) spin for milliseconds and
    # so keep the rasterizer's threads and other processes off the cores.
    os.environ.setdefault("GOMP_SPINCOUNT", "3000")
    from completesplat.commands import exit_status, launch, refusal

    try:
        launch(arguments[0], arguments[1:])
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:  # whoever read the output (`head`, say) has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except Exception as error:
        message = refusal(error)
        if message is None:
            raise
        sys.exit(_refuse(message, exit_status(error)))


def _complete(words: list[str], script: bool) -> None:
    """Print completions of the last word, or the script with which a shell asks for them."""
    from completesplat.settings.options import SCRIPTS, candidates

    if not script:
        return print("\n".join(candidates(words, VERBS)))
    if len(words) != 1 or words[0] not in SCRIPTS:
        sys.exit(_refuse(f"name a shell: completesplat completion {'|'.join(SCRIPTS)}"))
    return print(SCRIPTS[words[0]], end="")


def _refuse(message: str, status: int = 2) -> int:
    print(f"error: {message}", file=sys.stderr)
    return status
