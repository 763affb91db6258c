"""The `completesplat` command, which starts a verb and reports refusals in one line."""

import io
import os
import sys

VERBS = ("data", "plan", "fit", "test", "predict", "view", "export", "report", "new", "bench", "doctor")


def main() -> None:
    """Run the command.

    The exit status is 0 only if everything worked, 2 for a refused input, 130 after Ctrl-C, 1 for other failures.
    """
    try:
        try:
            _run()
        finally:
            if sys.stdout is not None:
                sys.stdout.flush()
    except OSError:
        _check_output()
        raise


def _check_output() -> None:
    """Exit with status 1 if standard output cannot be written, in silence if its reader (`head`, say) has closed it."""
    try:
        os.write(sys.stdout.fileno(), b"\n")  # fails if standard output was the reason
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # nothing more is written when Python ends
        if not isinstance(error, BrokenPipeError):
            _refuse(f"standard output: cannot be written: {error.strerror}")
        sys.exit(1)


def _run() -> None:
    # Paths may hold bytes that are not UTF-8. Standard error escapes them by default.
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    arguments = sys.argv[1:]
    try:
        os.getcwd()
    except FileNotFoundError:
        sys.exit(_refuse("the working folder was removed: go to another folder"))
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        return _help()
    if arguments[0] == "--version":
        from completesplat.version import __version__

        return print(f"completesplat {__version__}")
    if arguments[0] not in VERBS:
        from completesplat.settings.options import did_you_mean

        sys.exit(_refuse(f"no verb {arguments[0]!r}: there are {', '.join(VERBS)}{did_you_mean(arguments[0], VERBS)}"))

    from completesplat.commands import exit_status, launch, refusal

    try:
        launch(arguments[0], arguments[1:])
    except KeyboardInterrupt:
        sys.exit(130)
    except Exception as error:
        message = refusal(error)
        if message is None:
            raise
        sys.exit(_refuse(message, exit_status(error)))


def _help() -> None:
    """Print the verbs with their descriptions in `conf/`."""
    from completesplat.settings.help import describe

    print("usage: completesplat VERB [key=value ...]      completesplat VERB --help\n")
    for verb in VERBS:
        print(f"  {verb:9} {describe(verb)}")


def _refuse(message: str, status: int = 2) -> int:
    print(f"error: {message}", file=sys.stderr)
    return status
