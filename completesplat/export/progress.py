"""Progress of work on many photos, as a bar on a terminal or as lines elsewhere."""

from rich.console import Console
from rich.markup import escape
from rich.progress import Progress


class PhotoProgress:
    """Progress bar over the steps of all photos, which prints a line for each step where there is no terminal.

    Args:
        photos: number of photos.
        steps: number of steps of each photo.
        bar: whether a bar may be shown; several processes would draw theirs over each other.
    """

    def __init__(self, photos: int, steps: int, bar: bool) -> None:
        console = Console()
        self.steps = steps
        self.bar = Progress(console=console, disable=not bar or not console.is_terminal)
        self.task = self.bar.add_task("", total=photos * steps)
        self.photo = ""

    def begin_photo(self, name: str) -> None:
        """Show the steps that follow with the name of this photo."""
        self.photo = name

    def begin(self, step: str, advance: int = 1) -> None:
        """Show which step of the photo begins, after which `advance` earlier steps have ended."""
        if self.bar.disable:
            print(f"{self.photo}: {step}", flush=True)
        self.bar.update(self.task, description=escape(f"{self.photo}: {step}"), advance=advance)

    def end_photo(self, number: int, summary: str | None) -> None:
        """Show that so many photos are done, with a line about this one, unless the bar says enough."""
        if self.bar.disable and summary is not None:
            print(summary, flush=True)
        self.bar.update(self.task, completed=number * self.steps)
